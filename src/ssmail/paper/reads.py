"""What figures and claims read from runs, and so what a compact export keeps."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass

from ssmail.errors import InputError
from ssmail.paper.results import CLAIMS, FIGURES, FigureModule
from ssmail.paper.samples import Runs
from ssmail.plots.data_sets import data_sets, is_own
from ssmail.plots.series import select
from ssmail.store import RunRow, Store
from ssmail.store.maintenance.compact import Thinning, Wanted

USUAL_CURVES = tuple(
    f"{split}/{error}" for split in ("train", "validation") for error in ("mode_mse", "mse", "stroke_distance")
)
"""The errors of every epoch: kept for all runs, whether or not a figure reads them."""


FORECASTS = ("test", "test_constant_velocity", "test_copy_last")
"""Of runs on data of the user's own, the first parts of the names of arrays that their figures show."""


@dataclass(frozen=True)
class Contents:
    """What to keep of some runs, and which figures cannot be drawn from them, each with the reason."""

    wanted: Wanted
    undrawable: Mapping[str, str]


def contents(store: Store, runs: Sequence[RunRow]) -> Contents:
    """Return what all figures and claims read if these runs are the only ones.

    Figures are drawn, and claims judged, from any profile and from each, and where possible on each environment.
    """
    only = store.only(run.id for run in runs)
    curves = set(USUAL_CURVES)
    arrays: dict[str, dict[str, Thinning | None]] = {}
    undrawable: dict[str, str] = {}
    for data in data_sets(only, [run for run in runs if is_own(run)]):
        for run in data.runs:
            names = store.array_names(run.id)
            arrays[run.id] = dict.fromkeys(name for name in names if name.partition("/")[0] in FORECASTS)
    for figure in dict.fromkeys(FIGURES.values()):
        curves |= set(figure.reads.curves)
        for run_id in _drawn(only, figure, runs, undrawable):
            arrays.setdefault(run_id, {}).update(figure.reads.stored(store.array_names(run_id)))
    for run_id, name in _beside(only, runs):
        arrays.setdefault(run_id, {}).setdefault(name, None)
    return Contents(Wanted(frozenset(curves), arrays), undrawable)


def _drawn(store: Store, figure: FigureModule, runs: Sequence[RunRow], undrawable: dict[str, str]) -> Iterator[str]:
    """Yield the runs that the figure or its claim chooses; record in `undrawable` why it cannot be drawn by default."""
    environments = [None, *sorted({run.environment for run in runs})] if figure.has_environment else [None]
    for profile in (None, *sorted({run.profile for run in runs})):
        for environment in environments:
            try:
                yield from figure.collect(store, profile=profile, environment=environment).provenance.run_ids
            except InputError as error:
                if profile is None and environment is None:
                    undrawable[figure.name] = str(error)
                yield from _judged(store, figure, profile, environment)


def _beside(store: Store, runs: Sequence[RunRow]) -> Iterator[tuple[str, str]]:
    """Yield the runs that stand beside a claim without being drawn, with each array that the claim reads of them."""
    for profile in (None, *sorted({run.profile for run in runs})):
        for figure in (FIGURES[name] for name in CLAIMS):
            for other, group in Runs.of_figure(store, figure.name, profile, figure.others).beside:
                for run in group.runs if other.arrays else ():
                    yield from ((run.id, name) for name in other.arrays if name in store.array_names(run.id))


def _judged(store: Store, figure: FigureModule, profile: str | None, environment: str | None) -> Iterator[str]:
    """Yield the runs that the claim can be judged from although the figure cannot be drawn."""
    together = {name for name, thin in figure.reads.arrays.items() if thin is not None}
    with suppress(InputError):
        for run in select(store, figure.name, profile=profile, environment=environment).runs:
            if together <= {*store.array_names(run.id)}:
                yield run.id
