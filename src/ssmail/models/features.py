"""What every network reads of an agent at a step: its state and, by choice, the step index, its first state and which
agent it is.
"""

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from ssmail.config.sections import ModelSpec, VariationalSpec
from ssmail.models.normalization import Normalization


@dataclass(frozen=True)
class Features:
    """[state, time, first state, agent] per agent.

    steps: the trajectory length that the step index is scaled with: 0 .. steps - 1 -> -1 .. 1.
    root_relative: positions are differences to those of agent 0, the root of a skeleton; its own are then zeros.
    agents: N of the one-hot of the agent; 0 leaves it out.
    normalization: the units that an agent's state and action are read in; None leaves them in scaled units.
    """

    time: bool
    start: bool
    steps: int
    root_relative: bool = False
    agents: int = 0
    normalization: Normalization | None = None

    @classmethod
    def of(cls, spec: ModelSpec | VariationalSpec, experts: Tensor) -> "Features":
        """Those of a spec, for trajectories like the training set's: experts (M, T, N, D), scaled."""
        steps, agents = experts.shape[1:3]
        plain = cls(False, False, steps, spec.root_relative, agents * spec.agent_input)
        if isinstance(spec, ModelSpec):
            plain = replace(plain, time=spec.time_input, start=spec.start_input)
        return replace(plain, normalization=Normalization.fit(plain._relative(experts))) if spec.standardize else plain

    def size(self, state_size: int) -> int:
        """Number of features of an agent with D state features."""
        return state_size * (1 + self.start) + self.time + self.agents

    def __call__(self, states: Tensor, start: Tensor, first_step: int = 0) -> Tensor:
        """states (B, T, N, D), the first of them at step `first_step`, and start (B, N, D) -> (B, T, N, F)."""
        b, t, n, _ = states.shape
        parts = [self.read(states)]
        if self.time:
            steps = torch.arange(first_step, first_step + t, dtype=states.dtype, device=states.device)
            scaled = 2 * steps / (self.steps - 1) - 1
            parts.append(scaled.view(1, t, 1, 1).expand(b, t, n, 1))
        if self.start:
            parts.append(self.read(start).unsqueeze(1).expand(b, t, n, -1))
        if self.agents:
            parts.append(torch.eye(n, dtype=states.dtype, device=states.device).expand(b, t, n, n))
        return torch.cat(parts, dim=-1) if len(parts) > 1 else parts[0]

    def of_actions(self, actions: Tensor) -> Tensor:
        """Actions (..., N, A), which are velocities, in the units that they are read in."""
        return actions if self.normalization is None else self.normalization.velocity.normalize(actions)

    def to_actions(self, read: Tensor) -> Tensor:
        """Actions (..., N, A) in scaled units from what a network says in those that it reads."""
        return read if self.normalization is None else self.normalization.velocity.denormalize(read)

    def read(self, states: Tensor) -> Tensor:
        """States (..., N, 2P) in the units that they are read in."""
        relative = self._relative(states)
        return relative if self.normalization is None else self.normalization.normalize(relative)

    def _relative(self, states: Tensor) -> Tensor:
        """States (..., N, 2P) with the positions that are read."""
        if not self.root_relative:
            return states
        position, velocity = states.chunk(2, dim=-1)
        return torch.cat([position - position[..., :1, :], velocity], dim=-1)
