"""Message passing on the complete directed graph of N agents (Eq. 4; Kipf et al. 2018), batched over any leading axes.

The first layer of an edge function reads [x_i, x_j]; because it is linear it is applied per node, W [x_i, x_j] = W_s x_i + W_r x_j, and
broadcast to all pairs. That equals gathering both ends of each edge, without the gather. Axis -3 of a pair tensor is the sender i, axis -2
the receiver j. Sums over senders are divided by N - 1, so that one set of weights suits any number of agents.
"""

import torch
from torch import Tensor, nn


def perceptron(inputs: int, hidden: int, outputs: int) -> nn.Sequential:
    """Two linear layers with a SiLU between them."""
    return nn.Sequential(nn.Linear(inputs, hidden), nn.SiLU(), nn.Linear(hidden, outputs))


def mean_over_senders(pairs: Tensor) -> Tensor:
    """(..., N, N, H) -> (..., N, H): the mean over i != j; zeros for a single agent."""
    n = pairs.shape[-2]
    others = 1 - torch.eye(n, dtype=pairs.dtype, device=pairs.device)
    return torch.einsum("...ijh,ij->...jh", pairs, others / max(n - 1, 1))


class PairLayer(nn.Module):
    """The first layer of an edge function f_e([x_i, x_j]): x (..., N, D) -> (..., N, N, H)."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.sender = nn.Linear(inputs, outputs, bias=False)
        self.receiver = nn.Linear(inputs, outputs)

    def forward(self, x: Tensor) -> Tensor:
        """Pre-activations for every ordered pair, the diagonal included."""
        return self.sender(x).unsqueeze(-2) + self.receiver(x).unsqueeze(-3)


class EdgeFunction(nn.Module):
    """A two-layer edge function f_e([x_i, x_j]): x (..., N, D) -> (..., N, N, H)."""

    def __init__(self, inputs: int, hidden: int, outputs: int) -> None:
        super().__init__()
        self.first = PairLayer(inputs, hidden)
        self.second = nn.Linear(hidden, outputs)

    def forward(self, x: Tensor) -> Tensor:
        """Edge embeddings h_(i,j)."""
        out: Tensor = self.second(nn.functional.silu(self.first(x)))
        return out


class TypedMessages(nn.Module):
    """Messages sum_k z_ijk f_e^k([x_i, x_j]), averaged over senders (section 3.2.2).

    The second layer of every f_e^k is linear, so it is applied after the mean: K * N products instead of N * N * K.
    With `first_is_none` the first type has no function: no message flows along its edges.
    """

    def __init__(self, inputs: int, hidden: int, edge_types: int, first_is_none: bool) -> None:
        super().__init__()
        self.skipped = int(first_is_none)
        self.types = edge_types - self.skipped
        self.hidden = hidden
        self.first = PairLayer(inputs, hidden * self.types)
        self.second = nn.Linear(hidden * self.types, hidden, bias=False)
        self.type_bias = nn.Linear(self.types, hidden, bias=False)

    def forward(self, x: Tensor, graph: Tensor) -> Tensor:
        """x (..., N, D) and graph (..., N, N, K) -> (..., N, H)."""
        weights = graph[..., self.skipped :]
        embedded = nn.functional.silu(self.first(x)).unflatten(-1, (self.types, self.hidden))
        weighted = (embedded * weights.unsqueeze(-1)).flatten(-2)
        messages: Tensor = self.second(mean_over_senders(weighted)) + self.type_bias(mean_over_senders(weights))
        return messages
