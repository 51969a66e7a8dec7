"""The actor of G-SAC (section 3.2.2): edge-type-weighted messages -> a squashed Gaussian over each agent's next
velocity.
"""

import math

import torch
from torch import Tensor, nn

from ssmail.models.message_passing import TypedMessages, perceptron
from ssmail.spec import ModelSpec


class Actor(nn.Module):
    """a = c + d * tanh(u), u ~ N(mean, std): c is the current velocity, kept so far inside the bound that |a| <=
    action_bound.
    """

    def __init__(self, inputs: int, action_size: int, spec: ModelSpec) -> None:
        super().__init__()
        self.step, self.bound = spec.action_step, spec.action_bound
        self.log_std_range = (spec.log_std_min, spec.log_std_max)
        self.messages = TypedMessages(inputs, spec)
        self.own_input = spec.own_input
        self.head = perceptron(spec.hidden + inputs * spec.own_input, spec.hidden, 2 * action_size)
        last = self.head[-1]
        assert isinstance(last, nn.Linear)
        with torch.no_grad():  # the untrained policy drives straight on
            last.weight.mul_(0.1)
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
        gaussian = -0.5 * noise**2 - log_std - 0.5 * math.log(2 * math.pi)
        jacobian = math.log(self.step) + 2 * (math.log(2) - u - nn.functional.softplus(-2 * u))
        return self.squash(u, velocity), (gaussian - jacobian).sum(dim=-1)

    def squash(self, u: Tensor, velocity: Tensor) -> Tensor:
        """The action of an unsquashed u."""
        inner = self.bound - self.step
        return velocity.clamp(-inner, inner) + self.step * torch.tanh(u)
