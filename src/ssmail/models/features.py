"""What every network reads of an agent at a step: its state and, by choice, the step index, its first state and which
agent it is.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from ssmail.spec import ModelSpec


@dataclass(frozen=True)
class Features:
    """[state, time, first state, agent] per agent.

    steps: the trajectory length that the step index is scaled with: 0 .. steps - 1 -> -1 .. 1.
    root_relative: positions are differences to those of agent 0, the root of a skeleton; its own are then zeros.
    agents: N of the one-hot of the agent; 0 leaves it out.
    """

    time: bool
    start: bool
    steps: int
    root_relative: bool = False
    agents: int = 0

    @classmethod
    def of(cls, spec: ModelSpec, steps: int, agents: int) -> "Features":
        """Those of a spec, for trajectories of `steps` states of `agents` agents."""
        return cls(spec.time_input, spec.start_input, steps, spec.root_relative, agents * spec.agent_input)

    def size(self, state_size: int) -> int:
        """Number of features of an agent with D state features."""
        return state_size * (1 + self.start) + self.time + self.agents

    def __call__(self, states: Tensor, start: Tensor, first_step: int = 0) -> Tensor:
        """states (B, T, N, D), the first of them at step `first_step`, and start (B, N, D) -> (B, T, N, F)."""
        b, t, n, _ = states.shape
        parts = [self._relative(states)]
        if self.time:
            steps = torch.arange(first_step, first_step + t, dtype=states.dtype, device=states.device)
            scaled = 2 * steps / (self.steps - 1) - 1
            parts.append(scaled.view(1, t, 1, 1).expand(b, t, n, 1))
        if self.start:
            parts.append(self._relative(start).unsqueeze(1).expand(b, t, n, -1))
        if self.agents:
            parts.append(torch.eye(n, dtype=states.dtype, device=states.device).expand(b, t, n, n))
        return torch.cat(parts, dim=-1) if len(parts) > 1 else parts[0]

    def _relative(self, states: Tensor) -> Tensor:
        """States (..., N, 2P) with the positions that are read."""
        if not self.root_relative:
            return states
        position, velocity = states.chunk(2, dim=-1)
        return torch.cat([position - position[..., :1, :], velocity], dim=-1)
