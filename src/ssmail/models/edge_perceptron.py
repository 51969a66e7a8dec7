"""Two-layer perceptrons on agents and on the edges between them, as in NRI and DNRI (Kipf et al. 2018; Graber and
Schwing 2020).

An edge's perceptron reads [x_sender, x_receiver]. Its first layer is linear, so it is applied per node (see
message_passing); the rest is in edge_layers, which says how edges lie in memory. A mean over senders is a plain mean,
and batch norm sees real edges only. Batch norm multiplies and adds, feature by feature, and what reads it begins with a
linear layer or a mean: so edges are never normalised, but go on with the factors (ScaledEdges).
"""

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from ssmail.models.edge_layers import ELU, EdgeLayers
from ssmail.models.graph_encoder import on_diagonal


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

    def factors(self, mean: Tensor, variance: Tensor, count: int) -> tuple[Tensor, Tensor]:
        """Scale and shift (H,) with which scale * x + shift is the norm of `count` vectors x of this mean and variance
        (H,), biased; like forward it moves the running statistics in training and uses them in evaluation.
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
    """Edges scale * values + shift: values (B, T, N, N - 1, H), their mean over senders (B, T, N, H), and scale and
    shift (H,).
    """

    values: Tensor
    means: Tensor
    scale: Tensor
    shift: Tensor

    def tensor(self) -> Tensor:
        """(B, T, N, N - 1, H)."""
        return self.values * self.scale + self.shift

    def received(self) -> Tensor:
        """The mean over senders (B, T, N, H); zeros for a single agent."""
        return self.means * self.scale + self.shift


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

    def forward(self, x: Tensor, edges: ScaledEdges | None = None) -> ScaledEdges:
        """x (B, T, N, D) and, with edge_inputs, edges (B, T, N, N - 1, edge_inputs) -> (B, T, N, N - 1, H)."""
        b, t, n, _ = x.shape
        ones, zeros = torch.ones_like(self.second.bias), torch.zeros_like(self.second.bias)
        if n == 1:
            return ScaledEdges(x.new_zeros(b, t, 1, 0, len(ones)), x.new_zeros(b, t, 1, len(ones)), ones, zeros)
        receiver, skip = self.receiver(x), None
        if self.edge is not None and edges is not None:
            receiver = receiver + self.edge.weight @ edges.shift
            skip = self.edge.weight * edges.scale
        given = None if skip is None or edges is None else edges.values
        second = self.second.weight, self.second.bias
        values, means, variance = EdgeLayers.apply(self.sender(x), receiver, given, skip, *second, None, ELU)  # type: ignore[no-untyped-call]  # torch's
        if not isinstance(self.norm, FeatureNorm):
            return ScaledEdges(values, means, ones, zeros)
        return ScaledEdges(values, means, *self.norm.factors(means.mean(dim=(0, 1, 2)), variance, b * t * n * (n - 1)))
