"""What a run is: a frozen, validated, hashable description of everything but its seed.

No field has a default here: each default is written once, in experiments.yaml (see ssmail.experiments).
"""

import hashlib
import json
from typing import Annotated, Any, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, model_validator

Count = Annotated[int, Field(ge=1)]
NonNegativeCount = Annotated[int, Field(ge=0)]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
NonNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Fraction = Annotated[float, Field(ge=0, le=1, allow_inf_nan=False)]
Share = Annotated[float, Field(gt=0, le=1, allow_inf_nan=False)]
Finite = Annotated[float, Field(allow_inf_nan=False)]

Pairing = Literal["start", "nearest", "assignment"]

METHODS = ("ssail",)
ENVIRONMENTS = ("yjunction",)


class Frozen(BaseModel):
    """Immutable, and an unknown key or a value of the wrong type is an error (3 is a float, "3" and True are not)."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)


class YJunctionSpec(Frozen):
    """Geometry and size of the Y-Junction expert set (section 4.1 and B.2). Lengths are in units of the approach speed
    times one step.
    """

    train: Count  # trajectories
    validation: Count
    test: Count
    agents: Count
    steps: Annotated[int, Field(ge=3)]
    lane_angle: Annotated[float, Field(gt=0, lt=90)]  # degrees between the street and each lane
    jitter: NonNegative  # scale of the random starts, gaps, speeds and lateral offsets; 1 is the default spread
    seed: NonNegativeCount


class DataSpec(Frozen):
    """Where the expert trajectories come from: a file, or (path null) the generator with these parameters."""

    path: str | None
    yjunction: YJunctionSpec


class ModelSpec(Frozen):
    """Sizes and inputs of the graph encoder, the actor, the critics and the discriminator (section 3.2)."""

    hidden: Count
    encoder_hidden: Count
    edge_types: Annotated[int, Field(ge=1)]
    first_type_is_none: bool  # no message flows along an edge of the first type
    own_input: bool  # the heads of actor and critic read an agent's own features beside its messages
    graph_gain: Positive  # scale of the edge types' own initial weights: how differently the types act before training
    graph_temperature: Positive  # of the Gumbel-softmax relaxation
    graph_noise: Literal["shared", "edge"]  # one Gumbel draw for all edges of a graph, or one for each edge
    graph_resample: Literal["trajectory", "step"]  # how often that draw is renewed
    time_input: bool  # every network reads the step index, scaled to [-1, 1]
    start_input: bool  # every network reads each agent's first state
    action_step: Positive  # an action moves a velocity by at most this much, scaled units
    action_bound: Positive  # and never beyond this absolute value
    log_std_min: Finite
    log_std_max: Finite


class AdversarialSpec(Frozen):
    """The discriminator's game: Eq. 3, its alpha, and the batches it sees."""

    alpha_low: Finite
    alpha_high: Finite
    pairing: Pairing  # which expert trajectory a generated one is mixed with, in the discriminator's batches
    learning_rate: Positive
    learning_rate_final: Share  # the last epoch's rate as a fraction of the first's
    updates: Count  # discriminator steps for each SAC step
    past_share: (
        Fraction  # share of the generated batch drawn from the replay of past tau_G instead of the latest rollouts
    )
    # std of the Gaussian noise on the states and actions that the discriminator is trained on, scaled units
    input_noise: NonNegative
    reward_scale: Positive

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        if self.alpha_low > self.alpha_high:
            raise ValueError(f"alpha_low {self.alpha_low:g} is above alpha_high {self.alpha_high:g}; swap them")
        return self


class SacSpec(Frozen):
    """Soft actor-critic (section 3.2.2)."""

    gamma: Annotated[float, Field(ge=0, lt=1)]
    polyak: Annotated[float, Field(gt=0, le=1)]
    actor_learning_rate: Positive
    actor_learning_rate_final: Share  # the last epoch's rate as a fraction of the first's; the temperature's too
    critic_learning_rate: Positive
    critic_learning_rate_final: Share
    temperature: NonNegative  # the fixed one, or the first one when automatic
    automatic_temperature: bool
    temperature_learning_rate: Positive
    target_entropy: Finite  # nats for each action dimension of one agent, in scaled velocity units
    graph_entropy: NonNegative  # weight of the edge-type distribution's entropy in the actor's objective
    pairing: Pairing  # which expert trajectory a generated one is mixed with, in the actor-critic's batches
    mixed_share: Fraction  # share of tau_alpha in a SAC batch; the rest is tau_G


class CurriculumSpec(Frozen):
    """How often generation is put back on the expert's track while training (section 3.3)."""

    name: Literal["none", "trajectory-forcing"]
    beta: Fraction  # in fractions of all epochs: f(e) = 1.5 ** (-e / (beta * epochs))


class TrainingSpec(Frozen):
    """Budget and batches."""

    epochs: Count
    updates: Count  # SAC steps in each epoch
    batch: Count  # trajectories in a batch
    time_steps: (
        Count  # random time steps of each trajectory that an update uses (only the encoder needs whole sequences)
    )
    rollouts: Count  # trajectories generated in each epoch
    replay: Count  # generated trajectories kept
    decay_start: (
        Fraction  # fraction of the epochs after which the learning rates fall, geometrically, to their final values
    )
    policy_average: Annotated[
        float, Field(ge=0, lt=1)
    ]  # decay of the averaged actor that is evaluated; 0 evaluates the actor itself
    gradient_clip: Positive


class EvaluationSpec(Frozen):
    """Sizes of the free-running evaluations."""

    train_rollouts: Count  # training starts rolled out for the training metrics of an epoch
    samples: Count  # rollouts for each test start
    # an epoch whose validation lane_balance is below is best only while none reaches it
    least_balance: Annotated[float, Field(ge=0, le=0.5)]


class RunSpec(Frozen):
    """Everything that defines a run but its seed."""

    method: Literal["ssail"]
    environment: Literal["yjunction"]
    profile: str
    data: DataSpec
    model: ModelSpec
    adversarial: AdversarialSpec
    sac: SacSpec
    curriculum: CurriculumSpec
    training: TrainingSpec
    evaluation: EvaluationSpec

    def as_json(self) -> str:
        """Canonical JSON: sorted keys, no spaces; equal specs give equal text."""
        return json.dumps(self.model_dump(mode="json"), sort_keys=True, separators=(",", ":"))

    def hash(self) -> str:
        """First 16 hexadecimal digits of the SHA-256 of `as_json`; names a cell together with the seed."""
        return hashlib.sha256(self.as_json().encode()).hexdigest()[:16]

    @classmethod
    def from_mapping(cls, values: dict[str, Any]) -> Self:
        """Validate plain nested values. Raises pydantic.ValidationError, for ssmail.experiments to explain."""
        return cls.model_validate(values)
