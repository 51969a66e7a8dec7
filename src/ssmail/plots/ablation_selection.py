"""Which runs a figure of an ablation draws: one family, that is runs whose specs differ in the ablation's key alone.

By default it is the family that experiments.yaml gives for the ablation in some profile, whatever the values: those of
`ssmail ablate NAME --values ...` belong to it. Where none of its runs is stored it is the family with the most values
times seeds, if it has two values at least. The newest is taken on a tie, and of each value and seed the newest run that
finished or diverged. Explicit run ids replace this choice, and have to make one family too.
"""

import json
from collections.abc import Callable, Hashable, Sequence
from datetime import datetime
from typing import Any, NamedTuple

from ssmail.config.experiments import Ablation, ablation, ablation_specs, display_value, figure_requirements, to_tuples
from ssmail.config.spec import flatten
from ssmail.errors import InputError
from ssmail.plots import NoRuns
from ssmail.plots.selection import Group, Selection, newest_of_each_seed, on_one_data_set, runs_of
from ssmail.store import RunRow, Store

_ABSENT = object()


class _Family(NamedTuple):
    """Settled runs that differ in the key and the seed alone."""

    runs: tuple[RunRow, ...]  # newest last
    current: bool  # whether experiments.yaml gives these specs

    @property
    def rank(self) -> tuple[bool, int, datetime]:
        return self.current, len({(run.spec_hash, run.seed) for run in self.runs}), self.runs[-1].started

    @property
    def specs(self) -> int:
        return len({run.spec_hash for run in self.runs})


def select_ablation(
    store: Store,
    figure: str,
    ids: Sequence[str] | None = None,
    profile: str | None = None,
    environment: str | None = None,
) -> Selection:
    """The runs that `figure` draws, a group for each value of the ablation's key, in rising or the file's order.

    They are those of `ids`, or the default choice among the stored ones of `profile` (or any), on `environment` (or the
    figure's own). Raises NoRuns when none is stored, InputError when an id is unknown or of another environment, when
    the given runs differ in more than the key, and when the chosen ones were trained on different data.
    """
    entry = figure_requirements(figure)
    if entry.ablation is None:
        raise InputError(f"figures.{figure} of experiments.yaml names no ablation; add one, such as beta.")
    needed = ablation(entry.ablation, environment or entry.environment)
    if ids:
        runs = runs_of(store, figure, needed.environment, ids)
        _check_one_family(figure, needed.key, runs)
        return on_one_data_set(figure, Selection(_groups(needed, runs, tuple), ()))
    family = _family(store, figure, needed, profile)
    groups = _groups(needed, family.runs, newest_of_each_seed)
    notes = (_note(needed, family, groups), *_gaps(needed, family, groups))
    return on_one_data_set(figure, Selection(groups, notes))


def value_of(run: RunRow, key: str) -> Any:
    """The value of a dotted key in the run's spec; a mark of its own, equal to nothing else, where there is none."""
    return to_tuples(flatten(run.spec).get(key, _ABSENT))


def rest_of(run: RunRow, key: str) -> str:
    """The run's spec without the key, and without nulls, which earlier versions may have had no key for."""
    values = {name: value for name, value in flatten(run.spec).items() if name != key and value is not None}
    return json.dumps(values, sort_keys=True)


def _family(store: Store, figure: str, needed: Ablation, profile: str | None) -> _Family:
    stored = store.runs(method=needed.method, environment=needed.environment, profile=profile)
    found: dict[Hashable, list[RunRow]] = {}
    current: dict[Hashable, bool] = {}
    for run in stored:
        if run.state.settled and value_of(run, needed.key) is not _ABSENT:
            found.setdefault(rest_of(run, needed.key), []).append(run)
    for rest, runs in found.items():
        current[rest] = _is_current(needed, runs[0])
    families = [_Family(tuple(runs), current[rest]) for rest, runs in found.items()]
    fitting = [family for family in families if family.current or family.specs > 1]
    if not fitting:
        where = f"{store.where} holds no {'finished ' * bool(stored)}run of it on {needed.environment}"
        where += f" of profile {profile}" if profile else ""
        raise NoRuns(f"{figure} has nothing to draw: {where}; run {_command(needed, profile or 'quick')}.")
    return max(fitting, key=lambda family: family.rank)


def _is_current(needed: Ablation, run: RunRow) -> bool:
    """Whether experiments.yaml's ablation gives the run's spec; a profile that it does not know is of other times."""
    try:
        value, where = value_of(run, needed.key), needed.environment
        specs = ablation_specs(needed.name, run.profile, values=[value], environment=where)
    except InputError:
        return False
    return run.spec_hash in {spec.hash() for spec in specs.values()}


def _check_one_family(figure: str, key: str, runs: Sequence[RunRow]) -> None:
    first, known = runs[0], flatten(runs[0].spec)
    for run in runs:
        if value_of(run, key) is _ABSENT:
            raise InputError(f"run {run.name} ({run.method}) has no {key}, which {figure} compares; leave it out.")
        other = flatten(run.spec)
        differs = [name for name in known | other if name != key and known.get(name) != other.get(name)]
        if differs:
            raise InputError(
                f"runs {first.name} and {run.name} differ in {differs[0]}, but {figure} compares runs that differ in "
                f"{key} alone; leave one of them out."
            )


def _groups(
    needed: Ablation, runs: Sequence[RunRow], choose: Callable[[Sequence[RunRow]], tuple[RunRow, ...]]
) -> tuple[Group, ...]:
    """A group for each value: numbers rising, anything else in the order of experiments.yaml."""
    values: dict[Any, list[RunRow]] = {}
    for run in runs:
        values.setdefault(value_of(run, needed.key), []).append(run)
    order = list(needed.values)
    if not all(isinstance(value, int | float) for value in values):
        ranked = sorted(values, key=lambda value: order.index(value) if value in order else len(order))
    else:
        ranked = sorted(values)
    return tuple(
        Group(_label(value), tuple(sorted(choose(values[value]), key=lambda r: r.seed)), value) for value in ranked
    )


def _label(value: Any) -> str:
    return f"{value:g}" if isinstance(value, float) else str(display_value(value))


def _command(needed: Ablation, profile: str) -> str:
    own = ablation(needed.name).environment
    where = "" if needed.environment == own else f" --env {needed.environment}"
    return f"`ssmail ablate {needed.name}{where} --profile {profile} --seeds 0-4`"


def _note(needed: Ablation, family: _Family, groups: Sequence[Group]) -> str:
    """What is drawn."""
    seeds = sorted({run.seed for group in groups for run in group.runs})
    count = f"{len(groups)} value{'s' * (len(groups) > 1)}, seeds {', '.join(map(str, seeds))}"
    note = f"ablation {needed.name}: runs of {needed.method} (profile {family.runs[0].profile}), {count}"
    if family.current:
        return f"{note}."
    return f"{note}; they differ in {needed.key} alone, but are not what experiments.yaml gives now."


def _gaps(needed: Ablation, family: _Family, groups: Sequence[Group]) -> list[str]:
    """The values of experiments.yaml, and the seeds of any value, that other values have and that are not there."""
    seeds = {run.seed for group in groups for run in group.runs}
    there = {group.value: {run.seed for run in group.runs} for group in groups}
    values = [*there, *(value for value in needed.values if family.current and value not in there)]
    lacking = {value: sorted(seeds - there.get(value, set())) for value in values}
    told = [
        f"{_label(value)} (seed{'s' * (len(gone) > 1)} {', '.join(map(str, gone))})"
        if value in there
        else _label(value)
        for value, gone in lacking.items()
        if gone
    ]
    if not told:
        return []
    remedy = f"; {_command(needed, family.runs[0].profile)} computes what is missing" if family.current else ""
    return [f"missing of {needed.key}: {', '.join(told)}{remedy}."]
