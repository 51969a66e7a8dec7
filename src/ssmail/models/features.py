"""Input features of all networks: an agent's state and, optionally, the step index, its first state and a one-hot of
the agent.
"""

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from ssmail.config.sections import ModelSpec, VariationalSpec
from ssmail.models.normalization import Normalization


@dataclass(frozen=True)
class Waves:
    """Sines and cosines of the positions among an agent's features, so that a small network can resolve short distances
    (Tancik et al. 2020).

    axes: the first features, which are the position. frequencies: radians per unit of position.
    """

    axes: int
    frequencies: tuple[float, ...]

    @property
    def size(self) -> int:
        """The number of features that are added."""
        return 2 * self.axes * len(self.frequencies)

    def __call__(self, x: Tensor) -> Tensor:
        """Append the waves to features: (..., F) -> (..., F + size)."""
        if not self.frequencies:
            return x
        phases = torch.cat([frequency * x[..., : self.axes] for frequency in self.frequencies], dim=-1)
        return torch.cat([x, phases.sin(), phases.cos()], dim=-1)


NO_WAVES = Waves(0, ())


@dataclass(frozen=True)
class Features:
    """Computes the features [state, time, first state, agent] of every agent.

    steps: the trajectory length; the step index 0 .. steps - 1 is scaled to -1 .. 1.
    root_relative: take positions relative to agent 0, the root of a skeleton, whose own positions become zeros.
    centre_relative: take positions relative to the mean position of the group at the same step.
    agents: the length N of the one-hot of the agent; 0 leaves it out.
    normalization: normalization of states and actions; None leaves them in scaled units.
    """

    time: bool
    start: bool
    steps: int
    root_relative: bool = False
    centre_relative: bool = False
    agents: int = 0
    normalization: Normalization | None = None

    @classmethod
    def of(cls, spec: ModelSpec | VariationalSpec, *experts: Tensor) -> "Features":
        """Return the features that a spec without "auto" asks for, fitted to scaled training states.

        experts: (M, T, N, D) for each number N of agents in the expert set.
        """
        steps, agents = experts[0].shape[1:3]
        plain = cls(
            time=False,
            start=False,
            steps=steps,
            root_relative=spec.root_relative,
            centre_relative=spec.centre_relative is True,
            agents=agents * (spec.agent_input is True),
        )
        if isinstance(spec, ModelSpec):
            plain = replace(plain, time=spec.time_input, start=spec.start_input)
        if not spec.standardize:
            return plain
        relative = [plain._relative(states) for states in experts]
        fit = Normalization.pooled if spec.standardize == "pooled" else Normalization.fit
        return replace(plain, normalization=fit(*relative))

    @property
    def is_relative(self) -> bool:
        """Whether what is read of an agent's position depends on the positions of others."""
        return self.root_relative or self.centre_relative

    def size(self, state_size: int) -> int:
        """Return the number of features F of an agent with `state_size` state features."""
        return state_size * (1 + self.start) + self.time + self.agents

    def without_velocities(self, state_size: int) -> Tensor:
        """Return a mask (F,) of the features: 0 for the velocities of the state and of the first state, else 1."""
        mask, axes = torch.ones(self.size(state_size)), state_size // 2
        mask[axes:state_size] = 0
        if self.start:
            first = state_size + self.time
            mask[first + axes : first + state_size] = 0
        return mask

    def __call__(self, states: Tensor, start: Tensor, first_step: int = 0) -> Tensor:
        """Map states (..., T, N, D) from step `first_step` on, and start (..., N, D), to features (..., T, N, F)."""
        steps = torch.arange(first_step, first_step + states.shape[-3], dtype=states.dtype, device=states.device)
        return self.at(steps, states, start)

    def at(self, steps: Tensor, states: Tensor, start: Tensor) -> Tensor:
        """Map states (..., T, N, D) at the steps (T,), and start (..., N, D), to features (..., T, N, F)."""
        *lead, t, n, _ = states.shape
        parts = [self.normalize_states(states)]
        if self.time:
            scaled = 2 * steps / (self.steps - 1) - 1
            parts.append(scaled.view(t, 1, 1).expand(*lead, t, n, 1))
        if self.start:
            parts.append(self.normalize_states(start).unsqueeze(-3).expand(*lead, t, n, -1))
        if self.agents:
            parts.append(torch.eye(n, dtype=states.dtype, device=states.device).expand(*lead, t, n, n))
        return torch.cat(parts, dim=-1) if len(parts) > 1 else parts[0]

    def normalize_actions(self, actions: Tensor) -> Tensor:
        """Convert actions (..., N, A), which are velocities, from scaled units to the networks' units."""
        return actions if self.normalization is None else self.normalization.velocity.normalize(actions)

    def denormalize_actions(self, read: Tensor) -> Tensor:
        """Convert a network's actions (..., N, A) to scaled units."""
        return read if self.normalization is None else self.normalization.velocity.denormalize(read)

    def normalize_states(self, states: Tensor) -> Tensor:
        """Convert states (..., N, 2P) from scaled units to the networks' units."""
        relative = self._relative(states)
        return relative if self.normalization is None else self.normalization.normalize(relative)

    def _relative(self, states: Tensor) -> Tensor:
        """Take the positions of states (..., N, 2P) relative to the root or the group's centre, if asked for."""
        if not self.is_relative:
            return states
        position, velocity = states.chunk(2, dim=-1)
        origin = position.mean(dim=-2, keepdim=True) if self.centre_relative else position[..., :1, :]
        return torch.cat([position - origin, velocity], dim=-1)
