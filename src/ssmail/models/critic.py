"""Twin critics of G-SAC: one pass, two independent sets of weights."""

import math

import torch
from torch import Tensor, nn

from ssmail.config.sections import ModelSpec
from ssmail.models.message_passing import TypedMessages


class TwinLinear(nn.Module):
    """Two linear layers side by side: (..., 2, D) -> (..., 2, H)."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        bound = 1 / math.sqrt(inputs)
        self.weight = nn.Parameter(torch.empty(2, inputs, outputs).uniform_(-bound, bound))
        self.bias = nn.Parameter(torch.empty(2, outputs).uniform_(-bound, bound))

    def forward(self, x: Tensor) -> Tensor:
        """Apply weight k to x[..., k, :]."""
        return torch.einsum("...kd,kdh->...kh", x, self.weight) + self.bias


class TwinCritic(nn.Module):
    """Q_1 and Q_2 of each agent, given all agents' states and actions and the graph.

    Each agent has its own return (the discriminator scores every agent), learned from the messages of all others.
    """

    def __init__(self, inputs: int, spec: ModelSpec) -> None:
        super().__init__()
        self.messages = nn.ModuleList(TypedMessages(inputs, spec) for _ in range(2))
        self.own_input, hidden = spec.own_input, spec.hidden
        self.first = TwinLinear(hidden + inputs * spec.own_input, hidden)
        self.second = TwinLinear(hidden, hidden)
        self.last = TwinLinear(hidden, 1)

    def forward(self, x: Tensor, action: Tensor, graph: Tensor) -> Tensor:
        """x (..., N, D), action (..., N, A), graph (..., N, N, K) -> (..., N, 2)."""
        inputs = torch.cat([x, action], dim=-1)
        messages = [m(inputs, graph) for m in self.messages]
        h = torch.stack([torch.cat([m, inputs], dim=-1) if self.own_input else m for m in messages], dim=-2)
        h = torch.relu(self.first(h))
        h = torch.relu(self.second(h))
        q: Tensor = self.last(h).squeeze(-1)
        return q
