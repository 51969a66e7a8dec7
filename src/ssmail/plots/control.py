"""The arms of a control side by side: `ssmail plot control`.

It is drawn as `ssmail.plots.ablation` draws the values of a key: a panel for each metric, a column for each arm. Each
arm is compared with the first one by an exact two-sided rank test of the runs' values, in which a diverged run has the
worst error there is. The p-values stand in the table and the notes, uncorrected for the number of arms and metrics.

Runs are found by the spec hashes of the arms, so those that `ssmail train` or an ablation made are drawn too.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime

import numpy as np
import pandas as pd

from ssmail.config.controls import Arm, Control, arm_specs
from ssmail.config.controls import control as read_control
from ssmail.config.experiments_file import load_experiments
from ssmail.errors import InputError, command_line
from ssmail.evaluation.hypothesis_tests import two_sided
from ssmail.evaluation.statistics import Statistic
from ssmail.plots import NoRuns
from ssmail.plots.ablation import AblationRecord, Panel, collect_panel
from ssmail.plots.formatting import as_file_name, listed, number, spans
from ssmail.plots.provenance import Provenance
from ssmail.plots.run_groups import Group, Selection, check_one_data_set, grouped, newest_of_each_seed, settings_of
from ssmail.store import RunRow, Store

NAME = "control"
ARM = "arm"  # the column of the table, and the label of the axis


@dataclass(frozen=True, eq=False)
class ControlRecord:
    """Everything that the figure shows."""

    control: str
    question: str
    arms: tuple[str, ...]  # all of them; the first is what the others are compared with
    columns: AblationRecord  # of the arms that have runs
    stem: str
    lacking: tuple[str, ...]  # metrics that none of the runs has

    @property
    def provenance(self) -> Provenance:
        """See FigureRecord."""
        return self.columns.provenance

    @property
    def caption(self) -> str:
        """What the figure shows, in a few sentences that a paper could use."""
        groups = [column.group for column in self.columns.panels[0].columns]
        seeds = {group.label: spans([run.seed for run in group.runs]) for group in groups}
        alike = len(set(seeds.values())) == 1
        told = seeds[groups[0].label] if alike else ", ".join(f"{own} of {arm}" for arm, own in seeds.items())
        metrics = listed((panel.metric for panel in self.columns.panels), "and")
        lacking = f" No runs yet of {listed(self.without_runs, 'and')}." if self.without_runs else ""
        return (
            f"Control {self.control}: {self.question} {metrics} of each arm (profile {self.columns.settings}). Points "
            f"are single runs, seeds {told}; beside them {self.columns.statistic.words}.{lacking}"
        )

    @property
    def without_runs(self) -> list[str]:
        """The arms that have no runs."""
        drawn = [column.group.label for column in self.columns.panels[0].columns]
        return [arm for arm in self.arms if arm not in drawn]

    @property
    def notes(self) -> tuple[str, ...]:
        """Which arms have no runs, which metrics are not stored, and how each arm compares with the first one."""
        notes = [f"no runs yet of {listed(self.without_runs, 'and')}."] if self.without_runs else []
        notes += [f"{metric} is stored by none of these runs, so it is not drawn." for metric in self.lacking]
        for panel in self.columns.panels:
            values = {arm: p for arm, p in self.p_values(panel).items() if not np.isnan(p)}
            if values:
                told = ", ".join(f"{arm} {number(p, 2)}" for arm, p in values.items())
                notes.append(f"{panel.metric} against {self.arms[0]}, two-sided p: {told}.")
        return (*self.columns.notes, *notes)

    def p_values(self, panel: Panel) -> dict[str, float]:
        """Return p of each drawn arm but the first; NaN where a value of the two arms is unknown."""
        values = {column.group.label: column.values for column in panel.columns}
        first = values.pop(self.arms[0], np.array([np.nan]))
        return {
            arm: np.nan if np.isnan(first).any() or np.isnan(own).any() else two_sided(first, own)
            for arm, own in values.items()
        }

    def table(self) -> pd.DataFrame:
        """[metric, kind, arm, run_id, seed, value, low, high, p] as of an ablation; p is that of an arm's centre."""
        table = self.columns.table()
        p = {(panel.metric, arm): p for panel in self.columns.panels for arm, p in self.p_values(panel).items()}
        is_centre = table["kind"] == self.columns.statistic.centre
        places = zip(table["metric"], table[ARM], is_centre, strict=True)
        return table.assign(p=[p.get((metric, arm), np.nan) if centre else np.nan for metric, arm, centre in places])


def select(
    store: Store, name: str, profile: str | None = None, overrides: Sequence[str] = ()
) -> tuple[Control, Selection]:
    """Return a control, and the settled runs of its arms, of each seed the newest.

    By default they are of the profile with the most runs, the newest on a tie. overrides: those that the runs were
    trained with. Raises NoRuns where no arm has runs, and InputError as `arm_specs` does, and for runs on different
    data.
    """
    found, runs = read_control(name), [run for run in store.runs() if run.state.settled]
    choices, refused = [], None
    for candidate in [profile] if profile else load_experiments().profiles:
        try:
            specs = arm_specs(name, candidate, overrides)
        except InputError as error:  # two arms are the same in this profile, or no profile takes these overrides
            refused = error
            continue
        groups = _groups({arm: spec.hash() for arm, spec in specs.items()}, runs)
        if groups:
            choices.append(groups)
    if not choices and refused and (profile or overrides):
        raise refused
    if not choices:
        words = ("--profile", profile) if profile else ()
        command = command_line("ssmail", "control", name, *words, *(w for text in overrides for w in ("--set", text)))
        raise NoRuns(f"no run of the control {name} is stored in {store.where}; train some with `{command}`.")
    chosen = max(choices, key=_rank)
    drawn = [run for group in chosen for run in group.runs]
    for alike in grouped(drawn, lambda run: repr((run.environment, sorted(run.spec["data"].items(), key=str)))):
        check_one_data_set(NAME, alike)
    return found, Selection(tuple(chosen), ())


def collect(
    store: Store,
    found: Control,
    selection: Selection,
    metrics: Sequence[str] | None = None,
    statistic: Statistic = Statistic.MEDIAN_IQR,
) -> ControlRecord:
    """Collect `metrics`, or those of the control that are stored, of the runs that `select` chose.

    Raises InputError for a metric of `metrics` that none of the runs has.
    """
    panels, lacking = [], []
    for metric in dict.fromkeys(metrics or found.metrics):
        try:
            panels.append(collect_panel(store, selection.groups, metric, statistic))
        except InputError:
            if metrics or (not panels and metric == found.metrics[-1]):
                raise
            lacking.append(metric)
    arms, shown = [arm.name for arm in found.arms], [panel.metric for panel in panels]
    options = {
        "control": found.name,
        "question": found.question,
        "arms": arms,
        "metrics": shown,
        "statistic": statistic,
    }
    columns = AblationRecord(
        keys=(ARM,),
        panels=tuple(panels),
        statistic=statistic,
        settings=settings_of(selection.runs),
        provenance=Provenance.of(NAME, selection.runs, curves=selection.curves, options=options),
        notes=(),
    )
    stem = "_".join(map(as_file_name, (NAME, found.name, *(metrics or ()))))[:100]
    return ControlRecord(found.name, found.question, tuple(arms), columns, stem, tuple(lacking))


def collect_again(store: Store, source: Provenance, statistic: Statistic) -> ControlRecord:
    """Collect what a figure of this provenance shows. Raises InputError if it does not tell what that is."""
    arms, metrics = source.options.get("arms"), source.options.get("metrics")
    if not isinstance(arms, list) or not isinstance(metrics, list) or not arms or not metrics:
        raise InputError("it does not tell which metrics of which arms it shows")
    runs = {run.id: run for run in store.runs(ids=source.run_ids)}
    arm_of = {run.id: run.curve for run in source.runs}
    groups = tuple(
        _group(arm, [runs[run] for run, own in arm_of.items() if own == arm]) for arm in dict.fromkeys(arm_of.values())
    )
    found = Control("", (), "", "", tuple(map(str, metrics)), tuple(Arm(str(arm), "", "") for arm in arms))
    return collect(store, found, Selection(groups, ()), found.metrics, statistic)


def _groups(hashes: Mapping[str, str], runs: Sequence[RunRow]) -> list[Group]:
    """Return a group for each arm that has runs (newest last)."""
    own = {arm: newest_of_each_seed([run for run in runs if run.spec_hash == found]) for arm, found in hashes.items()}
    return [_group(arm, found) for arm, found in own.items() if found]


def _group(arm: str, runs: Sequence[RunRow]) -> Group:
    return Group(arm, tuple(runs), (arm,))


def _rank(groups: Sequence[Group]) -> tuple[int, datetime]:
    runs = [run for group in groups for run in group.runs]
    return len(runs), max(run.started for run in runs)
