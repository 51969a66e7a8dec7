"""The twin critics of G-SAC (section 3.2.2)."""

import math

import torch
from torch import Tensor, nn

from ssmail.config.sections import ModelSpec
from ssmail.models.message_passing import TypedMessages


class TwinLinear(nn.Module):
    """Two independent linear layers in one operation: (2, M, D) -> (2, M, H), or with an axis of S seeds in front."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        bound = 1 / math.sqrt(inputs)
        self.weight = nn.Parameter(torch.empty(2, inputs, outputs).uniform_(-bound, bound))
        self.bias = nn.Parameter(torch.empty(2, outputs).uniform_(-bound, bound))

    def forward(self, x: Tensor) -> Tensor:
        """Apply layer k to x[..., k, :, :]."""
        weight, bias = self.weight.flatten(0, -3), self.bias.flatten(0, -2).unsqueeze(1)
        return torch.baddbmm(bias, x.flatten(0, -3), weight).view(*x.shape[:-1], -1)


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
        """Map x (..., N, D), action (..., N, A) and graph (..., N, N, K) to (..., N, 2).

        With the weights of S seeds, the first axis of all inputs is S.
        """
        inputs = torch.cat([x, action], dim=-1)
        messages = [m(inputs, graph) for m in self.messages]
        each = [torch.cat([m, inputs], dim=-1) if self.own_input else m for m in messages]
        seeds = self.first.weight.dim() - 3  # the number of axes in front, 0 or 1
        h = torch.stack([part.flatten(seeds, -2) for part in each], dim=seeds)  # (2, M, H + D + A)
        h = torch.relu(self.first(h))
        h = torch.relu(self.second(h))
        q: Tensor = self.last(h).squeeze(-1).movedim(seeds, -1)  # (M, 2)
        return q.view(*x.shape[:-1], 2)
