"""The plain form of nri's and dnri's message passing: both ends of each edge gathered by index, concatenated, a full
first layer per edge, and messages added up by index.

Each class wraps a network of ssmail.models and computes the same function from the same weights, so that values,
gradients and times can be compared. Nothing here is imported by ssmail.
"""

import torch
from torch import Tensor, nn

from ssmail.models.decoders import ActivatedMessages, MessageDecoder, PairPerceptron, RecurrentDecoder
from ssmail.models.edge_layers import RELU, TANH
from ssmail.models.edge_perceptron import EdgePerceptron, NodePerceptron
from ssmail.models.variational_encoder import DynamicEncoder, EdgeEmbedding, StaticEncoder


def edge_ends(agents: int) -> tuple[Tensor, Tensor]:
    """Senders and receivers (E,) of the E = N * (N - 1) edges, sender by sender."""
    senders, receivers = torch.nonzero(1 - torch.eye(agents), as_tuple=True)
    return senders, receivers


def mean_by_receiver(edges: Tensor, agents: int) -> Tensor:
    """(B, T, E, H) -> (B, T, N, H)."""
    _, receivers = edge_ends(agents)
    total = edges.new_zeros(*edges.shape[:2], agents, edges.shape[-1]).index_add(2, receivers, edges)
    return total / max(agents - 1, 1)


def normalised(norm: nn.Module, x: Tensor) -> Tensor:
    """Batch norm, if any, of all vectors of (..., H)."""
    if not isinstance(norm, nn.BatchNorm1d) or not x.numel():
        return x
    flat = nn.functional.batch_norm(
        x.reshape(-1, x.shape[-1]), norm.running_mean, norm.running_var, norm.weight, norm.bias, norm.training
    )
    return flat.view(x.shape)


def on_nodes(perceptron: NodePerceptron, x: Tensor) -> Tensor:
    h = nn.functional.elu(perceptron.first(x))
    return normalised(perceptron.norm, nn.functional.elu(perceptron.second(h)))


def on_ends(x: Tensor, sender: nn.Linear, receiver: nn.Linear, *skip: tuple[Tensor, nn.Linear]) -> Tensor:
    """One full linear layer of [x_sender, x_receiver, the edge's own inputs]: x (B, T, N, D) -> (B, T, E, H)."""
    senders, receivers = edge_ends(x.shape[2])
    inputs = [x[:, :, senders], x[:, :, receivers], *(edges for edges, _ in skip)]
    weights = [sender.weight, receiver.weight, *(layer.weight for _, layer in skip)]
    return nn.functional.linear(torch.cat(inputs, dim=-1), torch.cat(weights, dim=1), receiver.bias)


def on_edges(perceptron: EdgePerceptron, x: Tensor, *skip: Tensor) -> Tensor:
    """x (B, T, N, D) and the edges (B, T, E, D') of a skip connection -> (B, T, E, H)."""
    first = on_ends(x, perceptron.sender, perceptron.receiver, *((edges, perceptron.edge) for edges in skip))
    h = nn.functional.elu(perceptron.second(nn.functional.elu(first)))
    return normalised(perceptron.norm, h)


def messages_of(perceptron: PairPerceptron, x: Tensor) -> Tensor:
    first = on_ends(x, perceptron.first.sender, perceptron.first.receiver)
    activation = {TANH: torch.tanh, RELU: torch.relu}[perceptron.activation]
    return activation(perceptron.second(activation(first)))


class GatherEmbedding(nn.Module):
    def __init__(self, dense: EdgeEmbedding) -> None:
        super().__init__()
        self.dense = dense

    def forward(self, x: Tensor) -> Tensor:
        """x (B, T, N, F) -> (B, T, E, H), sender by sender."""
        edges = on_edges(self.dense.edges_in, on_nodes(self.dense.nodes_in, x))
        nodes = on_nodes(self.dense.nodes, mean_by_receiver(edges, x.shape[2]))
        return on_edges(self.dense.edges_out, nodes, edges)


def as_graph(logits: Tensor, agents: int) -> Tensor:
    """(B, T, E, K) -> (B, T, N, N, K)."""
    senders, receivers = edge_ends(agents)
    b, t, _, k = logits.shape
    flat = logits.new_zeros(b, t, agents * agents, k).index_copy(2, senders * agents + receivers, logits)
    return flat.view(b, t, agents, agents, k)


class GatherStaticEncoder(nn.Module):
    def __init__(self, dense: StaticEncoder) -> None:
        super().__init__()
        self.dense = dense

    def forward(self, x: Tensor) -> Tensor:
        mean = GatherEmbedding(self.dense.embedding)(x).mean(dim=1, keepdim=True)
        return as_graph(self.dense.head(mean), x.shape[2])


class GatherDynamicEncoder(nn.Module):
    def __init__(self, dense: DynamicEncoder) -> None:
        super().__init__()
        self.dense = dense

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor]:
        edges = GatherEmbedding(self.dense.embedding)(x)
        b, t, e, h = edges.shape
        sequences = edges.transpose(0, 1).reshape(t, b * e, h)
        if e == 0:
            nothing = x.new_zeros(b, t, x.shape[2], x.shape[2], self.dense.prior_head[-1].out_features)
            return nothing, nothing
        past = self.dense.past(sequences)[0]
        both = torch.cat([past, self.dense.future(sequences.flip(0))[0].flip(0)], dim=-1)
        prior = self.dense.prior_head(past).view(t, b, e, -1).transpose(0, 1)
        posterior = self.dense.posterior_head(both).view(t, b, e, -1).transpose(0, 1)
        return as_graph(prior, x.shape[2]), as_graph(posterior, x.shape[2])


def received(messages: ActivatedMessages, x: Tensor, graph: Tensor) -> Tensor:
    """x (B, T, N, D), graph (B, T or 1, N, N, K) -> (B, T, N, H)."""
    senders, receivers = edge_ends(x.shape[2])
    total = x.new_zeros(*x.shape[:3], messages.size)
    for kind, perceptron in enumerate(messages.types, start=messages.skipped):
        sent = messages_of(perceptron, x) * graph[:, :, senders, receivers, kind].unsqueeze(-1)
        total = total + mean_by_receiver(sent, x.shape[2])
    return total


class GatherMessageDecoder(nn.Module):
    def __init__(self, dense: MessageDecoder) -> None:
        super().__init__()
        self.dense = dense

    def forward(self, x: Tensor, graph: Tensor) -> tuple[Tensor, None]:
        a = self.dense.action_size
        inputs = torch.cat([x, received(self.dense.messages, x, graph)], dim=-1)
        return x[..., a : 2 * a] + self.dense.head(inputs), None


class GatherRecurrentDecoder(nn.Module):
    def __init__(self, dense: RecurrentDecoder) -> None:
        super().__init__()
        self.dense = dense

    def forward(self, x: Tensor, graph: Tensor, memory: Tensor | None = None) -> tuple[Tensor, Tensor]:
        dense, a = self.dense, self.dense.action_size
        b, t, n, _ = x.shape
        hidden = x.new_zeros(b, n, dense.size) if memory is None else memory
        velocities = []
        for step in range(t):
            now = graph[:, step : step + 1] if graph.shape[1] > 1 else graph
            message = dense.received(received(dense.messages, hidden.unsqueeze(1), now).squeeze(1))
            own = dense.inputs(x[:, step])
            (r, z, c), (mr, mz, mc) = own.chunk(3, dim=-1), message.chunk(3, dim=-1)
            update = torch.sigmoid(z + mz)
            hidden = (1 - update) * torch.tanh(c + torch.sigmoid(r + mr) * mc) + update * hidden
            velocities.append(x[:, step, :, a : 2 * a] + dense.head(hidden))
        return torch.stack(velocities, dim=1), hidden


def make_plain(encoder: DynamicEncoder | StaticEncoder, decoder: MessageDecoder | RecurrentDecoder) -> None:
    """Give these networks the plain forward pass, with the weights and the names that they have."""
    in_full = GatherDynamicEncoder if isinstance(encoder, DynamicEncoder) else GatherStaticEncoder
    encoder.forward = in_full(encoder).forward
    by_index = GatherMessageDecoder if isinstance(decoder, MessageDecoder) else GatherRecurrentDecoder
    decoder.forward = by_index(decoder).forward
