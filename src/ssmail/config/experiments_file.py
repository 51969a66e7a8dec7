"""What stands in an experiments.yaml: its sections by name, and the layers of values that make a spec.

Layers, weakest first: defaults, environments.ENV, methods.METHOD, environments.ENV.methods.METHOD, profiles.PROFILE.
A profile may itself hold `environments: {ENV: {...}}` and `methods: {METHOD: {...}}`, which apply after its own keys.
"""

import os
from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, NamedTuple

from ssmail.config import strict_yaml
from ssmail.config.keys import nearest, unknown_name
from ssmail.errors import InputError

ENVIRONMENT_VARIABLE = "SSMAIL_EXPERIMENTS"
_FILE_NAME = "experiments.yaml"
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


class Layer(NamedTuple):
    """Nested values and the words that tell a user where they stand."""

    source: str
    values: Mapping[str, Any]


def load_experiments(file: Path | None = None) -> Experiments:
    """Read an experiments.yaml: `file`, else $SSMAIL_EXPERIMENTS, else the one shipped with the package.

    Raises InputError for a file that is missing, is not YAML (naming the line), or has other sections than Experiments.
    """
    path = file or find_file()
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


def find_file() -> Path:
    """$SSMAIL_EXPERIMENTS, else the file shipped with the package, else that of the checkout."""
    named = os.environ.get(ENVIRONMENT_VARIABLE)
    if named:
        return Path(named)
    package = Path(__file__).parents[1]
    packaged, checkout = package / _FILE_NAME, package.parents[1] / _FILE_NAME
    return packaged if packaged.exists() else checkout


def file_layers(experiments: Experiments, method: str, environment: str, profile: str) -> list[Layer]:
    """The layers of experiments.yaml for one cell, weakest first."""
    environment_values = named(experiments.environments, "environment", environment)
    method_values = named(experiments.methods, "method", method)
    profile_values = named(experiments.profiles, "profile", profile)
    special = _Special(experiments, method, environment)
    own, *for_methods = special.layers(f"environments.{environment}", environment_values)
    return [
        Layer(f"defaults of {experiments.path.name}", experiments.defaults),
        own,
        Layer(f"methods.{method} of {experiments.path.name}", method_values),
        *for_methods,
        *special.layers(f"profiles.{profile}", profile_values),
    ]


class _Special(NamedTuple):
    """Takes apart what an environment or a profile holds: its own keys, and those for a method or an environment."""

    experiments: Experiments
    method: str
    environment: str

    def layers(self, name: str, values: Mapping[str, Any]) -> list[Layer]:
        """The values' own layer, those of the sections within it that apply, and what these hold; weakest first."""
        file, own = self.experiments.path.name, dict(values)
        sections: list[Layer] = []
        within: list[Layer] = []
        for section, chosen, known in (
            ("environments", self.environment, self.experiments.environments),
            ("methods", self.method, self.experiments.methods),
            ("ablations", None, self.experiments.ablations),  # here for the check of its names; see ablation_layers
        ):
            entries = _mapping(own.pop(section, None), f"{name}.{section} of {file}")
            for entry in entries:
                named(known, f"{section.removesuffix('s')} in {name} of {file}", entry)
            if chosen is not None:
                source = f"{name}.{section}.{chosen}"
                held = _mapping(entries.get(chosen), f"{source} of {file}")
                layer, *deeper = self.layers(source, held) if held else [Layer(source, held)]
                sections.append(layer)
                within += deeper
        return [Layer(f"{name} of {file}", own), *sections, *within]


def ablation_layers(experiments: Experiments, name: str, profile: str) -> list[Layer]:
    """What an ablation sets, and what the profile sets for it."""
    file = experiments.path.name
    own, special = f"ablations.{name}.settings of {file}", f"profiles.{profile}.ablations.{name} of {file}"
    entries = _mapping(experiments.profiles[profile], f"profiles.{profile}").get("ablations") or {}
    return [
        Layer(own, _mapping(experiments.ablations[name].get("settings"), own)),
        Layer(special, _mapping(entries.get(name), special)),
    ]


def named(mappings: Mappings, kind: str, name: str) -> Mapping[str, Any]:
    """The entry `name`; raises InputError, with the nearest name, when there is none, or it is no mapping."""
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


def merge(weak: Mapping[str, Any], strong: Mapping[str, Any]) -> dict[str, Any]:
    """`weak` with the values of `strong` over its own, at any depth."""
    merged = dict(weak)
    for key, value in strong.items():
        both = isinstance(value, Mapping) and isinstance(merged.get(key), Mapping)
        merged[key] = merge(merged[key], value) if both else value
    return merged
