"""The graph encoder (section 3.2.1): node -> edge -> node -> edge messages, an LSTM per edge, a softmax over edge
types.

As in the paper there is no prior network. The paper leaves open how the graph is *sampled*, and it matters: the sampled
graph is the only randomness that a whole group shares. A graph is the arg max of logits plus Gumbel noise; `GraphNoise`
decides over which edges and steps one draw is shared. With one draw for all edges and the whole trajectory, the
marginal distribution of every edge at every step is still exactly the softmax, but the group commits to one graph and
so to one of the expert's modes (docs/paper.md).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor, nn

from ssmail.models.fast_messages import between_different
from ssmail.models.linear import ALIGNED, Linear, affine
from ssmail.models.message_passing import EdgeFunction, mean_over_senders, perceptron, sender_weights

Memory = tuple[Tensor, Tensor]  # the LSTM's hidden and cell state, each (1, B * N * (N - 1), H)

EDGES = 2**10  # whose LSTM is computed at once


class EdgeLSTM(nn.LSTM):
    """A one-layer LSTM along every edge, or those of S seeds, whose memory then begins with an axis S."""

    def forward(self, sequences: Tensor, memory: Memory | None = None) -> tuple[Tensor, Memory]:  # type: ignore[override]
        """Map sequences (T, E, D) to outputs (T, E, H) and the memory; both may begin with an axis S."""
        weights: Sequence[Tensor] = self.all_weights[0]
        if weights[0].dim() == 2:
            return remember(weights, sequences, memory)
        memories = [None] * len(sequences) if memory is None else list(zip(*memory, strict=True))
        made = [remember([w[s] for w in weights], sequences[s], memories[s]) for s in range(len(sequences))]
        outputs, hidden, cells = zip(*((out, *kept) for out, kept in made), strict=True)
        return torch.stack(outputs), (torch.stack(hidden), torch.stack(cells))


class GraphEncoder(nn.Module):
    """Logits of the K edge types of every ordered pair, given the history so far."""

    def __init__(self, inputs: int, hidden: int, edge_types: int) -> None:
        super().__init__()
        self.edges_in = EdgeFunction(inputs, hidden, hidden)
        self.nodes = perceptron(hidden + inputs, hidden, hidden)
        self.edges_out = EdgeFunction(hidden, hidden, hidden)
        self.lstm = EdgeLSTM(hidden, hidden)
        self.head = Linear(hidden, edge_types)

    def forward(self, x: Tensor, memory: Memory | None = None) -> tuple[Tensor, Memory]:
        """Map x (B, T, N, D) to logits (B, T, N, N, K) and the memory after the last step.

        With the weights of S seeds, all of them have another axis S in front. The logits of step t depend on
        x[:, : t + 1] only.
        """
        sequences = self._embed(x)
        embedded, memory = self.lstm(sequences.flatten(-3, -2), memory)
        return self._logits(embedded, sequences, x.shape[-2]), memory

    @torch.no_grad()
    def logits_after(self, x: Tensor, steps: Tensor, next_x: Tensor) -> Tensor:
        """Return the logits (S, B, C, N, N, K) of histories that end otherwise: with next_x (S, B, C, N, D), which
        follows x (S, B, T, N, D) after its steps (S, C). For the weights of S seeds.
        """
        w_in, w_hidden, b_in, b_hidden = self.lstm.all_weights[0]

        def gated(read: Tensor, hidden: Tensor) -> Sequence[Tensor]:
            i, f, g, o = (affine(read, w_in, b_in + b_hidden) + affine(hidden, w_hidden, None)).chunk(4, dim=-1)
            return g.tanh() * i.sigmoid(), f.sigmoid(), o.sigmoid()

        # Only the cell's states are missing in the outputs of the LSTM: c <- f c + i g.
        sequences = self._embed(x).flatten(-3, -2)  # (S, T, edges, H)
        hidden, _ = self.lstm(sequences)
        added, kept, _ = gated(sequences, nn.functional.pad(hidden[:, :-1], (0, 0, 0, 0, 1, 0)))
        cells = [added[:, 0]]
        for t in range(1, sequences.shape[1]):
            cells.append(torch.addcmul(added[:, t], kept[:, t], cells[-1]))
        # One more step from each of them.
        seeds = torch.arange(len(x), device=x.device).unsqueeze(1)
        following = self._embed(next_x)
        added, kept, out = gated(following.flatten(-3, -2), hidden[seeds, steps])
        cell = added + kept * torch.stack(cells, dim=1)[seeds, steps]
        return self._logits(out * cell.tanh(), following, x.shape[-2])

    def _embed(self, x: Tensor) -> Tensor:
        """Embed the edges at every step: x (B, T, N, D) -> (T, B, N * (N - 1), H)."""
        edges = self.edges_in(x)  # (B, T, N, N, H), sender first
        nodes = self.nodes(torch.cat([mean_over_senders(edges), x], dim=-1))
        edges = torch.relu(self.edges_out(nodes) + edges)
        return off_diagonal(edges).transpose(-4, -3)

    def _logits(self, remembered: Tensor, like: Tensor, agents: int) -> Tensor:
        """Map the LSTM's outputs (T, B * N * (N - 1), H) to logits (B, T, N, N, K); `like` is what `_embed` returns."""
        logits = self.head(remembered).unflatten(-2, like.shape[-3:-1])  # (T, B, N * (N - 1), K)
        return on_diagonal(logits.transpose(-4, -3), agents)


def remember(weights: Sequence[Tensor], sequences: Tensor, memory: Memory | None) -> tuple[Tensor, Memory]:
    """Run a one-layer LSTM over sequences (T, edges, D); return its outputs (T, edges, H) and its memory.

    Steps come first because torch's LSTM would copy otherwise. Edges do not depend on each other, so some are computed
    after the other, which keeps their gates in the processor's cache.
    """
    steps, edges, _ = sequences.shape
    if memory is None:
        zeros = sequences.new_zeros(1, edges, weights[1].shape[1])
        memory = (zeros, zeros)
    if not edges:
        return sequences.new_zeros(steps, 0, weights[1].shape[1]), memory
    parts = zip(*(torch.split(part, EDGES, dim=1) for part in (sequences, *memory)), strict=True)
    found = [_advance(weights, *part) for part in parts]
    embedded, hidden, cell = found[0] if len(found) == 1 else (torch.cat(p, dim=1) for p in zip(*found, strict=True))
    return embedded, (hidden, cell)


def _advance(
    weights: Sequence[Tensor], sequences: Tensor, hidden: Tensor, cell: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Return outputs, hidden and cell state. A single step calls the cell, which costs half as much."""
    if len(sequences) > 1:
        recorded = torch.is_grad_enabled()
        made = torch.lstm(sequences, (hidden, cell), list(weights), True, 1, 0.0, recorded, False, False)
        return made[0], made[1], made[2]
    hidden, cell = torch.lstm_cell(sequences[0], [hidden[0], cell[0]], *weights)
    return hidden.unsqueeze(0), hidden.unsqueeze(0), cell.unsqueeze(0)


def off_diagonal(pairs: Tensor) -> Tensor:
    """Select the edges between different agents, row by row: (..., N, N, H) -> (..., N * (N - 1), H)."""
    *lead, n, _, h = pairs.shape
    return between_different(pairs.flatten(0, -4)).reshape(*lead, n * (n - 1), h)


def on_diagonal(edges: Tensor, agents: int) -> Tensor:
    """Invert `off_diagonal`, with zeros on the diagonal."""
    *lead, _, h = edges.shape
    n = agents
    rows = nn.functional.pad(edges.reshape(*lead, n - 1, n, h), (0, 0, 0, 1)).view(*lead, (n - 1) * (n + 1), h)
    return nn.functional.pad(rows, (0, 0, 1, 0)).view(*lead, n, n, h)


@dataclass(frozen=True)
class GraphNoise:
    """Which edges and steps share a draw of Gumbel noise.

    shared: with "shared" all edges of a graph share one draw, with "edge" each has its own; with "none" there is no
    noise, and the sampled graph is the most likely one.
    resample: with "trajectory" a draw holds for the whole trajectory, with "step" it is renewed at every step.
    """

    shared: Literal["shared", "edge", "none"]
    resample: Literal["trajectory", "step"]

    def draw(self, batch: int, steps: int, agents: int, edge_types: int, generator: torch.Generator) -> Tensor:
        """Draw Gumbel noise that broadcasts to (B, T, N, N, K): axes over which it is shared have length 1."""
        if self.shared == "none":
            return torch.zeros(batch, 1, 1, 1, edge_types)
        n = 1 if self.shared == "shared" else agents
        t = 1 if self.resample == "trajectory" else steps
        uniform = torch.rand(batch, t, n, n, edge_types, generator=generator)
        return -torch.log(-torch.log(uniform.clamp(1e-6, 1 - 1e-6)))


def sample_graph(logits: Tensor, noise: Tensor, temperature: float) -> Tensor:
    """Sample one-hot edge types (..., K) as arg max(logits + Gumbel noise).

    The gradient is that of the softmax at `temperature` (straight-through Gumbel-softmax).
    """
    soft = few_way_softmax((logits + noise) / temperature)
    chosen = soft.detach().argmax(dim=-1, keepdim=True)
    hard = torch.zeros_like(soft).scatter_(-1, chosen, 1.0)
    return hard + soft - soft.detach()


def few_way_softmax(x: Tensor) -> Tensor:
    """Softmax over the last axis (..., K). For two or three edge types, torch's takes several times as long."""
    weights = (x - x.detach().amax(dim=-1, keepdim=True)).exp()
    return weights / weights.sum(dim=-1, keepdim=True)


def edge_entropy(logits: Tensor) -> Tensor:
    """Return the mean entropy (...) of the edges' types in nats, between 0 and log K, given logits (..., N, N, K).

    The diagonal is no edge; a single agent has none, and the entropy 0.
    """
    n, size = logits.shape[-2], logits.shape[1:-1].numel()
    # Without padding, seeds trained together would differ from the same ones alone in the last bit (ALIGNED). The last
    # axis is slow for small K.
    whole = nn.functional.pad(logits.flatten(1, -2), (0, 0, 0, -size % ALIGNED))
    log_p = torch.log_softmax(whole.movedim(-1, 0).contiguous(), dim=0)
    entropies = -(log_p.exp() * log_p).sum(dim=0)[:, :size].view(logits.shape[:-1])
    return (entropies * sender_weights(n, logits).squeeze(-1)).sum(dim=(-2, -1)) / n
