"""Two-layer perceptrons on agents and on the edges between them, as in NRI and DNRI (Kipf et al. 2018; Graber and
Schwing 2020).

An edge's perceptron reads [x_sender, x_receiver]. Its first layer is linear, so it is applied per node and the two
halves are added by broadcasting (see message_passing). Only the N * (N - 1) edges between different agents are kept,
receiver by receiver: axis -3 of an edge tensor (..., N, N - 1, H) is the receiver j, axis -2 its senders in order, j
left out. So a mean over senders is a plain mean, and batch norm sees real edges only.
"""

from collections.abc import Callable

from torch import Tensor, nn

from ssmail.models.graph_encoder import off_diagonal, on_diagonal

Activation = Callable[[Tensor], Tensor]


def receiver_edges(pairs: Tensor) -> Tensor:
    """(B, T, N receivers, N senders, H) -> (B, T, N, N - 1, H)."""
    b, t, n, _, h = pairs.shape
    return off_diagonal(pairs).view(b, t, n, n - 1, h)


def graph_edges(graph: Tensor) -> Tensor:
    """A graph, sender first, (B, T, N, N, K) -> its edges, receiver first, (B, T, N, N - 1, K)."""
    return receiver_edges(graph.transpose(2, 3))


def edge_graph(edges: Tensor) -> Tensor:
    """Inverse of `graph_edges`, with zeros on the diagonal."""
    return on_diagonal(edges.flatten(2, 3), edges.shape[2]).transpose(2, 3)


class FeatureNorm(nn.BatchNorm1d):
    """Batch norm of the last axis over all others (..., H). In evaluation it uses the running statistics, which are
    part of the state_dict. An empty tensor (the edges of a single agent) passes unchanged.
    """

    def forward(self, x: Tensor) -> Tensor:
        """(..., H) -> (..., H). Raises ValueError in training on a single vector, which has no variance."""
        return super().forward(x.flatten(0, -2)).view(x.shape) if x.numel() else x


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
        out: Tensor = self.norm(nn.functional.elu(self.second(nn.functional.elu(self.first(x)))))
        return out


class EdgePerceptron(nn.Module):
    """norm(act(W_2 act(W_s x_i + W_r x_j + W_e e_ij))) for the edge from i to j; e_ij is an optional embedding of the
    edge, the skip connection of the encoder.
    """

    def __init__(
        self, inputs: int, hidden: int, activation: Activation, *, edge_inputs: int = 0, batch_norm: bool = False
    ) -> None:
        super().__init__()
        self.activation = activation
        self.sender = nn.Linear(inputs, hidden, bias=False)
        self.receiver = nn.Linear(inputs, hidden)
        self.edge = nn.Linear(edge_inputs, hidden, bias=False) if edge_inputs else None
        self.second = nn.Linear(hidden, hidden)
        self.norm = norm_layer(hidden, batch_norm)

    def forward(self, x: Tensor, edges: Tensor | None = None) -> Tensor:
        """x (B, T, N, D) and, with edge_inputs, edges (B, T, N, N - 1, edge_inputs) -> (B, T, N, N - 1, H)."""
        h = receiver_edges(self.receiver(x).unsqueeze(-2) + self.sender(x).unsqueeze(-3))
        if self.edge is not None and edges is not None:
            h = h + self.edge(edges)
        out: Tensor = self.norm(self.activation(self.second(self.activation(h))))
        return out
