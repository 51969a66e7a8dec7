"""experiments.yaml -> run specs: defaults <- environments.ENV <- methods.METHOD <- profiles.PROFILE <- overrides.

A profile may itself hold `environments: {ENV: {...}}` and `methods: {METHOD: {...}}`, which apply after its own keys;
an environment may hold `methods: {METHOD: {...}}`, which apply after those of the method.
The specs of an ablation have its `settings`, and then the profile's `ablations: {NAME: {...}}`, before the overrides.
"""

import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, NamedTuple

import yaml
from pydantic import ValidationError

from ssmail import strict_yaml
from ssmail.errors import InputError
from ssmail.spec import ENVIRONMENTS, GENERATED, METHODS, OPTIONAL_SECTIONS, RunSpec, sections_of
from ssmail.spec_keys import check_keys, check_section, nearest, sentence
from ssmail.user_functions import UserFunction, pinned

ENVIRONMENT_VARIABLE = "SSMAIL_EXPERIMENTS"
_FILE_NAME = "experiments.yaml"
_LABEL = ("self_supervision", "label")
Mappings = Mapping[str, Mapping[str, Any]]


@dataclass(frozen=True)
class Experiments:
    """The sections of one experiments.yaml, by name, unvalidated below their names."""

    path: Path
    defaults: Mapping[str, Any]
    environments: Mappings
    methods: Mappings
    profiles: Mappings
    ablations: Mappings
    figures: Mappings


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


class _Layer(NamedTuple):
    """Nested values and the words that tell a user where they stand."""

    source: str
    values: Mapping[str, Any]


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
    layers = _file_layers(experiments, method, environment, profile)
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


def ablation_hashes(name: str, file: Path | None = None) -> list[str]:
    """The hashes of the ablation's specs in every profile."""
    experiments = load_experiments(file)
    wanted = _ablation(experiments, name)
    found = (_ablation_specs(experiments, wanted, profile, None, ()) for profile in experiments.profiles)
    return [spec.hash() for specs in found for spec in specs.values()]


def figure_requirements(name: str, file: Path | None = None) -> FigureRequirements:
    """The runs that figure `name` ("fig4") draws. Raises InputError for an unknown figure or a wrong entry."""
    experiments = load_experiments(file)
    entry = _named(experiments.figures, "figure", name)
    source = f"figures.{name} of {experiments.path.name}"
    if "environment" not in entry or ("methods" in entry) == ("ablation" in entry):
        raise InputError(f"{source} needs an environment, and either methods or an ablation; correct it.")
    if "methods" in entry:
        return FigureRequirements(entry["environment"], tuple(entry["methods"]))
    needed = _ablation(experiments, entry["ablation"])
    if needed.environment != entry["environment"]:
        raise InputError(f"{source} draws {entry['environment']}, but its ablation is of {needed.environment}.")
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


def load_experiments(file: Path | None = None) -> Experiments:
    """Read an experiments.yaml: `file`, else $SSMAIL_EXPERIMENTS, else the one shipped with the package.

    Raises InputError for a file that is missing, is not YAML (naming the line), or has other sections than Experiments.
    """
    path = file or _find_file()
    content = strict_yaml.read(path)
    sections = [field.name for field in fields(Experiments) if field.name != "path"]
    if not isinstance(content, dict):
        raise InputError(f"{path} holds no mapping; it needs the sections {', '.join(sections)}.")
    for name in content:
        if name not in sections:
            raise InputError(f"unknown section '{name}' in {path}; {nearest(str(name), sections)}")
    for name in sections:
        if not isinstance(content.get(name), dict):
            raise InputError(f"section '{name}' of {path} is missing or no mapping; compare with the shipped one.")
    return Experiments(path=path, **content)


def function_folders(file: Path | None = None) -> tuple[Path, ...]:
    """Where a user's own functions are looked for: the folder of the experiments.yaml in use, the current folder."""
    return tuple(dict.fromkeys(((file or _find_file()).resolve().parent, Path.cwd())))


def leaves(values: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """(dotted key, value) of every value that is not a mapping with keys."""
    for key, value in values.items():
        if isinstance(value, Mapping) and value:
            yield from leaves(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value


def unknown_name(kind: str, name: str, choices: Iterable[str]) -> InputError:
    """The error for a misspelt name: one sentence with the nearest of `choices`, or all of them."""
    return InputError(f"unknown {kind} '{name}'; {nearest(name, choices)}")


def _find_file() -> Path:
    named = os.environ.get(ENVIRONMENT_VARIABLE)
    if named:
        return Path(named)
    package = Path(__file__).parent
    packaged, checkout = package / _FILE_NAME, package.parents[1] / _FILE_NAME
    return packaged if packaged.exists() else checkout


def _assemble(
    experiments: Experiments, layers: Iterable[_Layer], method: str, environment: str, profile: str
) -> RunSpec:
    """The spec of these layers, weakest first."""
    merged: dict[str, Any] = {}
    origins: dict[str, str] = {}
    for layer in layers:
        given = dict(leaves(layer.values))
        check_keys(given, layer.source)
        origins.update(dict.fromkeys(given, layer.source))
        merged = _merge(merged, layer.values)
    if method in METHODS and environment in ENVIRONMENTS:
        merged |= dict.fromkeys(set(OPTIONAL_SECTIONS) - set(sections_of(method, environment)))
        merged["data"] = {**merged.get("data", {}), **dict.fromkeys(set(GENERATED) - {environment})}
    section, key = _LABEL
    if isinstance(merged.get(section), Mapping) and key in merged[section]:
        merged = _merge(merged, {section: {key: _pinned(merged[section][key], experiments)}})
    try:
        return RunSpec.from_mapping({**merged, "method": method, "environment": environment, "profile": profile})
    except ValidationError as error:
        raise InputError(sentence(error, origins, experiments.path)) from None


def _pinned(label: Any, experiments: Experiments) -> Any:
    """A label as a spec holds it: the name of a user's own function with the digest of its file, others unchanged."""
    function = UserFunction.parse(label)
    return pinned(function, function_folders(experiments.path)) if function else label


def _file_layers(experiments: Experiments, method: str, environment: str, profile: str) -> list[_Layer]:
    """The layers of experiments.yaml for one cell, weakest first."""
    environment_values = _named(experiments.environments, "environment", environment)
    method_values = _named(experiments.methods, "method", method)
    profile_values = _named(experiments.profiles, "profile", profile)
    special = _Special(experiments, method, environment)
    own, *for_methods = special.layers(f"environments.{environment}", environment_values)
    return [
        _Layer(f"defaults of {experiments.path.name}", experiments.defaults),
        own,
        _Layer(f"methods.{method} of {experiments.path.name}", method_values),
        *for_methods,
        *special.layers(f"profiles.{profile}", profile_values),
    ]


class _Special(NamedTuple):
    """Takes apart what an environment or a profile holds: its own keys, and those for a method or an environment."""

    experiments: Experiments
    method: str
    environment: str

    def layers(self, name: str, values: Mapping[str, Any]) -> list[_Layer]:
        """The values' own layer, those of the sections within it that apply, and what these hold; weakest first."""
        file, own = self.experiments.path.name, dict(values)
        sections: list[_Layer] = []
        within: list[_Layer] = []
        for section, chosen, known in (
            ("environments", self.environment, self.experiments.environments),
            ("methods", self.method, self.experiments.methods),
            ("ablations", None, self.experiments.ablations),  # here for the check of its names; see _ablation_layers
        ):
            entries = _mapping(own.pop(section, None), f"{name}.{section} of {file}")
            for entry in entries:
                _named(known, f"{section.removesuffix('s')} in {name} of {file}", entry)
            if chosen is not None:
                source = f"{name}.{section}.{chosen}"
                held = _mapping(entries.get(chosen), f"{source} of {file}")
                layer, *deeper = self.layers(source, held) if held else [_Layer(source, held)]
                sections.append(layer)
                within += deeper
        return [_Layer(f"{name} of {file}", own), *sections, *within]


def _ablation(experiments: Experiments, name: str, environment: str | None = None) -> Ablation:
    entry = _named(experiments.ablations, "ablation", name)
    source = f"ablations.{name} of {experiments.path.name}"
    choices = (*Ablation._fields[1:], "settings")
    for key in entry:
        if key not in choices:
            raise InputError(f"unknown key '{key}' in {source}; {nearest(str(key), choices)}")
    for key in Ablation._fields[1:]:
        if not isinstance(entry.get(key), list if key == "values" else str) or not entry[key]:
            raise InputError(f"{source} needs {key} ({'a list' if key == 'values' else 'text'}); add it.")
    where = environment or entry["environment"]
    _named(experiments.environments, "environment", where)
    check_section(entry["key"], entry["method"], where, source)
    values = entry["values"]
    if entry["key"] == ".".join(_LABEL):
        with suppress(InputError):  # runs can be drawn without the files of their functions
            values = [_pinned(value, experiments) for value in values]
    return Ablation(name, entry["method"], where, entry["key"], frozen(values))


def _ablation_specs(
    experiments: Experiments, found: Ablation, profile: str, values: Sequence[Any] | None, overrides: Sequence[str]
) -> dict[Any, RunSpec]:
    layers = _file_layers(experiments, found.method, found.environment, profile)
    layers += _ablation_layers(experiments, found.name, profile)
    given = _override_layers(overrides, found.method, found.environment, "--set")
    if any(found.key in dict(leaves(layer.values)) for layer in given):
        what = f"{found.key} is what the ablation {found.name} varies"
        raise InputError(f"{what}; give its values with --values, not --set.")
    source = f"ablations.{found.name} of {experiments.path.name}" if values is None else "--values"
    specs: dict[Any, RunSpec] = {}
    for value in found.values if values is None else values:
        varied = _Layer(source, _nested(found.key, value))
        spec = _assemble(experiments, [*layers, *given, varied], found.method, found.environment, profile)
        specs[spec_value(spec, found.key)] = spec
    return specs


def _ablation_layers(experiments: Experiments, name: str, profile: str) -> list[_Layer]:
    """What an ablation sets, and what the profile sets for it."""
    file = experiments.path.name
    own, special = f"ablations.{name}.settings of {file}", f"profiles.{profile}.ablations.{name} of {file}"
    entries = _mapping(experiments.profiles[profile], f"profiles.{profile}").get("ablations") or {}
    return [
        _Layer(own, _mapping(experiments.ablations[name].get("settings"), own)),
        _Layer(special, _mapping(entries.get(name), special)),
    ]


def _override_layers(overrides: Sequence[str], method: str, environment: str, source: str) -> list[_Layer]:
    """A layer for each override."""
    layers = [_Layer(source, _parse_override(text)) for text in overrides]
    for layer in layers:
        for key, _ in leaves(layer.values):
            check_section(key, method, environment, source)
    return layers


def _named(mappings: Mappings, kind: str, name: str) -> Mapping[str, Any]:
    if name not in mappings:
        raise unknown_name(kind, name, mappings)
    return _mapping(mappings[name], f"{kind} '{name}'")


def _mapping(value: Any, source: str) -> Mapping[str, Any]:
    """The value itself, or an empty mapping for YAML's null."""
    if value is None:
        return {}
    if not isinstance(value, Mapping):
        raise InputError(f"{source} should be a mapping, not {strict_yaml.shown(value)}.")
    return value


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


def _merge(weak: Mapping[str, Any], strong: Mapping[str, Any]) -> dict[str, Any]:
    merged = dict(weak)
    for key, value in strong.items():
        both = isinstance(value, Mapping) and isinstance(merged.get(key), Mapping)
        merged[key] = _merge(merged[key], value) if both else value
    return merged
