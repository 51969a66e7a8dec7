"""The keys of a spec, and one sentence for everything that can be wrong with values given for them."""

import difflib
import re
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, get_args

from pydantic import BaseModel, ValidationError

from ssmail.config import strict_yaml
from ssmail.config.spec import (
    ENVIRONMENT_SECTIONS,
    ENVIRONMENTS,
    GENERATED,
    METHODS,
    OPTIONAL_SECTIONS,
    SECTIONS,
    RunSpec,
    sections_of,
)
from ssmail.errors import InputError

_ARGUMENTS = ("method", "environment", "profile")  # they come from build_spec's arguments, never from a mapping


def nearest(name: str, choices: Iterable[str]) -> str:
    """The end of a sentence about an unknown name: the nearest of `choices`, or all of them."""
    choices = list(choices)
    near = difflib.get_close_matches(name, choices, n=1)
    return f"did you mean {near[0]}?" if near else f"choose from {', '.join(choices)}."


def unknown_name(kind: str, name: str, choices: Iterable[str]) -> InputError:
    """The error for a misspelt name: one sentence with the nearest of `choices`, or all of them."""
    return InputError(f"unknown {kind} '{name}'; {nearest(name, choices)}")


def leaves(values: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """(dotted key, value) of every value that is not a mapping with keys."""
    for key, value in values.items():
        if isinstance(value, Mapping) and value:
            yield from leaves(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value


def _spec_keys(model: type[BaseModel], prefix: str = "") -> Iterator[tuple[str, bool]]:
    """(dotted key, whether it is a section) of every field of a spec."""
    for name, field in model.model_fields.items():
        section = _section(field.annotation)
        yield f"{prefix}{name}", section is not None
        if section:
            yield from _spec_keys(section, f"{prefix}{name}.")


def check_keys(given: Mapping[str, Any], source: str) -> None:
    """Raise InputError, naming `source`, when a dotted key of `given` is unknown, an argument or a section."""
    known = {key: section for key, section in _spec_keys(RunSpec) if key not in _ARGUMENTS}
    for key, value in given.items():
        if key in _ARGUMENTS:
            raise InputError(f"'{key}' in {source} cannot be set there; give it with --{key.removesuffix('ironment')}.")
        if key not in known:
            raise InputError(f"unknown key '{key}' in {source}; {_nearest_key(key, known)}")
        if known[key] and not isinstance(value, Mapping):
            first = next(other for other in known if other.startswith(f"{key}."))
            given_as = f"{key} = {strict_yaml.shown(value)} in {source}"
            raise InputError(f"{given_as} is a section, not a value; set one of its keys such as {first}.")


def check_section(key: str, method: str, environment: str, source: str) -> None:
    """Raise InputError for a dotted key in a section that a known method or environment does not have."""
    if method not in METHODS or environment not in ENVIRONMENTS:
        return
    section = key.partition(".")[0]
    for other in set(GENERATED) - {environment}:
        if key == f"data.{other}" or key.startswith(f"data.{other}."):
            raise InputError(f"environment {environment} has no section 'data.{other}' to set in {source}.")
    if section in OPTIONAL_SECTIONS and section not in sections_of(method, environment):
        tables = {**SECTIONS, **ENVIRONMENT_SECTIONS}
        users = ", ".join(name for name, sections in tables.items() if section in sections)
        what = f"method {method} on {environment}"
        raise InputError(f"{what} has no section '{section}' to set in {source}; it belongs to {users}.")


def _section(annotation: Any) -> type[BaseModel] | None:
    """The model of a section, `Section` or `Section | None`; None for a plain value."""
    for kind in get_args(annotation) or (annotation,):
        if isinstance(kind, type) and issubclass(kind, BaseModel):
            return kind
    return None


def _nearest_key(key: str, known: Mapping[str, bool]) -> str:
    """The nearest key of the section; else one with the same last part; else the nearest of all; else the choices."""
    values = [name for name, section in known.items() if not section]
    section, _, last = key.rpartition(".")
    siblings = {name.rpartition(".")[2]: name for name in known if name.rpartition(".")[0] == section}
    near = [siblings[name] for name in difflib.get_close_matches(last, siblings, n=1)]
    near = near or [name for name in values if name.rpartition(".")[2] == last]
    near = near or ([] if siblings else difflib.get_close_matches(key, values, n=1))
    if near:
        return f"did you mean {near[0]}?"
    choices = siblings.values() or [name for name in known if "." not in name]
    return f"choose from {', '.join(choices)}."


def sentence(error: ValidationError, origins: Mapping[str, str], path: Path) -> str:
    """The first of a validation's complaints: the key, where it was given, what was given, what is expected."""
    first = error.errors(include_url=False)[0]
    key = ".".join(str(part) for part in first["loc"])
    if first["type"] == "missing":
        return f"{path} gives no value for {key}; add it under defaults."
    if first["type"] == "value_error":
        return f"{key}: {first['msg'].removeprefix('Value error, ')}."
    expected = re.sub(r"^Input should be (a valid )?", "", first["msg"])
    source = f" in {origins[key]}" if key in origins else ""
    return f"{key} = {strict_yaml.shown(first['input'])}{source} should be {_article(expected)}."


def _article(expected: str) -> str:
    kinds = {"integer": "a whole number", "number": "a number", "boolean": "true or false", "string": "text"}
    return kinds.get(expected, expected)
