"""Groups of stored runs, as figures draw them, how runs are sorted into them, and what is read of a run."""

import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from ssmail.config.experiments import to_tuples
from ssmail.config.spec import flatten
from ssmail.errors import InputError
from ssmail.store import RunRow
from ssmail.store.maintenance.compact import Thinning

ABSENT = object()
"""The value of a key that a spec does not have."""


@dataclass(frozen=True)
class Group:
    """The stored runs of one series, ordered by seed."""

    label: str  # the method, with the spec's hash where two specs of it are drawn; of an ablation, the value
    runs: tuple[RunRow, ...]
    value: Any = None  # of the ablation's key


@dataclass(frozen=True)
class Selection:
    """The groups of a figure, and what a reader should know of the choice.

    Methods are in the order of experiments.yaml; so are an ablation's values, unless they are numbers, which rise.
    """

    groups: tuple[Group, ...]
    notes: tuple[str, ...]
    named: bool = False  # whether the caller named the runs

    @property
    def runs(self) -> tuple[RunRow, ...]:
        """Every run, group after group."""
        return tuple(run for group in self.groups for run in group.runs)

    @property
    def curves(self) -> dict[str, str]:
        """By run id, the label of the group that the run is drawn in."""
        return {run.id: group.label for group in self.groups for run in group.runs}


@dataclass(frozen=True)
class Reads:
    """What a figure and its claim read from a run, besides the last values of metrics.

    curves: metrics that are read over the epochs. arrays: names of arrays, each with the Thinning that reduces it to
    what the figure shows, or None when all of it is read; the figure shows the same from the thinned array. landscapes:
    whether the first and the last stored landscape are read.
    """

    curves: tuple[str, ...] = ()
    arrays: Mapping[str, Thinning | None] = field(default_factory=dict)
    landscapes: bool = False

    def stored(self, names: Sequence[str]) -> dict[str, Thinning | None]:
        """Return those of a run's arrays (`names`, sorted) that are read."""
        from ssmail.plots.landscape_grids import first_and_last  # imported here because it needs matplotlib

        read = {name: thin for name, thin in self.arrays.items() if name in names}
        return read | dict.fromkeys(first_and_last(names)) if self.landscapes else read


def check_settled(runs: Iterable[RunRow], lacking: str) -> None:
    """Raise InputError for a run that neither finished nor diverged; `lacking` is what it therefore does not have."""
    for run in runs:
        if not run.state.settled:
            raise InputError(f"run {run.name} ({run.state}) has no {lacking}; leave it out or train it to its end.")


def check_one_data_set(figure: str, runs: Sequence[RunRow]) -> None:
    """Raise InputError when the runs were trained on different data."""
    hashes = sorted({run.dataset_hash for run in runs if run.dataset_hash})
    if len(hashes) > 1:
        names = ", ".join(value[:8] for value in hashes)
        raise InputError(f"{figure} would mix runs on different data ({names}); name runs on one of them with --runs.")


def by_spec(runs: Sequence[RunRow]) -> list[list[RunRow]]:
    """Return runs of equal spec together, in the order of their first appearance."""
    return grouped(runs, lambda run: run.spec_hash)


def newest_of_each_seed(runs: Sequence[RunRow]) -> tuple[RunRow, ...]:
    """Return one run for each seed, by seed; `runs` come newest last."""
    newest = {run.seed: run for run in runs}
    return tuple(newest[seed] for seed in sorted(newest))


def value_of(run: RunRow, key: str) -> Any:
    """Return the value of a dotted key in the run's spec; ABSENT where there is none."""
    return to_tuples(flatten(run.spec).get(key, ABSENT))


def rest_of(run: RunRow, key: str) -> str:
    """Return the run's spec without the key, and without nulls, which earlier versions may have had no key for."""
    values = {name: value for name, value in flatten(run.spec).items() if name != key and value is not None}
    return json.dumps(values, sort_keys=True)


def grouped(runs: Sequence[RunRow], mark: Callable[[RunRow], str]) -> list[list[RunRow]]:
    """Return runs of an equal mark together, in the order of their first appearance."""
    found: dict[str, list[RunRow]] = {}
    for run in runs:
        found.setdefault(mark(run), []).append(run)
    return list(found.values())
