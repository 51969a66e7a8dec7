"""Which runs a figure of methods draws, so that runs of different specs are never mixed in one mean unnoticed.

By default every method is drawn from one profile, the one with the most seeds that finished or diverged, and within it
from one spec: the one that experiments.yaml gives now, else the one with the most seeds, and the newest on a tie; of
each seed, its newest run. Every other stored spec is left out and counted in a note. Explicit run ids replace this
choice: all of them are drawn, whatever their state, and specs are kept apart as groups of their own.

Figures of an ablation choose theirs in `ssmail.plots.ablation_selection`.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Any, NamedTuple

from ssmail.config.experiments import build_spec, figure_requirements
from ssmail.errors import InputError
from ssmail.plots import NoRuns
from ssmail.store import RunRow, Store


@dataclass(frozen=True)
class Group:
    """The runs of one spec, ordered by seed."""

    label: str  # the method, with the spec's hash where two specs of it are drawn; of an ablation, the value
    runs: tuple[RunRow, ...]
    value: Any = None  # of the ablation's key


@dataclass(frozen=True)
class Selection:
    """The groups of a figure, in the order of experiments.yaml, and what a reader should know of the choice."""

    groups: tuple[Group, ...]
    notes: tuple[str, ...]

    @property
    def runs(self) -> tuple[RunRow, ...]:
        """Every run, group after group."""
        return tuple(run for group in self.groups for run in group.runs)


class _Candidate(NamedTuple):
    """The newest settled run of each seed of one spec."""

    method: str
    runs: tuple[RunRow, ...]
    current: bool  # whether experiments.yaml gives this spec for the method and the profile

    @property
    def rank(self) -> tuple[bool, int, datetime]:
        return self.current, len(self.runs), max(run.started for run in self.runs)


def select(store: Store, figure: str, ids: Sequence[str] | None = None, profile: str | None = None) -> Selection:
    """The runs that `figure` draws: those of `ids`, or the default choice among the stored ones of `profile` (or any).

    Raises NoRuns when none is stored, InputError when an id is unknown, of another environment, or when the chosen
    runs were trained on different data.
    """
    needed = figure_requirements(figure)
    if ids:
        chosen = _by_ids(runs_of(store, figure, needed.environment, ids), needed.methods)
    else:
        chosen = _by_default(store, figure, needed.environment, needed.methods, profile)
    return on_one_data_set(figure, chosen)


def runs_of(store: Store, figure: str, environment: str, ids: Sequence[str]) -> list[RunRow]:
    """The runs of the ids, newest last. Raises InputError for an unknown id or a run of another environment."""
    runs = store.runs(ids=ids)
    for run in runs:
        if run.environment != environment:
            raise InputError(f"run {run.name} is of {run.environment}, but {figure} draws {environment}; leave it out.")
    return runs


def on_one_data_set(figure: str, chosen: Selection) -> Selection:
    """The selection itself. Raises InputError when its runs were trained on different data."""
    hashes = sorted({run.dataset_hash for run in chosen.runs if run.dataset_hash})
    if len(hashes) > 1:
        names = ", ".join(value[:8] for value in hashes)
        raise InputError(f"{figure} would mix runs on different data ({names}); name runs on one of them with --runs.")
    return chosen


def command(method: str, environment: str, profile: str | None = None) -> str:
    """What to type to get runs of this method."""
    return f"`ssmail train --method {method} --env {environment} --profile {profile or 'quick'} --seeds 0-4`"


def by_spec(runs: Sequence[RunRow]) -> list[list[RunRow]]:
    """Runs of equal spec together, in the order of their first appearance."""
    specs: dict[str, list[RunRow]] = {}
    for run in runs:
        specs.setdefault(run.spec_hash, []).append(run)
    return list(specs.values())


def newest_of_each_seed(runs: Sequence[RunRow]) -> tuple[RunRow, ...]:
    """One run for each seed, by seed; `runs` come newest last."""
    newest = {run.seed: run for run in runs}
    return tuple(newest[seed] for seed in sorted(newest))


def _by_ids(runs: Sequence[RunRow], order: Sequence[str]) -> Selection:
    """Every run, the methods in the given order and any others after them."""
    places = {method: place for place, method in enumerate(order)}
    specs = sorted(by_spec(runs), key=lambda found: places.get(found[0].method, len(places)))
    methods = [found[0].method for found in specs]
    groups = [
        Group(_label(found[0], alone=methods.count(found[0].method) == 1), tuple(sorted(found, key=lambda r: r.seed)))
        for found in specs
    ]
    return Selection(tuple(groups), ())


def _by_default(store: Store, figure: str, environment: str, methods: Sequence[str], profile: str | None) -> Selection:
    stored = {method: store.runs(method=method, environment=environment, profile=profile) for method in methods}
    candidates = [candidate for method in methods for candidate in _candidates(stored[method])]
    if not candidates:
        method = methods[0]
        found = f"holds {'only unfinished runs' if stored[method] else 'no run'} of {method} on {environment}"
        found += f" of profile {profile}" if profile else ""
        remedy = f"run {command(method, environment, profile)}"
        raise NoRuns(f"{figure} has nothing to draw: {store.where} {found}; {remedy}.")
    drawn_profile = profile or _fullest_profile(candidates)
    groups, notes, missing = [], [], []
    for method in methods:
        fitting = [item for item in candidates if item.method == method and item.runs[0].profile == drawn_profile]
        if fitting:
            best = max(fitting, key=lambda candidate: candidate.rank)
            groups.append(Group(method, best.runs))
            notes.append(_note(best, stored[method]))
        else:
            missing.append(f"{method} is missing; run {command(method, environment, drawn_profile)}.")
    return Selection(tuple(groups), (*notes, *missing))


def _candidates(stored: Sequence[RunRow]) -> list[_Candidate]:
    settled = [run for run in stored if run.state.settled]
    return [_Candidate(runs[0].method, newest_of_each_seed(runs), _is_current(runs[0])) for runs in by_spec(settled)]


def _is_current(run: RunRow) -> bool:
    """Whether experiments.yaml gives the run's spec; a profile or a method that it does not know is of other times."""
    try:
        return build_spec(run.method, run.environment, run.profile).hash() == run.spec_hash
    except InputError:
        return False


def _fullest_profile(candidates: Sequence[_Candidate]) -> str:
    """The profile whose best specs have the most seeds over all methods; the newest on a tie."""
    best: dict[str, dict[str, _Candidate]] = {}
    for candidate in candidates:
        methods = best.setdefault(candidate.runs[0].profile, {})
        methods[candidate.method] = max(methods.get(candidate.method, candidate), candidate, key=lambda c: c.rank)

    def fullness(profile: str) -> tuple[int, datetime]:
        return sum(len(c.runs) for c in best[profile].values()), max(c.rank[-1] for c in best[profile].values())

    return max(best, key=fullness)


def _label(run: RunRow, alone: bool) -> str:
    return run.method if alone else f"{run.method} {run.spec_hash[:8]}"


def _note(chosen: _Candidate, stored: Sequence[RunRow]) -> str:
    """The spec that is drawn, and how many specs and unfinished runs are not."""
    first = chosen.runs[0]
    others = len({run.spec_hash for run in stored if run.state.settled} - {first.spec_hash})
    unfinished = sum(run.spec_hash == first.spec_hash and not run.state.settled for run in stored)
    seeds = ", ".join(str(run.seed) for run in chosen.runs)
    note = f"{chosen.method}: spec {first.spec_hash[:8]} (profile {first.profile}), seeds {seeds}"
    if not chosen.current:
        note += "; not the spec that experiments.yaml gives now"
    if others:
        note += f"; {others} other stored spec{'s' * (others > 1)} left out (choose with --runs)"
    if unfinished:
        note += f"; {unfinished} unfinished run{'s' * (unfinished > 1)} left out"
    return f"{note}."
