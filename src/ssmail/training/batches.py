"""The replay of past tau_G: whole trajectories in a ring buffer."""

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor


@dataclass(frozen=True)
class Batch:
    """B trajectories: states (B, T + 1, N, D), actions (B, T, N, A), and source (B,), the expert trajectory that each
    one started from.
    """

    states: Tensor
    actions: Tensor
    source: Tensor

    def __len__(self) -> int:
        return self.states.shape[0]

    def __getitem__(self, index: Tensor) -> "Batch":
        return Batch(self.states[index], self.actions[index], self.source[index])

    def draw(self, count: int, generator: torch.Generator) -> "Batch":
        """`count` of them, uniformly with replacement."""
        return self[torch.randint(len(self), (count,), generator=generator).to(self.states.device)]

    @staticmethod
    def concatenate(parts: "list[Batch]") -> "Batch":
        """Join along the batch axis."""
        return Batch(*(torch.cat([getattr(p, f) for p in parts]) for f in ("states", "actions", "source")))


class Replay:
    """The last `capacity` generated trajectories."""

    def __init__(self, capacity: int) -> None:
        self.capacity = capacity
        self.kept: Batch | None = None

    def add(self, batch: Batch) -> None:
        """Append a batch; the oldest trajectories fall out."""
        joined = batch if self.kept is None else Batch.concatenate([self.kept, batch])
        self.kept = joined[torch.arange(max(len(joined) - self.capacity, 0), len(joined))]

    def sample(self, count: int, generator: torch.Generator) -> Batch:
        """`count` trajectories, uniformly with replacement. Raises ValueError while empty."""
        if self.kept is None:
            raise ValueError("the replay is empty")
        return self.kept.draw(count, generator)

    def state_dict(self) -> dict[str, Any]:
        """Tensors to continue from."""
        return {} if self.kept is None else dict(vars(self.kept))

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Inverse of `state_dict`."""
        self.kept = Batch(**state) if state else None
