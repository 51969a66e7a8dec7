"""Specs built from experiments.yaml: that of a run, those of an ablation, and those of a grid of values of any keys.

`ssmail.config.experiments_file` lists the layers that they are merged from.
"""

from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from itertools import product
from operator import attrgetter
from pathlib import Path
from typing import Any, NamedTuple

import yaml
from pydantic import ValidationError
from yaml.constructor import ConstructorError

from ssmail.config import strict_yaml
from ssmail.config.experiments_file import ABLATION_LAYERS, LAYERS, Experiments, Layer, load_experiments, merge
from ssmail.config.names import DEFAULT_ENVIRONMENT, DEFAULT_METHOD, ENVIRONMENTS, METHODS, flatten
from ssmail.config.spec import (
    GENERATED_ENVIRONMENTS,
    OPTIONAL_SECTIONS,
    RunSpec,
    check_keys,
    check_section,
    explain,
    nearest_key,
    required_sections,
)
from ssmail.config.user_functions import UserFunction, search_folders
from ssmail.errors import InputError, shortened, suggestion

MOST_SPECS = 1000  # in a grid
_LABEL = "self_supervision.label"
_SHOWN = 80  # characters of an argument in a message


class Ablation(NamedTuple):
    """One method trained with several values of one key of its spec."""

    name: str
    method: str
    environment: str
    key: str  # dotted, such as curriculum.beta
    values: tuple[Any, ...]  # lists are tuples (see `to_tuples`)


class Axis(NamedTuple):
    """One side of a grid: the name of an ablation or a dotted key, and its values; None: those of the ablation."""

    name: str
    values: Sequence[Any] | None = None


class Grid(NamedTuple):
    """The specs for every combination of values of some keys; the values are in the order of the keys."""

    keys: tuple[str, ...]  # dotted
    specs: dict[tuple[Any, ...], RunSpec]


class FigureRequirements(NamedTuple):
    """The runs that a figure draws: those of the methods, or (ablation not None) those of the ablation's values."""

    environment: str
    methods: tuple[str, ...]
    ablation: str | None = None


def build_spec(
    method: str,
    environment: str,
    profile: str,
    overrides: Sequence[str] = (),
    file: Path | None = None,
    source: str = "--set",
) -> RunSpec:
    """Merge the layers of experiments.yaml and the overrides, and validate the result.

    overrides: "key.path=value" with a YAML value; later ones win. file: another experiments.yaml than the one in use.
    source: the place of the overrides, as messages name it. Raises InputError, one sentence, for an unknown name or key
    (with a suggestion), a value of the wrong type or out of range, and a file that cannot be read.
    """
    return explained_spec(method, environment, profile, overrides, file, source)[0]


def explained_spec(
    method: str,
    environment: str,
    profile: str,
    overrides: Sequence[str] = (),
    file: Path | None = None,
    source: str = "--set",
) -> tuple[RunSpec, dict[str, str]]:
    """Return the spec that `build_spec` builds, and the place that the value of each dotted key comes from."""
    experiments = load_experiments(file)
    layers = experiments.layers(LAYERS, environment=environment, method=method, profile=profile)
    layers += override_layers(overrides, method, environment, source)
    return merge_layers(experiments, layers, method, environment, profile)


def ablation(name: str, environment: str | None = None, file: Path | None = None) -> Ablation:
    """Return the ablation `name` ("beta") of experiments.yaml, in its own environment or another one.

    Raises InputError for an unknown or incomplete ablation, and for an environment without the section of its key.
    """
    return _read_ablation(load_experiments(file), name, environment)


def ablation_specs(
    name: str,
    profile: str,
    values: Sequence[Any] | None = None,
    overrides: Sequence[str] = (),
    file: Path | None = None,
    environment: str | None = None,
) -> dict[Any, RunSpec]:
    """Return the spec for each value of an ablation: for `values`, or those in the file. Equal values count once.

    The value is the strongest layer. The keys are the values as the specs hold them. Raises InputError as build_spec
    does (the source of a wrong value is --values or the file), and for an override of the ablation's key.
    """
    load_experiments(file).entry("ablation", name)
    grid = grid_specs([Axis(name, values)], profile, overrides, file, environment=environment)
    return {value: spec for (value,), spec in grid.specs.items()}


def grid_specs(
    axes: Sequence[Axis],
    profile: str,
    overrides: Sequence[str] = (),
    file: Path | None = None,
    method: str | None = None,
    environment: str | None = None,
) -> Grid:
    """Return the specs for all combinations of the values of some keys. Equal combinations count once.

    Ablations among the axes add their settings; method and environment are theirs by default. The values are the
    strongest layer, and the keys of the result hold them as the specs do. Raises InputError as `ablation_specs` does,
    for ablations of different methods or environments, and for a key that is varied twice.
    """
    experiments = load_experiments(file)
    named = [_read_ablation(experiments, axis.name, environment) for axis in axes if axis.name in experiments.ablations]
    method = method or _common("method", [found.method for found in named], DEFAULT_METHOD)
    environment = environment or _common("env", [found.environment for found in named], DEFAULT_ENVIRONMENT)
    layers = experiments.layers(LAYERS, environment=environment, method=method, profile=profile)
    for found in named:
        layers += experiments.layers(ABLATION_LAYERS, ablation=found.name, profile=profile)
    given = override_layers(overrides, method, environment, "--set")
    overridden = {key for layer in given for key in flatten(layer.values)}
    sides: dict[str, list[Layer]] = {}
    for axis in axes:
        key, side = _side(experiments, axis, {found.name: found for found in named}, method, environment)
        if key in overridden:
            what = f"the ablation {axis.name}" if axis.name != key else "the command"
            raise InputError(f"{key} is what {what} varies; give its values with --values, not --set.")
        if key in sides:
            raise InputError(f"{key} is varied twice; give all of its values at once.")
        sides[key] = side
    combinations = list(product(*sides.values()))
    if len(combinations) > MOST_SPECS:
        raise InputError(f"{len(combinations)} combinations of values are more than {MOST_SPECS}; give fewer values.")
    specs: dict[tuple[Any, ...], RunSpec] = {}
    for varied in combinations:
        spec, _ = merge_layers(experiments, [*layers, *given, *varied], method, environment, profile)
        specs[tuple(attrgetter(key)(spec) for key in sides)] = spec
    return Grid(tuple(sides), specs)


def figure_requirements(name: str, file: Path | None = None) -> FigureRequirements:
    """Return the runs that figure `name` ("fig4") draws. Raises InputError for an unknown figure or a wrong entry."""
    experiments = load_experiments(file)
    entry = experiments.entry("figure", name)
    source = f"figures.{name} of {experiments.path.name}"
    texts = [
        entry.get("environment"),
        *(entry["methods"] if _is_list(entry.get("methods")) else [entry.get("ablation")]),
    ]
    if not all(isinstance(text, str) for text in texts) or ("methods" in entry) == ("ablation" in entry):
        raise InputError(f"{source} needs an environment, and either methods or an ablation; correct it.")
    if "methods" in entry:
        return FigureRequirements(entry["environment"], tuple(entry["methods"]))
    needed = _read_ablation(experiments, entry["ablation"], entry["environment"])
    return FigureRequirements(needed.environment, (needed.method,), needed.name)


def to_tuples(value: Any) -> Any:
    """Return a value with its lists as tuples, as a spec holds it; it can be a key of a dictionary."""
    return tuple(map(to_tuples, value)) if isinstance(value, list | tuple) else value


def display_value(value: Any) -> Any:
    """Return a spec's tuple as a user writes it, (0.0, 1.0) -> [0, 1], and any other value unchanged."""
    if not isinstance(value, list | tuple):
        return value
    return [int(part) if isinstance(part, float) and part.is_integer() else display_value(part) for part in value]


def merge_layers(
    experiments: Experiments, layers: Iterable[Layer], method: str, environment: str, profile: str
) -> tuple[RunSpec, dict[str, str]]:
    """Return the spec of these layers, weakest first, and the source of each dotted key."""
    merged: dict[str, Any] = {}
    sources: dict[str, str] = {}
    for layer in layers:
        given = flatten(layer.values)
        check_keys(given, layer.source)
        sources |= dict.fromkeys(given, layer.source)
        merged = merge(merged, layer.values)
    if method in METHODS and environment in ENVIRONMENTS:
        merged |= dict.fromkeys(set(OPTIONAL_SECTIONS) - set(required_sections(method, environment)))
        merged["data"] = {**merged.get("data", {}), **dict.fromkeys(set(GENERATED_ENVIRONMENTS) - {environment})}
    if function := UserFunction.parse(flatten(merged).get(_LABEL)):
        merged = merge(merged, _nested(_LABEL, function.with_digest(search_folders(experiments.path))))
    try:
        spec = RunSpec.model_validate({**merged, "method": method, "environment": environment, "profile": profile})
    except ValidationError as error:
        raise InputError(explain(error, sources, str(experiments.path))) from None
    return spec, sources


def _common(option: str, found: Sequence[str], default: str) -> str:
    """Return what all of the ablations have, the default without any. Raises InputError if they differ."""
    if len(set(found)) > 1:
        raise InputError(f"these ablations are of {' and '.join(dict.fromkeys(found))}; choose one with --{option}.")
    return found[0] if found else default


def _side(
    experiments: Experiments, axis: Axis, named: Mapping[str, Ablation], method: str, environment: str
) -> tuple[str, list[Layer]]:
    """Return the key of an axis, and a layer for each of its values."""
    if found := named.get(axis.name):
        key, values, source = found.key, found.values, f"ablations.{axis.name} of {experiments.path.name}"
        check_section(key, method, environment, source)
    else:
        key, values, source = axis.name, (), "--values"
        if "." not in key:
            raise InputError(
                f"unknown ablation or key '{shortened(key, 60)}'; {nearest_key(key, experiments.ablations)}"
            )
        check_keys({key: None}, source)
        check_section(key, method, environment, source)
    if axis.values is not None:
        values, source = tuple(axis.values), "--values"
    if not values:
        raise InputError(f"{key} has no values of its own; give them with --values.")
    return key, [Layer(source, _nested(key, value)) for value in values]


def _read_ablation(experiments: Experiments, name: str, environment: str | None) -> Ablation:
    entry = experiments.entry("ablation", name)
    source = f"ablations.{name} of {experiments.path.name}"
    needed = Ablation._fields[1:]
    for key in entry:
        if key not in (*needed, "settings"):
            known = (*needed, "settings")
            raise InputError(f"unknown key '{shortened(key, _SHOWN)}' in {source}; {suggestion(key, known)}")
    for key in needed:
        if not isinstance(entry.get(key), list if key == "values" else str) or not entry[key]:
            raise InputError(f"{source} needs {key} ({'a list' if key == 'values' else 'text'}); add it.")
    environment = environment or entry["environment"]
    experiments.entry("environment", environment)
    check_section(entry["key"], entry["method"], environment, source)
    values = entry["values"]
    if entry["key"] == _LABEL:
        with suppress(InputError):  # stored runs can be drawn without the files of their functions
            folders = search_folders(experiments.path)
            values = [found.with_digest(folders) if (found := UserFunction.parse(value)) else value for value in values]
    values = to_tuples(values)
    try:
        hash(values)
    except TypeError:
        raise InputError(f"a mapping is no value of {source}; list numbers, texts or lists.") from None
    return Ablation(name, entry["method"], environment, entry["key"], values)


def override_layers(overrides: Sequence[str], method: str, environment: str, source: str) -> list[Layer]:
    """Return a layer for each "key.path=value"."""
    layers = []
    for text in overrides:
        key, equals, value = text.partition("=")
        key, shown = key.strip(), shortened(text, _SHOWN)
        if not equals or not all(key.split(".")):
            raise InputError(f"--set takes key.path=value, not '{shown}'; for example --set sac.gamma=0.9.")
        try:
            layers.append(Layer(source, _nested(key, strict_yaml.parse(value))))
        except ConstructorError as error:
            raise InputError(f"{source} {shown} cannot be used: {error.problem}.") from None
        except yaml.YAMLError:
            raise InputError(f"the value of {source} {shown} is not valid YAML; put quotes around text.") from None
    for layer in layers:
        for key in flatten(layer.values):
            check_section(key, method, environment, source)
    return layers


def _nested(key: str, value: Any) -> dict[str, Any]:
    """Return a dotted key as nested mappings: ("a.b", 0.5) -> {"a": {"b": 0.5}}. Raises InputError for endless ones."""
    first, *rest = key.split(".")
    if len(rest) > strict_yaml.DEEPEST:
        raise InputError(f"unknown key '{shortened(key, _SHOWN)}'; keys look like sac.gamma.")
    for part in reversed(rest):
        value = {part: value}
    return {first: value}


def _is_list(value: Any) -> bool:
    return isinstance(value, list) and bool(value)
