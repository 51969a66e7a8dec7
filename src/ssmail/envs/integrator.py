"""The trajectory environment: an action is the next velocity, and the position follows it.

In raw units, v[t+1] = a[t] and p[t+1] = p[t] + a[t]. This map is affine in (s, a), so any mix
(1 - alpha) * tau_G + alpha * tau_E of two trajectories is itself a trajectory of the environment. That is why an
off-policy critic can learn from tau_alpha (section 3.1.2). A non-linear environment would not have this property.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from ssmail.data.scaling import Scaling


@dataclass(frozen=True)
class Integrator:
    """One step of the dynamics, in scaled units."""

    scaling: Scaling

    def step(self, state: Tensor, action: Tensor) -> Tensor:
        """Return the next state (..., 2P) of a state [position, velocity] (..., 2P) and an action (..., P), scaled."""
        half_span, slowest, length = self.constants
        position = state[..., : action.shape[-1]]
        move = ((action + 1) * half_span + slowest) * length
        return torch.cat([position + move, action], dim=-1)

    @property
    def constants(self) -> tuple[Any, Any, Any]:
        """What turns a scaled velocity into a raw one (half of their span, and the least), then into a scaled move."""
        return self.scaling.velocity_span / 2, self.scaling.velocity_min, 2 / self.scaling.position_span


@dataclass(frozen=True)
class IntegratorOfSeeds(Integrator):
    """The dynamics of S seeds side by side, each as scaled for its own data: states (S, B, T, N, 2P), actions alike.

    scaling: that of the first seed. of_each: the constants of all, (S, 1, 1, 1, 1) each.
    """

    of_each: tuple[Tensor, ...]

    @classmethod
    def of(cls, integrators: Sequence[Integrator], like: Tensor) -> "IntegratorOfSeeds":
        """Put dynamics side by side, in the precision and on the device of `like`."""
        columns = zip(*(integrator.constants for integrator in integrators), strict=True)
        constants = tuple(like.new_tensor(column).view(-1, 1, 1, 1, 1) for column in columns)
        return cls(integrators[0].scaling, constants)

    @property
    def constants(self) -> tuple[Any, Any, Any]:
        """As those of one seed."""
        half_spans, slowest, lengths = self.of_each
        return half_spans, slowest, lengths
