"""The trajectory environment: an action is the next velocity, and the position follows it.

In raw units, v[t+1] = a[t] and p[t+1] = p[t] + a[t]. This map is affine in (s, a), so any mix
(1 - alpha) * tau_G + alpha * tau_E of two trajectories is itself a trajectory of the environment. That is why an
off-policy critic can learn from tau_alpha (section 3.1.2). A non-linear environment would not have this property.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from ssmail.data.scaling import Scaling


@dataclass(frozen=True)
class Integrator:
    """One step of the dynamics, in scaled units."""

    scaling: Scaling

    def step(self, state: Tensor, action: Tensor) -> Tensor:
        """Return the next state (..., 2P) of a state [position, velocity] (..., 2P) and an action (..., P), scaled."""
        position = state[..., : action.shape[-1]]
        move = self.scaling.unscale_velocities(action) * (2 / self.scaling.position_span)
        return torch.cat([position + move, action], dim=-1)
