"""The twin critics of G-SAC (section 3.2.2)."""

import math

import torch
from torch import Tensor, nn

from ssmail.config.sections import ModelSpec
from ssmail.models.message_passing import TypedMessages


class TwinLinear(nn.Module):
    """Two independent linear layers in one operation: (..., 2, D) -> (..., 2, H)."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        bound = 1 / math.sqrt(inputs)
        self.weight = nn.Parameter(torch.empty(2, inputs, outputs).uniform_(-bound, bound))
        self.bias = nn.Parameter(torch.empty(2, outputs).uniform_(-bound, bound))

    def forward(self, x: Tensor) -> Tensor:
        """Apply layer k to x[..., k, :]."""
        return torch.einsum("...kd,kdh->...kh", x, self.weight) + self.bias


class TwinCritic(nn.Module):
    """Q_1 and Q_2 of each agent, given the states and actions of all agents and the graph.

    Each agent has a return of its own, because the discriminator scores every agent; the messages of the others inform
    its value.
    """

    def __init__(self, inputs: int, spec: ModelSpec) -> None:
        super().__init__()
        self.messages = nn.ModuleList(TypedMessages(inputs, spec) for _ in range(2))
        self.own_input, hidden = spec.own_input, spec.hidden
        self.first = TwinLinear(hidden + inputs * spec.own_input, hidden)
        self.second = TwinLinear(hidden, hidden)
        self.last = TwinLinear(hidden, 1)

    def forward(self, x: Tensor, action: Tensor, graph: Tensor) -> Tensor:
        """Map x (..., N, D), action (..., N, A) and graph (..., N, N, K) to (..., N, 2)."""
        inputs = torch.cat([x, action], dim=-1)
        messages = [m(inputs, graph) for m in self.messages]
        # (..., N, 2, H + D + A): both critics side by side
        h = torch.stack([torch.cat([m, inputs], dim=-1) if self.own_input else m for m in messages], dim=-2)
        h = torch.relu(self.first(h))
        h = torch.relu(self.second(h))
        q: Tensor = self.last(h).squeeze(-1)
        return q
