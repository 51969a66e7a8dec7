"""What a run is: a frozen, validated, hashable description of everything but its seed. Its parts: spec_sections."""

import hashlib
import json
from collections.abc import Mapping
from typing import Any, Literal, Self, get_args

from pydantic import model_validator

from ssmail.config.sections import (
    AdversarialSpec,
    CloningSpec,
    CurriculumSpec,
    DataSpec,
    EvaluationSpec,
    ForecastSpec,
    Frozen,
    ModelSpec,
    SacSpec,
    SelfSupervisionSpec,
    TrainingSpec,
    VariationalSpec,
    WassersteinSpec,
)

Method = Literal["ssail", "gail", "wail", "bc", "nri", "dnri", "constant-velocity", "copy-last"]
METHODS: tuple[str, ...] = get_args(Method)
Environment = Literal["yjunction", "letters", "mocap"]
ENVIRONMENTS: tuple[str, ...] = get_args(Environment)

_GAME = ("model", "adversarial", "sac", "curriculum", "training")
_VARIATIONAL = ("variational", "cloning", "curriculum", "training")
SECTIONS: dict[str, tuple[str, ...]] = {
    "ssail": (*_GAME, "self_supervision"),
    "gail": _GAME,
    "wail": (*_GAME, "wasserstein"),
    "bc": ("model", "cloning", "training"),
    "nri": _VARIATIONAL,
    "dnri": _VARIATIONAL,
    "constant-velocity": (),
    "copy-last": (),
}  # the sections that a method has beside data and evaluation; the others are null in its spec
ENVIRONMENT_SECTIONS: dict[str, tuple[str, ...]] = {"yjunction": (), "letters": (), "mocap": ("forecast",)}  # likewise
GENERATED = ("yjunction", "letters")  # environments with a generator, whose parameters are data.ENVIRONMENT


class RunSpec(Frozen):
    """Everything that defines a run but its seed. A section that the method does not use is null (see SECTIONS)."""

    method: Method
    environment: Environment
    profile: str
    data: DataSpec
    model: ModelSpec | None
    adversarial: AdversarialSpec | None
    self_supervision: SelfSupervisionSpec | None
    wasserstein: WassersteinSpec | None
    sac: SacSpec | None
    variational: VariationalSpec | None
    cloning: CloningSpec | None
    curriculum: CurriculumSpec | None
    training: TrainingSpec | None
    evaluation: EvaluationSpec
    forecast: ForecastSpec | None

    @model_validator(mode="after")
    def _has_its_sections(self) -> Self:
        for name in OPTIONAL_SECTIONS:
            needed, given = name in sections_of(self.method, self.environment), getattr(self, name) is not None
            if needed != given:
                what = f"{self.method} on {self.environment}"
                raise ValueError(f"{what} {_needs(needed)} section {name}")
        for name in GENERATED:
            if (getattr(self.data, name) is not None) != (name == self.environment):
                raise ValueError(f"environment {self.environment} {_needs(name == self.environment)} data.{name}")
        if self.environment not in GENERATED and self.data.path is None:
            raise ValueError(f"environment {self.environment} needs a data file; set data.path")
        return self

    @property
    def epochs(self) -> int:
        """Training epochs; 0 for a reference that needs no training."""
        return self.training.epochs if self.training else 0

    def as_json(self) -> str:
        """Canonical JSON: sorted keys, no spaces; equal specs give equal text."""
        return _canonical(self.model_dump(mode="json"))

    def hash(self) -> str:
        """First 16 hexadecimal digits of the SHA-256 of the canonical JSON without nulls; names a cell together with
        the seed. A section that is added for other methods thus leaves the hash as it was, and so does a key of LATER
        with the value that earlier runs had.
        """
        return hash_of(self.model_dump(mode="json"))

    @classmethod
    def from_mapping(cls, values: dict[str, Any]) -> Self:
        """Validate plain nested values. Raises pydantic.ValidationError, for ssmail.config.experiments to explain."""
        return cls.model_validate(values)


def sections_of(method: str, environment: str) -> tuple[str, ...]:
    """The sections of a spec that are not null, beside data and evaluation."""
    return (*SECTIONS[method], *ENVIRONMENT_SECTIONS[environment])


def hash_of(stored: Mapping[str, Any]) -> str:
    """RunSpec.hash of a spec's nested values, as they are stored as JSON; of an earlier version's too."""
    values = _without_nulls(stored)
    for section, key, before in LATER:
        if section in values and values[section].get(key) == before:
            values[section].pop(key, None)
    return hashlib.sha256(_canonical(values).encode()).hexdigest()[:16]


def completed(values: Mapping[str, Any]) -> dict[str, Any]:
    """The nested values of a stored spec, with the keys of LATER that it is too old to have."""
    whole = dict(values)
    for section, key, before in LATER:
        if whole.get(section) is not None:
            whole[section] = {key: before, **whole[section]}
    return whole


def _needs(needed: bool) -> str:
    return "needs" if needed else "has no"


def _without_nulls(values: Mapping[str, Any]) -> dict[str, Any]:
    return {
        key: _without_nulls(value) if isinstance(value, Mapping) else value
        for key, value in values.items()
        if value is not None
    }


def _canonical(values: Any) -> str:
    return json.dumps(values, sort_keys=True, separators=(",", ":"))


LATER: tuple[tuple[str, str, Any], ...] = (
    ("self_supervision", "label", "identity"),
    ("data", "letters", None),
    ("model", "initial_scale", 0.1),
    ("model", "standardize", False),
    ("sac", "encoder_steps", None),
    *(("variational", key, False) for key in ("root_relative", "agent_input", "standardize")),
)
"""(section, key, value) of what runs of earlier versions had without a name for it."""

OPTIONAL_SECTIONS = tuple(
    dict.fromkeys(
        name for table in (SECTIONS, ENVIRONMENT_SECTIONS) for sections in table.values() for name in sections
    )
)
