"""experiments.yaml: how it is read, and the layers of values that make a spec.

A spec is merged from LAYERS, and later ones win. Each layer is a path in the file. For ssail on mocap in profile paper,
`defaults` come first, then `environments.mocap`, `methods.ssail` and `environments.mocap.methods.ssail`; then
`profiles.paper` and what it contains for the environment, for the method, and for the two together. The specs of an
ablation add ABLATION_LAYERS, the arms of a control CONTROL_LAYERS. Overrides (--set) come last. A path that the file
does not have is an empty layer.

One file is in use: the one that $SSMAIL_EXPERIMENTS names, else the experiments.yaml of the current folder, else the
one shipped with ssmail. That of the current folder is announced in the log, because nobody asked for it by name; for
the same reason it may not name Python functions, which would let a folder of someone else run code.
"""

import functools
import logging
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import MISSING, dataclass, field, fields
from pathlib import Path
from typing import Any, NamedTuple

from ssmail.config import strict_yaml
from ssmail.config.names import FUNCTION
from ssmail.errors import InputError, shortened, suggestion, unknown_name

LAYERS = (
    "defaults",
    "environments.{environment}",
    "methods.{method}",
    "environments.{environment}.methods.{method}",
    "profiles.{profile}",
    "profiles.{profile}.environments.{environment}",
    "profiles.{profile}.methods.{method}",
    "profiles.{profile}.environments.{environment}.methods.{method}",
    "profiles.{profile}.methods.{method}.environments.{environment}",
)
ABLATION_LAYERS = ("ablations.{ablation}.settings", "profiles.{profile}.ablations.{ablation}")
CONTROL_LAYERS = ("controls.{control}.arms.{arm}.settings", "profiles.{profile}.controls.{control}.{arm}")
ENVIRONMENT_VARIABLE = "SSMAIL_EXPERIMENTS"
FILE_NAME = "experiments.yaml"
PACKAGE = Path(__file__).resolve().parents[1]
"""The folder of ssmail itself, where an installation has its experiments.yaml."""
Mappings = Mapping[str, Mapping[str, Any]]
_LOG = logging.getLogger(__name__)


class Layer(NamedTuple):
    """Nested values, and the place they come from as error messages name it."""

    source: str
    values: Mapping[str, Any]


@dataclass(frozen=True, eq=False)
class Experiments:
    """The sections of one experiments.yaml. The values in them are not validated yet."""

    path: Path
    defaults: Mapping[str, Any]
    environments: Mappings
    methods: Mappings
    profiles: Mappings
    ablations: Mappings
    figures: Mappings
    controls: Mappings = field(default_factory=dict)  # files of earlier versions have none

    def entry(self, kind: str, name: str) -> Mapping[str, Any]:
        """Return the entry `name` of the section for `kind` ("method"). Raises InputError if there is none."""
        entries: Mappings = getattr(self, f"{kind}s")
        if name not in entries:
            raise unknown_name(kind, name, entries)
        return _mapping(entries[name], f"{kind} '{name}'")

    def layers(self, templates: Sequence[str], **names: str) -> list[Layer]:
        """Return the layers of LAYERS, ABLATION_LAYERS or CONTROL_LAYERS, filled in with the names of a method, etc.

        Raises InputError for an unknown name, in `names` or within an environment or a profile. Who names an arm has
        found it in its control already (`ssmail.config.controls`).
        """
        for kind, name in names.items():
            if kind != "arm":
                self.entry(kind, name)
        return [self._layer(template, names) for template in templates]

    def _layer(self, template: str, names: Mapping[str, str]) -> Layer:
        path = ""
        values: Mapping[str, Any] = vars(self)
        for part in template.split("."):
            path = f"{path}.{part.format(**names)}".lstrip(".")
            values = _mapping(values.get(part.format(**names)), f"{path} of {self.path.name}")
        own = dict(values)
        for section in _nested_sections(template):
            for name in _mapping(own.pop(section, None), f"{path}.{section} of {self.path.name}"):
                known = getattr(self, section)
                if name not in known:
                    raise unknown_name(f"{section.removesuffix('s')} in {path} of {self.path.name}", name, known)
        return Layer(f"{path} of {self.path.name}", own)


def load_experiments(file: Path | None = None) -> Experiments:
    """Read an experiments.yaml: `file`, or the one that `find_file` returns.

    Unless its content has changed, a file is parsed once in the life of the process, and the same object is returned.
    Raises InputError for a file that is missing, is not YAML (with the line), or lacks a section of Experiments, and
    for one that was only found in the current folder and names a Python function.
    """
    path = file or find_file()
    found = _parsed(path, strict_yaml.read_bytes(path, strict_yaml.MOST_BYTES))
    if file is None and is_local(path):
        _check_names_no_code(found)
        _announce(path)
    return found


@functools.lru_cache(maxsize=4)
def _parsed(path: Path, source: bytes) -> Experiments:
    content = strict_yaml.parse_bytes(source, path)
    sections = {part.name: part.default_factory is not MISSING for part in fields(Experiments) if part.name != "path"}
    if not isinstance(content, dict):
        raise InputError(f"{path} contains no mapping; it needs the sections {', '.join(sections)}.")
    for name in content:
        if name not in sections:
            raise InputError(f"unknown section '{shortened(name, 60)}' in {path}; {suggestion(name, sections)}")
    for name, is_optional in sections.items():
        if not isinstance(content.get(name, {} if is_optional else None), dict):
            raise InputError(f"section '{name}' of {path} is missing or no mapping; compare with the shipped one.")
    return Experiments(path=path, **content)


def find_file() -> Path:
    """Return the path of the file in use: that of $SSMAIL_EXPERIMENTS, of the current folder, or of ssmail."""
    if os.environ.get(ENVIRONMENT_VARIABLE):
        return Path(os.environ[ENVIRONMENT_VARIABLE])
    shipped = shipped_file()
    if not os.path.lexists(FILE_NAME):
        return shipped
    local = Path.cwd() / FILE_NAME
    return shipped if local.exists() and local.samefile(shipped) else local


def shipped_file() -> Path:
    """Return the path of the file that is installed with ssmail, or that of the checkout."""
    packaged, checkout = PACKAGE / FILE_NAME, PACKAGE.parents[1] / FILE_NAME
    return packaged if packaged.exists() else checkout


def is_local(path: Path) -> bool:
    """Return whether the file in use is in use only because it lies in the current folder."""
    return not os.environ.get(ENVIRONMENT_VARIABLE) and path != shipped_file()


@functools.cache
def _announce(path: Path) -> None:
    _LOG.warning("%s of the current folder is in use, not the one of ssmail", path)


def _check_names_no_code(experiments: Experiments) -> None:
    """Raise InputError if any text of the file has the form module:function."""
    for text in _texts([getattr(experiments, part.name) for part in fields(experiments) if part.name != "path"]):
        if FUNCTION.fullmatch(text):
            raise InputError(
                f"{experiments.path} names Python code, {shortened(text, 60)}, which a file that was only found in the "
                f"current folder may not; if it is yours, set {ENVIRONMENT_VARIABLE}={FILE_NAME}."
            )


def _texts(value: Any) -> Iterator[str]:
    """Yield every text within nested mappings and lists, keys excepted."""
    if isinstance(value, str):
        yield value
    elif isinstance(value, Mapping | list):
        for part in value.values() if isinstance(value, Mapping) else value:
            yield from _texts(part)


def merge(weak: Mapping[str, Any], strong: Mapping[str, Any]) -> dict[str, Any]:
    """Return `weak` updated with `strong`, recursively."""
    merged = dict(weak)
    for key, value in strong.items():
        both = isinstance(value, Mapping) and isinstance(merged.get(key), Mapping)
        merged[key] = merge(merged[key], value) if both else value
    return merged


def _nested_sections(template: str) -> list[str]:
    """Return the sections inside a layer that make up other layers, such as `methods` in an environment."""
    prefix = f"{template}."
    every = (*LAYERS, *ABLATION_LAYERS, *CONTROL_LAYERS)
    inside = [path.removeprefix(prefix) for path in every if path.startswith(prefix)]
    return list(dict.fromkeys(path.partition(".")[0] for path in inside))


def _mapping(value: Any, source: str) -> Mapping[str, Any]:
    """Return the value, or an empty mapping for YAML's null. Raises InputError if it is anything else."""
    if value is None:
        return {}
    if not isinstance(value, Mapping):
        raise InputError(f"{source} should be a mapping, not {strict_yaml.inline(value)}.")
    return value
