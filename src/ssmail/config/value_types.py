"""What the sections of a spec are made of: their base class, and types of values with their ranges and units."""

from dataclasses import dataclass
from typing import Annotated, Any, Literal

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field


class Frozen(BaseModel):
    """An immutable model that rejects unknown keys and values of other types (3 is a float; "3" and True are not)."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)


@dataclass(frozen=True)
class Unit:
    """The unit of a value, as the reference of the keys names it."""

    name: str


Count = Annotated[int, Field(ge=1, le=10**9)]
NonNegativeCount = Annotated[int, Field(ge=0, lt=2**63)]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
NonNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Jitter = Annotated[float, Field(ge=0, le=1000, allow_inf_nan=False)]
Fraction = Annotated[float, Field(ge=0, le=1, allow_inf_nan=False)]
Share = Annotated[float, Field(gt=0, le=1, allow_inf_nan=False)]
Start = Annotated[float, Field(ge=0, lt=1), Unit("fraction of the epochs")]
Inside = Annotated[float, Field(gt=0, lt=1)]
Finite = Annotated[float, Field(allow_inf_nan=False)]
ScaledUnits = Annotated[NonNegative, Unit("scaled units")]
Trajectories = Annotated[Count, Unit("trajectories")]
Steps = Annotated[Count, Unit("steps")]

Pairing = Literal["start", "nearest", "assignment"]


def _flag_or(*words: str) -> BeforeValidator:
    """Return a validator of values that are true, false or one of the words."""

    def check(value: Any) -> Any:
        if not isinstance(value, bool) and value not in words:
            raise ValueError(f"takes true, false or {' or '.join(words)}, not {str(value)[:20]!r}")
        return value

    return BeforeValidator(check)


# What is "auto", and what the data decide where it is null, is resolved by ssmail.training.data_defaults.
Automatic = Annotated[bool | Literal["auto"], _flag_or("auto")]
Standardize = Annotated[bool | Literal["pooled", "auto"], _flag_or("pooled", "auto")]
Waves = Annotated[
    tuple[Positive, ...],
    BeforeValidator(lambda value: tuple(value) if isinstance(value, list) else value),
    Unit("radians per scaled unit"),
]
