"""RunSpec: a frozen, validated and hashable description of a run, and the checks of its keys.

Its sections are in `ssmail.config.sections`. A spec defines everything about a run except its seed.
"""

import difflib
import hashlib
import json
import math
import re
from collections.abc import Iterable, Mapping
from itertools import chain
from typing import Any, Self, get_args

from pydantic import BaseModel, ValidationError, model_validator

from ssmail.config import data_sections, sections, strict_yaml
from ssmail.config.names import ENVIRONMENTS, METHODS, Environment, Method
from ssmail.config.value_types import Frozen
from ssmail.errors import InputError, shortened

_ADVERSARIAL = ("model", "adversarial", "sac", "curriculum", "training")
_VARIATIONAL = ("variational", "cloning", "curriculum", "training")
# The optional sections that each method and each environment requires. All others are null in its spec.
METHOD_SECTIONS: dict[str, tuple[str, ...]] = {
    "ssail": (*_ADVERSARIAL, "self_supervision"),
    "gail": _ADVERSARIAL,
    "wail": (*_ADVERSARIAL, "wasserstein"),
    "bc": ("model", "cloning", "training"),
    "nri": _VARIATIONAL,
    "dnri": _VARIATIONAL,
    "constant-velocity": (),
    "copy-last": (),
}
ENVIRONMENT_SECTIONS: dict[str, tuple[str, ...]] = {
    "yjunction": (),
    "letters": (),
    "mocap": ("forecast",),
    "trajectories": ("forecast",),
}
OPTIONAL_SECTIONS = tuple(dict.fromkeys(chain(*METHOD_SECTIONS.values(), *ENVIRONMENT_SECTIONS.values())))
GENERATED_ENVIRONMENTS = ("yjunction", "letters")  # environments with a data generator, configured by data.ENVIRONMENT

# (section, key, value) of keys that were added after runs had been stored. Earlier runs behaved as the value says, so
# it is left out of the hash.
ADDED_KEYS: tuple[tuple[str, str, Any], ...] = (
    ("self_supervision", "label", "identity"),
    ("data", "letters", None),
    ("model", "initial_scale", 0.1),
    ("model", "standardize", False),
    ("model", "discriminator_hidden", None),
    ("model", "discriminator_waves", []),
    ("model", "discriminator_velocities", True),
    ("self_supervision", "discriminator_weight", 1.0),
    ("sac", "encoder_steps", None),
    ("adversarial", "reward", "own"),
    ("adversarial", "input_noise_final", 1.0),
    ("adversarial", "input_noise_start", 0.0),
    ("sac", "expansion_steps", 0),
    ("sac", "expansion_start", 0.0),
    ("sac", "finite_horizon", False),
    ("sac", "average", None),
    ("variational", "graph_noise", "edge"),
    ("variational", "graph_resample", "step"),
    *(("variational", key, None) for key in ("encoder_window", "action_step", "action_bound")),
    *(("variational", key, False) for key in ("root_relative", "agent_input", "standardize")),
    *((section, "centre_relative", False) for section in ("model", "variational")),
    *(("forecast", key, None) for key in ("miss_distance", "collision_distance")),
    *(("evaluation", key, None) for key in ("validation_windows", "validation_samples", "test_windows")),
)
ARGUMENTS = ("method", "environment", "profile")  # arguments of build_spec, which no mapping may set


class RunSpec(Frozen):
    """Everything that defines a run except its seed. Sections that it does not use are null (see METHOD_SECTIONS)."""

    method: Method
    environment: Environment
    profile: str
    data: data_sections.DataSpec
    model: sections.ModelSpec | None
    adversarial: sections.AdversarialSpec | None
    self_supervision: sections.SelfSupervisionSpec | None
    wasserstein: sections.WassersteinSpec | None
    sac: sections.SacSpec | None
    variational: sections.VariationalSpec | None
    cloning: sections.CloningSpec | None
    curriculum: sections.CurriculumSpec | None
    training: sections.TrainingSpec | None
    evaluation: sections.EvaluationSpec
    forecast: sections.ForecastSpec | None

    @model_validator(mode="after")
    def _check_sections(self) -> Self:
        for name in OPTIONAL_SECTIONS:
            needed = name in required_sections(self.method, self.environment)
            if needed != (getattr(self, name) is not None):
                verb = "needs" if needed else "has no"
                raise ValueError(f"{self.method} on {self.environment} {verb} section {name}")
        for name in GENERATED_ENVIRONMENTS:
            needed = name == self.environment
            if needed != (getattr(self.data, name) is not None):
                raise ValueError(f"environment {self.environment} {'needs' if needed else 'has no'} data.{name}")
        if self.environment not in GENERATED_ENVIRONMENTS and self.data.path is None:
            raise ValueError(f"environment {self.environment} needs a data file; set data.path")
        if self.adversarial and self.adversarial.reward == "probability" and self.method != "gail":
            raise ValueError(f"adversarial.reward probability is for gail alone, not {self.method}; leave it out")
        if self.variational and self.variational.action_bound and not self.variational.action_step:
            raise ValueError("variational.action_bound bounds nothing without variational.action_step; set both")
        if self.variational and (self.variational.action_bound or math.inf) < (self.variational.action_step or 0):
            raise ValueError("variational.action_bound is less than variational.action_step; raise it")
        return self

    @property
    def epochs(self) -> int:
        """The number of training epochs; 0 for a baseline that is not trained."""
        return self.training.epochs if self.training else 0

    def as_json(self) -> str:
        """Return canonical JSON (sorted keys, no spaces): equal specs have equal text."""
        return _canonical(self.model_dump(mode="json"))

    def hash(self) -> str:
        """Return the hash that identifies a cell together with the seed (see `spec_hash`)."""
        return spec_hash(self.model_dump(mode="json"))


def required_sections(method: str, environment: str) -> tuple[str, ...]:
    """Return the optional sections that a spec of this method and environment must have."""
    return (*METHOD_SECTIONS[method], *ENVIRONMENT_SECTIONS[environment])


def spec_hash(stored: Mapping[str, Any]) -> str:
    """Return the first 16 hexadecimal digits of the SHA-256 of a spec's canonical JSON.

    Nulls and ADDED_KEYS with their value are left out. So the hash stays the same when a later version adds a section
    that other methods use, or a key whose null or listed value means what earlier versions did.
    """
    values = _without_nulls(stored)
    for section, key, before in ADDED_KEYS:
        if section in values and values[section].get(key) == before:
            values[section].pop(key, None)
    return hashlib.sha256(_canonical(values).encode()).hexdigest()[:16]


def with_added_keys(stored: Mapping[str, Any]) -> dict[str, Any]:
    """Return the nested values of a stored spec, with the ADDED_KEYS that it is too old to have."""
    values = dict(stored)
    for section, key, before in ADDED_KEYS:
        if values.get(section) is not None:
            values[section] = {key: before, **values[section]}
    return values


def check_keys(given: Mapping[str, Any], source: str) -> None:
    """Raise InputError if a dotted key of `given` is unknown, cannot be set, or is a section with a plain value.

    source: the place of the keys, as messages name it.
    """
    is_section = spec_keys()
    for key, value in given.items():
        if key in ARGUMENTS:
            raise InputError(f"'{key}' in {source} cannot be set there; give it with --{key.removesuffix('ironment')}.")
        if key not in is_section:
            raise InputError(f"unknown key '{shortened(key, 60)}' in {source}; {_suggest_key(key, is_section)}")
        if is_section[key] and not isinstance(value, Mapping):
            first = next(other for other in is_section if other.startswith(f"{key}."))
            what = f"{key} = {strict_yaml.inline(value)} in {source}"
            raise InputError(f"{what} is a section, not a value; set one of its keys such as {first}.")


def check_section(key: str, method: str, environment: str, source: str) -> None:
    """Raise InputError if a dotted key is in a section that the method or environment does not have.

    Unknown methods and environments are not checked.
    """
    if method not in METHODS or environment not in ENVIRONMENTS:
        return
    for other in GENERATED_ENVIRONMENTS:
        if other != environment and f"{key}.".startswith(f"data.{other}."):
            raise InputError(f"environment {environment} has no section 'data.{other}' to set in {source}.")
    section = key.partition(".")[0]
    if section in OPTIONAL_SECTIONS and section not in required_sections(method, environment):
        tables = {**METHOD_SECTIONS, **ENVIRONMENT_SECTIONS}
        users = ", ".join(name for name, sections in tables.items() if section in sections)
        what = f"method {method} on {environment}"
        raise InputError(f"{what} has no section '{section}' to set in {source}; it belongs to {users}.")


def explain(error: ValidationError, sources: Mapping[str, str], file: str) -> str:
    """Return one sentence about the first problem of a validation: the key, its value and source, what is expected.

    sources: the place where each dotted key was set. file: the name of the file that should hold all defaults.
    """
    first = error.errors(include_url=False)[0]
    key = ".".join(str(part) for part in first["loc"])
    if first["type"] == "missing":
        return f"{file} gives no value for {key}; add it under defaults."
    if first["type"] == "value_error":
        return f"{key}: {first['msg'].removeprefix('Value error, ')}."
    expected = re.sub(r"^Input should be (a valid )?", "", first["msg"])
    kinds = {"integer": "a whole number", "number": "a number", "boolean": "true or false", "string": "text"}
    source = f" in {sources[key]}" if key in sources else ""
    return f"{key} = {strict_yaml.inline(first['input'])}{source} should be {kinds.get(expected, expected)}."


def spec_keys() -> dict[str, bool]:
    """Return whether each dotted key that can be set is a section."""
    return _keys_of(RunSpec)


def nearest_key(name: str, others: Iterable[str] = ()) -> str:
    """The end of a message about an unknown name: the nearest of `others` and the keys, by their last part as well."""
    values = [key for key, is_section in spec_keys().items() if not is_section]
    close = [key for key in values if key.rpartition(".")[2] == name] or difflib.get_close_matches(name, others, n=1)
    by_last = {key.rpartition(".")[2]: key for key in reversed(values)}
    close = close or [key for key in values if key.startswith(f"{name}.")]
    close = close or [by_last[last] for last in difflib.get_close_matches(name, by_last, n=1)]
    if close:
        return f"did you mean {' or '.join(close[:3])}?"
    return f"choose from {', '.join(others)}, or a key such as sac.gamma."


def section_of(annotation: Any) -> type[Frozen] | None:
    """Return the class of a section from its annotation `Section` or `Section | None`; None for any other key."""
    kinds = get_args(annotation) or (annotation,)
    return next((kind for kind in kinds if isinstance(kind, type) and issubclass(kind, Frozen)), None)


def _keys_of(model: type[BaseModel], prefix: str = "") -> dict[str, bool]:
    keys: dict[str, bool] = {}
    for name, field in model.model_fields.items():
        section = section_of(field.annotation)
        if prefix or name not in ARGUMENTS:
            keys[f"{prefix}{name}"] = section is not None
        keys |= _keys_of(section, f"{prefix}{name}.") if section else {}
    return keys


def _suggest_key(key: str, sections: Mapping[str, bool]) -> str:
    """Suggest a close key of the same section, a key with the same last part, any close key, or all keys."""
    values = [name for name, is_section in sections.items() if not is_section]
    section, _, last = key.rpartition(".")
    siblings = {name.rpartition(".")[2]: name for name in sections if name.rpartition(".")[0] == section}
    close = [siblings[name] for name in difflib.get_close_matches(last, siblings, n=1)]
    close = close or [name for name in values if name.rpartition(".")[2] == last]
    close = close or ([] if siblings else difflib.get_close_matches(key, values, n=1))
    if close:
        return f"did you mean {close[0]}?"
    choices = siblings.values() or [name for name in sections if "." not in name]
    return f"choose from {shortened(', '.join(choices), 160)}."


def _without_nulls(values: Mapping[str, Any]) -> dict[str, Any]:
    return {
        key: _without_nulls(value) if isinstance(value, Mapping) else value
        for key, value in values.items()
        if value is not None
    }


def _canonical(values: Any) -> str:
    return json.dumps(values, sort_keys=True, separators=(",", ":"))
