"""The discriminator D(s, a): a score for every agent, 0 = generated, 1 = expert (section 3.1)."""

import torch
from torch import Tensor, nn

from ssmail.models.features import NO_WAVES, Waves
from ssmail.models.linear import Linear
from ssmail.models.message_passing import EdgeFunction


class Discriminator(nn.Module):
    """One round of messages over the complete graph, then a perceptron with an unbounded scalar output.

    seen: a mask of the features without velocities (`Features.without_velocities`); with it, actions are not read
    either. None: everything is read.
    """

    seen: Tensor | None

    def __init__(self, inputs: int, hidden: int, waves: Waves = NO_WAVES, seen: Tensor | None = None) -> None:
        super().__init__()
        self.waves = waves
        if seen is not None:
            actions = inputs - len(seen)
            seen = torch.cat([seen, torch.ones(waves.size), torch.zeros(actions)])
        self.register_buffer("seen", seen, persistent=False)
        inputs += waves.size
        self.edges = EdgeFunction(inputs, hidden, hidden)
        self.head = nn.Sequential(
            Linear(hidden + inputs, hidden), nn.SiLU(), Linear(hidden, hidden), nn.SiLU(), Linear(hidden, 1)
        )

    def forward(self, x: Tensor, action: Tensor) -> Tensor:
        """Map x (..., N, D) and action (..., N, A) to unbounded scores (..., N)."""
        inputs = self.read(x, action)
        out: Tensor = self.head(torch.cat([self.edges.messages(inputs), inputs], dim=-1))
        return out.squeeze(-1)

    def read(self, x: Tensor, action: Tensor) -> Tensor:
        """Return the inputs (..., D + waves + A) of the networks; what is not seen is 0."""
        inputs = torch.cat([self.waves(x), action], dim=-1)
        return inputs if self.seen is None else inputs * self.seen

    def score_agent(self, agent: int, own: Tensor, x: Tensor, action: Tensor) -> Tensor:
        """Return the scores (...) of one agent, with features `own` (..., D) in the place of its row of x.

        This takes N - 1 pairs for each score, where `forward` takes N * N for the scores of all agents. x (..., N, D)
        and action (..., N, A) are as in `forward`; the leading axes that they share broadcast with those of `own`.
        """
        others = [n for n in range(x.shape[-2]) if n != agent]
        senders = self.read(x[..., others, :], action[..., others, :])
        inputs = self.read(own, action[..., agent, :].expand(*own.shape[:-1], -1))
        out: Tensor = self.head(torch.cat([self.edges.messages_to_one(inputs, senders), inputs], dim=-1))
        return out.squeeze(-1)
