"""The reference of the keys of a spec: type, unit, range, default and meaning of each, read off the sections."""

import ast
import inspect
from collections.abc import Iterator, Mapping
from itertools import chain, pairwise
from textwrap import dedent
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, NamedTuple, Union, get_args, get_origin, get_type_hints

from pydantic.fields import FieldInfo

from ssmail.config.experiments_file import Experiments, load_experiments
from ssmail.config.names import flatten
from ssmail.config.spec import (
    ARGUMENTS,
    ENVIRONMENT_SECTIONS,
    METHOD_SECTIONS,
    OPTIONAL_SECTIONS,
    RunSpec,
    section_of,
)
from ssmail.config.value_types import Frozen, Unit

_KINDS = {bool: "true, false", int: "whole number", float: "number", str: "text", tuple: "list", NoneType: "null"}
_BRACKETS = {"ge": ("[", "≥"), "gt": ("(", ">"), "le": ("]", "≤"), "lt": (")", "<")}


class Key(NamedTuple):
    """A key that can be set. The range is an interval, "[0, 1)", or one bound, "> 0"; None where there is none."""

    name: str  # dotted
    kind: str  # "number or null"
    unit: str | None
    range: str | None
    default: Any  # in the layer `defaults`; environments, methods and profiles may replace it
    meaning: str


class Section(NamedTuple):
    """A section with keys."""

    name: str  # dotted
    meaning: str
    used_by: tuple[str, ...]  # methods or environments, of a section that the others do not have
    keys: tuple[Key, ...]


def reference(experiments: Experiments | None = None) -> list[Section]:
    """Return every section that has keys, with the defaults of an experiments.yaml (that in use by default)."""
    defaults = flatten((experiments or load_experiments()).defaults)
    users = {**METHOD_SECTIONS, **ENVIRONMENT_SECTIONS}
    found = []
    for name, model in _sections(RunSpec):
        hints, meanings = get_type_hints(model, include_extras=True), _meanings(model)
        keys = [
            _key(f"{name}.{key}", hints[key], defaults, meanings.get(key, ""))
            for key, field in model.model_fields.items()
            if section_of(field.annotation) is None
        ]
        used_by = tuple(user for user, names in users.items() if name in names) if name in OPTIONAL_SECTIONS else ()
        summary = " ".join((inspect.getdoc(model) or "").split())
        found.append(Section(name, summary, used_by, tuple(keys)))
    return found


def _sections(model: type[Frozen], prefix: str = "") -> Iterator[tuple[str, type[Frozen]]]:
    """Yield the sections in a model, and those in them, by dotted name."""
    for name, field in model.model_fields.items():
        if (section := section_of(field.annotation)) and name not in ARGUMENTS:
            yield f"{prefix}{name}", section
            yield from _sections(section, f"{prefix}{name}.")


def _key(name: str, hint: Any, defaults: Mapping[str, Any], meaning: str) -> Key:
    kinds, about = _unfold(hint)
    words = list(dict.fromkeys(chain.from_iterable(map(_words, kinds))))
    kind = " or ".join(filter(None, (", ".join(words[:-1]), words[-1])))
    unit = next((item.name for item in about if isinstance(item, Unit)), None)
    return Key(name, kind, unit, _range(about), defaults.get(name), meaning)


def _unfold(hint: Any) -> tuple[list[Any], list[Any]]:
    """Return the plain types of an annotation, and the metadata that stand anywhere in it."""
    if get_origin(hint) is Annotated:
        inner, *about = get_args(hint)
        kinds, deeper = _unfold(inner)
        fields = [item.metadata if isinstance(item, FieldInfo) else [item] for item in about]
        return kinds, [*deeper, *chain.from_iterable(fields)]
    if get_origin(hint) in (Union, UnionType, tuple):
        parts = [_unfold(part) for part in get_args(hint)]
        kinds = [tuple] if get_origin(hint) is tuple else [kind for kinds, _ in parts for kind in kinds]
        return kinds, [item for _, about in parts for item in about]
    return [hint], []


def _words(kind: Any) -> list[str]:
    return list(map(str, get_args(kind))) if get_origin(kind) is Literal else _KINDS[kind].split(", ")


def _range(about: list[Any]) -> str | None:
    """Return the interval of metadata that have the attributes ge, gt, le and lt, as pydantic's have."""
    bounds = {name: value for name in _BRACKETS for item in about if (value := getattr(item, name, None)) is not None}
    if len(bounds) == 2:
        (low, first), (high, last) = bounds.items()
        return f"{_BRACKETS[low][0]}{first:g}, {last:g}{_BRACKETS[high][0]}"
    return next((f"{_BRACKETS[name][1]} {value:g}" for name, value in bounds.items()), None)


def _meanings(model: type[Frozen]) -> dict[str, str]:
    """Return the text below each field of a section, as one line."""
    (tree,) = ast.parse(dedent(inspect.getsource(model))).body
    assert isinstance(tree, ast.ClassDef)
    found = {}
    for field, text in pairwise(tree.body):
        if isinstance(field, ast.AnnAssign) and isinstance(field.target, ast.Name) and isinstance(text, ast.Expr):
            found[field.target.id] = " ".join(str(ast.literal_eval(text.value)).split())
    return found
