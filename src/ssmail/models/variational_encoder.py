"""The encoders of NRI and DNRI: which type of edge joins each ordered pair of agents (Kipf et al. 2018, section 3.1;
Graber and Schwing 2020, section 3).

Both embed the edges at every step by node -> edge -> node -> edge perceptrons with a skip connection from the first to
the second edge embedding. DNRI runs an LSTM along each edge, forward in time for the learned prior and backward for the
posterior, which reads both. NRI's posterior is one graph for the whole trajectory; its prior is fixed
(losses.likelihood). WindowEncoder reads all steps of a trajectory in its first layer, as NRI is published.
StaticEncoder averages the embeddings of an edge over the steps instead, so that the number of observed steps is free.

Edge tensors are (B, T, N, N - 1, H), receiver by receiver (message_passing.edge_ends). All logits are (B, T, N, N, K),
sender first, and zero on the diagonal, where there is no edge.
"""

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from ssmail.config.sections import VariationalSpec
from ssmail.models import message_passing
from ssmail.models.fast_lstm import both_ways
from ssmail.models.fast_messages import ELU, EdgeLayers, by_steps
from ssmail.models.graph_encoder import EdgeLSTM, Memory, on_diagonal


def edge_graph(edges: Tensor) -> Tensor:
    """Arrange edges (B, T, N, N - 1, K) as pairs (B, T, N, N, K), sender first, with zeros on the diagonal."""
    return on_diagonal(edges.flatten(2, 3), edges.shape[2]).transpose(2, 3)


class FeatureNorm(nn.BatchNorm1d):
    """Batch norm of the last axis of (..., H) over all other axes.

    An empty tensor (the edges of a single agent) passes unchanged.
    """

    def forward(self, x: Tensor) -> Tensor:
        """Normalize (..., H). Raises ValueError in training on a single vector, which has no variance."""
        return super().forward(x.flatten(0, -2)).view(x.shape) if x.numel() else x

    def factors(self, mean: Tensor, variance: Tensor, count: int) -> tuple[Tensor, Tensor]:
        """Return scale and shift (H,) such that scale * x + shift normalizes `count` vectors x of this mean and biased
        variance (H,).

        Like `forward` it updates the running statistics in training and uses them in evaluation.
        """
        assert self.running_mean is not None
        assert self.running_var is not None
        assert self.num_batches_tracked is not None
        assert self.momentum is not None
        if self.training:
            self.num_batches_tracked += 1
            self.running_mean.lerp_(mean.detach(), self.momentum)
            self.running_var.lerp_(variance.detach() * (count / (count - 1)), self.momentum)
        else:
            mean, variance = self.running_mean, self.running_var
        scale = self.weight * torch.rsqrt(variance + self.eps)
        return scale, self.bias - mean * scale


@dataclass(frozen=True)
class ScaledEdges:
    """Edges in the form scale * values + shift.

    Batch norm scales and shifts each feature, and whatever reads its output begins with a linear layer or a mean. In
    the fast form, edges are therefore never normalized: the factors travel along and are folded into the next layer.

    values: (B, T, N, N - 1, H). means: their mean over senders (B, T, N, H). scale, shift: (H,).
    """

    values: Tensor
    means: Tensor
    scale: Tensor
    shift: Tensor

    def tensor(self) -> Tensor:
        """Return the edges themselves, (B, T, N, N - 1, H)."""
        return self.values * self.scale + self.shift

    def received(self) -> Tensor:
        """Return the mean over senders (B, T, N, H); zeros for a single agent."""
        return self.means * self.scale + self.shift


def elu(x: Tensor) -> Tensor:
    """ELU in place, for the output of a linear layer, which nothing else reads."""
    return nn.functional.elu(x, inplace=True)


def norm_layer(size: int, batch_norm: bool) -> nn.Module:
    """Return batch norm, or the identity."""
    return FeatureNorm(size) if batch_norm else nn.Identity()


class NodePerceptron(nn.Module):
    """norm(ELU(W_2 ELU(W_1 x))), applied to each agent."""

    def __init__(self, inputs: int, hidden: int, batch_norm: bool) -> None:
        super().__init__()
        self.first = nn.Linear(inputs, hidden)
        self.second = nn.Linear(hidden, hidden)
        self.norm = norm_layer(hidden, batch_norm)

    def forward(self, x: Tensor) -> Tensor:
        """Map x (..., N, D) to (..., N, H)."""
        out: Tensor = self.norm(elu(self.second(elu(self.first(x)))))
        return out


class EdgePerceptron(nn.Module):
    """norm(ELU(W_2 ELU(W_1 [x_i, x_j, e_ij] + b_1) + b_2)) for the edge from i to j.

    e_ij is an optional embedding of the edge, the skip connection of the encoder. W_1 = [W_s, W_r, W_e] acts on sender,
    receiver and embedding. Batch norm runs over the edges between different agents only.
    """

    def __init__(self, inputs: int, hidden: int, batch_norm: bool, edge_inputs: int = 0) -> None:
        super().__init__()
        self.sender = nn.Linear(inputs, hidden, bias=False)
        self.receiver = nn.Linear(inputs, hidden)
        self.edge = nn.Linear(edge_inputs, hidden, bias=False) if edge_inputs else None
        self.second = nn.Linear(hidden, hidden)
        self.norm = norm_layer(hidden, batch_norm)

    def forward(self, x: Tensor, edges: ScaledEdges | None = None) -> ScaledEdges:
        """Map x (B, T, N, D) and, with edge_inputs, edges (B, T, N, N - 1, D') to edges (B, T, N, N - 1, H)."""
        b, t, n, _ = x.shape
        ones, zeros = torch.ones_like(self.second.bias), torch.zeros_like(self.second.bias)
        if n == 1:
            return ScaledEdges(x.new_zeros(b, t, 1, 0, len(ones)), x.new_zeros(b, t, 1, len(ones)), ones, zeros)
        if not message_passing.FAST:
            normalized = self.norm(self._per_edge(x, edges))
            return ScaledEdges(normalized, normalized.mean(dim=-2), ones, zeros)
        receiver, skip, given = self.receiver(x), None, None
        if self.edge is not None and edges is not None:  # W_e (scale * e + shift), folded into bias and weight
            receiver = receiver + self.edge.weight @ edges.shift
            skip, given = self.edge.weight * edges.scale, edges.values
        second = self.second.weight, self.second.bias
        values, means, variance = EdgeLayers.apply(self.sender(x), receiver, given, skip, *second, None, ELU)  # type: ignore[no-untyped-call]  # torch's
        if not isinstance(self.norm, FeatureNorm):
            return ScaledEdges(values, means, ones, zeros)
        return ScaledEdges(values, means, *self.norm.factors(means.mean(dim=(0, 1, 2)), variance, b * t * n * (n - 1)))

    def _per_edge(self, x: Tensor, edges: ScaledEdges | None) -> Tensor:
        """The readable form, without the norm: (B, T, N, N - 1, H)."""
        inputs, weights = [message_passing.both_ends(x)], [self.sender.weight, self.receiver.weight]
        if self.edge is not None and edges is not None:
            inputs.append(edges.tensor())
            weights.append(self.edge.weight)
        first = nn.functional.linear(torch.cat(inputs, dim=-1), torch.cat(weights, dim=1), self.receiver.bias)
        return nn.functional.elu(self.second(nn.functional.elu(first)))


def edge_type_head(inputs: int, spec: VariationalSpec) -> nn.Sequential:
    """Three layers that map (..., inputs) to logits (..., K)."""
    return nn.Sequential(
        nn.Linear(inputs, spec.head), nn.ELU(inplace=True), nn.Linear(spec.head, spec.head), nn.ELU(inplace=True),
        nn.Linear(spec.head, spec.edge_types),
    )  # fmt: skip


class EdgeEmbedding(nn.Module):
    """Embeddings of all edges; no step reads another."""

    def __init__(self, inputs: int, hidden: int, batch_norm: bool) -> None:
        super().__init__()
        self.nodes_in = NodePerceptron(inputs, hidden, batch_norm)
        self.edges_in = EdgePerceptron(hidden, hidden, batch_norm)
        self.nodes = NodePerceptron(hidden, hidden, batch_norm)
        self.edges_out = EdgePerceptron(hidden, hidden, batch_norm, edge_inputs=hidden)

    def forward(self, x: Tensor) -> ScaledEdges:
        """Map x (B, T, N, F) to edges (B, T, N, N - 1, H)."""
        edges: ScaledEdges = self.edges_in(self.nodes_in(x))
        out: ScaledEdges = self.edges_out(self.nodes(edges.received()), edges)
        return out


class WindowEncoder(nn.Module):
    """NRI as published: one posterior for each edge, from `spec.encoder_window` steps W as one input of each agent.

    A longer history is read from its last W steps; a shorter one as if each agent had been in its first state before,
    which is what the DNRI authors' code does. Trained on such windows only, the encoder has learned nothing about
    histories that are much shorter.

    inputs: F. constant: how many of the F features, the last ones, are the same at every step; they are read once.
    """

    def __init__(self, inputs: int, constant: int, spec: VariationalSpec) -> None:
        super().__init__()
        assert spec.encoder_window is not None
        self.steps, self.moving = spec.encoder_window, inputs - constant
        self.embedding = EdgeEmbedding(self.steps * self.moving + constant, spec.hidden, spec.batch_norm)
        self.head = edge_type_head(spec.hidden, spec)

    def forward(self, x: Tensor) -> Tensor:
        """Map the observed steps x (B, T, N, F) to posterior logits (B, 1, N, N, K)."""
        return self._logits(x, 1)

    def running(self, x: Tensor) -> Tensor:
        """Return for each step the logits (B, T, N, N, K) given the steps of x (B, T, N, F) up to it."""
        return self._logits(x, x.shape[1])

    def _logits(self, x: Tensor, last: int) -> Tensor:
        """Return the logits (B, last, N, N, K) of the windows that end at the `last` steps of x (B, T, N, F)."""
        moving = x[..., : self.moving]
        before = moving[:, :1].expand(-1, self.steps - 1, -1, -1)
        read = torch.cat([before, moving], dim=1)[:, -(self.steps - 1 + last) :]
        windows = read.unfold(1, self.steps, 1).flatten(3)  # (B, last, N, moving * W)
        edges: ScaledEdges = self.embedding(torch.cat([windows, x[:, -last:, :, self.moving :]], dim=-1))
        return edge_graph(self.head(edges.tensor()))


class StaticEncoder(nn.Module):
    """NRI for histories of any length: one posterior for each edge, from the mean of its embeddings over the steps."""

    def __init__(self, inputs: int, spec: VariationalSpec) -> None:
        super().__init__()
        self.embedding = EdgeEmbedding(inputs, spec.hidden, spec.batch_norm)
        self.head = edge_type_head(spec.hidden, spec)

    def forward(self, x: Tensor) -> Tensor:
        """Map the observed steps x (B, T, N, F) to posterior logits (B, 1, N, N, K)."""
        edges: ScaledEdges = self.embedding(x)
        return edge_graph(self.head(edges.values.sum(dim=1, keepdim=True) * (edges.scale / x.shape[1]) + edges.shift))

    def running(self, x: Tensor) -> Tensor:
        """Return for each step the logits (B, T, N, N, K) given the steps of x (B, T, N, F) up to it."""
        count = torch.arange(1, x.shape[1] + 1, dtype=x.dtype, device=x.device).view(1, -1, 1, 1, 1)
        return edge_graph(self.head(self.embedding(x).tensor().cumsum(dim=1) / count))


class DynamicEncoder(nn.Module):
    """DNRI: a learned prior and a posterior for each edge at each step."""

    def __init__(self, inputs: int, spec: VariationalSpec) -> None:
        super().__init__()
        self.embedding = EdgeEmbedding(inputs, spec.hidden, spec.batch_norm)
        self.past = EdgeLSTM(spec.hidden, spec.memory)
        self.future = EdgeLSTM(spec.hidden, spec.memory)
        self.head_size = spec.head
        self.prior_head = edge_type_head(spec.memory, spec)
        self.posterior_head = edge_type_head(2 * spec.memory, spec)

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Map x (B, T, N, F) to the logits of the prior and of the posterior, both (B, T, N, N, K).

        At step t the prior reads x[:, : t + 1], and the posterior reads all of x.
        """
        edges: ScaledEdges = self.embedding(x.transpose(0, 1))
        if message_passing.FAST:
            both = both_ways(edges.values.flatten(1, 3), self.past, self.future, edges.scale, edges.shift)
            weights = [*self.prior_head.parameters(), *self.posterior_head.parameters()]
            logits = by_steps(self._heads, both, weights, both.shape[1] * self.head_size)
        else:
            sequences = edges.tensor().flatten(1, 3)  # (T, B * N * (N - 1), H)
            past, _ = self.past(sequences)
            future = self.future(sequences.flip(0))[0].flip(0)
            logits = self._heads(torch.cat([past, future], dim=-1))
        prior, posterior = logits.chunk(2, dim=-1)
        return self._graph(prior, x), self._graph(posterior, x)

    def _heads(self, both: Tensor) -> Tensor:
        """Map both hidden states (T, edges, 2 * H) to the logits of prior and posterior (T, edges, 2 * K)."""
        return torch.cat([self.prior_head(both[..., : self.past.hidden_size]), self.posterior_head(both)], dim=-1)

    def prior(self, x: Tensor, memory: Memory | None = None) -> tuple[Tensor, Memory]:
        """Return the logits (B, T, N, N, K) of the prior alone, for prediction, and the memory after the last step.

        x (B, T, N, F) holds the steps that follow those in `memory`. In evaluation mode, any division into calls yields
        the same logits; in training mode, batch norm depends on the steps that are read together.
        """
        sequences = self.embedding(x.transpose(0, 1)).tensor().flatten(1, 3)
        past, memory = self.past(sequences, memory)
        return self._graph(self.prior_head(past), x), memory

    @staticmethod
    def _graph(logits: Tensor, x: Tensor) -> Tensor:
        """Arrange logits (T, B * N * (N - 1), K) as (B, T, N, N, K); x is (B, T, N, F)."""
        b, t, n, _ = x.shape
        return edge_graph(logits.view(t, b, n, n - 1, logits.shape[-1]).transpose(0, 1))
