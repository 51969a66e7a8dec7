"""Message passing on the complete directed graph of N agents (Eq. 4; Kipf et al. 2018), batched over any leading axes.

An edge function f_e reads both ends of an edge, and agent j receives the mean of f_e([x_i, x_j]) over its senders
i != j. Dividing by N - 1 makes one set of weights suit any number of agents.

Each network has two forms, with the same weights and equal outputs up to rounding. The readable one is the equation as
it stands: gather x_i and x_j, concatenate, apply the layers, average over senders. The fast one is what training uses:
the first layer is linear, so it is applied per agent, W [x_i, x_j] = W_s x_i + W_r x_j, and the rest never stores all
edges at once (fast_messages.py). FAST is the one switch between them, for nri and dnri too.

Axis -3 of a tensor of pairs is the sender i, axis -2 the receiver j. Gathered edges are (..., N, N - 1, H): receivers,
then their senders.
"""

import torch
from torch import Tensor, nn

from ssmail.config.sections import ModelSpec
from ssmail.models.fast_messages import sum_over_senders
from ssmail.models.linear import Linear, affine

FAST = True  # False computes every network in its readable form


def edge_ends(agents: int) -> tuple[Tensor, Tensor]:
    """Return the senders and the receivers (N, N - 1) of all edges: row j holds the edges that end in agent j."""
    receivers = torch.arange(agents).unsqueeze(-1).expand(agents, agents - 1)
    senders = torch.arange(agents - 1).expand(agents, agents - 1)
    return senders + (senders >= receivers), receivers  # no edge from j to itself


def both_ends(x: Tensor) -> Tensor:
    """Gather [x_i, x_j] of every edge: x (..., N, D) -> (..., N, N - 1, 2 * D)."""
    senders, receivers = edge_ends(x.shape[-2])
    return torch.cat([x[..., senders, :], x[..., receivers, :]], dim=-1)


def perceptron(inputs: int, hidden: int, outputs: int) -> nn.Sequential:
    """Two linear layers with a SiLU between them."""
    return nn.Sequential(Linear(inputs, hidden), nn.SiLU(), Linear(hidden, outputs))


def sender_weights(agents: int, like: Tensor) -> Tensor:
    """Return the weights (N, N, 1) of the mean over senders: 1 / (N - 1) off the diagonal, 0 on it."""
    self_edges = torch.eye(agents, dtype=like.dtype, device=like.device).unsqueeze(-1)
    return torch.sub(1, self_edges) / max(agents - 1, 1)


def mean_over_senders(pairs: Tensor) -> Tensor:
    """Average over i != j: (..., N, N, H) -> (..., N, H); zeros for a single agent."""
    mean: Tensor = (pairs * sender_weights(pairs.shape[-2], pairs)).sum(dim=-3)
    return mean


class PairLayer(nn.Module):
    """The first layer of an edge function, W [x_i, x_j] + b, where W = [W_s, W_r] acts on sender and receiver."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.sender = Linear(inputs, outputs, bias=False)
        self.receiver = Linear(inputs, outputs)

    def gathered(self, x: Tensor) -> Tensor:
        """Apply the layer to every edge in readable form: x (..., N, D) -> (..., N, N - 1, H)."""
        return self._apply_to(both_ends(x))

    def forward(self, x: Tensor) -> Tensor:
        """Apply the layer to all pairs, the diagonal included: x (..., N, D) -> (..., N, N, H)."""
        if not FAST:
            x_i = x.unsqueeze(-2).expand(*x.shape[:-1], x.shape[-2], -1)  # (..., N, N, D)
            return self._apply_to(torch.cat([x_i, x.unsqueeze(-3).expand_as(x_i)], dim=-1))
        pairs: Tensor = self.sender(x).unsqueeze(-2) + self.receiver(x).unsqueeze(-3)
        return pairs

    def _apply_to(self, ends: Tensor) -> Tensor:
        weight = torch.cat([self.sender.weight, self.receiver.weight], dim=-1)
        return affine(ends, weight, self.receiver.bias)


class EdgeFunction(nn.Module):
    """A two-layer edge function f_e([x_i, x_j])."""

    def __init__(self, inputs: int, hidden: int, outputs: int) -> None:
        super().__init__()
        self.first = PairLayer(inputs, hidden)
        self.second = Linear(hidden, outputs)

    def forward(self, x: Tensor) -> Tensor:
        """Return the edge embeddings h_(i,j) of all pairs: x (..., N, D) -> (..., N, N, H)."""
        out: Tensor = self.second(torch.relu(self.first(x)))
        return out

    def messages(self, x: Tensor) -> Tensor:
        """Return the mean of the embeddings over senders: x (..., N, D) -> (..., N, H)."""
        agents = x.shape[-2]
        if not FAST:
            if agents == 1:  # without senders, the bias is what remains
                return affine(x.new_zeros(*x.shape[:-1], self.second.in_features), self.second.weight, self.second.bias)
            embedded: Tensor = self.second(torch.relu(self.first.gathered(x)))  # (..., N, N - 1, H)
            return embedded.mean(dim=-2)
        # The second layer is linear too, so it follows the mean.
        s, r = self.first.sender(x).unsqueeze(-2), self.first.receiver(x).unsqueeze(-2)
        out: Tensor = self.second(sum_over_senders(s, r, sender_weights(agents, x)).squeeze(-2))
        return out

    def messages_to_one(self, receiver: Tensor, senders: Tensor) -> Tensor:
        """Return the mean message to a single agent: receiver (..., D) and senders (..., N - 1, D) -> (..., H).

        Leading axes broadcast, so many receivers can share the senders' part of the first layer.
        """
        pairs = self.first.sender(senders) + self.first.receiver(receiver).unsqueeze(-2)  # (..., N - 1, H)
        mean = torch.relu_(pairs).sum(dim=-2) / max(senders.shape[-2], 1)
        out: Tensor = self.second(mean)
        return out


class TypedMessages(nn.Module):
    """The messages of G-SAC (section 3.2.2): sum_k z_ijk f_e^k([x_i, x_j]), averaged over the senders i.

    z is the sampled graph, and every edge type k has its own function of two layers. With `first_type_is_none` the
    first type has no function: no message flows along its edges.
    """

    def __init__(self, inputs: int, spec: ModelSpec) -> None:
        super().__init__()
        hidden = spec.hidden
        self.skipped = int(spec.first_type_is_none)
        self.types = spec.edge_types - self.skipped
        self.first = PairLayer(inputs, hidden * self.types)
        self.second = Linear(hidden * self.types, hidden, bias=False)
        self.type_bias = Linear(self.types, hidden, bias=False)
        with torch.no_grad():
            self.type_bias.weight.mul_(spec.graph_gain)

    def forward(self, x: Tensor, graph: Tensor) -> Tensor:
        """Map x (..., N, D) and graph (..., N, N, K) to the mean messages (..., N, H)."""
        return self._per_agent(x, graph) if FAST else self._per_edge(x, graph)

    def _per_edge(self, x: Tensor, graph: Tensor) -> Tensor:
        """The readable form."""
        senders, receivers = edge_ends(x.shape[-2])
        z = graph[..., senders, receivers, self.skipped :]  # (..., N, N - 1, K)
        hidden = torch.relu(self.first.gathered(x))
        layers = zip(
            hidden.chunk(self.types, dim=-1),  # (..., N, N - 1, H) of each type
            self.second.weight.chunk(self.types, dim=-1),
            self.type_bias.weight.unbind(dim=-1),
            strict=True,
        )
        f = torch.stack([affine(h, weight, bias) for h, weight, bias in layers], dim=-2)  # f_e^k([x_i, x_j])
        return (z.unsqueeze(-1) * f).sum(dim=(-3, -2)) / max(x.shape[-2] - 1, 1)

    def _per_agent(self, x: Tensor, graph: Tensor) -> Tensor:
        """The fast form: the second layers are linear, so they follow the mean, N products instead of N * N."""
        weights = graph[..., self.skipped :] * sender_weights(x.shape[-2], x)
        s, r = (layer(x).unflatten(-1, (self.types, -1)) for layer in (self.first.sender, self.first.receiver))
        received = sum_over_senders(s, r, weights).flatten(-2)  # (..., N, K * H)
        messages: Tensor = self.second(received) + self.type_bias(weights.sum(dim=-3))
        return messages
