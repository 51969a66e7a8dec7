"""Units of an agent's own: what is usual for it, and how far it usually strays."""

from dataclasses import dataclass

import torch
from torch import Tensor

from ssmail.config.sections import ModelSpec

SMALLEST = 0.1  # of the mean spread: what hardly moves is not blown up beyond this

FARTHEST = 5.0  # spreads from the mean


@dataclass(frozen=True)
class Standards:
    """Mean and spread over the training set, for each agent and feature, scaled units.

    mean, spread: (N, D) of the state features as they are read, positions relative to the root where that is so.
    """

    mean: Tensor
    spread: Tensor

    @classmethod
    def of(cls, read: Tensor) -> "Standards":
        """Those of training states as they are read, (M, T, N, D)."""
        std, mean = torch.std_mean(read.double(), dim=(0, 1))
        return cls(mean.to(read.dtype), _floored(std).to(read.dtype))

    @property
    def velocity(self) -> "Standards":
        """Those of the velocities alone, (N, A) each."""
        return Standards(self.mean.chunk(2, dim=-1)[1], self.spread.chunk(2, dim=-1)[1])

    def standardize(self, read: Tensor) -> Tensor:
        """State features (..., N, D) in units of their spread, about their mean; what is farther than FARTHEST counts
        as that far, so that single wrong frames do not stand out beyond all else.
        """
        return ((read - self.mean) / self.spread).clamp(-FARTHEST, FARTHEST)

    def restore(self, standardized: Tensor) -> Tensor:
        """Inverse of `standardize`, within FARTHEST."""
        return self.mean + self.spread * standardized


@dataclass(frozen=True)
class Reach:
    """Which velocities an action can choose, scaled units: at most `step` from the current one, and between `low` and
    `high`. Each is (N, A), or a scalar for all.
    """

    step: Tensor
    low: Tensor
    high: Tensor

    @classmethod
    def of(cls, spec: ModelSpec, standards: Standards | None = None) -> "Reach":
        """Those of a spec: in scaled units, or with standards in units of the agent's own."""
        if standards is None:
            bound = torch.tensor(spec.action_bound)
            return cls(torch.tensor(spec.action_step), -bound, bound)
        usual = standards.velocity
        away = spec.action_bound * usual.spread
        return cls(spec.action_step * usual.spread, usual.mean - away, usual.mean + away)


def _floored(spread: Tensor) -> Tensor:
    """(N, D) spreads, none of them below SMALLEST of the mean of their feature; 1 for a feature that never varies."""
    floored = spread.maximum(SMALLEST * spread.mean(dim=0))
    return torch.where(floored > 0, floored, torch.ones_like(floored))
