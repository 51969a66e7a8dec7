"""Which runs: the series that a figure compares, the specs that they need, and the stored runs that are drawn.

A figure compares methods, or the values of one key of the spec (an ablation); `figures` in experiments.yaml says which.
By default all series of a figure are drawn from one profile, and of each seed the newest run that finished or diverged:

- Methods: the profile with the most seeds. Within it each method is drawn from one spec: the one that experiments.yaml
  gives now, else the one with the most seeds, on a tie the most epochs, and then the newest. Other stored specs are
  counted in a note.
- An ablation: one family, that is runs whose specs differ in the ablation's key alone, whatever the values; those of
  `ssmail ablate NAME --values ...` belong to it. It is the family that experiments.yaml gives in some profile, else the
  one with the most values times seeds, if it has at least two values, and on a tie likewise.

Explicit run ids replace this choice: all of these runs are drawn, whatever their state. Methods keep different specs
apart as groups of their own; the runs of an ablation have to make one family.
"""

from collections.abc import Callable, Sequence, Set
from typing import Any, NamedTuple

from ssmail.config.experiments import (
    Ablation,
    ablation,
    ablation_specs,
    build_spec,
    display_value,
    figure_requirements,
)
from ssmail.config.experiments_file import load_experiments
from ssmail.config.spec import RunSpec
from ssmail.errors import InputError, command_line
from ssmail.plots import NoRuns
from ssmail.plots.formatting import counted
from ssmail.plots.run_groups import (
    ABSENT,
    Family,
    Group,
    Selection,
    by_spec,
    check_alike,
    check_one_data_set,
    choice_note,
    every_spec,
    fullest_profile,
    grouped,
    newest_of_each_seed,
    rest_of,
    settings_of,
    value_of,
)
from ssmail.store import RunRow, Store


class _Comparison(NamedTuple):
    """What a figure compares on one environment: methods, or the values of an ablation's key."""

    figure: str
    environment: str
    methods: tuple[str, ...]
    ablation: Ablation | None

    @classmethod
    def of(cls, figure: str, environment: str | None = None) -> "_Comparison":
        """Read it from experiments.yaml. Raises InputError for an unknown figure or environment."""
        needed = figure_requirements(figure)
        where = environment or needed.environment
        varied = None if needed.ablation is None else ablation(needed.ablation, where)
        return cls(figure, where, needed.methods, varied)

    @property
    def key(self) -> str | None:
        """The key of the spec in which the runs of a family may differ."""
        return self.ablation and self.ablation.key

    def command(self, method: str, profile: str | None) -> str:
        """The command that trains the runs: those of `method`, or all of the ablation."""
        if self.ablation is None:
            return train_command(method, self.environment, profile)
        elsewhere = self.environment != ablation(self.ablation.name).environment
        where = ("--env", self.environment) if elsewhere else ()
        options = (*where, "--profile", profile or "quick", "--seeds", "0-4")
        return f"`{command_line('ssmail', 'ablate', self.ablation.name, *options)}`"


def figure_specs(figure: str, profile: str) -> dict[RunSpec, dict[str, Any]]:
    """Return the spec of each series of `figure` ("fig4") in `profile`, with what tells it from the others.

    That is its method and, of an ablation, the key and its value: {"method": "ssail", "curriculum.beta": 0.15}. Raises
    InputError for an unknown figure or profile.
    """
    needed = _Comparison.of(figure)
    if (varied := needed.ablation) is None:
        return {build_spec(method, needed.environment, profile): {"method": method} for method in needed.methods}
    specs = ablation_specs(varied.name, profile, environment=varied.environment)
    return {spec: {"method": varied.method, varied.key: display_value(value)} for value, spec in specs.items()}


def needed_by(figure: str) -> Callable[[RunRow], bool]:
    """Return a test of whether `figure` needs a run: one of its methods, or of its ablation's specs in any profile.

    Raises InputError for an unknown figure.
    """
    needed = figure_requirements(figure)
    specs = None
    if needed.ablation is not None:
        specs = {spec.hash() for profile in load_experiments().profiles for spec in figure_specs(figure, profile)}

    def needs(run: RunRow) -> bool:
        fits = run.environment == needed.environment and run.method in needed.methods
        return fits and (specs is None or run.spec_hash in specs)

    return needs


def select(
    store: Store,
    figure: str,
    ids: Sequence[str] | None = None,
    profile: str | None = None,
    environment: str | None = None,
) -> Selection:
    """Return the runs that `figure` draws: those of `ids`, or the default choice among the stored ones.

    `profile` (any by default) and `environment` (the figure's own by default) restrict the default choice. Raises
    NoRuns when no run fits. Raises InputError for an unknown id, a run of another environment, runs of an ablation that
    differ in more than its key, and runs that were trained on different data.
    """
    needed = _Comparison.of(figure, environment)
    if ids:
        chosen = _given(needed, store.runs(ids=ids))
    elif needed.ablation is None:
        chosen = _default_methods(store, needed, profile)
    else:
        chosen = _default_family(store, needed, needed.ablation, profile)
    check_one_data_set(figure, chosen.runs)
    return chosen


def select_data(
    store: Store, figure: str, arrays: Set[str], ids: Sequence[str] | None, profile: str | None
) -> Selection:
    """Return the newest run that holds all of these arrays of the figure's environment, whatever its method.

    With `ids`, that is the newest of these runs, or else of the runs on the same data, because a compact database keeps
    the expert set only once. Raises NoRuns when no run holds the arrays, InputError for an unfit id.
    """
    needed = figure_requirements(figure)
    environment = needed.environment
    stored = store.runs(ids=ids) if ids else store.runs(environment=environment, profile=profile)

    def holding(runs: Sequence[RunRow]) -> list[RunRow]:
        return [run for run in runs if run.environment == environment and arrays <= {*store.array_names(run.id)}]

    fitting = holding(stored)
    if not fitting and ids:
        data = {run.dataset_hash for run in stored if run.environment == environment and run.dataset_hash}
        fitting = holding([run for run in store.runs(environment=environment) if run.dataset_hash in data])
    if fitting:
        run = fitting[-1]
        return Selection(
            (Group(run.method, (run,)),), (f"the environment is that of run {run.name}.",), named=bool(ids)
        )
    remedy = f"run {train_command(needed.methods[0], environment, profile)}"
    if ids:
        raise InputError(f"none of the given runs holds the expert set of {environment}; leave --runs out or {remedy}.")
    found = "no finished run" if stored else "no run"
    raise NoRuns(f"{figure} has nothing to draw: {store.where} holds {found} on {environment}; {remedy}.")


def figure_ablation(figure: str) -> Ablation:
    """Return the ablation whose values `figure` compares. Raises InputError when experiments.yaml names none for it."""
    found = _Comparison.of(figure).ablation
    if found is None:
        raise InputError(f"figures.{figure} of experiments.yaml names no ablation; add one, such as beta.")
    return found


def fullest_spec(runs: Sequence[RunRow]) -> tuple[RunRow, ...]:
    """Return the settled runs of the spec that is drawn of one method: see above. Empty without any."""
    families = [Family(tuple(found), _gives_now(found[0])) for found in by_spec(runs)]
    return max(families, key=lambda family: family.rank).runs if families else ()


def train_command(method: str, environment: str, profile: str | None = None) -> str:
    """Return the command that trains runs of this method."""
    options = ("--method", method, "--env", environment, "--profile", profile or "quick")
    return f"`{command_line('ssmail', 'train', *options, '--seeds', '0-4')}`"


def _given(needed: _Comparison, runs: Sequence[RunRow]) -> Selection:
    """All of these runs. Raises InputError for one that the figure cannot draw beside the others."""
    for run in runs:
        if run.environment != needed.environment:
            raise InputError(
                f"run {run.name} is of {run.environment}, but {needed.figure} draws {needed.environment}; leave it out."
            )
    if needed.ablation is not None:
        _check_one_family(needed.figure, needed.ablation.key, runs)
        return Selection(_groups_of_values(needed.ablation, runs, tuple), (), named=True)
    return Selection(every_spec(runs, needed.methods), (), named=True)


def _check_one_family(figure: str, key: str, runs: Sequence[RunRow]) -> None:
    for run in runs:
        if value_of(run, key) is ABSENT:
            raise InputError(f"run {run.name} ({run.method}) has no {key}, which {figure} compares; leave it out.")
    check_alike(figure, runs, key)


def _families(needed: _Comparison, stored: Sequence[RunRow]) -> list[Family]:
    """The families of the settled runs. A single spec of an ablation is none, unless experiments.yaml gives it."""
    settled = [run for run in stored if run.state.settled]
    if (key := needed.key) is None:
        return [Family(tuple(runs), _is_current(needed, runs[0])) for runs in by_spec(settled)]
    varied = [run for run in settled if value_of(run, key) is not ABSENT]
    found = grouped(varied, lambda run: rest_of(run, key))
    families = [Family(tuple(runs), _is_current(needed, runs[0])) for runs in found]
    return [family for family in families if family.current or len(by_spec(family.runs)) > 1]


def _is_current(needed: _Comparison, run: RunRow) -> bool:
    """Whether experiments.yaml gives the run's spec now; an unknown profile or method counts as outdated."""
    if needed.ablation is None:
        return _gives_now(run)
    try:
        name, value = needed.ablation.name, value_of(run, needed.ablation.key)
        specs = ablation_specs(name, run.profile, values=[value], environment=needed.environment)
        return run.spec_hash in {spec.hash() for spec in specs.values()}
    except InputError:
        return False


def _gives_now(run: RunRow) -> bool:
    """Whether `ssmail train` would give the run's method this spec now."""
    try:
        return build_spec(run.method, run.environment, run.profile).hash() == run.spec_hash
    except InputError:
        return False


def _no_runs(store: Store, needed: _Comparison, profile: str | None, any_stored: bool) -> NoRuns:
    """One sentence with the command that trains the runs."""
    what = needed.methods[0] if needed.ablation is None else f"the ablation {needed.ablation.name}"
    found = f"{store.where} holds no {'finished ' * any_stored}run of {what} on {needed.environment}"
    found += f" of profile {profile}" if profile else ""
    remedy = f"run {needed.command(needed.methods[0], profile)}"
    return NoRuns(f"{needed.figure} has nothing to draw: {found}; {remedy}.")


def _default_methods(store: Store, needed: _Comparison, profile: str | None) -> Selection:
    where = needed.environment
    stored = {method: store.runs(method=method, environment=where, profile=profile) for method in needed.methods}
    families = {method: _families(needed, runs) for method, runs in stored.items()}
    if not any(families.values()):
        raise _no_runs(store, needed, profile, any_stored=bool(stored[needed.methods[0]]))
    drawn_profile = profile or fullest_profile(families)
    groups, notes, missing = [], [], []
    for method, found in families.items():
        fitting = [family for family in found if family.runs[0].profile == drawn_profile]
        if fitting:
            best = max(fitting, key=lambda family: family.rank)
            groups.append(Group(method, newest_of_each_seed(best.runs)))
            notes.append(choice_note(needed.figure, groups[-1], best.current, stored[method]))
        else:
            missing.append(f"{method} is missing; run {needed.command(method, drawn_profile)}.")
    return Selection(tuple(groups), (*notes, *missing))


def _default_family(store: Store, needed: _Comparison, varied: Ablation, profile: str | None) -> Selection:
    stored = store.runs(method=varied.method, environment=needed.environment, profile=profile)
    families = _families(needed, stored)
    if not families:
        raise _no_runs(store, needed, profile, any_stored=bool(stored))
    best = max(families, key=lambda family: family.rank)
    groups = _groups_of_values(varied, best.runs, newest_of_each_seed)
    seeds = sorted({run.seed for group in groups for run in group.runs})
    drawn_profile = best.runs[0].profile
    note = f"ablation {varied.name}: runs of {varied.method} (profile {settings_of(best.runs)}), "
    note += f"{counted(len(groups), 'value')}, seeds {', '.join(map(str, seeds))}"
    if not best.current:
        note += f"; they differ in {varied.key} alone, but are not what experiments.yaml gives now"
        return Selection(groups, (f"{note}.", *_gaps(varied, groups, seeds, None)))
    return Selection(groups, (f"{note}.", *_gaps(varied, groups, seeds, needed.command(varied.method, drawn_profile))))


def _groups_of_values(
    varied: Ablation, runs: Sequence[RunRow], choose: Callable[[Sequence[RunRow]], tuple[RunRow, ...]]
) -> tuple[Group, ...]:
    """A group for each value: numbers rising, anything else in the order of experiments.yaml."""
    values: dict[Any, list[RunRow]] = {}
    for run in runs:
        values.setdefault(value_of(run, varied.key), []).append(run)
    order = list(varied.values)
    if not all(isinstance(value, int | float) for value in values):
        ranked = sorted(values, key=lambda value: order.index(value) if value in order else len(order))
    else:
        ranked = sorted(values)
    return tuple(
        Group(_value_label(value), tuple(sorted(choose(values[value]), key=lambda run: run.seed)), value)
        for value in ranked
    )


def _value_label(value: Any) -> str:
    return f"{value:g}" if isinstance(value, float) else str(display_value(value))


def _gaps(varied: Ablation, groups: Sequence[Group], seeds: Sequence[int], command: str | None) -> list[str]:
    """What is missing: of any value, the seeds that others have; and with a command, values of experiments.yaml."""
    there = {group.value: {run.seed for run in group.runs} for group in groups}
    missing = []
    for value, found in there.items():
        if gone := [seed for seed in seeds if seed not in found]:
            missing.append(
                f"{_value_label(value)} ({'seed' if len(gone) == 1 else 'seeds'} {', '.join(map(str, gone))})"
            )
    if command is not None:
        missing += [_value_label(value) for value in varied.values if value not in there]
    if not missing:
        return []
    remedy = f"; {command} computes what is missing" if command is not None else ""
    return [f"missing of {varied.key}: {', '.join(missing)}{remedy}."]
