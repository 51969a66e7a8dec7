"""Message passing on the complete directed graph of N agents (Eq. 4; Kipf et al. 2018), batched over any leading axes.

The first layer of an edge function reads [x_i, x_j]; because it is linear it is applied per node, W [x_i, x_j] = W_s
x_i + W_r x_j, and broadcast to all pairs. That equals gathering both ends of each edge, without the gather. Axis -3 of
a pair tensor is the sender i, axis -2 the receiver j. Sums over senders are divided by N - 1, so that one set of
weights suits any number of agents.
"""

import torch
from torch import Tensor, nn

from ssmail.spec import ModelSpec


def perceptron(inputs: int, hidden: int, outputs: int) -> nn.Sequential:
    """Two linear layers with a SiLU between them."""
    return nn.Sequential(nn.Linear(inputs, hidden), nn.SiLU(), nn.Linear(hidden, outputs))


def others(agents: int, like: Tensor) -> Tensor:
    """(N, N, 1) weights of the mean over senders: 1 / (N - 1) off the diagonal, 0 on it."""
    self_edges = torch.eye(agents, dtype=like.dtype, device=like.device).unsqueeze(-1)
    return torch.sub(1, self_edges) / max(agents - 1, 1)


def mean_over_senders(pairs: Tensor) -> Tensor:
    """(..., N, N, H) -> (..., N, H): the mean over i != j; zeros for a single agent."""
    mean: Tensor = (pairs * others(pairs.shape[-2], pairs)).sum(dim=-3)
    return mean


class PairLayer(nn.Module):
    """The first layer of an edge function f_e([x_i, x_j]): x (..., N, D) -> (..., N, N, H)."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.sender = nn.Linear(inputs, outputs, bias=False)
        self.receiver = nn.Linear(inputs, outputs)

    def forward(self, x: Tensor) -> Tensor:
        """Pre-activations for every ordered pair, the diagonal included."""
        pairs: Tensor = self.sender(x).unsqueeze(-2) + self.receiver(x).unsqueeze(-3)
        return pairs


class EdgeFunction(nn.Module):
    """A two-layer edge function f_e([x_i, x_j])."""

    def __init__(self, inputs: int, hidden: int, outputs: int) -> None:
        super().__init__()
        self.first = PairLayer(inputs, hidden)
        self.second = nn.Linear(hidden, outputs)

    def forward(self, x: Tensor) -> Tensor:
        """Edge embeddings h_(i,j): x (..., N, D) -> (..., N, N, H)."""
        out: Tensor = self.second(torch.relu(self.first(x)))
        return out

    def messages(self, x: Tensor) -> Tensor:
        """Their mean over senders: x (..., N, D) -> (..., N, H). The second layer is linear, so it is applied after
        the mean.
        """
        out: Tensor = self.second(mean_over_senders(torch.relu(self.first(x))))
        return out


class TypedMessages(nn.Module):
    """Messages sum_k z_ijk f_e^k([x_i, x_j]), averaged over senders (section 3.2.2).

    The second layer of every f_e^k is linear, so it is applied after the mean: N products instead of N * N.
    With `first_type_is_none` the first type has no function: no message flows along its edges.
    """

    def __init__(self, inputs: int, spec: ModelSpec) -> None:
        super().__init__()
        hidden = spec.hidden
        self.skipped = int(spec.first_type_is_none)
        self.types = spec.edge_types - self.skipped
        self.first = PairLayer(inputs, hidden * self.types)
        self.second = nn.Linear(hidden * self.types, hidden, bias=False)
        self.type_bias = nn.Linear(self.types, hidden, bias=False)
        with torch.no_grad():
            self.type_bias.weight.mul_(spec.graph_gain)

    def forward(self, x: Tensor, graph: Tensor) -> Tensor:
        """x (..., N, D) and graph (..., N, N, K) -> (..., N, H)."""
        weights = graph[..., self.skipped :] * others(x.shape[-2], x)
        embedded = torch.relu(self.first(x))
        embedded = embedded.view(*embedded.shape[:-1], self.types, -1)
        received = (embedded * weights.unsqueeze(-1)).sum(dim=-4).flatten(-2)
        messages: Tensor = self.second(received) + self.type_bias(weights.sum(dim=-3))
        return messages
