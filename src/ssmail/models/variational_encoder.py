"""The encoders of NRI and DNRI: which type of edge joins each ordered pair of agents (Kipf et al. 2018, section 3.1;
Graber and Schwing 2020, section 3).

Both embed the edges at every step by node -> edge -> node -> edge perceptrons with a skip from the first to the second
edge embedding. DNRI runs an LSTM along each edge, forward in time for the learned prior and backward for the posterior,
which reads both. NRI's posterior is one graph for the whole trajectory; its prior is fixed (losses.likelihood). Where
NRI reads all steps of a trajectory in its first layer, ours averages the edges' embeddings over the steps, so that the
number of observed steps is free.

All logits are (B, T, N, N, K), sender first, and zero on the diagonal, where there is no edge.
"""

import torch
from torch import Tensor, nn

from ssmail.config.sections import VariationalSpec
from ssmail.models.edge_layers import CHUNK
from ssmail.models.edge_memory import both_ways
from ssmail.models.edge_perceptron import EdgePerceptron, NodePerceptron, ScaledEdges, edge_graph
from ssmail.models.graph_encoder import Memory, remember


def edge_type_head(inputs: int, spec: VariationalSpec) -> nn.Sequential:
    """Three layers: (..., inputs) -> logits (..., K)."""
    return nn.Sequential(
        nn.Linear(inputs, spec.head), nn.ELU(inplace=True), nn.Linear(spec.head, spec.head), nn.ELU(inplace=True),
        nn.Linear(spec.head, spec.edge_types),
    )  # fmt: skip


class EdgeEmbedding(nn.Module):
    """Embeddings of all edges, each step by itself."""

    def __init__(self, inputs: int, hidden: int, batch_norm: bool) -> None:
        super().__init__()
        self.nodes_in = NodePerceptron(inputs, hidden, batch_norm)
        self.edges_in = EdgePerceptron(hidden, hidden, batch_norm)
        self.nodes = NodePerceptron(hidden, hidden, batch_norm)
        self.edges_out = EdgePerceptron(hidden, hidden, batch_norm, edge_inputs=hidden)

    def forward(self, x: Tensor) -> ScaledEdges:
        """x (B, T, N, F) -> (B, T, N, N - 1, H), receiver by receiver."""
        edges: ScaledEdges = self.edges_in(self.nodes_in(x))
        out: ScaledEdges = self.edges_out(self.nodes(edges.received()), edges)
        return out


class StaticEncoder(nn.Module):
    """NRI: one posterior for each edge of a trajectory."""

    def __init__(self, inputs: int, spec: VariationalSpec) -> None:
        super().__init__()
        self.embedding = EdgeEmbedding(inputs, spec.hidden, spec.batch_norm)
        self.head = edge_type_head(spec.hidden, spec)

    def forward(self, x: Tensor) -> Tensor:
        """Observed steps x (B, T, N, F) -> posterior logits (B, 1, N, N, K)."""
        edges: ScaledEdges = self.embedding(x)
        return edge_graph(self.head(edges.values.sum(dim=1, keepdim=True) * (edges.scale / x.shape[1]) + edges.shift))

    def running(self, x: Tensor) -> Tensor:
        """(B, T, N, F) -> (B, T, N, N, K): for each step the logits given the steps up to it."""
        count = torch.arange(1, x.shape[1] + 1, dtype=x.dtype, device=x.device).view(1, -1, 1, 1, 1)
        return edge_graph(self.head(self.embedding(x).tensor().cumsum(dim=1) / count))


class DynamicEncoder(nn.Module):
    """DNRI: a learned prior and a posterior for each edge at each step."""

    def __init__(self, inputs: int, spec: VariationalSpec) -> None:
        super().__init__()
        self.embedding = EdgeEmbedding(inputs, spec.hidden, spec.batch_norm)
        self.past = nn.LSTM(spec.hidden, spec.memory)
        self.future = nn.LSTM(spec.hidden, spec.memory)
        self.head_size = spec.head
        self.prior_head = edge_type_head(spec.memory, spec)
        self.posterior_head = edge_type_head(2 * spec.memory, spec)

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """x (B, T, N, F) -> the logits of the prior, which reads x[:, : t + 1] for step t, and of the posterior, which
        reads all of x; both (B, T, N, N, K).
        """
        edges: ScaledEdges = self.embedding(x.transpose(0, 1))
        past, both = both_ways(edges.values.flatten(1, 3), self.past, self.future, edges.scale, edges.shift)
        return self._logits(self.prior_head, past, x), self._logits(self.posterior_head, both, x)

    def prior(self, x: Tensor, memory: Memory | None = None) -> tuple[Tensor, Memory]:
        """The prior alone, for prediction: steps x (B, T, N, F) that follow those in `memory` -> logits (B, T, N, N, K)
        and the memory after the last step. In evaluation mode any division into calls gives the same logits (in
        training mode batch norm depends on the steps that are read together).
        """
        sequences = self.embedding(x.transpose(0, 1)).tensor().flatten(1, 3)
        past, memory = remember(self.past, sequences, memory)
        return self._logits(self.prior_head, past, x), memory

    def _logits(self, head: nn.Sequential, sequences: Tensor, x: Tensor) -> Tensor:
        """(T, B * N * (N - 1), H) -> (B, T, N, N, K)."""
        b, t, n, _ = x.shape
        in_cache = max(CHUNK // (b * n * n * self.head_size), 1)
        logits = torch.cat([head(steps) for steps in torch.split(sequences, in_cache)])
        return edge_graph(logits.view(t, b, n, n - 1, logits.shape[-1]).transpose(0, 1))
