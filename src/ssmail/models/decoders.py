"""The decoders of NRI and DNRI: the next velocity of each agent, given a graph (Kipf et al. 2018, section 3.2).

Each edge type has its own message perceptron, the messages to an agent are averaged over its senders, and the result is
a residual on the agent's current velocity: an untrained decoder predicts nearly constant velocity. The original has a
residual on the whole state; here the environment integrates the velocity (docs/paper.md), so the position follows.

Inputs x (B, T, N, F) begin with the state [position, velocity] of 2 * A features. Graphs are (B, T, N, N, K), sender
first; their diagonal is ignored. A graph with T = 1 holds for all steps.
"""

import torch
from torch import Tensor, nn

from ssmail.config.sections import VariationalSpec
from ssmail.models import message_passing
from ssmail.models.fast_messages import RELU, TANH, Activation, EdgeLayers
from ssmail.models.graph_encoder import off_diagonal
from ssmail.models.message_passing import PairLayer


class PairPerceptron(nn.Module):
    """act(W_2 act(W_1 [x_i, x_j] + b_1) + b_2) for the edge from i to j."""

    def __init__(self, inputs: int, hidden: int, activation: Activation) -> None:
        super().__init__()
        self.first = PairLayer(inputs, hidden)
        self.second = nn.Linear(hidden, hidden)
        self.activation = activation

    def forward(self, x: Tensor, weights: Tensor) -> Tensor:
        """Return the sum of the messages over senders (B, T, N, H), weighted with `weights` (B, T, N, N - 1), receiver
        by receiver; x is (B, T, N, D).
        """
        if not message_passing.FAST:
            act = self.activation.plain
            messages = act(self.second(act(self.first.gathered(x))))  # (B, T, N, N - 1, H)
            return (weights.unsqueeze(-1) * messages).sum(dim=-2)
        sent, own = self.first.sender(x), self.first.receiver(x)
        second = self.second.weight, self.second.bias
        received: Tensor = EdgeLayers.apply(sent, own, None, None, *second, weights, self.activation)[1]  # type: ignore[no-untyped-call]  # torch's
        return received


class ActivatedMessages(nn.Module):
    """The mean over senders i of sum_k z_ijk f_k([x_i, x_j]).

    Unlike in TypedMessages, f_k ends in an activation, as in NRI, so its second layer is applied to every edge. With
    `first_type_is_none` the first type has no f_k and carries no messages.
    """

    def __init__(self, inputs: int, spec: VariationalSpec, activation: Activation) -> None:
        super().__init__()
        self.skipped = int(spec.first_type_is_none)
        self.size = spec.decoder_hidden
        self.types = nn.ModuleList(
            PairPerceptron(inputs, self.size, activation) for _ in range(spec.edge_types - self.skipped)
        )

    def weights(self, graph: Tensor) -> Tensor:
        """Return z_ijk / (N - 1), receiver by receiver, (B, T, N, N - 1, K), without the type that carries no messages;
        graph is (B, T, N, N, K).
        """
        n = graph.shape[2]
        edges = off_diagonal(graph[..., self.skipped :].transpose(2, 3))
        return edges.reshape(*edges.shape[:2], n, n - 1, edges.shape[-1]) / max(n - 1, 1)

    def forward(self, x: Tensor, weights: Tensor) -> Tensor:
        """Map x (B, T, N, D) and the `weights` of a graph to the messages received (B, T, N, H)."""
        received = x.new_zeros(*x.shape[:-1], self.size)
        if x.shape[2] == 1:
            return received
        for function, weight in zip(self.types, weights.expand(-1, x.shape[1], -1, -1, -1).unbind(-1), strict=True):
            received = received + function(x, weight)
        return received


def motion_head(inputs: int, hidden: int, action_size: int) -> nn.Sequential:
    """Three layers that map (..., inputs) to (..., A); the last one is initialized with small weights."""
    last = nn.Linear(hidden, action_size)
    with torch.no_grad():
        last.weight.mul_(0.1)
        last.bias.zero_()
    return nn.Sequential(nn.Linear(inputs, hidden), nn.ReLU(), nn.Linear(hidden, hidden), nn.ReLU(), last)


class MessageDecoder(nn.Module):
    """For small systems: the messages read the inputs of the two agents; there is no memory."""

    def __init__(self, inputs: int, action_size: int, spec: VariationalSpec) -> None:
        super().__init__()
        self.action_size = action_size
        self.messages = ActivatedMessages(inputs, spec, RELU)
        self.head = motion_head(inputs + spec.decoder_hidden, spec.decoder_hidden, action_size)

    def forward(self, x: Tensor, graph: Tensor, memory: Tensor | None = None) -> tuple[Tensor, None]:
        """Map x (B, T, N, F) and graph (B, T or 1, N, N, K) to next velocities (B, T, N, A), all steps at once.

        `memory` is there for RecurrentDecoder's sake and always None.
        """
        received = self.messages(x, self.messages.weights(graph))
        a = self.action_size
        return x[..., a : 2 * a] + self.head(torch.cat([x, received], dim=-1)), None


class RecurrentDecoder(nn.Module):
    """For motion: the messages read the hidden states of the two agents, and update each hidden state h through gates.

    With the messages m: reset r = s(W_r x + V_r m), update z = s(W_z x + V_z m), candidate c = tanh(W_c x + r V_c m),
    h <- (1 - z) c + z h; s is the logistic function. Unlike in a GRU, h enters the gates through the messages only, as
    in NRI.
    """

    def __init__(self, inputs: int, action_size: int, spec: VariationalSpec) -> None:
        super().__init__()
        self.action_size, self.size = action_size, spec.decoder_hidden
        self.messages = ActivatedMessages(self.size, spec, TANH)
        self.inputs = nn.Linear(inputs, 3 * self.size)
        self.received = nn.Linear(self.size, 3 * self.size, bias=False)
        self.head = motion_head(self.size, self.size, action_size)

    def forward(self, x: Tensor, graph: Tensor, memory: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Map x (B, T, N, F) and graph (B, T or 1, N, N, K) to next velocities (B, T, N, A), step by step.

        `memory` holds the hidden states (B, N, H) before the first step, zeros if None. Also returns those after the
        last step.
        """
        b, t, n, _ = x.shape
        weights = self.messages.weights(graph).expand(b, t, -1, -1, -1)
        from_inputs = self.inputs(x)
        hidden = x.new_zeros(b, n, self.size) if memory is None else memory
        states = []
        for inputs, weight in zip(from_inputs.unbind(1), torch.split(weights, 1, dim=1), strict=True):
            hidden = self._update(hidden, inputs, weight)
            states.append(hidden)
        a = self.action_size
        return x[..., a : 2 * a] + self.head(torch.stack(states, dim=1)), hidden

    def _update(self, hidden: Tensor, from_inputs: Tensor, weights: Tensor) -> Tensor:
        """Advance the hidden states (B, N, H) by one step, given the weights (B, 1, N, N - 1, K) of its messages."""
        received = self.received(self.messages(hidden.unsqueeze(1), weights).squeeze(1))
        gates = torch.sigmoid(from_inputs[..., : 2 * self.size] + received[..., : 2 * self.size])
        reset, update = gates.chunk(2, dim=-1)
        candidate = torch.tanh(from_inputs[..., 2 * self.size :] + reset * received[..., 2 * self.size :])
        return candidate + update * (hidden - candidate)


def make_decoder(inputs: int, action_size: int, spec: VariationalSpec) -> MessageDecoder | RecurrentDecoder:
    """Return the decoder that `spec` names, for F = `inputs` features of each agent."""
    if spec.decoder == "messages":
        return MessageDecoder(inputs, action_size, spec)
    return RecurrentDecoder(inputs, action_size, spec)
