"""The contents of a report: judged claims, compared runs on other data, drawn figures, and all runs behind them."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import cached_property
from pathlib import Path
from types import MappingProxyType
from typing import Any

from ssmail.paper.claims import Part, Sample, Verdict
from ssmail.paper.judgement import Judgement
from ssmail.paper.report.drawing import Drawn
from ssmail.plots.data_sets import DataSet
from ssmail.store import RunRow, Store
from ssmail.store.comparison import Comparison, compare_runs, spec_differences


@dataclass(frozen=True)
class Table:
    """The runs on one data set: a row for each spec, which has a Comparison for each metric."""

    data: str
    metrics: tuple[str, ...]
    rows: tuple[tuple[Comparison, ...], ...]


@dataclass(frozen=True)
class Report:
    """Everything on the pages, in their order. `written` is in UTC."""

    database: str
    command: str  # that produces this report, including its runs
    written: datetime
    judgements: tuple[Judgement, ...]  # none in a report on other data than the paper's
    tables: tuple[Table, ...]
    figures: tuple[Drawn, ...]
    runs: tuple[RunRow, ...]  # by environment, method, spec and seed
    differs: Mapping[str, Mapping[str, Any]]  # by spec hash: see spec_differences
    unfinished: tuple[str, ...]  # one line for each requested run that did not finish

    @property
    def verdicts(self) -> Counter[Verdict]:
        """The number of claims with each verdict."""
        return Counter(found.verdict for found in self.judgements)

    @property
    def last(self) -> datetime:
        """When the last run ended, or last sent a heartbeat."""
        return max(run.finished or run.heartbeat for run in self.runs)

    @cached_property
    def specs(self) -> dict[str, RunRow]:
        """One run for each spec, by spec hash, in the order of the runs."""
        specs: dict[str, RunRow] = {}
        for run in self.runs:
            specs.setdefault(run.spec_hash, run)
        return specs


def gather(
    store: Store,
    figures: Sequence[Drawn],
    judgements: Sequence[Judgement],
    command: str,
    unfinished: Sequence[str] = (),
    data: Sequence[DataSet] = (),
    metrics: Mapping[str, Sequence[str]] = MappingProxyType({}),
) -> Report:
    """Return the report on these figures and judgements, with all of their runs.

    The runs of each set of `data` are compared by those of the `metrics` of its environment that any of them has.
    """
    wanted = {run.id for each in data for run in each.runs}
    wanted |= {run for found in judgements for run in found.runs}
    wanted |= {run for drawn in figures if drawn.provenance for run in drawn.provenance.run_ids}
    runs = sorted(
        (run for run in store.runs() if run.id in wanted),
        key=lambda run: (run.environment, run.method, run.spec_hash, run.seed, run.started),
    )
    return Report(
        database=_nearby(store.where),
        command=command,
        written=datetime.now(UTC),
        judgements=tuple(judgements),
        tables=tuple(_compared(store, each, metrics[each.environment]) for each in data),
        figures=tuple(figures),
        runs=tuple(runs),
        differs=spec_differences(runs),
        unfinished=tuple(unfinished),
    )


def _compared(store: Store, data: DataSet, metrics: Sequence[str]) -> Table:
    found = compare_runs(store, data.runs, metrics)
    known = tuple(name for name in metrics if any(item.known for item in found if item.metric == name))
    specs = dict.fromkeys(item.spec_hash for item in found)
    rows = (tuple(item for item in found if item.spec_hash == spec and item.metric in known) for spec in specs)
    return Table(data.name, known, tuple(rows))


def _nearby(where: str) -> str:
    """Make a path inside the working folder relative, because a report is read on other machines too."""
    path = Path(where)
    return str(path.relative_to(Path.cwd())) if path.is_relative_to(Path.cwd()) else where


def samples_of(found: Judgement) -> list[tuple[Part, Sample]]:
    """Return the samples of a claim, each once, with a part that states their statistic."""
    seen: dict[tuple[str, str], tuple[Part, Sample]] = {}
    for part in found.decision.every_part:
        for sample in part.samples:
            seen.setdefault((part.statistic, sample.label), (part, sample))
    return list(seen.values())
