"""nri and dnri with the operations that the original performs, in its order, on the weights of our networks.

The DNRI authors' code (github.com/cgraber/cvpr_dNRI) gathers both ends of every edge, concatenates them, applies the
layers of Kipf et al. 2018 one operation after the other, and adds up messages by a product with a one-hot matrix of
receivers. Agents precede steps in the encoder, and edges precede steps in the LSTMs; the decoder advances step by step,
output layers included. Written from that description, without code of theirs; its results are those of `ssmail.models`.
Its time is close to the original's (docs/experiments.md), so it is what the fast form is compared with.
"""

import torch
from torch import Tensor, nn

from ssmail.models.decoders import MessageDecoder, RecurrentDecoder
from ssmail.models.message_passing import edge_ends
from ssmail.models.variational_encoder import (
    DynamicEncoder,
    EdgeEmbedding,
    EdgePerceptron,
    NodePerceptron,
    StaticEncoder,
    WindowEncoder,
    edge_graph,
)

elu = nn.functional.elu


def ends(x: Tensor) -> Tensor:
    """Gather and concatenate both ends of every edge: x (B, N, ...) -> (B, N * (N - 1), ..., 2 * D)."""
    senders, receivers = (index.flatten() for index in edge_ends(x.shape[1]))
    return torch.cat([x[:, senders], x[:, receivers]], dim=-1)


def receivers_of(agents: int, like: Tensor) -> Tensor:
    """Return the one-hot matrix (N, N * (N - 1)) of the receivers of all edges."""
    return nn.functional.one_hot(edge_ends(agents)[1].flatten()).t().to(like.dtype)


def normed(norm: nn.Module, x: Tensor) -> Tensor:
    """Apply batch norm to the last axis of x, or nothing."""
    if not isinstance(norm, nn.BatchNorm1d):
        return x
    return nn.BatchNorm1d.forward(norm, x.reshape(-1, x.shape[-1])).view(x.shape)


def nodes(layer: NodePerceptron, x: Tensor) -> Tensor:
    """Apply a perceptron to each agent: (B, N, ..., D) -> (B, N, ..., H)."""
    return normed(layer.norm, elu(layer.second(elu(layer.first(x), inplace=True)), inplace=True))


def edges(layer: EdgePerceptron, inputs: Tensor) -> Tensor:
    """Apply a perceptron to the concatenated inputs of each edge."""
    weights = [layer.sender.weight, layer.receiver.weight, *([] if layer.edge is None else [layer.edge.weight])]
    first = elu(nn.functional.linear(inputs, torch.cat(weights, dim=1), layer.receiver.bias), inplace=True)
    return normed(layer.norm, elu(layer.second(first), inplace=True))


def embed(layers: EdgeEmbedding, x: Tensor) -> Tensor:
    """Embed the edges of x (B, N, ..., F), receiver by receiver: (B, N * (N - 1), ..., H)."""
    n = x.shape[1]
    skip = edges(layers.edges_in, ends(nodes(layers.nodes_in, x)))
    received = torch.matmul(receivers_of(n, x), skip.flatten(2)).view(len(x), n, *skip.shape[2:]) / (n - 1)
    return edges(layers.edges_out, torch.cat([ends(nodes(layers.nodes, received)), skip], dim=-1))


def lstm(layer: nn.LSTM, x: Tensor) -> Tensor:
    """Run an LSTM over sequences (edges, T, D)."""
    start = x.new_zeros(1, len(x), layer.hidden_size)
    return torch.lstm(x, (start, start), layer.all_weights[0], True, 1, 0.0, True, False, True)[0]


def encode(encoder: nn.Module, x: Tensor) -> Tensor | tuple[Tensor, Tensor]:
    """Return what the encoder returns for x (B, T, N, F)."""
    b, t, n, _ = x.shape

    def graph(logits: Tensor) -> Tensor:
        return edge_graph(logits.view(b, n, n - 1, -1, logits.shape[-1]).permute(0, 3, 1, 2, 4))

    if isinstance(encoder, WindowEncoder):
        assert (encoder.steps, encoder.moving) == (t, x.shape[-1])  # whole windows without constant features
        return graph(encoder.head(embed(encoder.embedding, x.permute(0, 2, 3, 1).flatten(2))))
    assert isinstance(encoder, StaticEncoder | DynamicEncoder)
    embedded = embed(encoder.embedding, x.transpose(1, 2).contiguous())  # (B, N * (N - 1), T, H)
    if isinstance(encoder, StaticEncoder):
        return graph(encoder.head(embedded.mean(dim=2)))
    sequences = embedded.flatten(0, 1)
    past = lstm(encoder.past, sequences)
    future = lstm(encoder.future, sequences.flip(1)).flip(1)
    return graph(encoder.prior_head(past)), graph(encoder.posterior_head(torch.cat([past, future], dim=-1)))


def received_messages(decoder: MessageDecoder | RecurrentDecoder, x: Tensor, graph: Tensor, one_hot: Tensor) -> Tensor:
    """Return the mean messages (B, N, H): x is (B, N, D), graph (B, N * (N - 1), K)."""
    pairs, messages = ends(x), decoder.messages
    total = pairs.new_zeros(*pairs.shape[:2], messages.size)
    for kind, layer in enumerate(messages.types, start=messages.skipped):
        weight = torch.cat([layer.first.sender.weight, layer.first.receiver.weight], dim=1)
        sent = layer.activation.plain(nn.functional.linear(pairs, weight, layer.first.receiver.bias))
        total += layer.activation.plain(layer.second(sent)) * graph[:, :, kind : kind + 1]
    return total.transpose(-2, -1).matmul(one_hot).transpose(-2, -1).contiguous() / (x.shape[1] - 1)


def decode(
    decoder: MessageDecoder | RecurrentDecoder, x: Tensor, graph: Tensor, memory: Tensor | None = None
) -> tuple[Tensor, Tensor | None]:
    """Return what the decoder returns for x (B, T, N, F) and graph (B, T or 1, N, N, K)."""
    b, t, n, _ = x.shape
    one_hot, a = receivers_of(n, x).t(), decoder.action_size
    senders, receivers = (index.flatten() for index in edge_ends(n))
    listed = graph[:, :, senders, receivers].expand(-1, t, -1, -1)
    if isinstance(decoder, RecurrentDecoder) and memory is None:
        memory = x.new_zeros(b, n, decoder.size)
    velocities = []
    for step in range(t):
        now = x[:, step]
        if isinstance(decoder, RecurrentDecoder):
            assert memory is not None
            messages = received_messages(decoder, memory, listed[:, step], one_hot)
            inputs = [nn.functional.linear(now, w, bias) for w, bias in thirds(decoder.inputs)]
            sent = [nn.functional.linear(messages, w) for w, _ in thirds(decoder.received)]
            reset, update = (torch.sigmoid(inputs[k] + sent[k]) for k in (0, 1))
            memory = (1 - update) * torch.tanh(inputs[2] + reset * sent[2]) + update * memory
            read = memory
        else:
            read = torch.cat([now, received_messages(decoder, now, listed[:, step], one_hot)], dim=-1)
        velocities.append(now[..., a : 2 * a] + decoder.head(read))
    return torch.stack(velocities, dim=1), memory


def thirds(layer: nn.Linear) -> list[tuple[Tensor, Tensor | None]]:
    """Return weights and biases of the three layers that are kept as one."""
    biases = [None] * 3 if layer.bias is None else layer.bias.chunk(3)
    return list(zip(layer.weight.chunk(3), biases, strict=True))


def in_plain_form(network: nn.Module) -> None:
    """Make an encoder or a decoder compute its results in this form. Weights, names and hooks stay as they are."""
    if isinstance(network, MessageDecoder | RecurrentDecoder):
        network.forward = lambda *inputs: decode(network, *inputs)
    else:
        network.forward = lambda x: encode(network, x)
