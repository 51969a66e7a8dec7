"""What a report holds: the claims as judged, the figures as drawn, and every run behind either of them."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import cached_property
from pathlib import Path
from typing import Any

from ssmail.paper.claims import Part, Sample, Verdict
from ssmail.paper.judgement import Judgement
from ssmail.paper.report.drawing import Drawn
from ssmail.store import RunRow, Store
from ssmail.store.comparison import spec_differences


@dataclass(frozen=True)
class Report:
    """Everything that is written, in the order of the pages. `written` is in UTC."""

    database: str
    command: str  # that makes this report, the runs included
    written: datetime
    judgements: tuple[Judgement, ...]
    figures: tuple[Drawn, ...]
    runs: tuple[RunRow, ...]  # by environment, method, spec and seed
    differs: Mapping[str, Mapping[str, Any]]  # by spec hash: in what specs of a method and an environment differ
    unfinished: tuple[str, ...]  # a line for each run that was wanted and did not finish

    @property
    def verdicts(self) -> Counter[Verdict]:
        """How many claims got each verdict."""
        return Counter(found.verdict for found in self.judgements)

    @property
    def states(self) -> Counter[str]:
        """How many runs are in each state."""
        return Counter(run.state.value for run in self.runs)

    @property
    def seconds(self) -> float:
        """What all runs took, one after the other."""
        return sum(run.wall_seconds for run in self.runs)

    @property
    def first(self) -> datetime:
        """When the first run began."""
        return min(run.started for run in self.runs)

    @property
    def last(self) -> datetime:
        """When the last run ended, or gave its last sign of life."""
        return max(run.finished or run.heartbeat for run in self.runs)

    @cached_property
    def specs(self) -> dict[str, RunRow]:
        """A run for each spec, by hash, in the order of the runs."""
        specs: dict[str, RunRow] = {}
        for run in self.runs:
            specs.setdefault(run.spec_hash, run)
        return specs

    @cached_property
    def by_id(self) -> dict[str, RunRow]:
        """Every run by its full id."""
        return {run.id: run for run in self.runs}


def gather(
    store: Store,
    figures: Sequence[Drawn],
    judgements: Sequence[Judgement],
    command: str,
    unfinished: Sequence[str] = (),
) -> Report:
    """The report of these figures and judgements, with all of their runs."""
    wanted = {run for found in judgements for run in found.runs}
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
        figures=tuple(figures),
        runs=tuple(runs),
        differs=spec_differences(runs),
        unfinished=tuple(unfinished),
    )


def _nearby(where: str) -> str:
    """The path from the working folder, if it lies in it; a report is read on other machines, too."""
    path = Path(where)
    return str(path.relative_to(Path.cwd())) if path.is_relative_to(Path.cwd()) else where


def samples_of(found: Judgement) -> list[tuple[Part, Sample]]:
    """The samples of a claim, each once, with a part whose statistic they are values of."""
    seen: dict[tuple[str, str], tuple[Part, Sample]] = {}
    for part in found.decision.parts:
        for sample in part.samples:
            seen.setdefault((part.statistic, sample.label), (part, sample))
    return list(seen.values())
