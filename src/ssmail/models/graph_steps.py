"""The graph encoder one step at a time, for many trajectories and without gradients.

Computes the equations of graph_encoder.py, with the features as the first axis and the pairs as the last one. Each
number of an edge is then a long row: all gates of the LSTM are one product and one logistic function, and nothing is
gathered or copied. That takes less than half the time. Read this module for speed only; a test compares the two.
"""

import torch
from torch import Tensor, nn

from ssmail.models.graph_encoder import GraphEncoder, Memory, on_diagonal
from ssmail.models.message_passing import EdgeFunction


class GraphSteps:
    """Infers and samples the graph of B trajectories of N agents, step after step.

    memory: the encoder's, (1, B * N * (N - 1), H), or None before the first step.
    """

    def __init__(self, encoder: GraphEncoder, memory: Memory | None, batch: int, agents: int) -> None:
        self.encoder, self.batch, self.agents = encoder, batch, agents
        h = encoder.lstm.hidden_size
        of_input, of_hidden, input_bias, hidden_bias = encoder.lstm.all_weights[0]
        # The candidate's tanh(x) is 2 s(2 x) - 1 with the logistic function s of the three gates.
        scale = torch.ones_like(input_bias)
        scale[2 * h : 3 * h] = 2
        self.weight = scale.unsqueeze(1) * torch.cat([of_input, of_hidden], dim=1)
        self.bias = scale * (input_bias + hidden_bias)
        pairs = batch * agents**2
        self.read = of_input.new_zeros(2 * h, pairs)  # the edges, and below them the LSTM's hidden state
        self.cell = of_input.new_zeros(h, pairs)
        if memory is not None:
            self.read[h:], self.cell = (self._of_pairs(part) for part in memory)

    def sample(self, x: Tensor, noise: Tensor) -> Tensor:
        """Map x (B, 1, N, F) to one-hot graphs (B, 1, N, N, K), given the steps so far.

        noise: see `GraphNoise`. The diagonal, where there is no edge, has some type too.
        """
        logits = self._logits(x[:, 0].permute(2, 0, 1).flatten(1))
        scores = logits.view(-1, self.batch, 1, self.agents, self.agents) + noise.movedim(-1, 0)
        # One-hot of the arg max, type by type: torch's is slow over an axis of two or three.
        most, chosen = scores[0], [torch.ones_like(scores[0], dtype=torch.bool)]
        for score in scores[1:]:
            better = score > most
            chosen = [*(before & ~better for before in chosen), better]
            most = torch.maximum(most, score)
        return torch.stack(chosen, dim=-1).to(logits.dtype)

    def _logits(self, x: Tensor) -> Tensor:
        """Map x (F, B * N) to logits (K, B * N * N)."""
        encoder, h = self.encoder, len(self.cell)
        # Node -> edge -> node -> edge.
        edges = self._pairs(encoder.edges_in, x)
        square = edges.view(h, self.batch, self.agents, self.agents)
        others = square.sum(dim=2) - square.diagonal(dim1=2, dim2=3)
        nodes = torch.cat([(others / max(self.agents - 1, 1)).flatten(1), x])
        nodes = encoder.nodes(nodes.T).T.contiguous()
        torch.add(self._pairs(encoder.edges_out, nodes), edges, out=self.read[:h]).relu_()
        # LSTM: c <- f c + i g, h <- o tanh(c).
        gates = torch.addmm(self.bias.unsqueeze(1), self.weight, self.read).sigmoid_()
        i, f, g, o = gates.chunk(4)
        self.cell.mul_(f).addcmul_(i, g.mul_(2).sub_(1))
        torch.mul(o, torch.mul(self.cell, 2, out=g).sigmoid_().mul_(2).sub_(1), out=self.read[h:])
        return _affine(encoder.head, self.read[h:])

    def _pairs(self, function: EdgeFunction, x: Tensor) -> Tensor:
        """Apply an edge function to all pairs, sender first: (F, B * N) -> (H, B * N * N)."""
        sent = (function.first.sender.weight @ x).view(-1, self.batch, self.agents, 1)
        own = _affine(function.first.receiver, x).view(-1, self.batch, 1, self.agents)
        return _affine(function.second, (sent + own).relu_().flatten(1))

    def _of_pairs(self, edges: Tensor) -> Tensor:
        """Arrange a part of the memory (1, B * N * (N - 1), H) as (H, B * N * N), with zeros on the diagonal."""
        by_group = edges.view(self.batch, self.agents * (self.agents - 1), len(self.cell))
        return on_diagonal(by_group, self.agents).permute(3, 0, 1, 2).flatten(1)


def _affine(layer: nn.Linear, x: Tensor) -> Tensor:
    """Apply a layer to the first axis: (F, M) -> (H, M)."""
    return torch.addmm(layer.bias.unsqueeze(1), layer.weight, x)
