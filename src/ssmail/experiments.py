"""experiments.yaml -> run specs: defaults <- environments.ENV <- methods.METHOD <- profiles.PROFILE <- overrides.

A profile may itself hold `environments: {ENV: {...}}` and `methods: {METHOD: {...}}`, which apply after its own keys.
"""

import difflib
import os
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, NamedTuple, get_args

import yaml
from pydantic import BaseModel, ValidationError

from ssmail.errors import InputError
from ssmail.spec import OPTIONAL_SECTIONS, SECTIONS, RunSpec

ENVIRONMENT_VARIABLE = "SSMAIL_EXPERIMENTS"
_FILE_NAME = "experiments.yaml"
_ARGUMENTS = (
    "method",
    "environment",
    "profile",
)  # spec fields that come from build_spec's arguments, never from a mapping

Mappings = Mapping[str, Mapping[str, Any]]


@dataclass(frozen=True)
class Experiments:
    """The sections of one experiments.yaml, by name, unvalidated below their names."""

    path: Path
    defaults: Mapping[str, Any]
    environments: Mappings
    methods: Mappings
    profiles: Mappings
    figures: Mappings


class FigureRequirements(NamedTuple):
    """The runs that a figure draws."""

    environment: str
    methods: tuple[str, ...]


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
    layers += [_Layer(source, _parse_override(text)) for text in overrides]
    merged: dict[str, Any] = {}
    origins: dict[str, str] = {}
    for layer in layers:
        given = dict(leaves(layer.values))
        _check_keys(given, layer.source)
        origins.update(dict.fromkeys(given, layer.source))
        merged = _merge(merged, layer.values)
    for text in overrides:
        _check_section(text.partition(".")[0].strip(), method, source)
    merged |= {name: None for name in OPTIONAL_SECTIONS if name not in SECTIONS[method]}
    try:
        return RunSpec.from_mapping({**merged, "method": method, "environment": environment, "profile": profile})
    except ValidationError as error:
        raise InputError(_sentence(error, origins, experiments.path)) from None


def figure_requirements(name: str, file: Path | None = None) -> FigureRequirements:
    """The environment and methods whose runs figure `name` ("fig4") draws. Raises InputError for an unknown figure."""
    experiments = load_experiments(file)
    entry = _named(experiments.figures, "figure", name)
    try:
        environment, methods = entry["environment"], entry["methods"]
    except KeyError as missing:
        raise InputError(f"figures.{name} in {experiments.path} has no key {missing}; add it.") from None
    return FigureRequirements(environment, tuple(methods))


def load_experiments(file: Path | None = None) -> Experiments:
    """Read an experiments.yaml: `file`, else $SSMAIL_EXPERIMENTS, else the one shipped with the package.

    Raises InputError for a file that is missing, is not YAML (naming the line), or has other sections than Experiments.
    """
    path = file or _find_file()
    content = _read_yaml(path)
    sections = [field.name for field in fields(Experiments) if field.name != "path"]
    if not isinstance(content, dict):
        raise InputError(f"{path} holds no mapping; it needs the sections {', '.join(sections)}.")
    for name in content:
        if name not in sections:
            raise InputError(f"unknown section '{name}' in {path}; {_nearest(str(name), sections)}")
    for name in sections:
        if not isinstance(content.get(name), dict):
            raise InputError(f"section '{name}' of {path} is missing or no mapping; compare with the shipped one.")
    return Experiments(path=path, **content)


def leaves(values: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """(dotted key, value) of every value that is not a mapping with keys."""
    for key, value in values.items():
        if isinstance(value, Mapping) and value:
            yield from leaves(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value


def unknown_name(kind: str, name: str, choices: Iterable[str]) -> InputError:
    """The error for a misspelt name: one sentence with the nearest of `choices`, or all of them."""
    return InputError(f"unknown {kind} '{name}'; {_nearest(name, choices)}")


def _find_file() -> Path:
    named = os.environ.get(ENVIRONMENT_VARIABLE)
    if named:
        return Path(named)
    package = Path(__file__).parent
    packaged, checkout = package / _FILE_NAME, package.parents[1] / _FILE_NAME
    return packaged if packaged.exists() else checkout


def _file_layers(experiments: Experiments, method: str, environment: str, profile: str) -> list[_Layer]:
    """The layers of experiments.yaml for one cell, weakest first."""
    file = experiments.path.name
    environment_values = _named(experiments.environments, "environment", environment)
    method_values = _named(experiments.methods, "method", method)
    profile_values = dict(_named(experiments.profiles, "profile", profile))
    special: list[_Layer] = []
    for section, chosen, known in (
        ("environments", environment, experiments.environments),
        ("methods", method, experiments.methods),
    ):
        entries = _mapping(profile_values.pop(section, None), f"profiles.{profile}.{section} of {file}")
        for name in entries:
            _named(known, f"{section.removesuffix('s')} in profiles.{profile} of {file}", name)
        source = f"profiles.{profile}.{section}.{chosen} of {file}"
        special.append(_Layer(source, _mapping(entries.get(chosen), source)))
    return [
        _Layer(f"defaults of {file}", experiments.defaults),
        _Layer(f"environments.{environment} of {file}", environment_values),
        _Layer(f"methods.{method} of {file}", method_values),
        _Layer(f"profiles.{profile} of {file}", profile_values),
        *special,
    ]


def _named(mappings: Mappings, kind: str, name: str) -> Mapping[str, Any]:
    if name not in mappings:
        raise unknown_name(kind, name, mappings)
    return _mapping(mappings[name], f"{kind} '{name}'")


def _mapping(value: Any, source: str) -> Mapping[str, Any]:
    """The value itself, or an empty mapping for YAML's null."""
    if value is None:
        return {}
    if not isinstance(value, Mapping):
        raise InputError(f"{source} should be a mapping, not {_shown(value)}.")
    return value


def _nearest(name: str, choices: Iterable[str]) -> str:
    choices = list(choices)
    near = difflib.get_close_matches(name, choices, n=1)
    return f"did you mean {near[0]}?" if near else f"choose from {', '.join(choices)}."


def _parse_override(text: str) -> dict[str, Any]:
    """ "a.b=0.5" -> {"a": {"b": 0.5}}."""
    key, equals, value = text.partition("=")
    key = key.strip()
    if not equals or not all(key.split(".")):
        raise InputError(f"--set takes key.path=value, not '{text}'; for example --set sac.gamma=0.9.")
    try:
        parsed = yaml.load(value, _Loader)
    except yaml.YAMLError:
        raise InputError(f"the value of --set {text} is not valid YAML; put quotes around text.") from None
    for part in reversed(key.split(".")):
        parsed = {part: parsed}
    return dict(parsed)


def _merge(weak: Mapping[str, Any], strong: Mapping[str, Any]) -> dict[str, Any]:
    merged = dict(weak)
    for key, value in strong.items():
        both = isinstance(value, Mapping) and isinstance(merged.get(key), Mapping)
        merged[key] = _merge(merged[key], value) if both else value
    return merged


def _spec_keys(model: type[BaseModel], prefix: str = "") -> Iterator[tuple[str, bool]]:
    """(dotted key, whether it is a section) of every field of a spec."""
    for name, field in model.model_fields.items():
        section = _section(field.annotation)
        yield f"{prefix}{name}", section is not None
        if section:
            yield from _spec_keys(section, f"{prefix}{name}.")


def _check_keys(given: Mapping[str, Any], source: str) -> None:
    known = {key: section for key, section in _spec_keys(RunSpec) if key not in _ARGUMENTS}
    for key, value in given.items():
        if key in _ARGUMENTS:
            raise InputError(f"'{key}' in {source} cannot be set there; give it with --{key.removesuffix('ironment')}.")
        if key not in known:
            raise InputError(f"unknown key '{key}' in {source}; {_nearest_key(key, known)}")
        if known[key] and not isinstance(value, Mapping):
            first = next(other for other in known if other.startswith(f"{key}."))
            raise InputError(
                f"{key} = {_shown(value)} in {source} is a section, not a value; set one of its keys such as {first}."
            )


def _check_section(section: str, method: str, source: str) -> None:
    """Raise InputError for a value in a section that the method does not have."""
    if section in OPTIONAL_SECTIONS and section not in SECTIONS[method]:
        users = ", ".join(name for name, sections in SECTIONS.items() if section in sections)
        raise InputError(f"method {method} has no section '{section}' to set in {source}; it belongs to {users}.")


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


def _shown(value: Any) -> str:
    """A value as YAML writes it on one line."""
    return str(yaml.safe_dump(value, default_flow_style=True, width=10**6)).removesuffix("\n").removesuffix("\n...")


def _sentence(error: ValidationError, origins: Mapping[str, str], path: Path) -> str:
    """The first of a validation's complaints: the key, where it was given, what was given, what is expected."""
    first = error.errors(include_url=False)[0]
    key = ".".join(str(part) for part in first["loc"])
    if first["type"] == "missing":
        return f"{path} gives no value for {key}; add it under defaults."
    if first["type"] == "value_error":
        return f"{key}: {first['msg'].removeprefix('Value error, ')}."
    expected = re.sub(r"^Input should be (a valid )?", "", first["msg"])
    source = f" in {origins[key]}" if key in origins else ""
    return f"{key} = {_shown(first['input'])}{source} should be {_article(expected)}."


def _article(expected: str) -> str:
    kinds = {"integer": "a whole number", "number": "a number", "boolean": "true or false", "string": "text"}
    return kinds.get(expected, expected)


def _read_yaml(path: Path) -> Any:
    try:
        return yaml.load(path.read_text(encoding="utf-8"), _Loader)
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror}.") from None
    except UnicodeDecodeError:
        raise InputError(f"{path} is not UTF-8 text.") from None
    except yaml.MarkedYAMLError as error:
        line = f", line {error.problem_mark.line + 1}" if error.problem_mark else ""
        raise InputError(f"{path}{line} is not valid YAML: {error.problem}.") from None
    except yaml.YAMLError:
        raise InputError(f"{path} is not valid YAML: it holds a character that is not allowed.") from None


class _Loader(yaml.SafeLoader):
    """Safe YAML where 1e-3 is a number (PyYAML: text) and a key given twice an error (PyYAML: the last one holds)."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        seen: set[str] = set()
        for key, _ in node.value:
            if not isinstance(key, yaml.ScalarNode):
                continue
            if key.value in seen:
                raise yaml.constructor.ConstructorError(None, None, f"'{key.value}' is given twice", key.start_mark)
            seen.add(key.value)
        return super().construct_mapping(node, deep)


_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float", re.compile(r"^[-+]?(\d+\.?\d*|\.\d+)[eE][-+]?\d+$"), list("-+.0123456789")
)
