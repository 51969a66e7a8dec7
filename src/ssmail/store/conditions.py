"""Stored runs by the values of their specs, metrics and columns: conditions such as "sac.gamma=0.9", and orders.

A name is a dotted key of the spec, a metric such as test/mode_mse, of which the last value counts, or a column of the
run such as seed. A run without a value meets no condition, and comes last in any order.
"""

import difflib
import math
import operator
import re
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import fields
from datetime import datetime
from typing import Any, NamedTuple, Self

import yaml

from ssmail.config import strict_yaml
from ssmail.config.experiments import to_tuples
from ssmail.config.names import flatten
from ssmail.config.spec import spec_keys
from ssmail.errors import InputError, shortened
from ssmail.store.comparison import known_values
from ssmail.store.queries import RunRow
from ssmail.store.run_store import Store
from ssmail.store.schema import RunState

SIGNS: dict[str, Callable[[Any, Any], bool]] = {
    "!=": operator.ne,
    "<=": operator.le,
    ">=": operator.ge,
    "==": operator.eq,
    "=": operator.eq,
    "<": operator.lt,
    ">": operator.gt,
}
_FORM = re.compile(rf"\s*([^\s=<>!]+)\s*({'|'.join(SIGNS)})(.*\S.*)", re.DOTALL)
COLUMNS: Mapping[str, str] = {
    field.name: field.name for field in fields(RunRow) if field.name not in ("spec_json", "owner")
} | {"env": "environment", "run": "name"}
"""Names of columns, with the attribute of a RunRow."""


class Condition(NamedTuple):
    """A name, one of SIGNS, and the value that it is compared with."""

    name: str
    sign: str
    value: Any

    @classmethod
    def parse(cls, text: str) -> Self:
        """Return the condition of a text such as "sac.gamma>=0.9". Raises InputError for anything else."""
        if found := _FORM.fullmatch(text):
            with suppress(yaml.YAMLError):
                return cls(found[1], found[2], to_tuples(strict_yaml.parse(found[3])))
        raise InputError(
            f"'{shortened(text, 60)}' is no condition; write one as sac.gamma=0.9 or test/mode_mse<0.003, with one of "
            + ", ".join(SIGNS)
        )

    def holds(self, value: Any) -> bool:
        """Return whether a value meets the condition. Raises InputError if the two have no order."""
        both_numbers = _is_number(value) and _is_number(self.value)
        if self.sign in ("=", "==", "!="):
            equal = (both_numbers or type(value) is type(self.value)) and value == self.value
            return bool(equal) is (self.sign != "!=")
        if both_numbers or (isinstance(value, str) and isinstance(self.value, str)):
            return SIGNS[self.sign](value, self.value)
        if value is None:
            return False
        raise InputError(f"{self.name} is {strict_yaml.inline(value)} in a run, which has no order with {self.text}")

    @property
    def text(self) -> str:
        """The value as the user writes it."""
        return strict_yaml.inline(list(self.value) if isinstance(self.value, tuple) else self.value)


def matching(store: Store, runs: Sequence[RunRow], conditions: Sequence[Condition]) -> list[RunRow]:
    """Return the runs that meet all conditions. Raises InputError for a name that none of the runs has."""
    for condition in conditions:
        values = values_of(store, runs, condition.name)
        runs = [run for run in runs if run.id in values and condition.holds(values[run.id])]
    return list(runs)


def in_order(store: Store, runs: Sequence[RunRow], name: str, descending: bool = False) -> list[RunRow]:
    """Return the runs by rising value of a name; equal ones stay as they are. Raises InputError as `matching` does."""
    by_id = {run.id: run for run in runs}
    return [by_id[run_id] for run_id in _ranked([*by_id], values_of(store, runs, name), descending)]


def specs_in_order(store: Store, runs: Sequence[RunRow], name: str, descending: bool = False) -> list[RunRow]:
    """Return the runs with those of one spec together, by the mean over its seeds (of each, the newest run's value)."""
    values = values_of(store, runs, name)
    means: dict[str, Any] = {}
    for spec in dict.fromkeys(run.spec_hash for run in runs):
        newest = {run.seed: run.id for run in runs if run.spec_hash == spec}
        known = [values[run_id] for run_id in newest.values() if run_id in values]
        if known:
            means[spec] = sum(known) / len(known) if all(map(_is_number, known)) else known[0]
    specs = _ranked(list(dict.fromkeys(run.spec_hash for run in runs)), means, descending)
    return [run for spec in specs for run in runs if run.spec_hash == spec]


def values_of(store: Store, runs: Sequence[RunRow], name: str) -> dict[str, Any]:
    """Return the values of a name by run id, without runs that have none; lists are tuples, times are text.

    Raises InputError for a name that none of the runs has, with the nearest one.
    """
    if name in COLUMNS:
        found = {run.id: _plain(getattr(run, COLUMNS[name])) for run in runs}
        return {run_id: value for run_id, value in found.items() if value is not None}
    specs = {run.id: flatten(run.spec) for run in runs}
    if name in spec_keys() or any(name in spec for spec in specs.values()):
        return {run_id: to_tuples(spec[name]) for run_id, spec in specs.items() if name in spec}
    known, _ = known_values(store, runs, [name])
    if runs and not known:
        raise _unknown(name, [*spec_keys(), *COLUMNS, *_metrics(store, runs)])
    return {run_id: value for (run_id, _), value in known.items()}


def _metrics(store: Store, runs: Sequence[RunRow]) -> list[str]:
    """Return the names of the metrics of these runs, those of the test first."""
    names = sorted(set(store.latest_metrics([run.id for run in runs])["name"]))
    return sorted(names, key=lambda name: not name.startswith("test/"))


def _unknown(name: str, names: Sequence[str]) -> InputError:
    """One sentence with the nearest name; one with the same last part is nearest."""
    last = {known: re.split("[./]", known)[-1] for known in names}
    near = [known for known in names if last[known] == name]
    near += difflib.get_close_matches(name, names, n=1) or [
        known
        for part in difflib.get_close_matches(name, set(last.values()), n=1)
        for known in names
        if last[known] == part
    ]
    hint = (
        f"did you mean {near[0]}?"
        if near
        else "`ssmail config keys` lists the keys, `ssmail runs show RUN` the metrics"
    )
    return InputError(f"no run here has a key or metric '{shortened(name, 60)}'; {hint}")


def _ranked(names: Sequence[str], values: Mapping[str, Any], descending: bool) -> list[str]:
    """Return the names by value: numbers before texts, and what has none, NaN included, last."""

    def rank(name: str) -> tuple[bool, float, str]:
        value = values[name]
        return (False, value, "") if _is_number(value) else (True, 0.0, str(value))

    known = [name for name in names if not _is_nothing(values.get(name))]
    return [*sorted(known, key=rank, reverse=descending), *(name for name in names if _is_nothing(values.get(name)))]


def _plain(value: Any) -> Any:
    """Return the value of a column as a number or text."""
    if isinstance(value, datetime):
        return value.isoformat(sep=" ", timespec="seconds")
    return str(value) if isinstance(value, RunState) else value


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _is_nothing(value: Any) -> bool:
    return value is None or (isinstance(value, float) and math.isnan(value))
