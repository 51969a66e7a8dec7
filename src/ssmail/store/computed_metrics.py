"""Metrics of the Y-Junction that runs stored before there were such metrics lack, computed from their stored rollouts.

The rollouts are those of `test/rollouts`. A compact database keeps only some of them, and the arrays of the data set
(`test/lanes`, `lane_centres`) of only some runs, so these are taken from any run on the same data.
"""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from ssmail.errors import InputError
from ssmail.evaluation.metrics import TURNING, path_metrics, turning
from ssmail.store.queries import RunRow
from ssmail.store.run_store import Store
from ssmail.store.schema import RunState

ROLLOUTS, LANES, CENTRES = "test/rollouts", "test/lanes", "lane_centres"
PATH = ("test/on_path", "test/path_rms")
TURNS = tuple(f"test/{name}" for name in TURNING)
AXES = 2
Values = dict[tuple[str, str], float]  # by run id and name


class Computed(NamedTuple):
    """Metrics by run id and name, and by run id the number of rollouts that they were computed from."""

    values: Values
    rollouts: dict[str, int]


def computed_metrics(
    store: Store, runs: Sequence[RunRow], names: Sequence[str], stored: Mapping[tuple[str, str], float]
) -> Computed:
    """Return those of the metrics `names` that are not in `stored` and can be computed from the runs' arrays.

    Arrays that cannot be read, or do not fit each other, count as absent.
    """
    arrays, found = _Arrays(store), Computed({}, {})
    for run in runs:
        lacking = [name for name in (*PATH, *TURNS) if name in names and (run.id, name) not in stored]
        if lacking and run.state is RunState.FINISHED and (rollouts := arrays.rollouts(run)) is not None:
            values = _measured(rollouts, arrays, run, lacking)
            found.values.update({(run.id, name): values[name] for name in lacking if name in values})
            found.rollouts.update({run.id: rollouts.shape[0] * rollouts.shape[1]} if values else {})
    return found


def centre_lines(store: Store, run: RunRow) -> Any:
    """Return the lanes' centre lines (L, P', 2) of the run's data, in double precision; None where none is stored."""
    return _Arrays(store).centre_lines(run)


def lanes_of(store: Store, run: RunRow, rollouts: Any) -> Any:
    """Return the expert's continuations (L, B, T, N, 2) of rollouts (S, B, T, N, 2) on the run's data, or None.

    A compact database keeps them of some runs only, so they may be those of another run on the same data.
    """
    return _Arrays(store).lanes(run, rollouts.shape[1:])


def note(computed: Computed) -> str | None:
    """Return one sentence on what was computed, None if nothing was."""
    if not computed.rollouts:
        return None
    names = [name for name in (*PATH, *TURNS) if any(name == of for _, of in computed.values)]
    counts = sorted(set(computed.rollouts.values()))
    each = f"{counts[0]}" if len(counts) == 1 else f"{counts[0]} to {counts[-1]}"
    runs = len(computed.rollouts)
    return (
        f"{', '.join(names)} of {runs} run{'' if runs == 1 else 's'}, stored before these metrics were, computed from "
        f"the {each} test rollouts stored of each"
    )


def _measured(rollouts: Any, arrays: "_Arrays", run: RunRow, names: Sequence[str]) -> dict[str, float]:
    """Return metrics of rollouts (S, B, T, N, 2), by their stored names."""
    flat = rollouts.reshape(-1, *rollouts.shape[2:])
    values: dict[str, float] = {}
    if not {*PATH}.isdisjoint(names) and (lines := arrays.centre_lines(run)) is not None:
        values |= path_metrics(flat[:, 1:], lines)
    if not {*TURNS}.isdisjoint(names) and (lanes := arrays.lanes(run, rollouts.shape[1:])) is not None:
        with suppress(np.linalg.LinAlgError):  # of positions too large to be fitted
            values |= turning(flat, np.tile(lanes, (1, len(rollouts), 1, 1, 1)))
    return {f"test/{name}": value for name, value in values.items()}


class _Arrays:
    """Arrays of runs on the Y-Junction, in double precision; None where there is none that fits."""

    def __init__(self, store: Store) -> None:
        self.store = store

    def rollouts(self, run: RunRow) -> Any:
        """Return (S, B, T, N, 2)."""
        return next((array for array in self._read([run], ROLLOUTS) if _is_motion(array)), None)

    def lanes(self, run: RunRow, shape: tuple[int, ...]) -> Any:
        """Return (L, B, T, N, 2) whose last axes have this shape."""
        alike = (array for array in self._read(self._on_the_same_data(run), LANES) if array.shape[1:] == shape)
        return next((array for array in alike if _is_motion(array)), None)

    def centre_lines(self, run: RunRow) -> Any:
        """Return (L, P', 2)."""
        found = self._read(self._on_the_same_data(run), CENTRES)
        return next((a for a in found if a.ndim == 3 and a.shape[0] and a.shape[1] > 1 and a.shape[2] == AXES), None)

    @cached_property
    def _runs(self) -> list[RunRow]:
        return self.store.runs(state=RunState.FINISHED)

    def _on_the_same_data(self, run: RunRow) -> Iterator[RunRow]:
        yield run
        if run.dataset_hash is not None:
            yield from (other for other in self._runs if other.dataset_hash == run.dataset_hash)

    def _read(self, runs: Iterator[RunRow] | Sequence[RunRow], name: str) -> Iterator[Any]:
        for run in runs:
            if name in self.store.array_names(run.id):
                try:
                    array = self.store.array(run.id, name)
                except InputError:
                    continue
                if array.dtype.kind == "f":
                    yield array.astype(np.float64)


def _is_motion(array: Any) -> bool:
    return array.ndim == 5 and array.size > 0 and array.shape[2] > 1 and bool(array.shape[-1] == AXES)
