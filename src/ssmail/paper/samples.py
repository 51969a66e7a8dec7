"""The runs of a claim, by group, and samples of one number for each run.

A run that diverged counts as the worst: +inf of an error, and what counts against the claim of anything else. A
finished run that did not store what is asked for is unknown (NaN).
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from ssmail.paper.claims import Sample
from ssmail.plots import NoRuns
from ssmail.plots.metric_units import is_error
from ssmail.plots.run_groups import Group, Selection
from ssmail.plots.series import select
from ssmail.store import RunRow, RunState, Store
from ssmail.store.comparison import latest_values

Floats = npt.NDArray[np.float64]
EMPTY = Selection((), ())


@dataclass(frozen=True)
class Runs:
    """The runs that a figure draws, and the store to read them from."""

    store: Store
    selection: Selection

    @classmethod
    def of(cls, store: Store, figure: str, profile: str | None) -> "Runs":
        """As the figure chooses them by default; none when there are none.

        Raises InputError for an unknown figure and for runs on different data.
        """
        try:
            return cls(store, select(store, figure, profile=profile))
        except NoRuns:
            return cls(store, EMPTY)

    def group(self, key: Any) -> Group:
        """The runs of a method (its name), or of a value of the ablation's key; empty when there are none."""
        for group in self.selection.groups:
            if key in (group.value, group.label):
                return group
        return Group(str(key), ())

    def sample(self, group: Group, label: str, value: Callable[[RunRow], float], diverged: float) -> Sample:
        """What `value` gives for every finished run of the group, and `diverged` for every diverged one."""
        return Sample(
            label=label,
            seeds=tuple(run.seed for run in group.runs),
            values=tuple(diverged if run.state is RunState.DIVERGED else value(run) for run in group.runs),
            runs=tuple(run.id for run in group.runs),
        )

    def metric(self, group: Group, label: str, name: str, diverged: float) -> Sample:
        """The last value of a metric; an error that is not finite counts as diverged."""
        known = latest_values(self.store, group.runs, [name])

        def value(run: RunRow) -> float:
            found = known.get((run.id, name), np.nan)
            lost = (run.id, name) in known and is_error(name) and not np.isfinite(found)
            return diverged if lost else found

        return self.sample(group, label, value, diverged)

    def curve(self, run: RunRow, name: str) -> Floats:
        """(E,) values of a metric over the epochs; empty when the run has none."""
        found: Floats = self.store.metrics([run.id], names=[name])["value"].to_numpy(dtype=np.float64)
        return found

    def arrays(self, run: RunRow, *names: str) -> list[npt.NDArray[Any]] | None:
        """The arrays of these names; None when the run lacks one."""
        there = self.store.array_names(run.id)
        return [self.store.array(run.id, name) for name in names] if {*names} <= {*there} else None
