"""Trajectories as tensors: batches of them, and the replay buffer."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ssmail.data.scaling import Scaling
from ssmail.data.trajectories import Floats, Trajectories
from ssmail.training.checkpoint import UnfitState, entries, fitted
from ssmail.training.seeding import Source, drawn

Arrays = dict[str, np.ndarray]
"""Arrays to store with a run, by name."""


@dataclass(frozen=True)
class Batch:
    """B scaled trajectories.

    states: (B, T + 1, N, D), positions and velocities.
    actions: (B, T, N, A), taken in states[:, :T].
    source: (B,), the index of the expert trajectory whose start each trajectory shares.

    Batches of S seeds side by side have an axis S in front; `of_seeds` and `draw` make them.
    """

    states: Tensor
    actions: Tensor
    source: Tensor

    @classmethod
    def from_trajectories(cls, trajectories: Trajectories, scaling: Scaling, device: torch.device) -> "Batch":
        """Scale expert trajectories to float32 tensors. An action is the velocity of the next state."""
        velocities = scaling.scale_velocities(trajectories.velocities)
        states = np.concatenate([scaling.scale_positions(trajectories.positions), velocities], axis=-1)
        return cls(
            torch.as_tensor(states, dtype=torch.float32, device=device),
            torch.as_tensor(velocities[:, 1:], dtype=torch.float32, device=device),
            torch.arange(len(trajectories), device=device),
        )

    def __len__(self) -> int:
        return self.source.shape[-1]

    def __getitem__(self, index: Tensor) -> "Batch":
        return Batch(self.states[index], self.actions[index], self.source[index])

    def draw(self, count: int, source: Source) -> "Batch":
        """Draw `count` trajectories uniformly with replacement.

        With the generators of S seeds, draw so many for each, from its part of this batch or from what all share.
        """
        return self.at(drawn(source, lambda g: torch.randint(len(self), (count,), generator=g)).to(self.states.device))

    def at(self, index: Tensor) -> "Batch":
        """Return the trajectories at an index (B,), or (S, B): for each of S seeds, from its part or what all share."""
        if self.source.dim() == 1:
            return self[index]
        seeds = torch.arange(len(index), device=index.device).unsqueeze(1)
        return Batch(*(x[seeds, index] for x in vars(self).values()))

    def split(self, count: int) -> "tuple[Batch, Batch]":
        """Return the first `count` trajectories and the others, of every seed."""
        parts = [x.tensor_split([count], dim=self.source.dim() - 1) for x in vars(self).values()]
        return Batch(*(first for first, _ in parts)), Batch(*(others for _, others in parts))

    def of_each(self) -> "list[Batch]":
        """Return the batch of each seed."""
        return [Batch(*part) for part in zip(self.states, self.actions, self.source, strict=True)]

    @staticmethod
    def of_seeds(batches: "Sequence[Batch]") -> "Batch":
        """Put the batches of S seeds side by side."""
        return Batch(*(torch.stack([getattr(p, f) for p in batches]) for f in ("states", "actions", "source")))

    @staticmethod
    def concatenate(parts: "Sequence[Batch]") -> "Batch":
        """Join batches along the batch axis."""
        axis = parts[0].source.dim() - 1
        return Batch(*(torch.cat([getattr(p, f) for p in parts], axis) for f in ("states", "actions", "source")))


class ReplayBuffer:
    """The last `capacity` generated trajectories, which are as long and wide as those of `experts`."""

    def __init__(self, capacity: int, experts: Batch) -> None:
        self.capacity, self.experts = capacity, experts
        self.kept: Batch | None = None

    def add(self, batch: Batch) -> None:
        """Append a batch and drop the oldest trajectories beyond the capacity."""
        joined = batch if self.kept is None else Batch.concatenate([self.kept, batch])
        self.kept = joined[torch.arange(max(len(joined) - self.capacity, 0), len(joined))]

    @property
    def trajectories(self) -> Batch:
        """All that it holds. Raises ValueError if the buffer is empty."""
        if self.kept is None:
            raise ValueError("the replay buffer is empty")
        return self.kept

    def state_dict(self) -> dict[str, Any]:
        """Return the stored trajectories."""
        return {} if self.kept is None else dict(vars(self.kept))

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Inverse of `state_dict`. Raises UnfitState when it holds no trajectories like those of the experts."""
        if isinstance(state, dict) and not len(state):
            self.kept = None
            return
        own = vars(self.experts)
        source = entries(state, own, "replay")["source"]
        count = len(source) if isinstance(source, Tensor) and source.dim() == 1 else 0
        if not 1 <= count <= self.capacity:
            raise UnfitState("replay has another number of trajectories")
        expected = {name: value[:1].expand(count, *value.shape[1:]) for name, value in own.items()}
        kept = fitted(state, expected, "replay")
        if not bool(((kept["source"] >= 0) & (kept["source"] < len(self.experts))).all()):
            raise UnfitState("replay.source is out of range")
        self.kept = Batch(**{name: value.to(self.experts.states.device) for name, value in kept.items()})


def to_numpy(tensor: Tensor) -> Floats:
    """Return the values as a float64 array in main memory."""
    array: Floats = tensor.double().cpu().numpy()
    return array
