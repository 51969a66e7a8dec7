"""What every network reads of an agent at a step: its state and, by choice, the step index and its first state."""

from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class Features:
    """[state, time, first state] per agent. `steps` is the trajectory length that the step index is scaled with: 0 ..
    steps - 1 -> -1 .. 1.
    """

    time: bool
    start: bool
    steps: int

    def size(self, state_size: int) -> int:
        """Number of features of an agent with D state features."""
        return state_size * (1 + self.start) + self.time

    def __call__(self, states: Tensor, start: Tensor, first_step: int = 0) -> Tensor:
        """states (B, T, N, D), the first of them at step `first_step`, and start (B, N, D) -> (B, T, N, F)."""
        b, t, n, _ = states.shape
        parts = [states]
        if self.time:
            steps = torch.arange(first_step, first_step + t, dtype=states.dtype, device=states.device)
            scaled = 2 * steps / (self.steps - 1) - 1
            parts.append(scaled.view(1, t, 1, 1).expand(b, t, n, 1))
        if self.start:
            parts.append(start.unsqueeze(1).expand(b, t, n, -1))
        return torch.cat(parts, dim=-1) if len(parts) > 1 else states
