"""Predictors that need no training: what every learned one has to beat."""

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from ssmail.envs.integrator import Integrator


class Stateless:
    """Has nothing to save."""

    def state_dict(self) -> dict[str, Any]:
        """Nothing."""
        return {}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Inverse of `state_dict`."""


@dataclass(frozen=True)
class ConstantVelocity(Stateless):
    """Every agent takes the velocity that is read of the state it is predicted from."""

    integrator: Integrator

    def free_run(
        self,
        observed: Tensor,
        steps: int,
        generator: torch.Generator,
        *,
        deterministic: bool = False,
        noise: Tensor | None = None,
    ) -> Tensor:
        """See Predictor."""
        states, first = [observed[:, -1]], observed.shape[1] - 1
        for t in range(steps):
            read = states[-1] if noise is None else states[-1] + noise[:, first + t]
            states.append(self._next(states[-1], read))
        return torch.stack(states, dim=1)

    def one_step(self, states: Tensor, generator: torch.Generator) -> Tensor:
        """See Predictor."""
        return self._next(states[:, :-1], states[:, :-1])

    def _next(self, state: Tensor, read: Tensor) -> Tensor:
        return self.integrator.step(state, read[..., read.shape[-1] // 2 :])


@dataclass(frozen=True)
class CopyLast(Stateless):
    """Every state, velocities included, is the last observed one as it was read."""

    def free_run(
        self,
        observed: Tensor,
        steps: int,
        generator: torch.Generator,
        *,
        deterministic: bool = False,
        noise: Tensor | None = None,
    ) -> Tensor:
        """See Predictor."""
        last, first = observed[:, -1:], observed.shape[1] - 1
        copies = last.repeat(1, steps, 1, 1)
        return torch.cat([last, copies if noise is None else copies + noise[:, first : first + 1]], dim=1)

    def one_step(self, states: Tensor, generator: torch.Generator) -> Tensor:
        """See Predictor."""
        return states[:, :-1]


class NothingToLearn(Stateless):
    """The learner of a reference."""

    def __init__(self, predictor: ConstantVelocity | CopyLast) -> None:
        self.predictor = predictor

    def networks(self) -> list[torch.nn.Module]:
        """None."""
        return []

    def run_epoch(self, epoch: int) -> dict[str, float]:
        """Never called: the spec of a reference has no training epochs."""
        raise NotImplementedError("a reference has nothing to learn")
