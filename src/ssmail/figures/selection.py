"""Which runs a figure draws, so that runs of different specs are never mixed in one mean unnoticed.

By default each method is drawn from one spec: the one with the most seeds that finished or diverged, and the newest on
a tie; of each seed, its newest run. Every other stored spec is left out and counted in a note. Explicit run ids replace
this choice: all of them are drawn, whatever their state, and specs are kept apart as groups of their own.
"""

from collections.abc import Sequence
from dataclasses import dataclass

from sqlalchemy import make_url

from ssmail.errors import InputError
from ssmail.experiments import figure_requirements
from ssmail.figures import NoRuns
from ssmail.store import RunRow, RunState, Store

SETTLED = (RunState.FINISHED, RunState.DIVERGED)


@dataclass(frozen=True)
class Group:
    """The runs of one method under one spec, ordered by seed."""

    label: str  # the method; with the spec's hash where two specs of it are drawn
    runs: tuple[RunRow, ...]


@dataclass(frozen=True)
class Selection:
    """The groups of a figure, in the order of experiments.yaml, and what a reader should know of the choice."""

    groups: tuple[Group, ...]
    notes: tuple[str, ...]

    @property
    def runs(self) -> tuple[RunRow, ...]:
        """Every run, group after group."""
        return tuple(run for group in self.groups for run in group.runs)


def select(store: Store, figure: str, ids: Sequence[str] | None = None) -> Selection:
    """The runs that `figure` draws: those of `ids`, or the default choice among the stored ones.

    Raises NoRuns when none is stored, InputError when an id is unknown, of another environment, or when the chosen
    runs were trained on different data.
    """
    environment, methods = figure_requirements(figure)
    chosen = _by_ids(store, figure, environment, ids) if ids else _by_default(store, figure, environment, methods)
    hashes = sorted({run.dataset_hash for run in chosen.runs if run.dataset_hash})
    if len(hashes) > 1:
        names = ", ".join(value[:8] for value in hashes)
        raise InputError(f"{figure} would mix runs on different data ({names}); name runs on one of them with --runs.")
    return chosen


def command(method: str, environment: str) -> str:
    """What to type to get runs of this method."""
    return f"`ssmail train --method {method} --env {environment} --profile quick --seeds 0-4`"


def place(store: Store) -> str:
    """The store's URL without its password."""
    return make_url(store.url).render_as_string(hide_password=True)


def _by_ids(store: Store, figure: str, environment: str, ids: Sequence[str]) -> Selection:
    runs = store.runs(ids=ids)
    for run in runs:
        if run.environment != environment:
            raise InputError(f"run {run.name} is of {run.environment}, but {figure} draws {environment}; leave it out.")
    specs = _by_spec(runs)
    methods = [found[0].method for found in specs]
    groups = [
        Group(_label(found[0], alone=methods.count(found[0].method) == 1), tuple(sorted(found, key=lambda r: r.seed)))
        for found in specs
    ]
    return Selection(tuple(groups), ())


def _by_default(store: Store, figure: str, environment: str, methods: Sequence[str]) -> Selection:
    groups, notes, missing = [], [], []
    for method in methods:
        stored = store.runs(method=method, environment=environment)
        settled = [run for run in stored if run.state in SETTLED]
        if not settled:
            missing.append((method, len(stored)))
            continue
        specs = [_newest_of_each_seed(runs) for runs in _by_spec(settled)]
        best = max(specs, key=lambda runs: (len(runs), max(run.started for run in runs)))
        groups.append(Group(method, best))
        notes.append(_note(method, best, stored))
    if not groups:
        method, unfinished = missing[0]
        found = f"holds only unfinished runs of {method}" if unfinished else f"holds no run of {method}"
        remedy = f"run {command(method, environment)}"
        raise NoRuns(f"{figure} has nothing to draw: {place(store)} {found} on {environment}; {remedy}.")
    notes.extend(f"{method} is missing; run {command(method, environment)}." for method, _ in missing)
    return Selection(tuple(groups), tuple(notes))


def _by_spec(runs: Sequence[RunRow]) -> list[list[RunRow]]:
    """Runs of equal spec together, in the order of their first appearance."""
    specs: dict[str, list[RunRow]] = {}
    for run in runs:
        specs.setdefault(run.spec_hash, []).append(run)
    return list(specs.values())


def _newest_of_each_seed(runs: Sequence[RunRow]) -> tuple[RunRow, ...]:
    """`runs` come newest last."""
    newest = {run.seed: run for run in runs}
    return tuple(newest[seed] for seed in sorted(newest))


def _label(run: RunRow, alone: bool) -> str:
    return run.method if alone else f"{run.method} {run.spec_hash[:8]}"


def _note(method: str, chosen: Sequence[RunRow], stored: Sequence[RunRow]) -> str:
    """The spec that is drawn, and how many specs and unfinished runs are not."""
    spec_hash, profile = chosen[0].spec_hash, chosen[0].profile
    others = len({run.spec_hash for run in stored if run.state in SETTLED} - {spec_hash})
    unfinished = sum(run.spec_hash == spec_hash and run.state not in SETTLED for run in stored)
    note = f"{method}: spec {spec_hash[:8]} (profile {profile}), seeds {', '.join(str(run.seed) for run in chosen)}"
    if others:
        note += f"; {others} other stored spec{'s' * (others > 1)} left out (choose with --runs)"
    if unfinished:
        note += f"; {unfinished} unfinished run{'s' * (unfinished > 1)} left out"
    return f"{note}."
