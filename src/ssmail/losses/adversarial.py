"""Losses of the discriminator. Each takes its outputs and returns the scalar to minimise and its terms.

Everywhere 0 = generated and 1 = expert, and a higher output means "more like the expert". Outputs are (B, T, N).
"""

from collections.abc import Callable

import torch
from torch import Tensor, nn

Terms = dict[str, Tensor]


def ssail_loss(generated: Tensor, expert: Tensor, mixed: Tensor, labels: Tensor) -> tuple[Tensor, Terms]:
    """Eq. 3: (0 - D(tau_G))^2 + (1 - D(tau_E))^2 + (label(alpha) - D(tau_alpha))^2, each a mean over trajectories,
    steps and agents. The paper's label is alpha itself, or that of A.2 (`ssmail.losses.labels`).

    generated, expert, mixed: (B, T, N) outputs of D; labels: (B,) those of the mixed trajectories.
    """
    wanted = labels.view(-1, *[1] * (mixed.dim() - 1))
    terms = {
        "generated": generated.square().mean(),
        "expert": (1 - expert).square().mean(),
        "self_supervised": (wanted - mixed).square().mean(),
    }
    return terms["generated"] + terms["expert"] + terms["self_supervised"], terms


def gail_loss(generated: Tensor, expert: Tensor) -> tuple[Tensor, Terms]:
    """Binary cross-entropy -log(1 - sigmoid(D(tau_G))) - log sigmoid(D(tau_E)) of logits (Eq. 1, with the labels of
    ssmail).

    Where generated and expert data have densities p_G and p_E, the optimal logit is log(p_E / p_G).
    """
    terms = {
        "generated": nn.functional.softplus(generated).mean(),
        "expert": nn.functional.softplus(-expert).mean(),
    }
    return terms["generated"] + terms["expert"], terms


def wail_loss(generated: Tensor, expert: Tensor) -> tuple[Tensor, Terms]:
    """mean D(tau_G) - mean D(tau_E): minus the critic's estimate of the Wasserstein distance (Eq. 2)."""
    terms = {"generated": generated.mean(), "expert": -expert.mean()}
    return terms["generated"] + terms["expert"], terms


def gradient_penalty(
    critic: Callable[[Tensor, Tensor], Tensor],
    generated: tuple[Tensor, Tensor],
    expert: tuple[Tensor, Tensor],
    mix: Tensor,
) -> Tensor:
    """E[(|| grad || - 1)^2] between generated and expert transitions (Gulrajani et al. 2017).

    generated and expert are (features (B, T, N, F), actions (B, T, N, A)); mix (B, T) in [0, 1] is one draw per
    transition, shared by its agents. The norm is that of each agent's own inputs, in the gradient of the sum of all
    agents' scores: a critic of one agent alone gets the usual penalty, and what agents hear of each other counts too.
    """
    weight = mix[..., None, None]
    inputs = [torch.lerp(g, e, weight).requires_grad_() for g, e in zip(generated, expert, strict=True)]
    gradients = torch.autograd.grad(critic(*inputs).sum(), inputs, create_graph=True)
    norm = torch.cat(gradients, dim=-1).square().sum(dim=-1).add(1e-12).sqrt()
    return (norm - 1).square().mean()
