"""nri and dnri in training and in prediction: graph-conditioned motion models with a variational posterior over graphs
(Kipf et al. 2018; Graber and Schwing 2020).
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from copy import deepcopy
from dataclasses import dataclass
from functools import partial
from typing import Any

import torch
from torch import Tensor, nn

from ssmail.config.sections import VariationalSpec, required
from ssmail.envs.integrator import Integrator
from ssmail.losses.likelihood import fixed_prior, variational_loss
from ssmail.models.decoders import make_decoder
from ssmail.models.features import Features
from ssmail.models.graph_encoder import GraphNoise, Memory, sample_graph
from ssmail.models.variational_encoder import DynamicEncoder, StaticEncoder
from ssmail.training.curricula import curriculum_metrics, draw_interventions, intervention_frequency
from ssmail.training.learning import Setting
from ssmail.training.learning_rates import DecayingRates
from ssmail.training.updates import clipped_step, mean_of, with_noise

AT_ONCE = 16  # trajectories that are predicted together


class VariationalModel(nn.Module):
    """Encoder and decoder. dnri (`dynamic`) has a graph at each step and a learned prior; nri has one graph."""

    fixed_prior: Tensor

    def __init__(self, features: Features, state_size: int, spec: VariationalSpec, dynamic: bool) -> None:
        super().__init__()
        self.features, self.spec, self.dynamic = features, spec, dynamic
        inputs, action_size = features.size(state_size), state_size // 2
        self.encoder = DynamicEncoder(inputs, spec) if dynamic else StaticEncoder(inputs, spec)
        self.decoder = make_decoder(inputs, action_size, spec)
        self.register_buffer("fixed_prior", fixed_prior(spec.edge_types, spec.none_prior), persistent=False)
        self.graph_noise = GraphNoise("edge", "step" if dynamic else "trajectory")

    def posterior(self, states: Tensor) -> tuple[Tensor, Tensor]:
        """states (B, T, N, D) -> logits of the posterior, (B, T or 1, N, N, K), and of the prior."""
        x = self.read(states)
        if isinstance(self.encoder, DynamicEncoder):
            prior, posterior = self.encoder(x)
            return posterior, prior
        return self.encoder(x), self.fixed_prior

    def past_logits(self, states: Tensor) -> Tensor:
        """(B, T, N, N, K): what is known of the graph at each step from the steps so far: dnri's prior, and nri's
        posterior given those steps.
        """
        x = self.read(states)
        if isinstance(self.encoder, DynamicEncoder):
            return self.encoder.prior(x)[0]
        return self.encoder.running(x)

    def read(self, states: Tensor) -> Tensor:
        """What encoder and decoder read of states (B, T, N, D): (B, T, N, F)."""
        return self.features(states, states[:, 0])

    def decode(self, states: Tensor, graphs: Tensor, memory: Tensor | None = None) -> tuple[Tensor, Tensor | None]:
        """Actions (B, T, N, A) after states (B, T, N, D) under graphs (B, T or 1, N, N, K), and the decoder's memory.

        The decoder's residual is one on the velocity as it is read.
        """
        said, memory = self.decoder(self.read(states), graphs, memory)
        return self.features.to_actions(said), memory

    def sample(self, logits: Tensor, noise: Tensor) -> Tensor:
        """One-hot graphs, straight-through."""
        return sample_graph(logits, noise, self.spec.temperature)

    def draw_noise(self, batch: int, steps: int, agents: int, generator: torch.Generator) -> Tensor:
        """Gumbel noise for the graphs of `batch` trajectories."""
        return self.graph_noise.draw(batch, steps, agents, self.spec.edge_types, generator)


@contextmanager
def evaluation_mode(model: nn.Module) -> Iterator[None]:
    """Batch norm uses its running statistics inside."""
    was_training = model.training
    model.eval()
    try:
        yield
    finally:
        model.train(was_training)


def in_parts(function: Callable[..., Tensor], *given: Tensor) -> Tensor:
    """function(*given) for tensors (B, ...), AT_ONCE trajectories at a time: the 930 edges of recorded motion times the
    steps of a long history are gigabytes otherwise.
    """
    return torch.cat([function(*part) for part in zip(*(torch.split(x, AT_ONCE) for x in given), strict=True)])


class _Graphs:
    """The sampled graphs of a prediction, step after step: nri's one, or dnri's from the prior and its memory."""

    def __init__(self, model: VariationalModel, observed: Tensor, gumbel: Tensor) -> None:
        self.model, self.gumbel, self.step = model, gumbel, 0
        self.memory: Memory | None = None
        self.fixed = None if model.dynamic else model.sample(model.past_logits(observed)[:, -1:], gumbel)

    def of(self, states: Tensor) -> Tensor:
        """The graphs (B, T or 1, N, N, K) under which the next steps (B, T, N, D) are decoded."""
        if self.fixed is not None:
            return self.fixed
        assert isinstance(self.model.encoder, DynamicEncoder)
        logits, self.memory = self.model.encoder.prior(self.model.read(states), self.memory)
        first, self.step = self.step, self.step + states.shape[1]
        return self.model.sample(logits, self.gumbel[:, first : self.step])


@dataclass(frozen=True)
class VariationalPredictor:
    """Sampled graphs, and the decoder's mean under each. `deterministic` takes the most likely graph instead."""

    model: VariationalModel
    integrator: Integrator

    @torch.no_grad()
    def free_run(
        self,
        observed: Tensor,
        steps: int,
        generator: torch.Generator,
        *,
        deterministic: bool = False,
        noise: Tensor | None = None,
    ) -> Tensor:
        """See Predictor. dnri's graphs are drawn from its prior; nri's one graph from its posterior given what was
        observed. A recurrent decoder has read the observed states too.
        """
        with evaluation_mode(self.model):
            b, h, n, _ = observed.shape
            noise = observed.new_zeros(1, h + steps - 1, 1, 1) if noise is None else noise
            gumbel = self.model.draw_noise(b, h - 1 + steps, n, generator).to(observed.device) * (not deterministic)
            return in_parts(partial(self._free_run, steps), observed, noise.expand(b, -1, -1, -1), gumbel)

    def _free_run(self, steps: int, observed: Tensor, noise: Tensor, gumbel: Tensor) -> Tensor:
        h = observed.shape[1]
        graphs = _Graphs(self.model, observed + noise[:, :h], gumbel)
        memory: Tensor | None = None
        if h > 1:
            past = observed[:, :-1] + noise[:, : h - 1]
            _, memory = self.model.decode(past, graphs.of(past))
        state = observed[:, -1:]
        states = [state]
        for t in range(h - 1, h - 1 + steps):
            read = state + noise[:, t : t + 1]
            action, memory = self.model.decode(read, graphs.of(read), memory)
            state = self.integrator.step(state, action)
            states.append(state)
        return torch.cat(states, dim=1)

    @torch.no_grad()
    def one_step(self, states: Tensor, generator: torch.Generator) -> Tensor:
        """See Predictor. Under graphs sampled from what the past tells of them."""
        now = states[:, :-1]
        noise = self.model.draw_noise(len(now), now.shape[1], now.shape[2], generator).to(now.device)
        with evaluation_mode(self.model):
            return in_parts(self._one_step, now, noise)

    def _one_step(self, now: Tensor, noise: Tensor) -> Tensor:
        graphs = self.model.sample(self.model.past_logits(now), noise)
        return self.integrator.step(now, self.model.decode(now, graphs)[0])

    def __deepcopy__(self, memo: dict[int, Any]) -> "VariationalPredictor":
        return VariationalPredictor(deepcopy(self.model, memo), self.integrator)

    def state_dict(self) -> dict[str, Any]:
        """Weights and batch statistics."""
        return self.model.state_dict()

    def load_state_dict(self, state: dict[str, Any]) -> object:
        """Inverse of `state_dict`."""
        return self.model.load_state_dict(state)


class VariationalLearner:
    """The negative evidence lower bound on batches of whole expert trajectories.

    The decoder's inputs are the expert's states where the curriculum intervenes (always, by default: teacher forcing),
    and its own predictions elsewhere, through which the gradient flows.
    """

    def __init__(self, setting: Setting) -> None:
        spec = setting.spec
        self.setting, self.variational, self.cloning = setting, required(spec.variational), required(spec.cloning)
        self.curriculum, self.training = required(spec.curriculum), required(spec.training)
        self.generators, self.device = setting.generators, setting.device
        features = Features.of(self.variational, setting.experts.states)
        state_size = setting.experts.states.shape[-1]
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(self.generators.seeds["weights"])
            model = VariationalModel(features, state_size, self.variational, dynamic=spec.method == "dnri")
        self.model = model.to(self.device)
        self.predictor = VariationalPredictor(self.model, setting.integrator)
        self.optimizer = torch.optim.Adam(self.model.parameters(), lr=self.cloning.learning_rate, fused=True)
        self.rates = DecayingRates(
            self.training, {"model": self.optimizer}, {"model": self.cloning.learning_rate_final}
        )

    def networks(self) -> list[nn.Module]:
        """The model."""
        return [self.model]

    def run_epoch(self, epoch: int) -> dict[str, float]:
        """training.updates gradient steps under the curriculum."""
        self.rates.set(epoch)
        frequency = intervention_frequency(self.curriculum, epoch, self.training.epochs)
        batch, steps, updates = self.training.batch, self.setting.steps, self.training.updates
        curriculum = self.generators["curriculum"]
        interventions = [draw_interventions(batch, steps, frequency, curriculum) for _ in range(updates)]
        return mean_of([self._update(mask) for mask in interventions]) | curriculum_metrics(frequency, interventions)

    def _update(self, interventions: Tensor) -> dict[str, float]:
        b = self.training.batch
        batch = self.setting.experts.draw(b, self.generators["data"])
        states = batch.states[:, :-1]
        posterior, prior = self.model.posterior(states)
        noise = self.model.draw_noise(b, states.shape[1], states.shape[2], self.generators["policy"])
        graphs = self.model.sample(posterior, noise.to(self.device))
        read = with_noise(states, self.cloning.input_noise, self.generators["data"])
        predicted = self._decode(read, graphs, interventions.to(self.device))
        loss, terms = variational_loss(
            predicted,
            batch.states[:, 1:],
            posterior,
            prior,
            variance=self.variational.variance,
            kl_weight=self.variational.kl_weight,
        )
        clipped_step(self.optimizer, loss, self.model.parameters(), self.training.gradient_clip)
        return {f"cloning/{name}": float(value.detach()) for name, value in {"loss": loss, **terms}.items()}

    def _decode(self, states: Tensor, graphs: Tensor, interventions: Tensor) -> Tensor:
        """Predicted next states (B, T, N, D); all steps at once where every input is the expert's."""
        integrator, decode = self.setting.integrator, self.model.decode
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

    def state_dict(self) -> dict[str, Any]:
        """Weights, batch statistics and optimiser."""
        return {"model": self.model.state_dict(), "optimizer": self.optimizer.state_dict()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Inverse of `state_dict`."""
        self.model.load_state_dict(state["model"])
        self.optimizer.load_state_dict(state["optimizer"])
