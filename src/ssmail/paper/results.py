"""The nine figures of the paper and the eight claims that are read off them.

Each figure has a module. Its `collect(store, selection)` returns a frozen record of what is shown, and `draw(record)` a
matplotlib Figure. Where a claim is read off the figure, the module also has the CLAIM, the OTHERS that the figure does
not draw but the claim looks at, `samples(runs)`, which reads its numbers from the store, and `decide(*samples)`, which
tests them. Importing this table imports neither matplotlib nor
pandas: a figure's module is imported when it is used.
"""

import importlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, cast

from ssmail.errors import stored_values
from ssmail.plots import FigureRecord

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from ssmail.evaluation.statistics import Statistic
    from ssmail.paper.claims import Claim, Part
    from ssmail.paper.samples import Other, Runs
    from ssmail.plots.run_groups import Reads
    from ssmail.store import Store


@dataclass(frozen=True)
class FigureModule:
    """One figure of the paper: its name, its alias, and its module, which is imported at first use."""

    name: str
    alias: str
    summary: str
    statistic: str = ""  # its centre and spread unless another is chosen; empty for a figure that has none
    has_environment: bool = False  # whether it can be drawn for another environment
    of_data: bool = False  # whether it draws the expert set, which any run may hold, and no runs

    @property
    def has_statistic(self) -> bool:
        """Whether its centre and spread can be chosen."""
        return bool(self.statistic)

    @property
    def stem(self) -> str:
        """The name of the module, and of the saved files without the ending."""
        return f"{self.name}_{self.alias}".replace("-", "_")

    def collect(
        self,
        store: "Store",
        runs: Sequence[str] | None = None,
        *,
        profile: str | None = None,
        statistic: "Statistic | None" = None,
        environment: str | None = None,
    ) -> FigureRecord:
        """Collect the record from `store`.

        `runs` (ids or their beginnings) replace the default choice of runs, which `profile` restricts. `statistic`
        (the figure's own by default) and `environment` (the paper's by default) have no effect on figures without that
        option.
        Raises NoRuns when there is nothing to draw, InputError for an unknown or unfit id.
        """
        from ssmail.evaluation.statistics import Statistic
        from ssmail.plots.series import select, select_data

        module = self._module()
        options = [statistic or Statistic(self.statistic)] if self.has_statistic else []
        with stored_values(self.name):
            if self.of_data:
                selection = select_data(store, self.name, {*self.reads.arrays}, runs, profile)
            else:
                selection = select(store, self.name, runs, profile, environment if self.has_environment else None)
            return cast(FigureRecord, module.collect(store, selection, *options))

    def draw(self, record: FigureRecord) -> "Figure":
        """Draw the record as a matplotlib Figure, one column wide."""
        with stored_values(self.name):
            return cast("Figure", self._module().draw(record))

    @property
    def claim(self) -> "Claim":
        """The claim that is read off the figure; only those of CLAIMS have one."""
        return cast("Claim", self._module().CLAIM)

    @property
    def others(self) -> "tuple[Other, ...]":
        """The methods that the figure does not draw and that stand beside its claim."""
        return cast("tuple[Other, ...]", self._module().OTHERS)

    def decide(self, runs: "Runs") -> "tuple[Part, ...]":
        """Test the parts of the claim on the figure's runs, and what stands beside it."""
        module = self._module()
        with stored_values(self.name):
            return cast("tuple[Part, ...]", module.decide(*module.samples(runs)))

    @property
    def reads(self) -> "Reads":
        """What the figure and its claim read from the runs that it draws."""
        return cast("Reads", self._module().READS)

    def _module(self) -> Any:
        return importlib.import_module(f"ssmail.paper.{self.stem}")


_MODULES = (
    FigureModule("fig1", "landscapes", "letters: the task, and the reward over the plane, ideal and learned"),
    FigureModule("fig2", "vector-field", "letters: the learned reward's gradient around the current trajectory"),
    FigureModule("fig3", "curricula", "segment lengths over epochs, under each curriculum", statistic="median-iqr"),
    FigureModule("fig4", "stability", "Y-Junction: training error over epochs, every seed", statistic="median-iqr"),
    FigureModule("fig5", "modes", "Y-Junction: sampled trajectories over the expert's two lanes, every seed"),
    FigureModule("fig6", "beta", "Y-Junction: test error against beta, every seed", statistic="median-iqr"),
    FigureModule(
        "fig7", "noise", "mocap: test error against the predicted step, clean and noisy", statistic="mean-std"
    ),
    FigureModule(
        "fig8", "alpha", "mocap: training over epochs for ranges of alpha", statistic="median-iqr", has_environment=True
    ),
    FigureModule("fig9", "yjunction", "Y-Junction: a snapshot of the environment", of_data=True),
)

FIGURES: dict[str, FigureModule] = {key: module for module in _MODULES for key in (module.name, module.alias)}

CLAIMS = ("fig4", "fig5", "fig6", "fig7", "fig8", "fig3", "fig1", "fig2")
"""The figures whose modules decide the claims C1 to C8, in this order."""
