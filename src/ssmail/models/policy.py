"""The actor of G-SAC (section 3.2.2): edge-type-weighted messages -> a squashed Gaussian over each agent's next
velocity.
"""

import math

import torch
from torch import Tensor, nn

from ssmail.config.sections import ModelSpec
from ssmail.models.message_passing import TypedMessages, perceptron
from ssmail.models.standards import Reach

EDGE = 0.999  # of the action's range: where log_prob takes actions at the edge to be (atanh is exact to 1e-4 there)


class Actor(nn.Module):
    """a = c + d * tanh(u), u ~ N(mean, std): c is the current velocity, kept so far inside the bound that |a| <=
    action_bound.
    """

    step: Tensor  # d
    low: Tensor  # of c
    high: Tensor

    def __init__(self, inputs: int, action_size: int, spec: ModelSpec, reach: Reach | None = None) -> None:
        super().__init__()
        reach = reach or Reach.of(spec)
        self.register_buffer("step", reach.step, persistent=False)
        self.register_buffer("low", reach.low + reach.step, persistent=False)
        self.register_buffer("high", reach.high - reach.step, persistent=False)
        self.log_std_range = (spec.log_std_min, spec.log_std_max)
        self.messages = TypedMessages(inputs, spec)
        self.own_input = spec.own_input
        self.head = perceptron(spec.hidden + inputs * spec.own_input, spec.hidden, 2 * action_size)
        last = self.head[-1]
        assert isinstance(last, nn.Linear)
        with torch.no_grad():  # the untrained policy drives straight on, nearly
            last.weight.mul_(spec.initial_scale)
            last.bias.zero_()

    def distribution(self, x: Tensor, graph: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and log std of u, each (..., N, A), from inputs (..., N, D) and graph (..., N, N, K)."""
        messages = self.messages(x, graph)
        out = self.head(torch.cat([messages, x], dim=-1) if self.own_input else messages)
        mean, raw = out.chunk(2, dim=-1)
        low, high = self.log_std_range
        return mean, low + (high - low) * torch.sigmoid(raw)

    def sample(self, x: Tensor, graph: Tensor, velocity: Tensor, noise: Tensor) -> Tensor:
        """Actions (..., N, A) for standard normal `noise` (..., N, A) and the current velocity; zero noise gives the
        mean action.
        """
        mean, log_std = self.distribution(x, graph)
        return self.squash(mean + log_std.exp() * noise, velocity)

    def sample_with_log_prob(self, x: Tensor, graph: Tensor, velocity: Tensor, noise: Tensor) -> tuple[Tensor, Tensor]:
        """The actions of `sample` and their log-probabilities (..., N), in scaled velocity units.

        log p(a) = sum over axes of log N(u; mean, std) - log d - log(1 - tanh(u)^2); the last term in its stable form.
        """
        mean, log_std = self.distribution(x, graph)
        u = mean + log_std.exp() * noise
        return self.squash(u, velocity), self._log_density(u, noise, log_std)

    def log_prob(self, x: Tensor, graph: Tensor, velocity: Tensor, action: Tensor) -> Tensor:
        """Log-probabilities (..., N) of given actions (..., N, A), as in `sample_with_log_prob`.

        The current velocity limits the actions within reach; their density is ill-conditioned at the edge of that range
        and 0 beyond. An action past EDGE of the range counts as the one at EDGE: the result is finite, and its gradient
        still draws the mean to that side.
        """
        mean, log_std = self.distribution(x, graph)
        u = torch.atanh(((action - self._centre(velocity)) / self.step).clamp(-EDGE, EDGE))
        return self._log_density(u, (u - mean) * torch.exp(-log_std), log_std)

    def squash(self, u: Tensor, velocity: Tensor) -> Tensor:
        """The action of an unsquashed u."""
        return self._centre(velocity) + self.step * torch.tanh(u)

    def _centre(self, velocity: Tensor) -> Tensor:
        return torch.maximum(torch.minimum(velocity, self.high), self.low)

    def _log_density(self, u: Tensor, noise: Tensor, log_std: Tensor) -> Tensor:
        """log p(a) of the action of u = mean + std * noise, summed over the axes."""
        gaussian = -0.5 * noise**2 - log_std - 0.5 * math.log(2 * math.pi)
        jacobian = self.step.log() + 2 * (math.log(2) - u - nn.functional.softplus(-2 * u))
        return (gaussian - jacobian).sum(dim=-1)
