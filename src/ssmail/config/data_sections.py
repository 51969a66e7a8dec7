"""The section `data` of a spec: the source of the expert trajectories, and the parameters of the generators."""

from typing import Annotated, Any, Self

from pydantic import BeforeValidator, Field, model_validator

from ssmail.config.value_types import Count, Frozen, Jitter, NonNegativeCount, Trajectories, Unit

MOST_STATES = 10**7  # of all agents in an expert set that a generator makes; 320 MB


def _check_size(data: "YJunctionSpec | LettersSpec", agents: int) -> None:
    """Raise ValueError for an expert set that is too large to be generated."""
    states = (data.train + data.validation + data.test) * data.steps * agents
    if states > MOST_STATES:
        raise ValueError(
            f"{states} states in all trajectories are more than {MOST_STATES}; lower train, validation, test or steps"
        )


class YJunctionSpec(Frozen):
    """Geometry and size of the Y-Junction expert set (sections 4.1 and B.2).

    The unit of length is the distance covered in one step at the approach speed.
    """

    train: Trajectories
    """Size of the training split."""
    validation: Trajectories
    """Size of the validation split."""
    test: Trajectories
    """Size of the test split."""
    agents: Annotated[Count, Unit("agents")]
    """Agents that drive in single file."""
    steps: Annotated[int, Field(ge=3), Unit("steps")]
    """Length of a trajectory."""
    lane_angle: Annotated[float, Field(gt=0, lt=90), Unit("degrees")]
    """Angle between the street and each lane."""
    jitter: Jitter
    """Scale of the random starts, gaps, speeds and lateral offsets."""
    seed: NonNegativeCount | None
    """Seed of the generator, which all runs share; null: that of the run, so every seed has data of its own."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        _check_size(self, self.agents)
        return self


MOST_LETTERS = 6


def check_word(word: Any) -> Any:
    """Return the word. Raises ValueError unless it is 1 to 6 capital letters."""
    wanted = f"takes 1 to {MOST_LETTERS} capital letters A to Z"
    if not isinstance(word, str):
        raise ValueError(f"{wanted}; YAML reads NO, ON, YES and NULL as something else, unless in quotes as '\"NO\"'")
    if not (1 <= len(word) <= MOST_LETTERS and word.isascii() and word.isalpha() and word.isupper()):
        raise ValueError(f"{wanted}, not {word[:20]!r}")
    return word


class LettersSpec(Frozen):
    """The word that the agents draw, and the size of the expert set (sections 1 and A.2)."""

    word: Annotated[str, BeforeValidator(check_word)]
    """The letters to draw, one agent each: 1 to 6 capitals."""
    train: Trajectories
    """Size of the training split."""
    validation: Trajectories
    """Size of the validation split."""
    test: Trajectories
    """Size of the test split."""
    steps: Annotated[int, Field(ge=20), Unit("steps")]
    """Length of a trajectory."""
    jitter: Jitter
    """Scale of the random starts, shapes, wobble and tempo."""
    seed: NonNegativeCount | None
    """Seed of the generator, which all runs share; null: that of the run, so every seed has data of its own."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        _check_size(self, len(self.word))
        return self


class DataSpec(Frozen):
    """The source of the expert trajectories: a file, or the generator of the environment."""

    path: str | None
    """The expert set, an .npz file; null: the generator of the environment makes it."""
    yjunction: YJunctionSpec | None
    """null in other environments."""
    letters: LettersSpec | None
    """null in other environments."""
