"""The two layers of an edge's perceptron and what is summed up of them, a few steps at a time.

For the edge from agent i to agent j, h_ij = act(s_i + r_j + E e_ij) and m_ij = act(W h_ij + b): s and r are the halves
of the first layer, applied per agent; e_ij is an optional embedding of the edge. Agent j receives the mean over its
senders of w_ij m_ij. On recorded motion (31 agents, 930 edges, 50 steps) each of these tensors has hundreds of
megabytes; written as one operation after the other, much of the time goes into moving them. Here all operations are
done for as many steps as fit into the processor's cache, forwards and backwards. m is kept for the gradient, and h only
where it depends on e: otherwise it is cheaper to compute again than to fetch.

Only the N * (N - 1) edges between different agents are there, receiver by receiver: axis -3 of an edge tensor (..., N,
N - 1, H) is the receiver j, axis -2 its senders in order, j left out.
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

CHUNK = 2**18  # numbers in a tensor that is worked on: a megabyte of single precision

Part = tuple[slice, slice]  # of the axes B and T


@dataclass(frozen=True)
class Activation:
    """`apply` works in place; `gradient` takes a gradient by the result and the result to the one by the argument."""

    apply: Callable[[Tensor], Tensor]
    gradient: Callable[[Tensor, Tensor], Tensor]


def elu_(x: Tensor) -> Tensor:
    """max(x, 2^(min(x, 0) / ln 2) - 1), in place: torch's, by expm1, takes more than twice the time."""
    return torch.maximum(x, (x * (1 / math.log(2))).clamp_(max=0).exp2_().sub_(1), out=x)


def tanh_(x: Tensor) -> Tensor:
    """2 s(2 x) - 1 with the logistic function s, in place, in a quarter of the time of torch's."""
    return x.mul_(2).sigmoid_().mul_(2).sub_(1)


ELU = Activation(elu_, lambda g, result: torch.ops.aten.elu_backward(g, 1.0, 1.0, 1.0, True, result))
TANH = Activation(tanh_, torch.ops.aten.tanh_backward)
RELU = Activation(torch.relu_, lambda g, result: torch.ops.aten.threshold_backward(g, result, 0))


def parts(batch: int, steps: int, size: int) -> Iterator[Part]:
    """Divide (B, T) into parts of about CHUNK numbers, where a step has `size`; of whole trajectories if they fit."""
    fitting = max(CHUNK // max(size, 1), 1)
    trajectories, length = max(fitting // max(steps, 1), 1), min(fitting, steps)
    for b in range(0, batch, trajectories):
        for t in range(0, steps, length):
            yield slice(b, b + trajectories), slice(t, t + length)


def first_layer(s: Tensor, r: Tensor) -> Tensor:
    """s_i + r_j of a part of the steps, (B, T, N, H) twice -> (B * T * N * (N - 1), H)."""
    pairs = s.flatten(0, 1).unsqueeze(1) + r.flatten(0, 1).unsqueeze(2)
    return between_different(pairs).reshape(-1, s.shape[-1])


def between_different(pairs: Tensor) -> Tensor:
    """The view (M, N - 1, N, H) of pairs (M, N, N, H) that has the edges in the order of a tensor (M, N, N - 1, H)."""
    m, n, _, h = pairs.shape
    return pairs.flatten(1, 2)[:, 1:].view(m, n - 1, n + 1, h)[:, :, :n]


class EdgeLayers(torch.autograd.Function):
    """m (B, T, N, N - 1, H), what is received (B, T, N, H), and the variance of m over all edges (H,)."""

    @staticmethod
    def forward(
        ctx: Any, s: Tensor, r: Tensor, edges: Tensor | None, edge_weight: Tensor | None, weight: Tensor, bias: Tensor,
        weights: Tensor | None, activation: Activation,
    ) -> tuple[Tensor, Tensor, Tensor]:  # fmt: skip
        """s, r (B, T, N, H); edges (B, T, N, N - 1, D) and edge_weight (H, D), or neither; weight (H, H) and bias (H,)
        of the second layer; weights (B, T, N, N - 1) of the mean over senders, or None where all are equal.
        """
        b, t, n, h = s.shape
        second, received, first = s.new_empty(b, t, n, n - 1, h), torch.empty_like(s), []
        squares, near = s.new_zeros(h), None
        for k in parts(b, t, n * (n - 1) * h):
            hidden, out = first_layer(s[k], r[k]), second[k].flatten(0, 3)
            if edges is not None and edge_weight is not None:
                first.append(hidden.addmm_(edges[k].flatten(0, 3), edge_weight.t()))
            torch.addmm(bias, activation.apply(hidden), weight.t(), out=out)
            activation.apply(out)
            if weights is None:
                torch.mean(second[k], dim=-2, out=received[k])
                near = out.mean(dim=0) if near is None else near  # subtracted, so that nothing is lost to rounding
                squares += (out - near).square_().sum(dim=0)
            else:
                torch.sum(second[k] * weights[k].unsqueeze(-1), dim=-2, out=received[k])
        mean = received.mean(dim=(0, 1, 2))
        variance = squares if near is None else squares / (second.numel() // h) - (mean - near).square()
        ctx.save_for_backward(s, r, second, edges, edge_weight, weight, weights, mean, *first)
        ctx.activation = activation
        ctx.set_materialize_grads(False)
        return second, received, variance

    @staticmethod
    def backward(ctx: Any, by_second: Tensor | None, by_received: Tensor | None, by_variance: Tensor | None) -> Any:
        """The gradients of s, r, edges, edge_weight, weight, bias and weights."""
        s, r, second, edges, edge_weight, weight, weights, mean, *first = ctx.saved_tensors
        b, t, n, _, h = second.shape
        if by_received is None:
            by_received = second.new_zeros(b, t, n, h)
        slope = None if by_variance is None else by_variance * (2 * h / second.numel())
        of_s, of_r = second.new_empty(b, t, n, h), second.new_empty(b, t, n, h)
        of_edges, of_edge_weight = (None if x is None else torch.zeros_like(x) for x in (edges, edge_weight))
        of_weight, of_bias = torch.zeros_like(weight), weight.new_zeros(h)
        of_weights, pairs = (None if weights is None else torch.empty_like(weights)), None
        for number, k in enumerate(parts(b, t, n * (n - 1) * h)):
            g, m = by_received[k].unsqueeze(-2), second[k]
            if weights is not None and of_weights is not None:
                torch.sum(m * g, dim=-1, out=of_weights[k])
                g = g * weights[k].unsqueeze(-1)
            else:
                g = g / (n - 1)
            if slope is not None:
                g = torch.addcmul(g - slope * mean, m, slope)
            if by_second is not None:
                g = by_second[k] + g
            g = ctx.activation.gradient(g.expand_as(m), m).flatten(0, 3)
            hidden = ctx.activation.apply(first_layer(s[k], r[k])) if edges is None else first[number]
            of_weight.addmm_(g.t(), hidden)
            of_bias += g.sum(dim=0)
            g = ctx.activation.gradient(g @ weight, hidden)
            if of_edges is not None and of_edge_weight is not None:
                torch.mm(g, edge_weight, out=of_edges[k].flatten(0, 3))
                of_edge_weight.addmm_(g.t(), edges[k].flatten(0, 3))
            steps = len(g) // (n * (n - 1))
            if pairs is None or len(pairs) != steps:
                pairs = g.new_zeros(steps, n, n, h)
            between_different(pairs).copy_(g.view(steps, n - 1, n, h))
            of_s[k], of_r[k] = pairs.sum(dim=1).view_as(of_s[k]), pairs.sum(dim=2).view_as(of_r[k])
        return of_s, of_r, of_edges, of_edge_weight, of_weight, of_bias, of_weights, None
