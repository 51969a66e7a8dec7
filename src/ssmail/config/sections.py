"""The sections of a spec: what each key is called, which values it takes, and its unit.

No field has a default here: each default is written once, in experiments.yaml (see ssmail.config.experiments).
"""

from typing import Annotated, Any, Literal, TypeVar

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field

from ssmail.config.shaping import AlphaDensity, AlphaPiece, Label

Count = Annotated[int, Field(ge=1)]
NonNegativeCount = Annotated[int, Field(ge=0)]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
NonNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Fraction = Annotated[float, Field(ge=0, le=1, allow_inf_nan=False)]
Share = Annotated[float, Field(gt=0, le=1, allow_inf_nan=False)]
Finite = Annotated[float, Field(allow_inf_nan=False)]

Pairing = Literal["start", "nearest", "assignment"]


class Frozen(BaseModel):
    """Immutable, and an unknown key or a value of the wrong type is an error (3 is a float, "3" and True are not)."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)


Section = TypeVar("Section", bound=Frozen)


def required(section: Section | None) -> Section:
    """Return a section that the method requires (spec.SECTIONS), for callers that serve no other methods."""
    assert section is not None
    return section


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


MOST_LETTERS = 6


def check_word(word: Any) -> Any:
    """The word. Raises ValueError unless it is 1 to 6 capital letters."""
    wanted = f"takes 1 to {MOST_LETTERS} capital letters A to Z"
    if not isinstance(word, str):
        raise ValueError(f"{wanted}; YAML reads NO, ON, YES and NULL as something else, unless in quotes as '\"NO\"'")
    if not (1 <= len(word) <= MOST_LETTERS and word.isascii() and word.isalpha() and word.isupper()):
        raise ValueError(f"{wanted}, not {word[:20]!r}")
    return word


class LettersSpec(Frozen):
    """The word that is drawn and the size of the letters' expert set (sections 1 and A.2)."""

    word: Annotated[str, BeforeValidator(check_word)]  # one agent for each letter
    train: Count  # trajectories
    validation: Count
    test: Count
    steps: Annotated[int, Field(ge=20)]
    jitter: NonNegative  # scale of the hand's random starts, shapes, wobble and tempo; 1 is the default spread
    seed: NonNegativeCount


class DataSpec(Frozen):
    """Where the expert trajectories come from: a file, or (path null) the environment's generator."""

    path: str | None
    yjunction: YJunctionSpec | None  # null in other environments
    letters: LettersSpec | None  # likewise


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
    root_relative: bool  # positions are read relative to the first agent's, whose own are left out
    agent_input: bool  # every network reads which agent it looks at, one-hot (agents that are not alike, as joints)
    # states and actions are read, and the two keys that follow are given, in units of each agent's own spread over the
    # training set, about its mean
    standardize: bool
    action_step: Positive  # an action moves a velocity by at most this much; scaled units if not standardize
    action_bound: Positive  # and never farther from 0 (with standardize: from the mean) than this
    initial_scale: NonNegative  # of the actor's last weights: how far the untrained mean strays from the velocity
    log_std_min: Finite
    log_std_max: Finite


class AdversarialSpec(Frozen):
    """The discriminator's game, whatever its loss: the batches it sees and how it learns."""

    learning_rate: Positive
    learning_rate_final: Share  # the last epoch's rate as a fraction of the first's
    beta1: Annotated[float, Field(ge=0, lt=1)]  # of Adam, for the discriminator
    updates: Count  # discriminator steps for each SAC step
    rollouts: Count  # trajectories generated in each epoch
    replay: Count  # generated trajectories kept
    # share of the generated batch drawn from the replay of past tau_G instead of the latest rollouts
    past_share: Fraction
    # random time steps of each trajectory that an update uses (only the encoder needs whole sequences)
    time_steps: Count
    # std of the Gaussian noise on the states and actions that the discriminator is trained on, scaled units
    input_noise: NonNegative
    reward_scale: Positive
    reward_limit: Positive | None  # rewards are kept within plus and minus this, after scaling; null: as they are


class SelfSupervisionSpec(Frozen):
    """What Eq. 3 adds to the game: tau_alpha, for the discriminator and for the actor-critic (3.1.1, 3.1.3)."""

    alpha: AlphaDensity  # what alpha is drawn from: [low, high], or [[low, high, weight], ...]
    # what D is trained to say of tau_alpha: identity, zero-above-one, [[alpha, label], ...] or module:function
    label: Label
    pairing: Pairing  # which expert trajectory a generated one is mixed with, in the discriminator's batches
    actor_pairing: Pairing  # the same in the actor-critic's batches
    actor_share: Fraction  # share of tau_alpha in an actor-critic batch; the rest is tau_G

    @property
    def alpha_pieces(self) -> tuple[AlphaPiece, ...]:
        """(low, high, weight) of each range that alpha is drawn from."""
        density: Any = self.alpha
        return density if isinstance(density[0], tuple) else ((*density, 1.0),)


class WassersteinSpec(Frozen):
    """How wail's critic is kept Lipschitz."""

    constraint: Literal["penalty", "clipping"]
    penalty: NonNegative  # weight of the gradient penalty (Gulrajani et al. 2017)
    clip: Positive  # largest absolute weight of the critic with clipping (Arjovsky et al. 2017)


class SacSpec(Frozen):
    """Soft actor-critic (section 3.2.2)."""

    gamma: Annotated[float, Field(ge=0, lt=1)]
    polyak: Annotated[float, Field(gt=0, le=1)]
    actor_learning_rate: Positive
    actor_learning_rate_final: Share  # the last epoch's rate as a fraction of the first's; the temperature's too
    # fraction of the epochs in which the critics and the discriminator learn and the actor does not; null: none
    actor_start: Annotated[float, Field(gt=0, lt=1)] | None
    critic_learning_rate: Positive
    critic_learning_rate_final: Share
    temperature: NonNegative  # the fixed one, or the first one when automatic
    automatic_temperature: bool
    temperature_learning_rate: Positive
    target_entropy: Finite  # nats for each action dimension of one agent, in scaled velocity units
    # consecutive steps of a trajectory through which the encoder's gradient goes in an update; null: all
    encoder_steps: Count | None
    graph_entropy: NonNegative  # weight of the edge-type distribution's entropy in the actor's objective


class VariationalSpec(Frozen):
    """Sizes and terms of nri and dnri (Kipf et al. 2018; Graber and Schwing 2020)."""

    root_relative: bool  # as in the section model
    agent_input: bool
    standardize: bool
    hidden: Count  # of the encoder's perceptrons
    memory: Count  # of the LSTM of each edge, in each direction (dnri)
    head: Count  # hidden size of the heads that give the edge types
    decoder: Literal["messages", "recurrent"]  # without memory, for small systems; or with a gated memory per agent
    decoder_hidden: Count
    edge_types: Annotated[int, Field(ge=1)]
    first_type_is_none: bool  # no message flows along an edge of the first type
    batch_norm: bool  # in the encoder
    temperature: Positive  # of the Gumbel-softmax relaxation
    variance: Positive  # of the Gaussian likelihood, squared scaled units
    kl_weight: NonNegative  # of the divergence of the posterior from the prior
    # nri: prior probability of the first type; the others share the rest
    none_prior: Annotated[float, Field(gt=0, lt=1)]


class CloningSpec(Frozen):
    """How bc, nri and dnri learn from the expert's trajectories."""

    learning_rate: Positive
    learning_rate_final: Share  # the last epoch's rate as a fraction of the first's
    input_noise: NonNegative  # std of the Gaussian noise on the states that are read in training, scaled units


class CurriculumSpec(Frozen):
    """How often generation is put back on the expert's track while training (section 3.3). E is training.epochs."""

    name: Literal["none", "trajectory-forcing", "teacher-forcing", "scheduled-sampling"]
    beta: Fraction  # trajectory forcing: f(e) = 1.5 ** (-e / (beta * E))
    rate: Fraction  # teacher forcing: the probability of an intervention at each step; 1 always, 0 never
    decay: Literal["linear", "exponential", "inverse-sigmoid"]  # scheduled sampling (Bengio et al. 2015)
    half_life: Share  # scheduled sampling: the fraction of E after which the probability is 1/2
    steepness: Annotated[float, Field(gt=1, allow_inf_nan=False)]  # scheduled sampling: k of the inverse sigmoid


class TrainingSpec(Frozen):
    """Budget and batches."""

    epochs: Count
    updates: Count  # gradient steps in each epoch (SAC steps in the adversarial methods)
    batch: Count  # trajectories in a batch
    # fraction of the epochs after which the learning rates fall, geometrically, to their final values
    decay_start: Fraction
    gradient_clip: Positive


class EvaluationSpec(Frozen):
    """Sizes of the free-running evaluations."""

    train_rollouts: Count  # training starts rolled out for the training metrics of an epoch
    samples: Count  # rollouts for each test start
    # an epoch whose validation lane_balance is below is best only while none reaches it
    least_balance: Annotated[float, Field(ge=0, le=0.5)]
    # landscapes of the reward that are kept, evenly over the epochs, beside those of the untrained and of the current
    # model (training.landscape_recorder); null: that of the last epoch alone
    landscapes: Count | None


class ForecastSpec(Frozen):
    """The test of an environment with recorded motion: how much is observed, how much predicted, and the noise of
    section 4.6 on what the model reads.
    """

    observed: Count  # frames given at test time; the last of them is where prediction starts
    predicted: Count  # frames predicted after them
    noise: NonNegative  # std in scaled units of the Gaussian noise of the noisy test
    noise_on: Literal["all", "history"]  # every state that the model reads, or the observed ones alone
    noise_seed: NonNegativeCount  # of the draws, which all methods and seeds share
