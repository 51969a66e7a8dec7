"""The sections of a spec: the name, the allowed values and the unit of each key.

No field has a default here. All defaults are in experiments.yaml (see ssmail.config.experiments_file).
"""

from typing import Annotated, Any, Literal, Self, TypeVar

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, model_validator

from ssmail.config.shaping import AlphaDensity, AlphaPiece, Label

Count = Annotated[int, Field(ge=1, le=10**9)]
NonNegativeCount = Annotated[int, Field(ge=0, lt=2**63)]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
NonNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Jitter = Annotated[float, Field(ge=0, le=1000, allow_inf_nan=False)]
Fraction = Annotated[float, Field(ge=0, le=1, allow_inf_nan=False)]
Share = Annotated[float, Field(gt=0, le=1, allow_inf_nan=False)]
Start = Annotated[float, Field(ge=0, lt=1)]
Finite = Annotated[float, Field(allow_inf_nan=False)]

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


class Frozen(BaseModel):
    """An immutable model that rejects unknown keys and values of other types (3 is a float; "3" and True are not)."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)


Section = TypeVar("Section", bound=Frozen)


def required(section: Section | None) -> Section:
    """Return a section that the method requires (spec.METHOD_SECTIONS), for callers that serve no other methods."""
    assert section is not None
    return section


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

    train: Count  # trajectories
    validation: Count
    test: Count
    agents: Count
    steps: Annotated[int, Field(ge=3)]
    lane_angle: Annotated[float, Field(gt=0, lt=90)]  # degrees between the street and each lane
    jitter: Jitter  # scale of the random starts, gaps, speeds and lateral offsets; 1 is the default
    seed: NonNegativeCount

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

    word: Annotated[str, BeforeValidator(check_word)]  # one agent per letter
    train: Count  # trajectories
    validation: Count
    test: Count
    steps: Annotated[int, Field(ge=20)]
    jitter: Jitter  # scale of the random starts, shapes, wobble and tempo; 1 is the default
    seed: NonNegativeCount

    @model_validator(mode="after")
    def _check(self) -> Self:
        _check_size(self, len(self.word))
        return self


class DataSpec(Frozen):
    """The source of the expert trajectories: a file, or (path null) the generator of the environment."""

    path: str | None
    yjunction: YJunctionSpec | None  # null in other environments
    letters: LettersSpec | None  # null in other environments


class ModelSpec(Frozen):
    """Sizes and inputs of the graph encoder, the actor, the critics and the discriminator (section 3.2)."""

    hidden: Count
    encoder_hidden: Count
    discriminator_hidden: Count | None  # hidden size of the discriminator; null: `hidden`
    # frequencies, in radians per scaled unit, of the sines and cosines of positions that the discriminator reads beside
    # the positions: without them a small network is slow to tell places apart that are close to each other
    discriminator_waves: Annotated[
        tuple[Positive, ...], BeforeValidator(lambda v: tuple(v) if isinstance(v, list) else v)
    ]
    edge_types: Count
    first_type_is_none: bool  # edges of the first type carry no messages
    own_input: bool  # the heads of actor and critics read an agent's own features in addition to its messages
    graph_gain: Positive  # scale of the edge types' initial weights: how much the types differ before training
    graph_temperature: Positive  # temperature of the Gumbel-softmax relaxation
    graph_noise: Literal["shared", "edge"]  # one Gumbel sample for all edges of a graph, or one per edge
    graph_resample: Literal["trajectory", "step"]  # how often the noise is resampled
    time_input: bool  # every network reads the step index, scaled to [-1, 1]
    start_input: bool  # every network reads each agent's first state
    root_relative: bool  # positions are relative to those of the first agent, which are zero
    centre_relative: Automatic  # positions are relative to the mean of the group's; auto: where groups wander
    # every network reads a one-hot agent index, for agents that differ, such as joints; auto: if the agents of all
    # trajectories are the same ones
    agent_input: Automatic
    # networks read states and actions normalized by each agent's mean and standard deviation over the training set, and
    # action_step and action_bound are in these units; pooled: one mean and standard deviation for all agents; auto:
    # those of each agent if the agents of all trajectories are the same ones
    standardize: Standardize
    action_step: Positive | None  # largest change of velocity by an action; scaled units unless standardize
    action_bound: Positive | None  # largest distance of the velocity from 0 (with standardize: from the mean)
    initial_scale: NonNegative  # of the actor's last weights: how far the untrained mean is from the current velocity
    log_std_min: Finite
    log_std_max: Finite


class AdversarialSpec(Frozen):
    """Training of the discriminator, whatever its loss: its batches and its optimizer."""

    learning_rate: Positive
    learning_rate_final: Share  # learning rate of the last epoch as a fraction of the first
    beta1: Annotated[float, Field(ge=0, lt=1)]  # of Adam
    updates: Count  # discriminator steps per SAC step
    rollouts: Count  # trajectories generated per epoch
    replay: Count  # capacity of the replay buffer in trajectories
    # share of the generated batch that comes from the replay buffer instead of the latest rollouts
    past_share: Fraction
    # random time steps per trajectory that an update uses (only the encoder needs whole sequences)
    time_steps: Count
    # standard deviation of the Gaussian noise on the discriminator's training inputs, scaled units
    input_noise: NonNegative
    # input_noise of the last epoch as a fraction of the first: it falls geometrically, from a coarse to a fine reward
    input_noise_final: Share
    input_noise_start: Start  # fraction of the epochs before input_noise begins to fall
    reward_scale: Positive
    reward_limit: Positive | None  # rewards are clipped to plus or minus this after scaling; null: no clipping


class SelfSupervisionSpec(Frozen):
    """What Eq. 3 adds: tau_alpha, for the discriminator and for the actor-critic (sections 3.1.1 and 3.1.3)."""

    alpha: AlphaDensity  # the density of alpha: [low, high], or [[low, high, weight], ...]
    # the target of D for tau_alpha: identity, zero-above-one, [[alpha, label], ...] or module:function
    label: Label
    pairing: Pairing  # which expert trajectory a generated one is mixed with in the discriminator's batches
    actor_pairing: Pairing  # the same in the actor-critic's batches
    actor_share: Fraction  # share of tau_alpha in an actor-critic batch; the rest is tau_G

    @property
    def alpha_pieces(self) -> tuple[AlphaPiece, ...]:
        """The ranges (low, high, weight) that alpha is drawn from."""
        density: Any = self.alpha
        return density if isinstance(density[0], tuple) else ((*density, 1.0),)


class WassersteinSpec(Frozen):
    """The Lipschitz constraint of wail's critic."""

    constraint: Literal["penalty", "clipping"]
    penalty: NonNegative  # with penalty: its weight (WGAN-GP, Gulrajani et al. 2017)
    clip: Positive  # with clipping: largest absolute weight of the critic (Arjovsky et al. 2017)


class SacSpec(Frozen):
    """Soft actor-critic (section 3.2.2)."""

    gamma: Annotated[float, Field(ge=0, lt=1)]
    polyak: Annotated[float, Field(gt=0, le=1)]
    actor_learning_rate: Positive
    actor_learning_rate_final: (
        Share  # learning rate of the last epoch as a fraction of the first; the temperature's too
    )
    # fraction of the epochs at the start in which only critics and discriminator learn; null: none
    actor_start: Annotated[float, Field(gt=0, lt=1)] | None
    critic_learning_rate: Positive
    critic_learning_rate_final: Share
    temperature: NonNegative  # fixed, or the initial one if automatic
    automatic_temperature: bool
    temperature_learning_rate: Positive
    target_entropy: Finite | None  # nats per action dimension of one agent, for actions in scaled units
    # consecutive steps of a trajectory that the encoder's gradient covers in an update (truncated BPTT); null: all
    encoder_steps: Count | None
    # steps over which an action's value in the actor's objective is computed with the known dynamics and rewards before
    # the critics estimate the rest (model-based value expansion); 0: the critics estimate all, as in the paper
    expansion_steps: Annotated[int, Field(ge=0, le=100)]
    expansion_start: Start  # fraction of the epochs before that, in which the critics estimate all
    graph_entropy: NonNegative  # weight of the edge types' entropy in the actor's objective
    # the policy that is evaluated has weights averaged over the updates, of which each counts this fraction (an
    # exponential moving average); null: the current weights
    average: Annotated[float, Field(gt=0, lt=1)] | None


class VariationalSpec(Frozen):
    """Network sizes and loss terms of nri and dnri (Kipf et al. 2018; Graber and Schwing 2020)."""

    root_relative: bool  # these four as in ModelSpec
    centre_relative: Automatic
    agent_input: Automatic
    standardize: Standardize
    hidden: Count  # of the encoder's MLPs
    memory: Count  # of the LSTM of an edge, in each direction (dnri)
    head: Count  # hidden size of the heads that output edge types
    decoder: Literal["messages", "recurrent"]  # without memory, for small systems; or with a gated memory per agent
    decoder_hidden: Count
    edge_types: Count
    first_type_is_none: bool  # edges of the first type carry no messages
    batch_norm: bool  # in the encoder
    # nri: steps that its encoder reads as one input, as published; null: any number, embedded one by one and averaged
    encoder_window: Count | None
    temperature: Positive  # temperature of the Gumbel-softmax relaxation
    variance: Positive | None  # of the Gaussian likelihood, scaled units squared
    kl_weight: NonNegative  # weight of the KL divergence of the posterior from the prior
    # nri: prior probability of the first edge type; the others share the rest
    none_prior: Annotated[float, Field(gt=0, lt=1)]


class CloningSpec(Frozen):
    """Training of bc, nri and dnri on expert trajectories."""

    learning_rate: Positive
    learning_rate_final: Share  # learning rate of the last epoch as a fraction of the first
    input_noise: NonNegative  # standard deviation of the Gaussian noise on the states read in training, scaled units


class CurriculumSpec(Frozen):
    """How often training rollouts are reset to the expert's state (section 3.3). E is training.epochs."""

    name: Literal["none", "trajectory-forcing", "teacher-forcing", "scheduled-sampling"]
    beta: Fraction  # trajectory forcing: f(e) = 1.5 ** (-e / (beta * E))
    rate: Fraction  # teacher forcing: the probability of an intervention at each step; 1 always, 0 never
    decay: Literal["linear", "exponential", "inverse-sigmoid"]  # scheduled sampling (Bengio et al. 2015)
    half_life: Share  # scheduled sampling: the fraction of E after which the probability is 1/2
    steepness: Annotated[float, Field(gt=1, allow_inf_nan=False)]  # scheduled sampling: k of the inverse sigmoid


class TrainingSpec(Frozen):
    """Training budget and batch size."""

    epochs: Count
    updates: Count  # gradient steps per epoch (SAC steps in the adversarial methods)
    batch: Count  # trajectories per batch
    # fraction of the epochs after which learning rates decay geometrically to their final values
    decay_start: Fraction
    gradient_clip: Positive


class EvaluationSpec(Frozen):
    """Sizes of the free-running evaluations, and when landscapes are stored."""

    train_rollouts: Count  # training trajectories whose starts are rolled out for an epoch's training metrics
    samples: Count  # rollouts per test start
    # trajectories: validation windows that judge an epoch, evenly over the split (null: all), and forecasts of each
    validation_windows: Count | None
    validation_samples: Count | None
    # trajectories: test windows of the final evaluation, evenly over the split, the same for all runs; null: all
    test_windows: Count | None
    # model selection prefers epochs whose validation lane_balance is at least this
    least_balance: Annotated[float, Field(ge=0, le=0.5)]
    # reward landscapes to store, evenly over the epochs, in addition to those of the untrained and of the current model
    # (docs/paper.md, Figures 1 and 2); null: none, not even these
    landscapes: Count | None


class ForecastSpec(Frozen):
    """The test by forecasts: frames observed and predicted, distances that count, and the noise of section 4.6."""

    # frames observed at test time, and predicted after the last of them; null: as many as the expert set was made for
    observed: Count | None
    predicted: Count | None
    # distance at the last frame from which a forecast is a miss, raw units; null: a fifth of the mean distance that
    # agents of the training split cover in the predicted frames
    miss_distance: Positive | None
    collision_distance: Positive | None  # two agents that are nearer collide, raw units; null: not measured
    noise: NonNegative  # standard deviation of the Gaussian noise in the noisy test, scaled units
    noise_on: Literal["all", "history"]  # noise on every state that the model reads, or on the observed ones only
    noise_seed: NonNegativeCount  # seed of the noise, which all methods and seeds of runs share
