"""Message passing on the complete directed graph of N agents (Eq. 4; Kipf et al. 2018), batched over any leading axes.

The first layer of an edge function reads [x_i, x_j]; because it is linear it is applied per node, W [x_i, x_j] = W_s
x_i + W_r x_j, and broadcast to all pairs. That equals gathering both ends of each edge, without the gather. Axis -3 of
a pair tensor is the sender i, axis -2 the receiver j. Sums over senders are divided by N - 1, so that one set of
weights suits any number of agents.
"""

from typing import Any

import torch
from torch import Tensor, nn

from ssmail.config.sections import ModelSpec


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


class SumOverSenders(torch.autograd.Function):
    """sum_i w_ijk relu(s_ik + r_jk), without the tensor of all pairs: sender by sender, forwards and backwards.

    s and r (..., N, K, H), w (..., N, N, K) -> (..., N, K, H). What is computed for a sender stays in the processor's
    cache, and nothing of it is kept for the gradient. Differentiable twice.
    """

    @staticmethod
    def forward(ctx: Any, s: Tensor, r: Tensor, w: Tensor) -> Tensor:
        """See the class."""
        ctx.save_for_backward(s, r, w)
        total = torch.zeros_like(r)
        for i in range(s.shape[-3]):
            total.addcmul_(torch.relu_(s[..., i : i + 1, :, :] + r), w[..., i, :, :].unsqueeze(-1))
        return total

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, Tensor, Tensor | None]:
        """The gradients of s, r and (where it is wanted) w."""
        s, r, w = ctx.saved_tensors
        of_s, of_r, of_w = [], torch.zeros_like(r), []
        for i in range(s.shape[-3]):
            pairs = torch.relu_(s[..., i : i + 1, :, :] + r)
            if ctx.needs_input_grad[2]:
                of_w.append((pairs * gradient).sum(dim=-1))
            weighted = gradient * w[..., i, :, :].unsqueeze(-1)
            through = torch.ops.aten.threshold_backward(weighted, pairs, 0)
            of_r += through
            of_s.append(through.sum(dim=-3))
        return torch.stack(of_s, dim=-3), of_r, torch.stack(of_w, dim=-3) if of_w else None


DENSE_UP_TO = 8  # agents: up to so many, all pairs at once are faster than sender by sender


def sum_over_senders(s: Tensor, r: Tensor, w: Tensor) -> Tensor:
    """sum_i w_ijk relu(s_ik + r_jk), in the form that is faster for this number of agents; see SumOverSenders."""
    if s.shape[-3] > DENSE_UP_TO:
        total: Tensor = SumOverSenders.apply(s, r, w)  # type: ignore[no-untyped-call]  # torch's
        return total
    pairs = torch.relu_(s.unsqueeze(-3) + r.unsqueeze(-4))
    return (pairs * w.unsqueeze(-1)).sum(dim=-4)


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
        s, r = self.first.sender(x).unsqueeze(-2), self.first.receiver(x).unsqueeze(-2)
        out: Tensor = self.second(sum_over_senders(s, r, others(x.shape[-2], x)).squeeze(-2))
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
        s, r = (layer(x).unflatten(-1, (self.types, -1)) for layer in (self.first.sender, self.first.receiver))
        received = sum_over_senders(s, r, weights).flatten(-2)
        messages: Tensor = self.second(received) + self.type_bias(weights.sum(dim=-3))
        return messages
