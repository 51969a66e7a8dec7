"""tau_alpha: mixing generated and expert trajectories, labelled by alpha (sections 3.1.1 and 3.1.3).

The paper prints tau_alpha = alpha * tau_G + (1 - alpha) * tau_E with label alpha, which contradicts D(tau_G) = 0 and D(tau_E) = 1. Here, as in the rest
of its text, alpha = 0 is the generated trajectory and alpha = 1 the expert: tau_alpha = (1 - alpha) * tau_G + alpha * tau_E (docs/paper.md).
"""

import torch
from torch import Tensor


def sample_alpha(batch: int, low: float, high: float, generator: torch.Generator) -> Tensor:
    """(B,) uniform draws from [low, high]: one alpha for all agents and steps of a trajectory."""
    return low + (high - low) * torch.rand(batch, generator=generator)


def mix(generated: Tensor, expert: Tensor, alpha: Tensor) -> Tensor:
    """(1 - alpha) * generated + alpha * expert, for (B, ...) tensors and alpha (B,)."""
    a = alpha.view(-1, *[1] * (generated.dim() - 1))
    return generated + a * (expert - generated)


def nearest(generated: Tensor, experts: Tensor) -> Tensor:
    """(B,) index of the expert trajectory (M, ...) closest to each generated one (B, ...) in mean squared distance.

    A generated trajectory with non-finite values is paired with the first expert.
    """
    distances = torch.cdist(generated.flatten(1), experts.flatten(1))
    return distances.nan_to_num(nan=torch.inf).argmin(dim=1)
