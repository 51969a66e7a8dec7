"""nri and dnri: motion models conditioned on a graph with a variational posterior, in training and in prediction.

Kipf et al. 2018 (nri); Graber and Schwing 2020 (dnri).
"""

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from typing import Unpack

import torch
from torch import Tensor, nn

from ssmail.config.sections import VariationalSpec, required
from ssmail.envs.integrator import Integrator
from ssmail.errors import InputError
from ssmail.losses.likelihood import fixed_prior, variational_loss
from ssmail.models.decoders import make_decoder
from ssmail.models.features import Features
from ssmail.models.graph_encoder import GraphNoise, Memory, sample_graph
from ssmail.models.normalization import ActionBounds
from ssmail.models.variational_encoder import DynamicEncoder, StaticEncoder, WindowEncoder
from ssmail.training.batches import Batch
from ssmail.training.cloning import SupervisedLearner
from ssmail.training.curricula import curriculum_metrics, draw_interventions, intervention_frequency
from ssmail.training.learner import LearnerContext, Reading
from ssmail.training.optimization import add_noise, mean_metrics

PREDICTION_CHUNK = 16  # trajectories predicted at once: a skeleton's edges take gigabytes otherwise
EDGES = PREDICTION_CHUNK * 930  # of the trajectories predicted at once, if their number depends on that of the agents


class VariationalModel(nn.Module):
    """Encoder and decoder. dnri (`dynamic`) has a graph per step and a learned prior; nri has one per trajectory."""

    fixed_prior: Tensor

    def __init__(self, features: Features, state_size: int, spec: VariationalSpec, dynamic: bool) -> None:
        super().__init__()
        self.features, self.spec, self.dynamic = features, spec, dynamic
        inputs, action_size = features.size(state_size), state_size // 2
        self.encoder: DynamicEncoder | WindowEncoder | StaticEncoder
        if dynamic:
            self.encoder = DynamicEncoder(inputs, spec)
        elif spec.encoder_window is not None:
            self.encoder = WindowEncoder(inputs, features.agents, spec)
        else:
            self.encoder = StaticEncoder(inputs, spec)
        self.decoder = make_decoder(inputs, action_size, spec)
        self.register_buffer("fixed_prior", fixed_prior(spec.edge_types, spec.none_prior), persistent=False)
        self.graph_noise = GraphNoise(spec.graph_noise, spec.graph_resample if dynamic else "trajectory")
        self.bounds = None
        if spec.action_step is not None:
            bound = math.inf if spec.action_bound is None else spec.action_bound
            self.bounds = ActionBounds.within(spec.action_step, bound, features.normalization)

    def posterior(self, states: Tensor) -> tuple[Tensor, Tensor]:
        """Return the posterior's logits (B, T or 1, N, N, K) for states (B, T, N, D), and the prior's."""
        x = self.read(states)
        if isinstance(self.encoder, DynamicEncoder):
            prior, posterior = self.encoder(x)
            return posterior, prior
        return self.encoder(x), self.fixed_prior

    def past_logits(self, states: Tensor) -> Tensor:
        """Return the graph's logits (B, T, N, N, K) at each step, given the steps so far.

        For dnri they are those of the prior, for nri those of the posterior given these steps.
        """
        x = self.read(states)
        if isinstance(self.encoder, DynamicEncoder):
            return self.encoder.prior(x)[0]
        return self.encoder.running(x)

    def observed_logits(self, states: Tensor) -> Tensor:
        """Return nri's logits (B, 1, N, N, K) given all states (B, T, N, D), for the graph of a prediction."""
        if isinstance(self.encoder, WindowEncoder):
            logits: Tensor = self.encoder(self.read(states))
            return logits
        return self.past_logits(states)[:, -1:]

    def read(self, states: Tensor) -> Tensor:
        """Return the features (B, T, N, F) that encoder and decoder read of states (B, T, N, D)."""
        return self.features(states, states[:, 0])

    def decode(self, states: Tensor, graphs: Tensor, memory: Tensor | None = None) -> tuple[Tensor, Tensor | None]:
        """Return actions (B, T, N, A) after states (B, T, N, D), and the decoder's memory.

        graphs: (B, T or 1, N, N, K). The decoder predicts a residual on the velocity as it reads it; the action is
        within the bounds of variational.action_step, if there are any.
        """
        output, memory = self.decoder(self.read(states), graphs, memory)
        action = self.features.denormalize_actions(output)
        return action if self.bounds is None else self.bounds.limit(action, states[..., action.shape[-1] :]), memory

    def sample(self, logits: Tensor, noise: Tensor) -> Tensor:
        """Sample one-hot graphs by the straight-through Gumbel softmax."""
        return sample_graph(logits, noise, self.spec.temperature)

    def draw_noise(self, batch: int, steps: int, agents: int, generator: torch.Generator) -> Tensor:
        """Draw Gumbel noise for the graphs of `batch` trajectories."""
        return self.graph_noise.draw(batch, steps, agents, self.spec.edge_types, generator)


@contextmanager
def evaluation_mode(model: nn.Module) -> Iterator[None]:
    """Put the model into evaluation mode within the block: batch norm uses its running statistics."""
    was_training = model.training
    model.eval()
    try:
        yield
    finally:
        model.train(was_training)


def in_chunks(function: Callable[..., Tensor], chunk: int, *inputs: Tensor) -> Tensor:
    """Apply a function to `chunk` rows of the inputs (B, ...) at a time and join the results."""
    chunks = zip(*(torch.split(x, chunk) for x in inputs), strict=True)
    return torch.cat([function(*part) for part in chunks])


class _GraphSampler:
    """Samples the graphs of a prediction step by step: nri's single one, or dnri's from the prior and its memory.

    gumbel: noise for S samples of each of the B observed groups, the samples of a group one after the other.
    """

    def __init__(self, model: VariationalModel, observed: Tensor, gumbel: Tensor) -> None:
        self.model, self.gumbel, self.step = model, gumbel, 0
        self.samples = len(gumbel) // len(observed)
        self.memory: Memory | None = None
        self.fixed: Tensor | None = None
        if not model.dynamic:
            self.fixed = model.sample(self._of_samples(model.observed_logits(observed)), gumbel)

    def observe(self, states: Tensor) -> Tensor:
        """Return the graphs (S * B, T or 1, N, N, K) under which to decode the observed states (B, T, N, D)."""
        if self.fixed is not None:
            return self.fixed
        logits = self._of_samples(self._prior(states))
        assert self.memory is not None
        groups, _, agents, _ = states.shape
        by_group = (part.view(len(part), groups, agents * (agents - 1), part.shape[-1]) for part in self.memory)
        hidden, cell = (self._of_samples(part, 1).flatten(1, 2) for part in by_group)
        self.memory = hidden, cell
        return self._next(logits)

    def sample(self, states: Tensor) -> Tensor:
        """Return the graphs (S * B, T or 1, N, N, K) under which to decode the next states (S * B, T, N, D)."""
        return self._next(self._prior(states)) if self.fixed is None else self.fixed

    def _prior(self, states: Tensor) -> Tensor:
        assert isinstance(self.model.encoder, DynamicEncoder)
        logits, self.memory = self.model.encoder.prior(self.model.read(states), self.memory)
        return logits

    def _next(self, logits: Tensor) -> Tensor:
        first, self.step = self.step, self.step + logits.shape[1]
        held = self.gumbel.shape[1] == 1  # one draw for the whole trajectory
        return self.model.sample(logits, self.gumbel if held else self.gumbel[:, first : self.step])

    def _of_samples(self, of_groups: Tensor, axis: int = 0) -> Tensor:
        return of_groups.repeat_interleave(self.samples, axis) if self.samples > 1 else of_groups


@dataclass(frozen=True)
class VariationalPredictor:
    """Samples graphs and predicts the decoder's mean. `deterministic` takes the most likely graph instead.

    by_edges: predict as many trajectories at once as have EDGES edges, instead of PREDICTION_CHUNK.
    """

    model: VariationalModel
    integrator: Integrator
    by_edges: bool = False

    def _chunk(self, agents: int) -> int:
        return max(1, EDGES // max(agents * (agents - 1), 1)) if self.by_edges else PREDICTION_CHUNK

    @property
    def features(self) -> Features:
        """See Predictor."""
        return self.model.features

    @torch.no_grad()
    def free_run(self, observed: Tensor, steps: int, generator: torch.Generator, **reading: Unpack[Reading]) -> Tensor:
        """See Predictor.

        dnri draws its graphs from the prior, nri its single graph from the posterior given the observed states. A
        recurrent decoder reads the observed states first.
        """
        samples = reading.get("samples", 1)
        with evaluation_mode(self.model):
            b, h, n, _ = observed.shape
            noise = reading.get("noise")
            noise = observed.new_zeros(1, h + steps - 1, 1, 1) if noise is None else noise
            gumbel = self.model.draw_noise(samples * b, h - 1 + steps, n, generator).to(observed.device)
            gumbel = gumbel.view(samples, b, *gumbel.shape[1:]).transpose(0, 1)
            if reading.get("deterministic"):  # so all samples of a group are alike
                gumbel = 0 * gumbel[:, :1]
            chunk = max(1, self._chunk(n) // gumbel.shape[1])
            made = in_chunks(partial(self._free_run, steps), chunk, observed, noise.expand(b, -1, -1, -1), gumbel)
            return made.expand(-1, samples, -1, -1, -1).transpose(0, 1).flatten(0, 1)

    def _free_run(self, steps: int, observed: Tensor, noise: Tensor, gumbel: Tensor) -> Tensor:
        """Return S futures of each group, (B, S, steps + 1, N, D), for Gumbel noise with the axes (B, S, ...)."""
        (b, samples), h = gumbel.shape[:2], observed.shape[1]
        graphs = _GraphSampler(self.model, observed + noise[:, :h], gumbel.flatten(0, 1))
        memory: Tensor | None = None
        past, state = observed[:, :-1] + noise[:, : h - 1], observed[:, -1:]
        if h > 1:
            seen = graphs.observe(past)
        if samples > 1:
            past, state, noise = (x.repeat_interleave(samples, 0) for x in (past, state, noise))
        if h > 1:
            _, memory = self.model.decode(past, seen)
        states = [state]
        for t in range(h - 1, h - 1 + steps):
            read = state + noise[:, t : t + 1]
            action, memory = self.model.decode(read, graphs.sample(read), memory)
            state = self.integrator.step(state, action)
            states.append(state)
        return torch.cat(states, dim=1).view(b, samples, steps + 1, *state.shape[2:])

    @torch.no_grad()
    def one_step(self, states: Tensor, generator: torch.Generator) -> Tensor:
        """See Predictor. Samples the graph at each step given the steps so far."""
        now = states[:, :-1]
        noise = self.model.draw_noise(len(now), now.shape[1], now.shape[2], generator).to(now.device)
        with evaluation_mode(self.model):
            return in_chunks(self._one_step, self._chunk(now.shape[2]), now, noise)

    def _one_step(self, now: Tensor, noise: Tensor) -> Tensor:
        graphs = self.model.sample(self.model.past_logits(now), noise)
        return self.integrator.step(now, self.model.decode(now, graphs)[0])


class VariationalLearner(SupervisedLearner):
    """Minimizes the negative evidence lower bound on batches of whole expert trajectories.

    The decoder reads the expert's state where the curriculum intervenes (always, by default: teacher forcing), and its
    own prediction elsewhere. The gradient flows through the predictions.
    """

    def __init__(self, context: LearnerContext) -> None:
        spec = context.spec
        self.variational, self.curriculum = required(spec.variational), required(spec.curriculum)
        assert self.variational.variance is not None  # resolved by then
        self.variance = self.variational.variance
        features = Features.of(self.variational, *(batch.states for batch in context.by_number))
        state_size = context.experts.states.shape[-1]
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(context.generators.seeds["weights"])
            model = VariationalModel(features, state_size, self.variational, dynamic=spec.method == "dnri")
        self.model = model.to(context.device)
        # other chunks may be rounded in another way, and the other environments have stored runs to repeat
        by_edges = spec.environment == "trajectories"
        self.predictor = VariationalPredictor(self.model, context.integrator, by_edges)
        super().__init__(context, "model", self.model)
        vectors = self.training.batch * min(batch.states.shape[2] for batch in context.by_number)
        if isinstance(model.encoder, WindowEncoder) and self.variational.batch_norm and vectors == 1:
            remedy = "set training.batch=2 or variational.batch_norm=false"
            raise InputError(f"batch norm needs two agents in a batch, and there is one; {remedy}.")

    def run_epoch(self, epoch: int) -> dict[str, float]:
        """Take training.updates gradient steps under the curriculum."""
        self.schedule.set(epoch)
        frequency = intervention_frequency(self.curriculum, epoch, self.training.epochs)
        batch, steps, updates = self.training.batch, self.context.steps, self.training.updates
        curriculum = self.generators["curriculum"]
        interventions = [draw_interventions(batch, steps, frequency, curriculum) for _ in range(updates)]
        turns = self.context.turns(epoch, updates)
        logs = [
            self._update(self.context.by_number[turn], mask) for turn, mask in zip(turns, interventions, strict=True)
        ]
        return mean_metrics(logs) | curriculum_metrics(frequency, interventions)

    def _update(self, experts: Batch, interventions: Tensor) -> dict[str, float]:
        batch = experts.draw(self.training.batch, self.generators["data"])
        states = batch.states[:, :-1]
        # Encode: posterior and prior over graphs, and one sample from the posterior. nri as published reads the whole
        # window; the other encoders leave out the last state, after which nothing is predicted.
        whole = isinstance(self.model.encoder, WindowEncoder)
        posterior, prior = self.model.posterior(batch.states if whole else states)
        noise = self.model.draw_noise(len(batch), states.shape[1], states.shape[2], self.generators["policy"])
        graphs = self.model.sample(posterior, noise.to(self.device))
        # Decode: next states under that graph.
        read = add_noise(states, self.cloning.input_noise, self.generators["data"])
        predicted = self._decode(read, graphs, interventions.to(self.device))
        loss, terms = variational_loss(
            predicted,
            batch.states[:, 1:],
            posterior,
            prior,
            variance=self.variance,
            kl_weight=self.variational.kl_weight,
        )
        self.step(loss)
        return {f"cloning/{name}": float(value.detach()) for name, value in {"loss": loss, **terms}.items()}

    def _decode(self, states: Tensor, graphs: Tensor, interventions: Tensor) -> Tensor:
        """Predict the next states (B, T, N, D): in one pass if every input is the expert's, else step by step."""
        integrator, decode = self.context.integrator, self.model.decode
        if bool(interventions[:, 1:].all()):
            return integrator.step(states, decode(states, graphs)[0])
        b, steps = interventions.shape
        graphs = graphs.expand(-1, steps, -1, -1, -1)
        predicted: list[Tensor] = []
        memory: Tensor | None = None
        for t in range(steps):
            given = states[:, t : t + 1]
            if t:
                given = torch.where(interventions[:, t].view(b, 1, 1, 1), given, predicted[-1])
            action, memory = decode(given, graphs[:, t : t + 1], memory)
            predicted.append(integrator.step(given, action))
        return torch.cat(predicted, dim=1)
