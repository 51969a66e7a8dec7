"""The policy of MAIL (section 3.2): a graph encoder samples the edge types, and the actor of G-SAC reads them."""

import math

import torch
from torch import Tensor, nn

from ssmail.config.sections import ModelSpec
from ssmail.models.graph_encoder import GraphEncoder, GraphNoise, Memory, sample_graph
from ssmail.models.message_passing import TypedMessages, perceptron
from ssmail.models.normalization import ActionBounds

EDGE = 0.999  # log_prob clips actions to this fraction of their range, where atanh is still exact to 1e-4


class Actor(nn.Module):
    """The actor of G-SAC (section 3.2.2): messages weighted by edge type -> a squashed Gaussian over the next velocity.

    a = c + d tanh(u) with u ~ N(mean, std). The centre c is the current velocity, clipped so that every a stays within
    the action bounds.
    """

    step: Tensor  # d
    low: Tensor  # lower bound of c
    high: Tensor  # upper bound of c

    def __init__(self, inputs: int, action_size: int, spec: ModelSpec, bounds: ActionBounds | None = None) -> None:
        super().__init__()
        self.bounds = bounds = bounds or ActionBounds.of(spec)
        self.register_buffer("step", bounds.step, persistent=False)
        self.register_buffer("low", bounds.low + bounds.step, persistent=False)
        self.register_buffer("high", bounds.high - bounds.step, persistent=False)
        self.log_std_range = (spec.log_std_min, spec.log_std_max)
        self.messages = TypedMessages(inputs, spec)
        self.own_input = spec.own_input
        self.head = perceptron(spec.hidden + inputs * spec.own_input, spec.hidden, 2 * action_size)
        last = self.head[-1]
        assert isinstance(last, nn.Linear)
        with torch.no_grad():  # so that the untrained policy nearly keeps the current velocity
            last.weight.mul_(spec.initial_scale)
            last.bias.zero_()

    def distribution(self, x: Tensor, graph: Tensor) -> tuple[Tensor, Tensor]:
        """Return the mean and log std of u, each (..., N, A), given inputs (..., N, D) and graph (..., N, N, K)."""
        messages = self.messages(x, graph)
        out = self.head(torch.cat([messages, x], dim=-1) if self.own_input else messages)
        mean, raw = out.chunk(2, dim=-1)
        low, high = self.log_std_range
        return mean, low + (high - low) * torch.sigmoid(raw)

    def sample(self, x: Tensor, graph: Tensor, velocity: Tensor, noise: Tensor) -> Tensor:
        """Return actions (..., N, A) for standard normal `noise` and the current velocity, both (..., N, A).

        Zero noise yields the mean action.
        """
        mean, log_std = self.distribution(x, graph)
        return self.squash(mean + log_std.exp() * noise, velocity)

    def sample_with_log_prob(self, x: Tensor, graph: Tensor, velocity: Tensor, noise: Tensor) -> tuple[Tensor, Tensor]:
        """Return the actions of `sample` and their log-probabilities (..., N), in scaled velocity units."""
        mean, log_std = self.distribution(x, graph)
        u = mean + log_std.exp() * noise
        return self.squash(u, velocity), self._log_density(u, noise, log_std)

    def log_prob(self, x: Tensor, graph: Tensor, velocity: Tensor, action: Tensor) -> Tensor:
        """Return the log-probabilities (..., N) of given actions (..., N, A), as in `sample_with_log_prob`.

        The current velocity limits the possible actions; their density is ill-conditioned at the edge of that range and
        0 beyond it. An action past EDGE of the range counts as the one at EDGE: the result is finite, and its gradient
        still draws the mean to that side.
        """
        mean, log_std = self.distribution(x, graph)
        u = torch.atanh(((action - self._centre(velocity)) / self.step).clamp(-EDGE, EDGE))
        return self._log_density(u, (u - mean) * torch.exp(-log_std), log_std)

    def squash(self, u: Tensor, velocity: Tensor) -> Tensor:
        """Map u to the action c + d tanh(u)."""
        return self._centre(velocity) + self.step * torch.tanh(u)

    def _centre(self, velocity: Tensor) -> Tensor:
        return torch.maximum(torch.minimum(velocity, self.high), self.low)

    def _log_density(self, u: Tensor, noise: Tensor, log_std: Tensor) -> Tensor:
        """Return log p(a) of the action for u = mean + std * noise.

        log p(a) = sum over axes of log N(u; mean, std) - log d - log(1 - tanh(u)^2); the last term in its stable form.
        """
        gaussian = -0.5 * noise**2 - log_std - 0.5 * math.log(2 * math.pi)
        jacobian = self.step.log() + 2 * (math.log(2) - u - nn.functional.softplus(-2 * u))
        return (gaussian - jacobian).sum(dim=-1)


class GraphPolicy(nn.Module):
    """pi(a | history): the sampled edge types weight the actor's messages."""

    def __init__(self, inputs: int, action_size: int, spec: ModelSpec, bounds: ActionBounds | None = None) -> None:
        super().__init__()
        self.action_size = action_size
        self.edge_types = spec.edge_types
        self.graph_temperature = spec.graph_temperature
        self.graph_noise = GraphNoise(spec.graph_noise, spec.graph_resample)
        self.encoder = GraphEncoder(inputs, spec.encoder_hidden, spec.edge_types)
        self.actor = Actor(inputs, action_size, spec, bounds)

    def draw_graph_noise(self, batch: int, steps: int, agents: int, generator: torch.Generator) -> Tensor:
        """Draw Gumbel noise for `batch` trajectories of `steps` steps; GraphNoise.draw documents its shape."""
        return self.graph_noise.draw(batch, steps, agents, self.edge_types, generator)

    def graphs(self, x: Tensor, noise: Tensor, memory: Memory | None = None) -> tuple[Tensor, Tensor, Memory]:
        """Map x (B, T, N, F) to one-hot graphs and their logits, both (B, T, N, N, K), and the encoder's memory."""
        logits, memory = self.encoder(x, memory)
        return sample_graph(logits, noise, self.graph_temperature), logits, memory
