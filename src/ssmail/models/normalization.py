"""Normalization of features by mean and standard deviation, and the bounds on actions that follow from it."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from ssmail.config.sections import ModelSpec

STD_FLOOR = 0.1  # smallest standard deviation, as a fraction of the mean over agents: noise is not blown up beyond this
MOST = 0.999  # share of the observed changes of velocity, and of velocities, that actions reach easily
SPARE = 1.5  # what actions reach, as a multiple of that
SMALLEST = 1e-6  # of both, for data in which nothing changes
CLIP = 5.0  # standard deviations from the mean


@dataclass(frozen=True)
class Normalization:
    """Mean and standard deviation of the state features over the training set, of each agent or of all.

    mean, std: (N or 1, D), of the features as networks read them: scaled, and relative to the root or to the group's
    centre where the spec says so.
    """

    mean: Tensor
    std: Tensor

    @classmethod
    def fit(cls, states: Tensor) -> "Normalization":
        """Fit to training states (M, T, N, D). A feature that never varies gets a standard deviation of 1."""
        std, mean = torch.std_mean(states.double(), dim=(0, 1))
        floored = std.maximum(STD_FLOOR * std.mean(dim=0))
        std = torch.where(floored > 0, floored, torch.ones_like(floored))
        return cls(mean.to(states.dtype), std.to(states.dtype))

    @classmethod
    def pooled(cls, *states: Tensor) -> "Normalization":
        """Fit one mean and standard deviation for all agents, from states (M, T, N, D) for each number of agents N."""
        return cls.fit(torch.cat([part.flatten(0, 2) for part in states]).unsqueeze(1).unsqueeze(1))

    @property
    def velocity(self) -> "Normalization":
        """The normalization of the velocities alone, (N or 1, A) each."""
        return Normalization(self.mean.chunk(2, dim=-1)[1], self.std.chunk(2, dim=-1)[1])

    def normalize(self, states: Tensor) -> Tensor:
        """Return (x - mean) / std of state features (..., N, D), clipped to +-CLIP so that single bad frames do not
        dominate.
        """
        return ((states - self.mean) / self.std).clamp(-CLIP, CLIP)

    def denormalize(self, normalized: Tensor) -> Tensor:
        """Invert `normalize`, up to the clipping."""
        return self.mean + self.std * normalized


@dataclass(frozen=True)
class ActionBounds:
    """The velocities that an action can choose, in scaled units: at most `step` from the current velocity, and between
    `low` and `high`. Each is (N or 1, A), or a scalar for all agents.
    """

    step: Tensor
    low: Tensor
    high: Tensor

    @classmethod
    def of(
        cls, spec: ModelSpec, normalization: Normalization | None = None, velocities: Sequence[Tensor] = ()
    ) -> "ActionBounds":
        """Return the bounds of a spec, which are in scaled units or, with a normalization, in standard deviations
        around the mean velocity.

        velocities: the scaled ones of the training set, (M, T, N, A) for each number of agents. Where a key is null,
        they decide, axis by axis: `step` is SPARE times the change of velocity that the share MOST of them does not
        exceed, and the bound SPARE times the distance of velocities from the mean (or 0), and a step.
        """
        mean, unit = _mean_and_unit(normalization)
        step, bound = spec.action_step, spec.action_bound
        reach = step if step is not None else SPARE * _most([part.diff(dim=1) / unit for part in velocities])
        margin = bound if bound is not None else SPARE * _most([(part - mean) / unit for part in velocities]) + reach
        return cls.within(reach, margin, normalization)

    @classmethod
    def within(
        cls, step: float | Tensor, bound: float | Tensor, normalization: Normalization | None = None
    ) -> "ActionBounds":
        """Return the bounds for `step` and `bound` in the units of `of`; an infinite `bound` bounds nothing."""
        mean, unit = _mean_and_unit(normalization)
        return cls(step * unit, mean - bound * unit, mean + bound * unit)

    def limit(self, action: Tensor, velocity: Tensor) -> Tensor:
        """Bring actions (..., N, A) softly within the bounds, given the current velocities (..., N, A).

        c + d tanh((a - c) / d), with the actor's centre c (`ssmail.models.policy`): near the current velocity a itself.
        """
        centre = torch.maximum(torch.minimum(velocity, self.high - self.step), self.low + self.step)
        return centre + self.step * torch.tanh((action - centre) / self.step)


def _mean_and_unit(normalization: Normalization | None) -> tuple[Tensor, Tensor]:
    """Return the mean velocity and the unit of velocities that networks read."""
    if normalization is None:
        return torch.tensor(0.0), torch.tensor(1.0)
    return normalization.velocity.mean, normalization.velocity.std


def _most(parts: Sequence[Tensor]) -> Tensor:
    """Return the MOST quantile (A,) of the sizes of vectors' components (M, T, N, A), but SMALLEST at least."""
    sizes = torch.cat([part.abs().flatten(0, 2) for part in parts])
    found = np.quantile(sizes.double().cpu().numpy(), MOST, axis=0)
    return torch.as_tensor(found, dtype=sizes.dtype, device=sizes.device).clamp(min=SMALLEST)
