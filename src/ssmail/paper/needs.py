"""What figures need of a database: found by collecting each of them from a store that remembers what is read."""

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy.typing as npt

from ssmail.errors import InputError
from ssmail.paper.results import FIGURES, FigureModule
from ssmail.store import RunRow, Store
from ssmail.store.maintenance.compact import Thinning, Wanted

if TYPE_CHECKING:
    import pandas as pd

USUAL_CURVES = tuple(
    f"{split}/{error}" for split in ("train", "validation") for error in ("mode_mse", "mse", "stroke_distance")
)
"""The errors of every epoch: kept for all runs, whether or not a figure reads them."""


class RecordingStore(Store):
    """A store that shows some of its runs alone, and remembers which curves and arrays were read."""

    def show(self, run_ids: Collection[str]) -> None:
        """From now on these runs are all there is."""
        self.shown = set(run_ids)
        self.curves: set[str] = set(USUAL_CURVES)
        self.arrays: dict[str, dict[str, Thinning | None]] = {}
        self.thinnings: Mapping[str, Thinning] = {}

    def runs(self, **conditions: Any) -> list[RunRow]:
        """As Store.runs, among those shown."""
        return [run for run in super().runs(**conditions) if run.id in self.shown]

    def metrics(self, run_ids: Sequence[str], names: Sequence[str] | None = None) -> "pd.DataFrame":
        """As Store.metrics; every metric is remembered when no name is given."""
        frame = super().metrics(run_ids, names)
        self.curves |= set(names if names is not None else frame["name"])
        return frame

    def array(self, run_id: str, name: str) -> npt.NDArray[Any]:
        """As Store.array; an array that is needed whole once is remembered as such."""
        array = super().array(run_id, name)  # first: what is not there cannot be kept
        thin = self.thinnings.get(name)
        known = self.arrays.setdefault(run_id, {})
        known[name] = thin if known.get(name, thin) is thin else None
        return array


@dataclass(frozen=True)
class Needs:
    """What the figures read, and which of them cannot be drawn from these runs, each with the reason."""

    wanted: Wanted
    undrawable: Mapping[str, str]


def needs(store: Store, runs: Sequence[RunRow], readers: Sequence[Callable[[Store], object]] = ()) -> Needs:
    """What every figure reads, were these runs the only ones: of each profile and, where it can, each environment.

    `readers` are called with the same store, for what they read to be wanted too, arrays that a figure thins as thin as
    that figure wants them; what they give is dropped.
    """
    recorder = RecordingStore.open(store.url)
    recorder.show([run.id for run in runs])
    undrawable = {}
    try:
        for module in dict.fromkeys(FIGURES.values()):
            recorder.thinnings = module.thinnings()
            if reason := _read(module, recorder, runs):
                undrawable[module.name] = reason
        recorder.thinnings = {k: v for module in FIGURES.values() for k, v in module.thinnings().items()}
        for reader in readers:
            reader(recorder)
    finally:
        recorder.close()
    return Needs(Wanted(frozenset(recorder.curves), recorder.arrays), undrawable)


def _read(module: FigureModule, store: Store, runs: Sequence[RunRow]) -> str | None:
    """Collect the figure in every way that needs no ids; the reason when it cannot be drawn as in the paper."""
    environments = [None, *sorted({run.environment for run in runs})] if module.has_environment else [None]
    reasons: dict[tuple[str | None, str | None], str] = {}
    for profile in (None, *sorted({run.profile for run in runs})):
        for environment in environments:
            try:
                module.collect(store, profile=profile, environment=environment)
            except InputError as error:
                reasons[profile, environment] = str(error)
    return reasons.get((None, None))
