"""Losses of the discriminator. Each takes its outputs and returns the scalar to minimise and its terms."""

from torch import Tensor

Terms = dict[str, Tensor]


def ssail_loss(generated: Tensor, expert: Tensor, mixed: Tensor, alpha: Tensor) -> tuple[Tensor, Terms]:
    """Eq. 3: (0 - D(tau_G))^2 + (1 - D(tau_E))^2 + (alpha - D(tau_alpha))^2, each a mean over trajectories, steps and
    agents.

    generated, expert, mixed: (B, T, N) outputs of D; alpha: (B,) labels of the mixed trajectories.
    """
    labels = alpha.view(-1, *[1] * (mixed.dim() - 1))
    terms = {
        "generated": generated.square().mean(),
        "expert": (1 - expert).square().mean(),
        "self_supervised": (labels - mixed).square().mean(),
    }
    return terms["generated"] + terms["expert"] + terms["self_supervised"], terms
