"""tau_alpha: draws of alpha, mixing, and the pairing of generated with expert trajectories (sections 3.1.1, 3.1.3).

The paper prints tau_alpha = alpha * tau_G + (1 - alpha) * tau_E with label alpha, which contradicts D(tau_G) = 0 and
D(tau_E) = 1. In ssmail, as in the rest of the paper's text, alpha = 0 is the generated trajectory and alpha = 1 the
expert: tau_alpha = (1 - alpha) * tau_G + alpha * tau_E (docs/paper.md). The labels are in `ssmail.losses.labels`.
"""

from collections.abc import Sequence

import torch
from torch import Tensor


def sample_alpha(batch: int, pieces: Sequence[tuple[float, float, float]], generator: torch.Generator) -> Tensor:
    """Draw alphas (B,), one for all agents and steps of a trajectory, from a piecewise constant density.

    pieces: ranges (low, high, weight). A range is chosen with probability proportional to its weight, and alpha is
    uniform in it. Overlapping ranges add up; a range of length 0 is a single value. Each alpha takes one number from
    the generator (inverse transform sampling).
    """
    low, high, weight = torch.tensor(pieces, dtype=torch.float64).unbind(dim=1)
    cumulative = (weight / weight.sum()).cumsum(dim=0)
    uniform = torch.rand(batch, generator=generator).double()
    piece = torch.searchsorted(cumulative[:-1], uniform, right=True)
    before = (cumulative - weight / weight.sum())[piece]
    fraction = (uniform - before) * weight.sum() / weight[piece]
    return (low[piece] + (high - low)[piece] * fraction.clamp(0, 1)).float()


def mix(generated: Tensor, expert: Tensor, alpha: Tensor) -> Tensor:
    """Return (1 - alpha) * generated + alpha * expert of tensors (B, ...) and alpha (B,), or (S, B, ...) and (S, B)."""
    a = alpha.view(*alpha.shape, *[1] * (generated.dim() - alpha.dim()))
    return generated + a * (expert - generated)


def nearest(generated: Tensor, experts: Tensor) -> Tensor:
    """Return the index (B,) of the expert (M, ...) closest to each generated trajectory (B, ...) in squared distance.

    A generated trajectory with non-finite values is paired with the first expert.
    """
    distances = torch.cdist(generated.flatten(1), experts.flatten(1))
    return distances.nan_to_num(nan=torch.inf).argmin(dim=1)


def assignment(generated: Tensor, experts: Tensor) -> Tensor:
    """Return the permutation (B,) that pairs each generated trajectory with its own expert at the least total cost.

    This is optimal transport between two batches of equal size, with the squared distance as cost. If the policy
    neglects one of the expert's modes, some generated trajectories are paired with that mode; if it covers all modes as
    the expert does, the pairs are those of `nearest`.
    """
    from scipy.optimize import linear_sum_assignment  # half a second to import, in every process that trains

    distances = torch.cdist(generated.flatten(1), experts.flatten(1)).square().nan_to_num(nan=1e30, posinf=1e30)
    _, columns = linear_sum_assignment(distances.cpu().numpy())
    return torch.as_tensor(columns, device=generated.device)
