"""Baselines that need no training: constant velocity, and copies of the last state."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Unpack

import torch
from torch import Tensor, nn

from ssmail.envs.integrator import Integrator
from ssmail.training.checkpoint import Stateful
from ssmail.training.learner import Reading


class Baseline:
    """A deterministic predictor without weights."""

    model = nn.Module()
    features = None


@dataclass(frozen=True)
class ConstantVelocity(Baseline):
    """Every agent keeps the velocity that it reads in the current state."""

    integrator: Integrator

    def free_run(self, observed: Tensor, steps: int, generator: torch.Generator, **reading: Unpack[Reading]) -> Tensor:
        """See Predictor."""
        states, first, noise = [observed[:, -1]], observed.shape[1] - 1, reading.get("noise")
        for t in range(steps):
            read = states[-1] if noise is None else states[-1] + noise[:, first + t]
            states.append(self._next(states[-1], read))
        return torch.stack(states, dim=1).repeat(reading.get("samples", 1), 1, 1, 1)

    def one_step(self, states: Tensor, generator: torch.Generator) -> Tensor:
        """See Predictor."""
        return self._next(states[:, :-1], states[:, :-1])

    def _next(self, state: Tensor, read: Tensor) -> Tensor:
        return self.integrator.step(state, read[..., read.shape[-1] // 2 :])


@dataclass(frozen=True)
class CopyLast(Baseline):
    """Every predicted state, velocities included, is a copy of the last observed state as it was read."""

    def free_run(self, observed: Tensor, steps: int, generator: torch.Generator, **reading: Unpack[Reading]) -> Tensor:
        """See Predictor."""
        last, first, noise = observed[:, -1:], observed.shape[1] - 1, reading.get("noise")
        copies = last.repeat(1, steps, 1, 1)
        states = torch.cat([last, copies if noise is None else copies + noise[:, first : first + 1]], dim=1)
        return states.repeat(reading.get("samples", 1), 1, 1, 1)

    def one_step(self, states: Tensor, generator: torch.Generator) -> Tensor:
        """See Predictor."""
        return states[:, :-1]


class BaselineLearner:
    """The learner of a baseline, which has nothing to train."""

    def __init__(self, predictor: ConstantVelocity | CopyLast) -> None:
        self.predictor = predictor

    def networks(self) -> list[nn.Module]:
        """Return no networks."""
        return []

    def run_epoch(self, epoch: int) -> dict[str, float]:
        """Raise NotImplementedError: the spec of a baseline has no training epochs."""
        raise NotImplementedError("a baseline has nothing to learn")

    def parts(self) -> Mapping[str, Stateful]:
        """Return nothing to save."""
        return {}
