"""Two-layer perceptrons on agents and on the edges between them, as in NRI and DNRI (Kipf et al. 2018; Graber and
Schwing 2020).

An edge's perceptron reads [x_sender, x_receiver]. Its first layer is linear, so it is applied per node (see
message_passing); the sender's half is repeated for each of its edges and the receiver's half is broadcast. Only the N *
(N - 1) edges between different agents are there, receiver by receiver: axis -3 of an edge tensor (..., N, N - 1, H) is
the receiver j, axis -2 its senders in order, j left out. So a mean over senders is a plain mean, and batch norm sees
real edges only.
"""

import torch
from torch import Tensor, nn

from ssmail.models.graph_encoder import on_diagonal


def senders(agents: int, device: torch.device) -> Tensor:
    """(N * (N - 1),) the sender of each edge, receiver by receiver."""
    return torch.arange(agents, device=device).repeat(agents, 1)[~torch.eye(agents, dtype=torch.bool, device=device)]


def edge_graph(edges: Tensor) -> Tensor:
    """(B, T, N, N - 1, K) -> the same on pairs, sender first, (B, T, N, N, K), with zeros on the diagonal."""
    return on_diagonal(edges.flatten(2, 3), edges.shape[2]).transpose(2, 3)


class FeatureNorm(nn.BatchNorm1d):
    """Batch norm of the last axis over all others (..., H). In evaluation it uses the running statistics, which are
    part of the state_dict. An empty tensor (the edges of a single agent) passes unchanged.
    """

    def forward(self, x: Tensor) -> Tensor:
        """(..., H) -> (..., H). Raises ValueError in training on a single vector, which has no variance."""
        return super().forward(x.flatten(0, -2)).view(x.shape) if x.numel() else x


def elu(x: Tensor) -> Tensor:
    """In place: for the output of a linear layer, which nothing else reads."""
    return nn.functional.elu(x, inplace=True)


def norm_layer(size: int, batch_norm: bool) -> nn.Module:
    """Batch norm, or nothing."""
    return FeatureNorm(size) if batch_norm else nn.Identity()


class NodePerceptron(nn.Module):
    """norm(ELU(W_2 ELU(W_1 x))), agent by agent: (..., N, D) -> (..., N, H)."""

    def __init__(self, inputs: int, hidden: int, batch_norm: bool) -> None:
        super().__init__()
        self.first = nn.Linear(inputs, hidden)
        self.second = nn.Linear(hidden, hidden)
        self.norm = norm_layer(hidden, batch_norm)

    def forward(self, x: Tensor) -> Tensor:
        """x (..., D) -> (..., H)."""
        out: Tensor = self.norm(elu(self.second(elu(self.first(x)))))
        return out


class EdgePerceptron(nn.Module):
    """norm(ELU(W_2 ELU(W_s x_i + W_r x_j + W_e e_ij))) for the edge from i to j; e_ij is an optional embedding of the
    edge, the skip connection of the encoder.
    """

    def __init__(self, inputs: int, hidden: int, batch_norm: bool, edge_inputs: int = 0) -> None:
        super().__init__()
        self.sender = nn.Linear(inputs, hidden, bias=False)
        self.receiver = nn.Linear(inputs, hidden)
        self.edge = nn.Linear(edge_inputs, hidden, bias=False) if edge_inputs else None
        self.second = nn.Linear(hidden, hidden)
        self.norm = norm_layer(hidden, batch_norm)

    def forward(self, x: Tensor, edges: Tensor | None = None) -> Tensor:
        """x (B, T, N, D) and, with edge_inputs, edges (B, T, N, N - 1, edge_inputs) -> (B, T, N, N - 1, H)."""
        n = x.shape[2]
        sent = self.sender(x).index_select(2, senders(n, x.device)).unflatten(2, (n, n - 1))
        h = sent + self.receiver(x).unsqueeze(-2)
        if self.edge is not None and edges is not None:
            h = h + self.edge(edges)
        out: Tensor = self.norm(elu(self.second(elu(h))))
        return out
