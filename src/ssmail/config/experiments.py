"""experiments.yaml -> run specs: defaults <- environments.ENV <- methods.METHOD <- profiles.PROFILE <- overrides.

A profile may itself hold `environments: {ENV: {...}}` and `methods: {METHOD: {...}}`, which apply after its own keys;
an environment may hold `methods: {METHOD: {...}}`, which apply after those of the method.
The specs of an ablation have its `settings`, and then the profile's `ablations: {NAME: {...}}`, before the overrides.
"""

from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import yaml
from pydantic import ValidationError

from ssmail.config import strict_yaml
from ssmail.config.experiments_file import (
    Experiments,
    Layer,
    ablation_layers,
    file_layers,
    find_file,
    load_experiments,
    merge,
    named,
)
from ssmail.config.keys import check_keys, check_section, leaves, nearest, sentence
from ssmail.config.spec import ENVIRONMENTS, GENERATED, METHODS, OPTIONAL_SECTIONS, RunSpec, sections_of
from ssmail.config.user_functions import UserFunction, pinned
from ssmail.errors import InputError

_LABEL = ("self_supervision", "label")


class Ablation(NamedTuple):
    """One method trained for several values of one key of its spec."""

    name: str
    method: str
    environment: str
    key: str  # dotted, as curriculum.beta
    values: tuple[Any, ...]  # see `frozen`


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
    """Merge the layers of experiments.yaml and validate the result.

    Each override is "key.path=value" with a YAML value; later ones win. `file` replaces the experiments.yaml that is
    found; `source` is what a sentence calls the place of the overrides. Raises InputError, one sentence, for an unknown
    name or key (it names the nearest), a value of the wrong type or out of range, and a file that cannot be read.
    """
    experiments = load_experiments(file)
    layers = file_layers(experiments, method, environment, profile)
    layers += _override_layers(overrides, method, environment, source)
    return _assemble(experiments, layers, method, environment, profile)


def ablation(name: str, environment: str | None = None, file: Path | None = None) -> Ablation:
    """The ablation `name` ("beta") of experiments.yaml, on its own environment or another one.

    Raises InputError for an unknown or incomplete one, and for an environment without the section of its key.
    """
    return _ablation(load_experiments(file), name, environment)


def ablation_specs(
    name: str,
    profile: str,
    values: Sequence[Any] | None = None,
    overrides: Sequence[str] = (),
    file: Path | None = None,
    environment: str | None = None,
) -> dict[Any, RunSpec]:
    """The spec for each of `values` (else the ablation's own), by the value as the spec holds it, each value once.

    Layers: those of build_spec's method, environment (the ablation's own unless one is given) and profile, the
    ablation's settings, the profile's settings for it, the overrides, the value. Raises InputError as build_spec does
    (a wrong value is "in --values" or in the file), and for an override of the ablated key.
    """
    experiments = load_experiments(file)
    return _ablation_specs(experiments, _ablation(experiments, name, environment), profile, values, overrides)


def figure_requirements(name: str, file: Path | None = None) -> FigureRequirements:
    """The runs that figure `name` ("fig4") draws. Raises InputError for an unknown figure or a wrong entry."""
    experiments = load_experiments(file)
    entry = named(experiments.figures, "figure", name)
    source = f"figures.{name} of {experiments.path.name}"
    if "environment" not in entry or ("methods" in entry) == ("ablation" in entry):
        raise InputError(f"{source} needs an environment, and either methods or an ablation; correct it.")
    if "methods" in entry:
        return FigureRequirements(entry["environment"], tuple(entry["methods"]))
    needed = _ablation(experiments, entry["ablation"], entry["environment"])
    return FigureRequirements(needed.environment, (needed.method,), needed.name)


def spec_value(spec: RunSpec, key: str) -> Any:
    """The value of a dotted key of the spec."""
    value: Any = spec
    for part in key.split("."):
        value = getattr(value, part)
    return value


def frozen(value: Any) -> Any:
    """A value as a spec holds it and as a dictionary may have it for a key: lists become tuples."""
    return tuple(map(frozen, value)) if isinstance(value, list | tuple) else value


def as_written(value: Any) -> Any:
    """The value of a spec as people write it: (0.0, 1.0) -> [0, 1]. One that is no tuple stays as it is."""
    if not isinstance(value, list | tuple):
        return value
    return [int(part) if isinstance(part, float) and part.is_integer() else as_written(part) for part in value]


def function_folders(file: Path | None = None) -> tuple[Path, ...]:
    """Where a user's own functions are looked for: the folder of the experiments.yaml in use, the current folder."""
    return tuple(dict.fromkeys(((file or find_file()).resolve().parent, Path.cwd())))


def _assemble(
    experiments: Experiments, layers: Iterable[Layer], method: str, environment: str, profile: str
) -> RunSpec:
    """The spec of these layers, weakest first."""
    merged: dict[str, Any] = {}
    origins: dict[str, str] = {}
    for layer in layers:
        given = dict(leaves(layer.values))
        check_keys(given, layer.source)
        origins.update(dict.fromkeys(given, layer.source))
        merged = merge(merged, layer.values)
    if method in METHODS and environment in ENVIRONMENTS:
        merged |= dict.fromkeys(set(OPTIONAL_SECTIONS) - set(sections_of(method, environment)))
        merged["data"] = {**merged.get("data", {}), **dict.fromkeys(set(GENERATED) - {environment})}
    section, key = _LABEL
    if isinstance(merged.get(section), Mapping) and key in merged[section]:
        merged = merge(merged, {section: {key: _pinned(merged[section][key], experiments)}})
    try:
        return RunSpec.from_mapping({**merged, "method": method, "environment": environment, "profile": profile})
    except ValidationError as error:
        raise InputError(sentence(error, origins, experiments.path)) from None


def _pinned(label: Any, experiments: Experiments) -> Any:
    """A label as a spec holds it: the name of a user's own function with the digest of its file, others unchanged."""
    function = UserFunction.parse(label)
    return pinned(function, function_folders(experiments.path)) if function else label


def _ablation(experiments: Experiments, name: str, environment: str | None = None) -> Ablation:
    entry = named(experiments.ablations, "ablation", name)
    source = f"ablations.{name} of {experiments.path.name}"
    choices = (*Ablation._fields[1:], "settings")
    for key in entry:
        if key not in choices:
            raise InputError(f"unknown key '{key}' in {source}; {nearest(str(key), choices)}")
    for key in Ablation._fields[1:]:
        if not isinstance(entry.get(key), list if key == "values" else str) or not entry[key]:
            raise InputError(f"{source} needs {key} ({'a list' if key == 'values' else 'text'}); add it.")
    where = environment or entry["environment"]
    named(experiments.environments, "environment", where)
    check_section(entry["key"], entry["method"], where, source)
    values = entry["values"]
    if entry["key"] == ".".join(_LABEL):
        with suppress(InputError):  # runs can be drawn without the files of their functions
            values = [_pinned(value, experiments) for value in values]
    return Ablation(name, entry["method"], where, entry["key"], frozen(values))


def _ablation_specs(
    experiments: Experiments, found: Ablation, profile: str, values: Sequence[Any] | None, overrides: Sequence[str]
) -> dict[Any, RunSpec]:
    layers = file_layers(experiments, found.method, found.environment, profile)
    layers += ablation_layers(experiments, found.name, profile)
    given = _override_layers(overrides, found.method, found.environment, "--set")
    if any(found.key in dict(leaves(layer.values)) for layer in given):
        what = f"{found.key} is what the ablation {found.name} varies"
        raise InputError(f"{what}; give its values with --values, not --set.")
    source = f"ablations.{found.name} of {experiments.path.name}" if values is None else "--values"
    specs: dict[Any, RunSpec] = {}
    for value in found.values if values is None else values:
        varied = Layer(source, _nested(found.key, value))
        spec = _assemble(experiments, [*layers, *given, varied], found.method, found.environment, profile)
        specs[spec_value(spec, found.key)] = spec
    return specs


def _override_layers(overrides: Sequence[str], method: str, environment: str, source: str) -> list[Layer]:
    """A layer for each override."""
    layers = [Layer(source, _parse_override(text)) for text in overrides]
    for layer in layers:
        for key, _ in leaves(layer.values):
            check_section(key, method, environment, source)
    return layers


def _parse_override(text: str) -> dict[str, Any]:
    """ "a.b=0.5" -> {"a": {"b": 0.5}}."""
    key, equals, value = text.partition("=")
    key = key.strip()
    if not equals or not all(key.split(".")):
        raise InputError(f"--set takes key.path=value, not '{text}'; for example --set sac.gamma=0.9.")
    try:
        parsed = strict_yaml.parse(value)
    except yaml.YAMLError:
        raise InputError(f"the value of --set {text} is not valid YAML; put quotes around text.") from None
    return _nested(key, parsed)


def _nested(key: str, value: Any) -> dict[str, Any]:
    """("a.b", 0.5) -> {"a": {"b": 0.5}}."""
    first, _, rest = key.partition(".")
    return {first: _nested(rest, value) if rest else value}
