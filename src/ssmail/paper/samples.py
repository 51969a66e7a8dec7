"""The runs that decide a claim or stand beside it, and samples of one number per run.

Each sample states what a diverged run counts as: WORST for an error, LEAST for a quantity that should be large, and
otherwise whatever speaks against the claim. A finished run counts as diverged when a value that its number is computed
from is not finite, so that there is no number. A finished run that did not store such a value is unknown (NaN).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from ssmail.config.controls import arm_specs
from ssmail.data.trajectories import Floats
from ssmail.errors import InputError, command_line
from ssmail.paper.claims import Sample
from ssmail.plots import NoRuns
from ssmail.plots.formatting import spans
from ssmail.plots.metric_units import is_error
from ssmail.plots.run_groups import Group, Selection, newest_of_each_seed
from ssmail.plots.series import fullest_spec, select, train_command
from ssmail.store import RunRow, RunState, Store
from ssmail.store.comparison import known_values

Array = npt.NDArray[Any]

WORST, LEAST = np.inf, -np.inf  # what a diverged run counts as
PARTS = 5  # the first and the last fifth of the epochs are the beginning and the end of training


@dataclass(frozen=True)
class Other:
    """A method that stands beside a claim, although its figure does not draw it: as it is, or as an arm of a control.

    `arrays` are those that are read of its runs.
    """

    label: str  # the name of its group
    method: str
    control: tuple[str, str] | None = None  # the control and its arm
    arrays: tuple[str, ...] = ()

    def runs(self, store: Store, drawn: Sequence[RunRow]) -> tuple[RunRow, ...]:
        """Return its settled runs in the environment and the profile of the drawn runs and on their data, by seed.

        They are of one spec: that of the arm, else the one that a figure would draw.
        """
        first, data = drawn[0], {run.dataset_hash for run in drawn}
        stored = store.runs(method=self.method, environment=first.environment, profile=first.profile)
        fitting = [run for run in stored if run.state.settled and run.dataset_hash in data]
        if self.control is None:
            return newest_of_each_seed(fullest_spec(fitting))
        name, arm = self.control
        try:
            spec = arm_specs(name, first.profile)[arm].hash()
        except (InputError, KeyError):  # an experiments.yaml without this control or profile
            return ()
        return newest_of_each_seed([run for run in fitting if run.spec_hash == spec])

    def command(self, drawn: Sequence[RunRow]) -> str:
        """The command that trains its runs."""
        profile = drawn[0].profile
        if self.control is None:
            return train_command(self.method, drawn[0].environment, profile)
        return f"`{command_line('ssmail', 'control', self.control[0], '--profile', profile, '--seeds', '0-4')}`"


@dataclass(frozen=True)
class Runs:
    """The runs that a figure draws and those of other methods, in groups, and the store to read their numbers from.

    A group is named by its method, or by its value of the ablation's key; samples are labelled with that name unless
    `label` is given. A group without runs gives an empty sample.
    """

    store: Store
    selection: Selection
    others: tuple[Other, ...] = ()

    @classmethod
    def of_figure(cls, store: Store, figure: str, profile: str | None, others: Sequence[Other] = ()) -> "Runs":
        """The runs that the figure chooses by default. Runs that cannot be compared are left out; a note says why."""
        try:
            return cls(store, select(store, figure, profile=profile), tuple(others))
        except NoRuns:
            return cls(store, Selection((), ()))
        except InputError as error:
            return cls(store, Selection((), (str(error),)))

    @cached_property
    def beside(self) -> tuple[tuple[Other, Group], ...]:
        """The runs of the other methods."""
        drawn = self.selection.runs
        return tuple(
            (other, Group(other.label, other.runs(self.store, drawn) if drawn else ())) for other in self.others
        )

    @property
    def notes(self) -> tuple[str, ...]:
        """Which runs were chosen, and what is missing."""
        return (*self.selection.notes, *(self._note(other, group.runs) for other, group in self.beside))

    def _note(self, other: Other, runs: Sequence[RunRow]) -> str:
        if not runs:
            return f"beside the claim, {other.label} is missing; run {other.command(self.selection.runs)}."
        spec, seeds = runs[0].spec_hash[:8], spans([run.seed for run in runs])
        return f"beside the claim, {other.label}: spec {spec} (profile {runs[0].settings}), seeds {seeds}."

    def metric(self, group: Any, name: str, *, diverged: float, label: str | None = None) -> Sample:
        """Sample the last value of a metric. An error that is not finite counts as diverged.

        What a run did not store is computed from its stored test rollouts where that is possible.
        """
        known, _ = known_values(self.store, self._group(group).runs, [name])

        def value(run: RunRow) -> float:
            found = known.get((run.id, name), np.nan)
            lost = (run.id, name) in known and is_error(name) and not np.isfinite(found)
            return diverged if lost else found

        return self._sample(group, label, value, diverged, lambda run: [name] * ((run.id, name) not in known))

    def computed(
        self,
        group: Any,
        read: Callable[[RunRow, str], Array],
        names: Sequence[str],
        number: Callable[..., float],
        *,
        diverged: float,
        label: str | None = None,
    ) -> Sample:
        """Sample `number` of what `read`, that is `curve` or `array`, returns for each of these names."""

        def value(run: RunRow) -> float:
            values = [read(run, name) for name in names]
            if not all(len(found) for found in values):
                return np.nan
            found = number(*values)
            lost = np.isnan(found) and not all(np.isfinite(array).all() for array in values)
            return diverged if lost else found

        return self._sample(
            group, label, value, diverged, lambda run: [name for name in names if not len(read(run, name))]
        )

    def curve(self, run: RunRow, name: str) -> Array:
        """(E,) values of the run's metric over the epochs; empty when it has none."""
        return self.store.metrics([run.id], names=[name])["value"].to_numpy(dtype=np.float64)

    def array(self, run: RunRow, name: str) -> Array:
        """The array of that name that the run stored; empty when there is none."""
        return self.store.array(run.id, name) if name in self.store.array_names(run.id) else np.empty(0)

    def _group(self, key: Any) -> Group:
        for group in (*self.selection.groups, *(group for _, group in self.beside)):
            if key in (group.value, group.label):
                return group
        return Group(str(key), ())

    def _sample(
        self,
        group: Any,
        label: str | None,
        value: Callable[[RunRow], float],
        diverged: float,
        absent: Callable[[RunRow], Sequence[str]],
    ) -> Sample:
        runs = self._group(group).runs
        values = tuple(diverged if run.state is RunState.DIVERGED else value(run) for run in runs)
        unknown = [run for run, found in zip(runs, values, strict=True) if np.isnan(found)]
        return Sample(
            label=label or str(group),
            seeds=tuple(run.seed for run in runs),
            values=values,
            runs=tuple(run.id for run in runs),
            not_stored=tuple(dict.fromkeys(name for run in unknown for name in absent(run))),
        )


def end_mean(values: Floats) -> float:
    """Mean of the last fifth of (E,) values, at least one; NaN where a value is not finite, and without any."""
    return _finite_mean(values[-max(len(values) // PARTS, 1) :])


def beginning_mean(values: Floats) -> float:
    """Mean of the first fifth of (E,) values, at least one; NaN where a value is not finite, and without any."""
    return _finite_mean(values[: max(len(values) // PARTS, 1)])


def _finite_mean(values: Floats) -> float:
    return float(values.mean()) if len(values) and np.isfinite(values).all() else np.nan
