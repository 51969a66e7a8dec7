"""Runs that forecast, by the data that they were trained on: recorded motion, or trajectories of the user's own.

Errors on different data are not comparable, so each data set has figures and tables of its own. A figure draws one
profile, that with the most seeds, and of each method the spec that `run_groups.Family.rank` prefers. Of each seed it
is the newest run that finished or diverged. Baselines are drawn as references by all figures, so runs of theirs are
left out. Explicit run ids replace this choice: then each spec is a group of its own.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from ssmail.config.experiments_file import load_experiments
from ssmail.config.names import METHODS
from ssmail.errors import command_line, printable, shortened
from ssmail.plots import NoRuns
from ssmail.plots.formatting import as_file_name
from ssmail.plots.run_groups import (
    Family,
    Group,
    Selection,
    by_spec,
    choice_note,
    every_spec,
    fullest_profile,
    newest_of_each_seed,
)
from ssmail.store import RunRow, RunState, Store

FIGURE = "forecast"  # draws a chosen selection of the runs on a data set
OWN = "trajectories"
ENVIRONMENTS = ("mocap", OWN)
ERRORS = "test/mse"
"""The array that a finished run stores of its error at each predicted step."""
BASELINES = ("constant-velocity", "copy-last")
_LONGEST = 40  # characters of a name


@dataclass(frozen=True)
class DataSet:
    """The runs on one data set that finished or diverged, newest last. At least one of them finished."""

    name: str  # of its file, without the ending
    environment: str
    runs: tuple[RunRow, ...]

    @property
    def file_name(self) -> str:
        """The name as a part of a file's name."""
        return as_file_name(self.name)

    def selection(self, named: bool = False) -> Selection:
        """Return the default choice among the runs, or every run if the caller `named` them."""
        if named:
            return Selection(every_spec(self.runs, METHODS), (), named=True)
        learned = [run for run in self.runs if run.method not in BASELINES] or list(self.runs)
        methods = sorted({run.method for run in learned}, key=_place)
        families = {
            method: [Family(tuple(runs), current=True) for runs in by_spec([r for r in learned if r.method == method])]
            for method in methods
        }
        profile = fullest_profile(families)
        groups, notes = [], []
        for method, found in families.items():
            fitting = [family for family in found if family.runs[0].profile == profile]
            if fitting:
                best = max(fitting, key=lambda family: family.rank)
                groups.append(Group(method, newest_of_each_seed(best.runs)))
                notes.append(choice_note(FIGURE, groups[-1], True, [run for run in learned if run.method == method]))
            else:
                notes.append(f"{method} has no run of profile {profile}; `ssmail plot {FIGURE} --runs` chooses others.")
        return Selection(tuple(groups), tuple(notes))


def data_sets(store: Store, runs: Sequence[RunRow]) -> list[DataSet]:
    """Return the data sets on which some of the runs (newest last) forecast, in the order of their first run.

    Data sets of one name get the first digits of their hash as well.
    """
    found: dict[tuple[str, str | None], list[RunRow]] = {}
    for run in runs:
        if run.environment in ENVIRONMENTS and run.state.settled and _has_errors(store, run):
            found.setdefault((run.environment, run.dataset_hash), []).append(run)
    drawable = {key: each for key, each in found.items() if any(run.state is RunState.FINISHED for run in each)}
    names = _names(drawable)
    return [DataSet(names[key], key[0], tuple(each)) for key, each in drawable.items()]


def by_data(runs: Sequence[RunRow]) -> list[tuple[str | None, list[RunRow]]]:
    """Return the runs whose results can be compared together, with the name of their data set.

    On ENVIRONMENTS these are the runs on one data set; a run that did not come to read its file counts as one on the
    same file. The data of other environments are generated, so all runs of one are together, under no name.
    """
    read = {(run.environment, _path(run)): run.dataset_hash for run in runs if run.dataset_hash}
    named: dict[tuple[str, str | None], list[RunRow]] = {}
    found: dict[tuple[str, str | None], list[RunRow]] = {}
    for run in runs:
        recorded = run.environment in ENVIRONMENTS
        digest = run.dataset_hash or read.get((run.environment, _path(run))) if recorded else None
        group = found.setdefault((run.environment, digest), [])
        group.append(run)
        if recorded:
            named[run.environment, digest] = group
    names = _names(named)
    return [(names.get(key), each) for key, each in found.items()]


def _names(sets: Mapping[tuple[str, str | None], Sequence[RunRow]]) -> dict[tuple[str, str | None], str]:
    """Return a name for each data set, given as its environment and hash, by the last of its runs."""
    names = {key: name_of(each[-1]) for key, each in sets.items()}
    shared = [name for name, times in Counter(names.values()).items() if times > 1]
    return {key: f"{name}-{(key[1] or 'none')[:8]}" if name in shared else name for key, name in names.items()}


def required(store: Store, figure: str, runs: Sequence[RunRow]) -> list[DataSet]:
    """Return the `data_sets`. Raises NoRuns when there is none."""
    found = data_sets(store, runs)
    if not found:
        command = command_line("ssmail", "train", "--env", OWN, "--set", "data.path=FILE.npz", "--seeds", "0-4")
        what = f"none of the {len(runs)} chosen runs in {store.where} finished on {' or '.join(ENVIRONMENTS)}"
        raise NoRuns(f"{figure} has nothing to draw: {what}; run `{command}`.")
    return found


def is_own(run: RunRow) -> bool:
    """Return whether the run was trained on the user's own data, of which the paper says nothing.

    That is trajectories, and recorded motion from a file of another name than the one that experiments.yaml names.
    """
    if run.environment not in ENVIRONMENTS or run.environment == OWN:
        return run.environment == OWN
    usual = load_experiments().environments.get(run.environment, {}).get("data", {}).get("path", "")
    return Path(_path(run)).name != Path(usual).name


def _has_errors(store: Store, run: RunRow) -> bool:
    """Whether the errors of the run can be drawn; those of a diverged run are infinite."""
    return run.state is RunState.DIVERGED or ERRORS in store.array_names(run.id)


def name_of(run: RunRow) -> str:
    """Return the name of the run's data: that of its file without the ending, or else its environment."""
    return shortened(printable(Path(_path(run)).stem), _LONGEST) or run.environment


def _path(run: RunRow) -> str:
    return str(run.spec["data"].get("path") or "")


def _place(method: str) -> int:
    return METHODS.index(method) if method in METHODS else len(METHODS)
