"""Fast forms of message passing: hand-written gradients that save time and memory on a processor.

They compute the equations of message_passing.py and variational_encoder.py, which these modules also write out in their
readable form; `message_passing.FAST` chooses, and tests compare the two. Read this module for speed only.

- `sum_over_senders`: messages of the graph policy, sender by sender.
- `EdgeLayers`: both layers of an edge's perceptron and the mean over its senders, a few steps at a time. On recorded
  motion (31 agents, 930 edges, 50 steps) each tensor of edges has hundreds of megabytes; written as one operation after
  the other, much of the time goes into moving them.
- `by_steps`: dnri's heads a few steps at a time, whose hidden layers are computed again instead of being stored.

The edge tensors of EdgeLayers hold only the N * (N - 1) edges between different agents, receiver by receiver: axis -3
of (B, T, N, N - 1, H) is the receiver j, axis -2 its senders in order, j left out.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

CHUNK = 2**18  # numbers in a tensor that is worked on: a megabyte of single precision
DENSE_UP_TO = 8  # agents: up to this many, all pairs at once are faster than sender by sender
SPARSE_UP_TO = 0.9  # share of edges with a weight: up to this, leaving out the others saves time

Chunk = tuple[slice, slice]  # of the axes B and T


class SumOverSenders(torch.autograd.Function):
    """sum_i w_ijk relu(s_ik + r_jk), sender by sender: s and r (..., N, K, H), w (..., N, N, K) -> (..., N, K, H).

    The pairs of one sender fit into the processor's cache, and the backward pass computes them again instead of
    storing them. Differentiable twice.
    """

    @staticmethod
    def forward(ctx: Any, s: Tensor, r: Tensor, w: Tensor) -> Tensor:
        """Add up the weighted pairs of one sender i after the other."""
        ctx.save_for_backward(s, r, w)
        total = torch.zeros_like(r)
        for i in range(s.shape[-3]):
            total.addcmul_(torch.relu_(s[..., i : i + 1, :, :] + r), w[..., i, :, :].unsqueeze(-1))
        return total

    @staticmethod
    def backward(ctx: Any, grad_total: Tensor) -> tuple[Tensor, Tensor, Tensor | None]:
        """Return the gradients of s, r and, if needed, w."""
        s, r, w = ctx.saved_tensors
        grad_s, grad_r, grad_w = [], torch.zeros_like(r), []
        for i in range(s.shape[-3]):
            pairs = torch.relu_(s[..., i : i + 1, :, :] + r)  # (..., N, K, H), again
            if ctx.needs_input_grad[2]:
                grad_w.append((pairs * grad_total).sum(dim=-1))
            weighted = grad_total * w[..., i, :, :].unsqueeze(-1)
            through = torch.ops.aten.threshold_backward(weighted, pairs, 0)
            grad_r += through
            grad_s.append(through.sum(dim=-3))
        return torch.stack(grad_s, dim=-3), grad_r, torch.stack(grad_w, dim=-3) if grad_w else None


def sum_over_senders(s: Tensor, r: Tensor, w: Tensor) -> Tensor:
    """Return sum_i w_ijk relu(s_ik + r_jk), by SumOverSenders or, for few agents, with all pairs at once."""
    if s.shape[-3] > DENSE_UP_TO:
        total: Tensor = SumOverSenders.apply(s, r, w)  # type: ignore[no-untyped-call]  # torch's
        return total
    pairs = torch.relu_(s.unsqueeze(-3) + r.unsqueeze(-4)) * w.unsqueeze(-1)  # (..., N, N, K, H)
    received, *others = pairs.unbind(dim=-4)  # a sum over a short axis takes longer than additions
    for one in others:
        received = received + one
    return received


@dataclass(frozen=True)
class Activation:
    """An activation as a plain function and, for EdgeLayers, in place.

    gradient: maps the gradient of the result, and the result, to the gradient of the argument.
    """

    plain: Callable[[Tensor], Tensor]
    in_place: Callable[[Tensor], Tensor]
    gradient: Callable[[Tensor, Tensor], Tensor]


def elu_(x: Tensor) -> Tensor:
    """ELU in place, as max(x, 2^(min(x, 0) / ln 2) - 1): torch's expm1 takes more than twice the time."""
    return torch.maximum(x, (x * (1 / math.log(2))).clamp_(max=0).exp2_().sub_(1), out=x)


def tanh_(x: Tensor) -> Tensor:
    """Tanh in place, as 2 s(2 x) - 1 with the logistic function s: a quarter of the time of torch's."""
    return x.mul_(2).sigmoid_().mul_(2).sub_(1)


ELU = Activation(nn.functional.elu, elu_, lambda g, result: torch.ops.aten.elu_backward(g, 1.0, 1.0, 1.0, True, result))
TANH = Activation(torch.tanh, tanh_, torch.ops.aten.tanh_backward)
RELU = Activation(torch.relu, torch.relu_, lambda g, result: torch.ops.aten.threshold_backward(g, result, 0))


def chunks(batch: int, steps: int, size: int) -> Iterator[Chunk]:
    """Divide (B, T) into chunks of about CHUNK numbers, where a step has `size`; whole trajectories if they fit."""
    fitting = max(CHUNK // max(size, 1), 1)
    trajectories, length = max(fitting // max(steps, 1), 1), min(fitting, steps)
    for b in range(0, batch, trajectories):
        for t in range(0, steps, length):
            yield slice(b, b + trajectories), slice(t, t + length)


def first_layer(s: Tensor, r: Tensor) -> Tensor:
    """Return s_i + r_j for the edges of a chunk: (B, T, N, H) twice -> (B * T * N * (N - 1), H)."""
    pairs = s.flatten(0, 1).unsqueeze(1) + r.flatten(0, 1).unsqueeze(2)  # (B * T, N, N, H), receiver first
    return between_different(pairs).reshape(-1, s.shape[-1])


def between_different(pairs: Tensor) -> Tensor:
    """Return the view (M, N - 1, N, H) of pairs (M, N, N, H) without the diagonal, in the order of (M, N, N - 1, H).

    Once the first diagonal element is dropped, every (N + 1)-th of the rest lies on the diagonal.
    """
    m, n, _, h = pairs.shape
    return pairs.flatten(1, 2)[:, 1:].view(m, n - 1, n + 1, h)[:, :, :n]


def nonzero_rows(weights: Tensor) -> Tensor | None:
    """Return the positions of the edges with a weight other than 0, or None if choosing them would not save time.

    Sampled graphs are one-hot, so the messages of a type have weight 0 along all edges of another type.
    """
    rows = weights.flatten().nonzero().squeeze(-1)
    return rows if len(rows) < SPARSE_UP_TO * weights.numel() else None


def place_among_pairs(edges: Tensor, agents: int) -> Tensor:
    """Convert positions in (M, N, N - 1), receiver by receiver, to positions in (M, N, N)."""
    # Of N * N pairs, one on the diagonal comes before every N others, and one before the first.
    graph, place = edges // (agents * (agents - 1)), edges % (agents * (agents - 1))
    return graph * agents * agents + place + place // agents + 1


class EdgeLayers(torch.autograd.Function):
    """Two layers on each edge, h_ij = act(s_i + r_j + E e_ij) and m_ij = act(W h_ij + b), and the sum of w_ij m_ij over
    the senders i of each receiver j.

    s and r are the two halves of the first layer, applied per agent; e_ij is an optional embedding of the edge. Forward
    and backward pass do all of this for as many steps as fit into the processor's cache. m is stored for the gradient;
    h is computed again, which costs hardly more than fetching it from memory. Edges of weight 0 have no part in the
    gradients of the layers and are left out of their products.
    """

    @staticmethod
    def forward(
        ctx: Any, s: Tensor, r: Tensor, edges: Tensor | None, edge_weight: Tensor | None, weight: Tensor, bias: Tensor,
        weights: Tensor | None, activation: Activation,
    ) -> tuple[Tensor, Tensor, Tensor]:  # fmt: skip
        """Return m (B, T, N, N - 1, H), the sum over senders (B, T, N, H), and the variance of m over all edges (H,).

        s, r: (B, T, N, H). edges and edge_weight: e (B, T, N, N - 1, D) and E (H, D), or neither. weight and bias: W
        (H, H) and b (H,). weights: w (B, T, N, N - 1), or None for the mean.
        """
        b, t, n, h = s.shape
        second, received = s.new_empty(b, t, n, n - 1, h), torch.empty_like(s)
        squares, near = s.new_zeros(h), None
        for k in chunks(b, t, n * (n - 1) * h):
            # first layer
            hidden, out = first_layer(s[k], r[k]), second[k].flatten(0, 3)
            if edges is not None and edge_weight is not None:
                hidden.addmm_(edges[k].flatten(0, 3), edge_weight.t())
            # second layer, written into its place in `second`
            torch.addmm(bias, activation.in_place(hidden), weight.t(), out=out)
            activation.in_place(out)
            # sum over senders; of the plain mean also the squares, for batch norm
            if weights is None:
                torch.mean(second[k], dim=-2, out=received[k])
                near = out.mean(dim=0) if near is None else near  # close to the mean: avoids cancellation
                squares += (out - near).square_().sum(dim=0)
            else:
                torch.sum(second[k] * weights[k].unsqueeze(-1), dim=-2, out=received[k])
        mean = received.mean(dim=(0, 1, 2))
        variance = squares if near is None else squares / (second.numel() // h) - (mean - near).square()
        ctx.save_for_backward(s, r, second, edges, edge_weight, weight, weights, mean)
        ctx.activation = activation
        ctx.set_materialize_grads(False)
        return second, received, variance

    @staticmethod
    def backward(
        ctx: Any, grad_second: Tensor | None, grad_received: Tensor | None, grad_variance: Tensor | None
    ) -> Any:
        """Return the gradients of s, r, edges, edge_weight, weight, bias and weights."""
        s, r, second, edges, edge_weight, weight, weights, mean = ctx.saved_tensors
        b, t, n, _, h = second.shape
        if grad_received is None:
            grad_received = second.new_zeros(b, t, n, h)
        slope = None if grad_variance is None else grad_variance * (2 * h / second.numel())
        grad_s, grad_r = second.new_empty(b, t, n, h), second.new_empty(b, t, n, h)
        grad_edges, grad_edge_weight = (None if x is None else torch.zeros_like(x) for x in (edges, edge_weight))
        grad_weight, grad_bias = torch.zeros_like(weight), weight.new_zeros(h)
        grad_weights, pairs = (None if weights is None else torch.empty_like(weights)), None
        for k in chunks(b, t, n * (n - 1) * h):
            # gradient of m: through the sum over senders, the variance, and m itself
            g, m = grad_received[k].unsqueeze(-2), second[k]
            kept = None
            if weights is not None and grad_weights is not None:
                torch.sum(m * g, dim=-1, out=grad_weights[k])
                g = g * weights[k].unsqueeze(-1)
                kept = None if grad_second is not None or slope is not None else nonzero_rows(weights[k])
            else:
                g = g / (n - 1)
            if slope is not None:
                g = torch.addcmul(g - slope * mean, m, slope)
            if grad_second is not None:
                g = grad_second[k] + g
            # second layer
            g, m = g.expand_as(m).flatten(0, 3), m.flatten(0, 3)
            hidden = first_layer(s[k], r[k])
            if edges is not None and edge_weight is not None:
                hidden.addmm_(edges[k].flatten(0, 3), edge_weight.t())
            if kept is not None:
                g, m, hidden = g[kept], m[kept], hidden[kept]
            g, hidden = ctx.activation.gradient(g, m), ctx.activation.in_place(hidden)
            grad_weight.addmm_(g.t(), hidden)
            grad_bias += g.sum(dim=0)
            # first layer
            g = ctx.activation.gradient(g @ weight, hidden)
            if grad_edges is not None and grad_edge_weight is not None:
                torch.mm(g, edge_weight, out=grad_edges[k].flatten(0, 3))
                grad_edge_weight.addmm_(g.t(), edges[k].flatten(0, 3))
            # the edges go back into all pairs, whose diagonal stays zero, and add up over receivers (s) and senders (r)
            steps = len(second[k].flatten(0, 1))
            if pairs is None or len(pairs) != steps:
                pairs = g.new_zeros(steps, n, n, h)
            if kept is None:
                between_different(pairs).copy_(g.view(steps, n - 1, n, h))
            else:
                pairs.zero_().view(-1, h).index_copy_(0, place_among_pairs(kept, n), g)
            grad_s[k], grad_r[k] = pairs.sum(dim=1).view_as(grad_s[k]), pairs.sum(dim=2).view_as(grad_r[k])
        return grad_s, grad_r, grad_edges, grad_edge_weight, grad_weight, grad_bias, grad_weights, None


class BySteps(torch.autograd.Function):
    """A function of x (T, E, D) -> (T, E, K) for a few steps at a time. The backward pass computes it again."""

    @staticmethod
    def forward(ctx: Any, function: Callable[[Tensor], Tensor], steps: int, x: Tensor, *weights: Tensor) -> Tensor:
        """Apply `function`, which reads `weights`, to `steps` steps at a time."""
        ctx.save_for_backward(x, *weights)
        ctx.function, ctx.steps = function, steps
        return torch.cat([function(part) for part in torch.split(x, steps)])

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        """Return the gradients of x and of the weights."""
        x, *weights = ctx.saved_tensors
        grad_x, grad_weights = torch.empty_like(x), [torch.zeros_like(w) for w in weights]
        for part, given, out in zip(*(torch.split(y, ctx.steps) for y in (x, grad, grad_x)), strict=True):
            with torch.enable_grad():
                read = part.detach().requires_grad_()
                found = torch.autograd.grad(ctx.function(read), [read, *weights], given)
            out.copy_(found[0])
            for total, more in zip(grad_weights, found[1:], strict=True):
                total += more
        return None, None, grad_x, *grad_weights


def by_steps(function: Callable[[Tensor], Tensor], x: Tensor, weights: Sequence[Tensor], size: int) -> Tensor:
    """Apply a function, which reads `weights`, to each step of x (T, E, D) -> (T, E, K), as many steps at a time as fit
    into the processor's cache; `size` is the number of its intermediate results in a step.
    """
    steps = max(CHUNK // max(size, 1), 1)
    if steps >= len(x):
        return function(x)
    out: Tensor = BySteps.apply(function, steps, x, *weights)  # type: ignore[no-untyped-call]  # torch's
    return out
