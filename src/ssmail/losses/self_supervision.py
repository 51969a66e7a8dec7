"""tau_alpha: mixing generated and expert trajectories by alpha (sections 3.1.1, 3.1.3); `labels` has what it is called.

The paper prints tau_alpha = alpha * tau_G + (1 - alpha) * tau_E with label alpha, which contradicts D(tau_G) = 0 and
D(tau_E) = 1. Here, as in the rest of its text, alpha = 0 is the generated trajectory and alpha = 1 the expert:
tau_alpha = (1 - alpha) * tau_G + alpha * tau_E (docs/paper.md).
"""

from collections.abc import Sequence

import torch
from scipy.optimize import linear_sum_assignment
from torch import Tensor


def sample_alpha(batch: int, pieces: Sequence[tuple[float, float, float]], generator: torch.Generator) -> Tensor:
    """(B,) draws: one alpha for all agents and steps of a trajectory.

    pieces: (low, high, weight) of the ranges, each drawn from with a probability in proportion to its weight, and
    uniform inside; where ranges overlap their densities add up, and a range without length is one value. The inverse of
    the distribution function, so that each alpha costs one number of the generator.
    """
    low, high, weight = torch.tensor(pieces, dtype=torch.float64).unbind(dim=1)
    upto = (weight / weight.sum()).cumsum(dim=0)
    uniform = torch.rand(batch, generator=generator).double()
    piece = torch.searchsorted(upto[:-1], uniform, right=True)
    before = (upto - weight / weight.sum())[piece]
    fraction = (uniform - before) * weight.sum() / weight[piece]
    return (low[piece] + (high - low)[piece] * fraction.clamp(0, 1)).float()


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


def assignment(generated: Tensor, experts: Tensor) -> Tensor:
    """(B,) permutation that pairs each generated trajectory with its own expert of a batch of equal size, least total
    squared distance.

    This is the optimal transport between the two batches. Where the policy neglects one of the expert's modes, some
    generated trajectories are paired across to it; where it uses all modes as the expert does, it pairs like `nearest`.
    """
    distances = torch.cdist(generated.flatten(1), experts.flatten(1)).square().nan_to_num(nan=1e30, posinf=1e30)
    _, columns = linear_sum_assignment(distances.cpu().numpy())
    return torch.as_tensor(columns, device=generated.device)
