"""Groups of stored runs, as figures draw them, how runs are sorted into them, and what is read of a run."""

import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from typing import Any, NamedTuple

from ssmail.config.changes import with_changes
from ssmail.config.experiments import to_tuples
from ssmail.config.names import flatten
from ssmail.errors import InputError
from ssmail.plots.formatting import counted
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


class Family(NamedTuple):
    """Settled runs of one spec, or of specs that differ in the ablation's key alone."""

    runs: tuple[RunRow, ...]  # newest last
    current: bool  # whether experiments.yaml gives these specs now

    @property
    def seeds(self) -> int:
        """How many different cells (a spec and a seed) there are."""
        return len({(run.spec_hash, run.seed) for run in self.runs})

    @property
    def epochs(self) -> int:
        """The most epochs that one of its specs is trained for; 0 for methods without training."""
        sections = [run.spec.get("training") for run in self.runs]
        given = [section.get("epochs") for section in sections if isinstance(section, Mapping)]
        return max((epochs for epochs in given if isinstance(epochs, int)), default=0)

    @property
    def rank(self) -> tuple[bool, int, int, datetime]:
        """The greater, the better for drawing.

        Epochs stand before the date, because an arm of an ablation, which is shorter, is often newer than the method.
        """
        return self.current, self.seeds, self.epochs, self.runs[-1].started


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
    """Raise InputError when the runs were trained on different data, other than by the seed."""
    by_seed: dict[int | None, set[str]] = {}
    for run in runs:
        if run.dataset_hash:
            by_seed.setdefault(run.seed if _differs_by_seed(run) else None, set()).add(run.dataset_hash)
    hashes = sorted({value for found in by_seed.values() for value in found})
    if len(hashes) > 1 and (None in by_seed or max(map(len, by_seed.values())) > 1):
        names = ", ".join(value[:8] for value in hashes)
        remedy = f"name runs on one of them (`ssmail plot {figure} --runs`)"
        raise InputError(f"{figure} would mix runs on different data ({names}); {remedy}.")


def _differs_by_seed(run: RunRow) -> bool:
    """Return whether every seed of the run's spec has data of its own."""
    data = run.spec.get("data")
    generator = data.get(run.environment) if isinstance(data, Mapping) and data.get("path") is None else None
    return isinstance(generator, Mapping) and generator.get("seed", 0) is None


def tested_alike(figure: str, runs: Sequence[RunRow]) -> Mapping[str, Any]:
    """Return the section `forecast` of the runs' specs, which states how they are tested.

    Raises InputError for a run that has not ended, and where runs differ in it.
    """
    check_settled(runs, "test errors")
    first = runs[0]
    for run in runs:
        differs = [key for key, value in run.spec["forecast"].items() if value != first.spec["forecast"].get(key)]
        if differs:
            raise InputError(
                f"runs {first.name} and {run.name} differ in forecast.{differs[0]}, so {figure} cannot compare their "
                "errors; leave one of them out."
            )
    found: dict[str, Any] = first.spec["forecast"]
    return found


def by_spec(runs: Sequence[RunRow]) -> list[list[RunRow]]:
    """Return runs of equal spec together, in the order of their first appearance."""
    return grouped(runs, lambda run: run.spec_hash)


def every_spec(runs: Sequence[RunRow], methods: Sequence[str]) -> tuple[Group, ...]:
    """Return a group with all runs of each spec: those of `methods` first, in this order, and then the others."""
    places = {method: place for place, method in enumerate(methods)}
    specs = sorted(by_spec(runs), key=lambda found: places.get(found[0].method, len(places)))
    names = [found[0].method for found in specs]
    groups = []
    for found in specs:
        method = found[0].method
        label = method if names.count(method) == 1 else f"{method} {found[0].spec_hash[:8]}"
        groups.append(Group(label, tuple(sorted(found, key=lambda run: run.seed))))
    return tuple(groups)


def fullest_profile(families: Mapping[str, Sequence[Family]]) -> str:
    """Return the profile whose best specs have the most seeds over all methods; the newest on a tie."""

    def fullness(profile: str) -> tuple[int, datetime]:
        fitting = [[family for family in found if family.runs[0].profile == profile] for found in families.values()]
        best = [max(found, key=lambda family: family.rank) for found in fitting if found]
        return sum(family.seeds for family in best), max(family.runs[-1].started for family in best)

    return max((family.runs[0].profile for found in families.values() for family in found), key=fullness)


def choice_note(figure: str, group: Group, current: bool, stored: Sequence[RunRow]) -> str:
    """Say which spec `figure` draws of a method, and how many other specs and unfinished runs of `stored` it leaves."""
    first = group.runs[0]
    others = len({run.spec_hash for run in stored if run.state.settled} - {first.spec_hash})
    unfinished = sum(run.spec_hash == first.spec_hash and not run.state.settled for run in stored)
    seeds = ", ".join(str(run.seed) for run in group.runs)
    note = f"{group.label}: spec {first.spec_hash[:8]} (profile {first.settings}), seeds {seeds}"
    if not current:
        note += "; not the spec that experiments.yaml gives now"
    if others:
        note += f"; {counted(others, 'other stored spec')} left out (`ssmail plot {figure} --runs` chooses)"
    if unfinished:
        note += f"; {counted(unfinished, 'unfinished run')} left out"
    return f"{note}."


def settings_of(runs: Sequence[RunRow]) -> str:
    """Return the profile of these runs, with the changes to it that all of them have: "quick + training.epochs=12"."""
    first, *others = runs
    shared = {k: v for k, v in first.changes.items() if all(run.changes.get(k, ABSENT) == v for run in others)}
    return with_changes(first.profile, shared)


def newest_of_each_seed(runs: Sequence[RunRow]) -> tuple[RunRow, ...]:
    """Return one run for each seed, by seed; `runs` come newest last."""
    newest = {run.seed: run for run in runs}
    return tuple(newest[seed] for seed in sorted(newest))


def value_of(run: RunRow, key: str) -> Any:
    """Return the value of a dotted key in the run's spec; ABSENT where there is none."""
    return to_tuples(flatten(run.spec).get(key, ABSENT))


def rest_of(run: RunRow, *keys: str) -> str:
    """Return the run's spec without these keys, and without nulls, which earlier versions may have had no key for."""
    values = {name: value for name, value in flatten(run.spec).items() if name not in keys and value is not None}
    return json.dumps(values, sort_keys=True)


def check_alike(figure: str, runs: Sequence[RunRow], *keys: str) -> None:
    """Raise InputError, naming a key, if a run differs from the first one in more than these keys."""
    first, known = runs[0], flatten(runs[0].spec)
    for run in runs:
        other = flatten(run.spec)
        differs = [name for name in known | other if name not in keys and known.get(name) != other.get(name)]
        if differs:
            raise InputError(
                f"runs {first.name} and {run.name} differ in {differs[0]}, but {figure} compares runs that differ in "
                f"{' and '.join(keys)} alone; leave one of them out."
            )


def grouped(runs: Sequence[RunRow], mark: Callable[[RunRow], str]) -> list[list[RunRow]]:
    """Return runs of an equal mark together, in the order of their first appearance."""
    found: dict[str, list[RunRow]] = {}
    for run in runs:
        found.setdefault(mark(run), []).append(run)
    return list(found.values())
