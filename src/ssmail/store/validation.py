"""Whether stored rows are sound. A database may be damaged or come from someone else, so no value in it is trusted.

Rows are read as the database holds them (`raw`) and become values of the schema's types (`sound`), or are unsound.
"""

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import lru_cache
from typing import Any

import sqlalchemy as sa
from pydantic import ValidationError

from ssmail.config.names import ENVIRONMENTS, METHODS
from ssmail.config.spec import RunSpec, required_sections, with_added_keys
from ssmail.errors import shortened
from ssmail.store import arrays, schema
from ssmail.store.schema import RunState

LONGEST_NAME = 10_000  # characters of a text, except of those below
LONGEST_TEXT = 1_000_000  # characters of a spec or an error
LARGEST = 2**63 - 1
_SHOWN = 40  # characters of a value in a message
_DEEPEST = 16  # levels of a spec
_READ = ("training", "forecast")  # sections that are read of stored specs
_NEEDED = ("method", "environment", "profile", "training.epochs")  # of a spec, by whatever version
_KINDS = ("finite", "nan", "inf", "-inf")


class UnsoundError(ValueError):
    """What is wrong with a row: "its state is 'paused'"."""


@dataclass(frozen=True)
class DamagedRow:
    """A row that is not used: its table, the id of its run, what is wrong with it, and its name unless it is a run.

    Id and name are what is stored, of whatever type.
    """

    table: str
    run_id: Any
    reason: str
    named: Any = None

    @property
    def run(self) -> str:
        """The run as messages name it."""
        return self.run_id[:8] if schema.is_run_id(self.run_id) else shown(self.run_id)

    @property
    def place(self) -> str:
        """Where in the run it is: "metric test/mse: "; empty for the run itself."""
        return "" if self.table == schema.run.name else f"{self.table} {self.name}: "

    @property
    def name(self) -> str:
        """The name as messages show it."""
        return self.named if is_name(self.named) and len(self.named) <= _SHOWN else shown(self.named)


def raw(table: sa.Table) -> list[sa.ColumnElement[Any]]:
    """Return the columns of the table to select, for values as the database holds them, of whatever type."""
    return [sa.type_coerce(column, sa.types.NullType()).label(column.name) for column in table.c]


def sound(table: sa.Table, row: Mapping[Any, Any]) -> dict[str, Any]:
    """Return the values of a raw row, of the types of the table's columns. Raises UnsoundError."""
    values = {column.name: _value(column, row[column.name]) for column in table.c}
    if table is schema.run:
        _check_run(values)
    elif table is schema.array:
        try:
            arrays.decode(values["dtype"], values["shape"], values["data"])
        except arrays.UnreadableArrayError as error:
            raise UnsoundError(str(error)) from None
    elif "kind" in values and (fault := metric_fault(values["name"], values["step"], values["value"], values["kind"])):
        raise UnsoundError(fault)
    return values


def metric_fault(name: Any, step: Any, value: Any, kind: Any) -> str | None:
    """Return what is wrong with a raw value of a metric, or None."""
    if type(name) is not str or not _is_text(name, LONGEST_NAME):
        return f"its name is {shown(name)}"
    if type(step) is not int or not 0 <= step < 2**31:
        return f"its step is {shown(step)}"
    if kind == "finite":
        return None if type(value) in (float, int) and math.isfinite(value) else f"its value is {shown(value)}"
    return None if value is None and kind in _KINDS else f"its kind is {shown(kind)}, its value {shown(value)}"


def is_name(value: Any) -> bool:
    """Return whether a raw value can be the name of an array or a file."""
    return isinstance(value, str) and _is_text(value, LONGEST_NAME)


def shown(value: Any) -> str:
    """Return a stored value as messages show it: short, whatever it is."""
    return repr(value[:_SHOWN] if isinstance(value, str | bytes) else value)[:_SHOWN]


def _value(column: sa.Column[Any], value: Any) -> Any:
    """Return a raw value as one of the column's type. Raises UnsoundError."""
    kind, wrong = column.type, UnsoundError(f"its {column.name} is {shown(value)}")
    if value is None:
        if not column.nullable:
            raise wrong
        return None
    if isinstance(kind, sa.LargeBinary):
        if not isinstance(value, bytes | memoryview):
            raise wrong
        return bytes(value)
    if isinstance(kind, schema.UtcDateTime):
        return _time(value, wrong)
    if isinstance(kind, sa.Boolean):
        if value not in (0, 1):
            raise wrong
        return bool(value)
    if isinstance(kind, sa.String):
        return _text(column.name, value, wrong)
    if type(value) not in ((int,) if isinstance(kind, sa.Integer) else (int, float)) or not math.isfinite(value):
        raise wrong
    if column.name != "value" and not 0 <= value <= LARGEST:
        raise wrong
    return value if isinstance(kind, sa.Integer) else float(value)


def _time(value: Any, wrong: UnsoundError) -> datetime:
    try:
        time = value if isinstance(value, datetime) else datetime.fromisoformat(value)
    except (ValueError, TypeError):
        raise wrong from None
    if time.tzinfo is not None or not 1970 <= time.year < 9000:
        raise wrong
    return time.replace(tzinfo=UTC)


def _text(column: str, value: Any, wrong: UnsoundError) -> str:
    if not isinstance(value, str):
        raise wrong
    longest = LONGEST_TEXT if column in ("spec_json", "error") else LONGEST_NAME
    if len(value) > longest:
        raise UnsoundError(f"its {column} has {len(value)} characters")
    if not _is_text(value, longest):
        raise wrong
    return value


def _is_text(value: str, longest: int) -> bool:
    """Return whether the text is not too long, and is valid UTF-8 in the database (see `connection.make_engine`)."""
    if len(value) > longest:
        return False
    try:
        return value.isascii() or bool(value.encode())
    except UnicodeEncodeError:
        return False


def _check_run(values: dict[str, Any]) -> None:
    """Check what the types do not say of a row of the table `run`, and make its state a RunState.

    Raises UnsoundError.
    """
    if not schema.is_run_id(values["id"]):
        raise UnsoundError(f"its id is {shown(values['id'])}, not 32 hexadecimal digits")
    if values["state"] not in list(RunState):
        raise UnsoundError(f"its state is {shown(values['state'])}")
    values["state"] = RunState(values["state"])
    fault, *identity = _examine_spec(values["spec_json"])
    if fault is not None:
        raise UnsoundError(fault)
    for name, stored in zip(("method", "environment", "profile"), identity, strict=True):
        if values[name] != stored:
            raise UnsoundError(f"its {name} is {shown(values[name])}, but {shown(stored)} in its spec")


@lru_cache(maxsize=256)  # runs that differ in the seed have one spec
def _examine_spec(text: str) -> tuple[str | None, Any, Any, Any]:
    """Return what is wrong with a stored spec, or None; and its method, environment and profile.

    Keys that are missing, and keys and choices that this ssmail does not know, are not wrong: an earlier or a later one
    may have written them.
    """
    try:
        spec = json.loads(text)
    except (ValueError, RecursionError):
        return "its spec is not JSON", None, None, None
    if not isinstance(spec, dict) or not _is_plain(spec):
        return "its spec is JSON, but not a spec", None, None, None
    try:
        spec = with_added_keys(spec)
        RunSpec.model_validate_json(json.dumps(spec))
    except (TypeError, AttributeError, ValidationError) as error:
        problems = error.errors(include_url=False) if isinstance(error, ValidationError) else []
        serious = [item for item in problems if not _is_of_another_version(item)]
        if serious or not problems:
            key = ".".join(str(part) for part in serious[0]["loc"]) if serious else ""
            where = f" at {shortened(key, _SHOWN)}" if key else ""
            return f"its spec is not valid{where}", None, None, None
    method, environment, profile = (spec[key] for key in ("method", "environment", "profile"))
    known = method in METHODS and environment in ENVIRONMENTS
    for name in required_sections(method, environment) if known else ():
        if name in _READ and spec.get(name) is None:
            return f"its spec has no section {name}", None, None, None
    return None, method, environment, profile


def _is_of_another_version(problem: Mapping[str, Any]) -> bool:
    """Return whether a key is unknown, or has an unknown choice, or is one that runs are read without."""
    kind, key = problem["type"], ".".join(map(str, problem["loc"]))
    if kind == "missing":
        return key not in _NEEDED and not key.startswith("forecast.")
    return kind == "extra_forbidden" or (kind == "literal_error" and isinstance(problem["input"], str))


def _is_plain(spec: Any) -> bool:
    """Return whether a JSON value is not nested too deeply, and its numbers and texts are such as ssmail can use."""
    level = [spec]
    for _ in range(_DEEPEST):
        values = [item for value in level for item in (value.values() if isinstance(value, dict) else value)]
        keys = [key for value in level if isinstance(value, dict) for key in value]
        for value in (*keys, *values):
            if isinstance(value, str) and not _is_text(value, LONGEST_NAME):
                return False
            if isinstance(value, int | float) and not abs(value) <= LARGEST:  # not true of NaN either
                return False
        level = [value for value in values if isinstance(value, dict | list)]
        if not level:
            return True
    return False
