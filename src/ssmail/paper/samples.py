"""The runs that decide a claim, and samples of one number per run.

Each sample states what a diverged run counts as: WORST for an error, LEAST for a quantity that should be large, and
otherwise whatever speaks against the claim. A finished run counts as diverged when a value that its number is computed
from is not finite, so that there is no number. A finished run that did not store such a value is unknown (NaN).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from ssmail.data.trajectories import Floats
from ssmail.errors import InputError
from ssmail.paper.claims import Sample
from ssmail.plots import NoRuns
from ssmail.plots.metric_units import is_error
from ssmail.plots.run_groups import Group, Selection
from ssmail.plots.series import select
from ssmail.store import RunRow, RunState, Store
from ssmail.store.comparison import latest_values

Array = npt.NDArray[Any]

WORST, LEAST = np.inf, -np.inf  # what a diverged run counts as
PARTS = 5  # the first and the last fifth of the epochs are the beginning and the end of training


@dataclass(frozen=True)
class Runs:
    """The runs that a figure draws, in groups, and the store to read their numbers from.

    A group is named by its method, or by its value of the ablation's key; samples are labelled with that name unless
    `label` is given. A group without runs gives an empty sample.
    """

    store: Store
    selection: Selection

    @classmethod
    def of_figure(cls, store: Store, figure: str, profile: str | None) -> "Runs":
        """The runs that the figure chooses by default. Runs that cannot be compared are left out; a note says why."""
        try:
            return cls(store, select(store, figure, profile=profile))
        except NoRuns:
            return cls(store, Selection((), ()))
        except InputError as error:
            return cls(store, Selection((), (str(error),)))

    def metric(self, group: Any, name: str, *, diverged: float, label: str | None = None) -> Sample:
        """Sample the last value of a metric. An error that is not finite counts as diverged."""
        known = latest_values(self.store, self._group(group).runs, [name])

        def value(run: RunRow) -> float:
            found = known.get((run.id, name), np.nan)
            lost = (run.id, name) in known and is_error(name) and not np.isfinite(found)
            return diverged if lost else found

        return self._sample(group, label, value, diverged)

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

        return self._sample(group, label, value, diverged)

    def curve(self, run: RunRow, name: str) -> Array:
        """(E,) values of the run's metric over the epochs; empty when it has none."""
        return self.store.metrics([run.id], names=[name])["value"].to_numpy(dtype=np.float64)

    def array(self, run: RunRow, name: str) -> Array:
        """The array of that name that the run stored; empty when there is none."""
        return self.store.array(run.id, name) if name in self.store.array_names(run.id) else np.empty(0)

    def _group(self, key: Any) -> Group:
        for group in self.selection.groups:
            if key in (group.value, group.label):
                return group
        return Group(str(key), ())

    def _sample(self, group: Any, label: str | None, value: Callable[[RunRow], float], diverged: float) -> Sample:
        runs = self._group(group).runs
        return Sample(
            label=label or str(group),
            seeds=tuple(run.seed for run in runs),
            values=tuple(diverged if run.state is RunState.DIVERGED else value(run) for run in runs),
            runs=tuple(run.id for run in runs),
        )


def end_mean(values: Floats) -> float:
    """Mean of the last fifth of (E,) values, at least one; NaN where a value is not finite, and without any."""
    return _finite_mean(values[-max(len(values) // PARTS, 1) :])


def beginning_mean(values: Floats) -> float:
    """Mean of the first fifth of (E,) values, at least one; NaN where a value is not finite, and without any."""
    return _finite_mean(values[: max(len(values) // PARTS, 1)])


def _finite_mean(values: Floats) -> float:
    return float(values.mean()) if len(values) and np.isfinite(values).all() else np.nan
