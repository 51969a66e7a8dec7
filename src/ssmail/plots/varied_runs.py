"""Which runs `ssmail plot ablation` draws: a family, whose specs differ in one key alone, or in two.

Without named runs it is the family with the most values times seeds, the newest on a tie, and of each seed the newest
run that finished or diverged.
"""

from collections.abc import Sequence
from datetime import datetime
from typing import Any

from ssmail.errors import InputError, command_line
from ssmail.plots import NoRuns
from ssmail.plots.formatting import counted, setting, spans
from ssmail.plots.run_groups import (
    ABSENT,
    Group,
    Selection,
    by_spec,
    check_alike,
    check_one_data_set,
    check_settled,
    grouped,
    newest_of_each_seed,
    rest_of,
    settings_of,
    value_of,
)
from ssmail.store import RunRow, Store
from ssmail.store.comparison import spec_differences

NAME = "ablation"
MOST_KEYS = 2


def select(store: Store, runs: Sequence[RunRow], keys: Sequence[str], named: bool = False) -> Selection:
    """Return the fullest family among these runs (newest last), or all of them if they are `named`, by value.

    The value of a group is a tuple, one for each key. Raises NoRuns where no runs differ in the keys alone, InputError
    for more than two keys, and for named runs that are no family, have not ended, or were trained on different data.
    """
    if not 1 <= len(keys) <= MOST_KEYS or len({*keys}) < len(keys):
        raise InputError(f"{NAME} draws the values of one key or of two; give --key once or twice.")
    chosen = _checked(runs, keys) if named else _fullest(store, runs, keys)
    check_one_data_set(NAME, chosen)
    groups = _groups(chosen, keys, named)
    drawn = [run for group in groups for run in group.runs]
    return Selection(tuple(groups), () if named else (_note(drawn, runs, keys),), named)


def _checked(runs: Sequence[RunRow], keys: Sequence[str]) -> list[RunRow]:
    """Return the runs. Raises InputError for one that differs from the first in more than the keys."""
    check_settled(runs, "test results")
    for run in runs:
        for key in keys:
            if value_of(run, key) is ABSENT:
                raise InputError(f"run {run.name} ({run.method}) has no {key}; leave it out.")
    check_alike(NAME, runs, *keys)
    return list(runs)


def _fullest(store: Store, runs: Sequence[RunRow], keys: Sequence[str]) -> list[RunRow]:
    """Return the runs of the family with the most cells, the newest on a tie. Raises NoRuns without any."""

    def rank(family: Sequence[RunRow]) -> tuple[int, datetime]:
        return len({(run.spec_hash, run.seed) for run in family}), family[-1].started

    families = _families(runs, keys)
    if families:
        return max(families, key=rank)
    told, words = " and ".join(keys), [f"{key}=V1,V2" for key in keys]
    others = [key for key in _varied(runs) if key not in keys]
    hint = f"; others differ in {', '.join(others[:5])}" if others else ""
    raise NoRuns(
        f"no runs in {store.where} differ in {told} alone{hint}; train some with "
        f"`{command_line('ssmail', 'ablate', *words)}`."
    )


def _families(runs: Sequence[RunRow], keys: Sequence[str]) -> list[list[RunRow]]:
    """Return the settled runs that differ in the keys alone, together; each key has two values or more."""
    there = [run for run in runs if run.state.settled and all(value_of(run, key) is not ABSENT for key in keys)]
    found = grouped(there, lambda run: rest_of(run, *keys))
    return [family for family in found if all(len({value_of(run, key) for run in family}) > 1 for key in keys)]


def _varied(runs: Sequence[RunRow]) -> list[str]:
    """Return the keys in which alone some of the runs differ."""
    keys = dict.fromkeys(key for differs in spec_differences(runs).values() for key in differs)
    return [key for key in keys if _families(runs, (key,))]


def _groups(runs: Sequence[RunRow], keys: Sequence[str], named: bool) -> list[Group]:
    """Return a group for each combination of values that is there, in order."""
    specs = [found if named else newest_of_each_seed(found) for found in by_spec(runs)]
    found = {
        tuple(value_of(each[0], key) for key in keys): sorted(each, key=lambda run: (run.seed, run.started))
        for each in sorted(specs, key=lambda each: min(run.started for run in each))
    }
    orders = [_ordered([values[number] for values in found]) for number in range(len(keys))]
    ranked = sorted(found, key=lambda values: [orders[number].index(value) for number, value in enumerate(values)])
    return [Group(", ".join(map(setting, values)), tuple(found[values]), values) for values in ranked]


def _ordered(values: Sequence[Any]) -> list[Any]:
    """Return the values, each once: numbers rising, then the others as they come, null last."""
    distinct = list(dict.fromkeys(values))
    numbers = sorted(value for value in distinct if isinstance(value, int | float) and not isinstance(value, bool))
    others = [value for value in distinct if value not in numbers]
    return [*numbers, *(value for value in others if value is not None), *([None] if None in others else [])]


def _note(drawn: Sequence[RunRow], runs: Sequence[RunRow], keys: Sequence[str]) -> str:
    """Say which family is drawn, and how many others there are."""
    first = drawn[0]
    others = len(_families(runs, keys)) - 1
    combinations = counted(len({run.spec_hash for run in drawn}), "value" if len(keys) == 1 else "combination")
    note = (
        f"runs of {first.method} on {first.environment} (profile {settings_of(drawn)}), {combinations} of "
        f"{' and '.join(keys)}, seeds {spans([run.seed for run in drawn])}"
    )
    if others:
        note += f"; {counted(others, 'other set')} of runs left out (choose with --method, --env, --where or --runs)"
    return f"{note}."
