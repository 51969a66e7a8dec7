"""The sections of a spec: the name, the allowed values, the unit and the meaning of each key.

`ssmail.config.keys` makes the reference of the keys from what stands here. No field has a default: all defaults are in
experiments.yaml (see ssmail.config.experiments_file).
"""

from typing import Annotated, Any, Literal, TypeVar

from pydantic import Field

from ssmail.config.shaping import AlphaDensity, AlphaPiece, Label
from ssmail.config.value_types import (
    Automatic,
    Count,
    Finite,
    Fraction,
    Frozen,
    Inside,
    NonNegative,
    NonNegativeCount,
    Pairing,
    Positive,
    ScaledUnits,
    Share,
    Standardize,
    Start,
    Steps,
    Trajectories,
    Unit,
    Waves,
)

Section = TypeVar("Section", bound=Frozen)


def required(section: Section | None) -> Section:
    """Return a section that the method requires (spec.METHOD_SECTIONS), for callers that serve no other methods."""
    assert section is not None
    return section


class ModelSpec(Frozen):
    """Sizes and inputs of the graph encoder, the actor, the critics and the discriminator (section 3.2)."""

    hidden: Count
    """Hidden size of actor and critics."""
    encoder_hidden: Count
    """Hidden size of the graph encoder."""
    discriminator_hidden: Count | None
    """Hidden size of the discriminator; null: that of actor and critics."""
    discriminator_waves: Waves
    """Frequencies of the sines and cosines of positions that the discriminator reads beside the positions: without them
    a small network is slow to tell places apart that are close to each other."""
    discriminator_velocities: bool
    """The discriminator reads velocities, of states and actions; false: positions alone, beside time and agent."""
    edge_types: Count
    """Number of edge types, the latent classes of an ordered pair of agents."""
    first_type_is_none: bool
    """Edges of the first type carry no messages."""
    own_input: bool
    """The heads of actor and critics read an agent's own features in addition to its messages."""
    graph_gain: Positive
    """Scale of the edge types' initial weights: how much the types differ before training."""
    graph_temperature: Positive
    """Temperature of the Gumbel-softmax relaxation of the edge types."""
    graph_noise: Literal["shared", "edge"]
    """One Gumbel sample for all edges of a graph, or one per edge."""
    graph_resample: Literal["trajectory", "step"]
    """How often the noise of the edge types is resampled."""
    time_input: bool
    """Every network reads the step index, scaled to [-1, 1]."""
    start_input: bool
    """Every network reads each agent's first state."""
    root_relative: bool
    """Positions are relative to those of the first agent, which are zero."""
    centre_relative: Automatic
    """Positions are relative to the mean of the group's; auto: where groups wander."""
    agent_input: Automatic
    """Every network reads a one-hot agent index, for agents that differ, such as joints; auto: if the agents of all
    trajectories are the same ones."""
    standardize: Standardize
    """Networks read states and actions normalized by each agent's mean and standard deviation over the training set;
    pooled: one mean and standard deviation for all agents; auto: those of each agent if the agents of all trajectories
    are the same ones."""
    action_step: Annotated[Positive, Unit("scaled units")] | None
    """Largest change of velocity by an action (with standardize: normalized); null: from the data."""
    action_bound: Annotated[Positive, Unit("scaled units")] | None
    """Largest distance of the velocity from 0 (with standardize: from the mean, normalized); null: from the data."""
    initial_scale: NonNegative
    """Scale of the actor's last weights: how far the untrained mean is from the current velocity."""
    log_std_min: Finite
    """Least logarithm of the policy's standard deviation."""
    log_std_max: Finite
    """Greatest logarithm of the policy's standard deviation."""


class AdversarialSpec(Frozen):
    """Training of the discriminator, whatever its loss: its batches and its optimizer."""

    learning_rate: Positive
    """Learning rate of the discriminator's Adam."""
    learning_rate_final: Share
    """Learning rate of the last epoch as a fraction of the first."""
    beta1: Annotated[float, Field(ge=0, lt=1)]
    """Decay of the mean of gradients in the discriminator's Adam."""
    updates: Count
    """Discriminator steps per SAC step."""
    rollouts: Trajectories
    """Trajectories generated per epoch."""
    replay: Trajectories
    """Capacity of the replay buffer."""
    past_share: Fraction
    """Share of the generated batch that comes from the replay buffer instead of the latest rollouts."""
    time_steps: Steps
    """Random time steps per trajectory that an update uses (only the encoder needs whole sequences)."""
    input_noise: ScaledUnits
    """Standard deviation of the Gaussian noise on the discriminator's training inputs."""
    input_noise_final: Share
    """input_noise of the last epoch as a fraction of the first: it falls geometrically, from a coarse to a fine
    reward."""
    input_noise_start: Start
    """When input_noise begins to fall."""
    reward: Literal["own", "probability"]
    """The reward made of the discriminator's output: the method's own; or, of gail, the probability of "expert"."""
    reward_scale: Positive
    """Factor of the reward."""
    reward_limit: Positive | None
    """Rewards are clipped to plus or minus this after scaling; null: no clipping."""


class SelfSupervisionSpec(Frozen):
    """What Eq. 3 adds: tau_alpha, for the discriminator and for the actor-critic (sections 3.1.1 and 3.1.3)."""

    alpha: AlphaDensity
    """The density of alpha: a range [low, high], or ranges with weights [[low, high, weight], ...]."""
    label: Label
    """The target of D for tau_alpha: identity, zero-above-one, knots [[alpha, label], ...] or module:function."""
    pairing: Pairing
    """Which expert trajectory a generated one is mixed with in the discriminator's batches."""
    actor_pairing: Pairing
    """Which expert trajectory a generated one is mixed with in the actor-critic's batches."""
    discriminator_weight: NonNegative
    """Weight of the term of tau_alpha in the discriminator's loss; 0: the discriminator never sees tau_alpha."""
    actor_share: Fraction
    """Share of tau_alpha in an actor-critic batch; the rest is tau_G."""

    @property
    def alpha_pieces(self) -> tuple[AlphaPiece, ...]:
        """The ranges (low, high, weight) that alpha is drawn from."""
        density: Any = self.alpha
        return density if isinstance(density[0], tuple) else ((*density, 1.0),)


class WassersteinSpec(Frozen):
    """The Lipschitz constraint of wail's critic."""

    constraint: Literal["penalty", "clipping"]
    """A gradient penalty (WGAN-GP, Gulrajani et al. 2017), or clipped weights (Arjovsky et al. 2017)."""
    penalty: NonNegative
    """Weight of the gradient penalty."""
    clip: Positive
    """Largest absolute weight of the critic, with clipping."""


class SacSpec(Frozen):
    """Soft actor-critic (section 3.2.2)."""

    gamma: Annotated[float, Field(ge=0, lt=1), Unit("per step")]
    """Discount factor of the reward."""
    polyak: Share
    """Step of the target critics towards the critics, per update."""
    actor_learning_rate: Positive
    """Learning rate of the actor's Adam."""
    actor_learning_rate_final: Share
    """Learning rate of actor and temperature in the last epoch as a fraction of the first."""
    actor_start: Annotated[Inside, Unit("fraction of the epochs")] | None
    """How long only critics and discriminator learn, at the start; null: not at all."""
    critic_learning_rate: Positive
    """Learning rate of the critics' Adam."""
    critic_learning_rate_final: Share
    """Learning rate of the critics in the last epoch as a fraction of the first."""
    temperature: NonNegative
    """Weight of the policy's entropy: fixed, or the initial one if it is automatic."""
    automatic_temperature: bool
    """The temperature is learned, so that the entropy becomes target_entropy."""
    temperature_learning_rate: Positive
    """Learning rate of the temperature's Adam."""
    target_entropy: Annotated[Finite, Unit("nats per action dimension of an agent")] | None
    """The entropy that an automatic temperature aims at, for actions in scaled units; null: from the data."""
    encoder_steps: Steps | None
    """Consecutive steps of a trajectory that the encoder's gradient covers in an update (truncated BPTT); null: all."""
    expansion_steps: Annotated[int, Field(ge=0, le=100), Unit("steps")]
    """Steps over which an action's value in the actor's objective is computed with the known dynamics and rewards
    before the critics estimate the rest (model-based value expansion); 0: the critics estimate all, as in the paper."""
    expansion_start: Start
    """When value expansion begins; before, the critics estimate all."""
    finite_horizon: bool
    """The value after a trajectory's last step is zero, for tasks whose time is an input (model.time_input); otherwise
    the critics bootstrap there, from a time step that they are never trained on."""
    graph_entropy: NonNegative
    """Weight of the edge types' entropy in the actor's objective, a mean over the edges."""
    average: Inside | None
    """The policy that is evaluated has weights averaged over the updates, of which each counts this fraction (an
    exponential moving average); null: the current weights."""


class VariationalSpec(Frozen):
    """Network sizes and loss terms of nri and dnri (Kipf et al. 2018; Graber and Schwing 2020)."""

    root_relative: bool
    """As model.root_relative."""
    centre_relative: Automatic
    """As model.centre_relative."""
    agent_input: Automatic
    """As model.agent_input."""
    standardize: Standardize
    """As model.standardize."""
    hidden: Count
    """Hidden size of the encoder's MLPs."""
    memory: Count
    """Size of the LSTM of an edge, in each direction (dnri)."""
    head: Count
    """Hidden size of the heads that output edge types."""
    decoder: Literal["messages", "recurrent"]
    """Without memory, for small systems; or with a gated memory per agent."""
    decoder_hidden: Count
    """Hidden size of the decoder."""
    edge_types: Count
    """Number of edge types, the latent classes of an ordered pair of agents."""
    first_type_is_none: bool
    """Edges of the first type carry no messages."""
    graph_noise: Literal["edge", "shared", "none"]
    """As model.graph_noise; none: the most likely graph instead of a sampled one, in training and afterwards."""
    graph_resample: Literal["step", "trajectory"]
    """dnri: how often the noise of the edge types is resampled, as model.graph_resample; nri has one graph."""
    action_step: Annotated[Positive, Unit("scaled units")] | None
    """Largest change of velocity by a prediction, as model.action_step of the actor; null: no bound."""
    action_bound: Annotated[Positive, Unit("scaled units")] | None
    """As model.action_bound, where there is an action_step; null: no bound."""
    batch_norm: bool
    """The encoder has batch normalization."""
    encoder_window: Steps | None
    """nri: steps that its encoder reads as one input, as published; null: any number, embedded one by one and
    averaged."""
    temperature: Positive
    """Temperature of the Gumbel-softmax relaxation of the edge types."""
    variance: Annotated[Positive, Unit("scaled units squared")] | None
    """Variance of the Gaussian likelihood; null: from the data."""
    kl_weight: NonNegative
    """Weight of the KL divergence of the posterior from the prior."""
    none_prior: Inside
    """nri: prior probability of the first edge type; the others share the rest."""


class CloningSpec(Frozen):
    """Training of bc, nri and dnri on expert trajectories."""

    learning_rate: Positive
    """Learning rate of Adam."""
    learning_rate_final: Share
    """Learning rate of the last epoch as a fraction of the first."""
    input_noise: ScaledUnits
    """Standard deviation of the Gaussian noise on the states read in training."""


class CurriculumSpec(Frozen):
    """How often training rollouts are reset to the expert's state (section 3.3). E is training.epochs."""

    name: Literal["none", "trajectory-forcing", "teacher-forcing", "scheduled-sampling"]
    """The curriculum."""
    beta: Annotated[Fraction, Unit("fraction of the epochs")]
    """Trajectory forcing: its pace; the frequency of resets at epoch e is 1.5 ** (-e / (beta * E))."""
    rate: Annotated[Fraction, Unit("per step")]
    """Teacher forcing: the probability of an intervention at each step; 1 always, 0 never."""
    decay: Literal["linear", "exponential", "inverse-sigmoid"]
    """Scheduled sampling: how the probability falls (Bengio et al. 2015)."""
    half_life: Annotated[Share, Unit("fraction of the epochs")]
    """Scheduled sampling: when the probability is 1/2."""
    steepness: Annotated[float, Field(gt=1, allow_inf_nan=False)]
    """Scheduled sampling: k of the inverse sigmoid."""


class TrainingSpec(Frozen):
    """Training budget and batch size."""

    epochs: Annotated[Count, Unit("epochs")]
    """Length of training; the model is validated after each epoch."""
    updates: Annotated[Count, Unit("steps per epoch")]
    """Gradient steps (SAC steps in the adversarial methods)."""
    batch: Trajectories
    """Size of a batch."""
    decay_start: Annotated[Fraction, Unit("fraction of the epochs")]
    """When learning rates begin to decay, geometrically to their final values."""
    gradient_clip: Positive
    """Largest norm of a gradient; a longer one is scaled down to it."""


class EvaluationSpec(Frozen):
    """Sizes of the free-running evaluations, and when landscapes are stored."""

    train_rollouts: Trajectories
    """Training trajectories whose starts are rolled out for an epoch's training metrics."""
    samples: Annotated[Count, Unit("rollouts")]
    """Rollouts per test start."""
    validation_windows: Annotated[Count, Unit("windows")] | None
    """trajectories: validation windows that judge an epoch, evenly over the split; null: all."""
    validation_samples: Annotated[Count, Unit("forecasts")] | None
    """trajectories: forecasts of each validation window; null: one."""
    test_windows: Annotated[Count, Unit("windows")] | None
    """trajectories: test windows of the final evaluation, evenly over the split, the same for all runs; null: all."""
    least_balance: Annotated[float, Field(ge=0, le=0.5)]
    """Model selection prefers epochs whose validation lane_balance is at least this."""
    landscapes: Count | None
    """Reward landscapes to store, evenly over the epochs, in addition to those of the untrained and of the current
    model (docs/paper.md, Figures 1 and 2); null: none, not even these."""


class ForecastSpec(Frozen):
    """The test by forecasts: frames observed and predicted, distances that count, and the noise of section 4.6."""

    observed: Annotated[Count, Unit("frames")] | None
    """Frames observed at test time; null: as many as the expert set was made for."""
    predicted: Annotated[Count, Unit("frames")] | None
    """Frames predicted after the last observed one; null: as many as the expert set was made for."""
    miss_distance: Annotated[Positive, Unit("raw units")] | None
    """Distance at the last frame from which a forecast is a miss; null: a fifth of the mean distance that agents of the
    training split cover in the predicted frames."""
    collision_distance: Annotated[Positive, Unit("raw units")] | None
    """Two agents that are nearer collide; null: not measured."""
    noise: ScaledUnits
    """Standard deviation of the Gaussian noise in the noisy test."""
    noise_on: Literal["all", "history", "predictions"]
    """Noise on every state that the model reads, on the observed ones only, or on its own predictions only."""
    noise_seed: NonNegativeCount
    """Seed of the noise, which all methods and seeds of runs share."""
