"""Discriminator losses and rewards of ssail, gail and wail.

Everywhere 0 = generated and 1 = expert: a higher output D means "more like the expert" and is a higher reward. Outputs
are (B, T, N); the losses are scalars to minimize. With an axis of S seeds in front, there is one loss per seed, (S,).
"""

from collections.abc import Callable

import torch
from torch import Tensor, nn

from ssmail.losses import PER_SEED, Terms


def ssail_loss(
    generated: Tensor, expert: Tensor, mixed: Tensor | None = None, labels: Tensor | None = None, weight: float = 1.0
) -> tuple[Tensor, Terms]:
    """Eq. 3: (0 - D(tau_G))^2 + (1 - D(tau_E))^2 + (label(alpha) - D(tau_alpha))^2, each averaged over B, T and N.

    labels: (B,), or (S, B), targets for the mixed trajectories: alpha itself in the paper, or that of A.2
    (`ssmail.losses.labels`). weight: of the last term, 1 in the paper. Without `mixed` there is no such term, and the
    loss is that of least-squares GAN (Mao et al. 2017).
    """
    terms = {
        "generated": generated.square().mean(dim=PER_SEED),
        "expert": (1 - expert).square().mean(dim=PER_SEED),
    }
    loss = terms["generated"] + terms["expert"]
    if mixed is None or labels is None:
        return loss, terms
    target = labels.view(*labels.shape, *[1] * (mixed.dim() - labels.dim()))
    terms["self_supervised"] = weight * (target - mixed).square().mean(dim=PER_SEED)
    return loss + terms["self_supervised"], terms


def ssail_reward(output: Tensor) -> Tensor:
    """D itself: Alg. 1 trains the policy to increase the expectation of D."""
    return output


def gail_loss(generated: Tensor, expert: Tensor) -> tuple[Tensor, Terms]:
    """Binary cross-entropy of logits, -log(1 - sigmoid(D(tau_G))) - log sigmoid(D(tau_E)): Eq. 1 with ssmail's labels.

    Where generated and expert data have densities p_G and p_E, the optimal logit is log(p_E / p_G).
    """
    terms = {
        "generated": nn.functional.softplus(generated).mean(dim=PER_SEED),
        "expert": nn.functional.softplus(-expert).mean(dim=PER_SEED),
    }
    return terms["generated"] + terms["expert"], terms


def gail_reward(logit: Tensor) -> Tensor:
    """-log(1 - sigmoid(logit)) = softplus(logit), never negative; sigmoid(logit) is the probability of "expert".

    Ho and Ermon (2016) minimize E_pi[log D] with D = 1 on the policy. With ssmail's labels their D is
    1 - sigmoid(logit), so the reward to maximize is -log(1 - sigmoid(logit)). softplus does not overflow.
    """
    return nn.functional.softplus(logit)


def gail_probability(logit: Tensor) -> Tensor:
    """sigmoid(logit), the probability of "expert": a reward that hardly rises where the discriminator is sure."""
    return torch.sigmoid(logit)


def wail_loss(generated: Tensor, expert: Tensor) -> tuple[Tensor, Terms]:
    """mean D(tau_G) - mean D(tau_E): minus the critic's estimate of the Wasserstein distance (Eq. 2)."""
    terms = {"generated": generated.mean(dim=PER_SEED), "expert": -expert.mean(dim=PER_SEED)}
    return terms["generated"] + terms["expert"], terms


def wail_reward(output: Tensor) -> Tensor:
    """The Wasserstein critic's output, which is trained to be high on the expert (Xiao et al. 2019)."""
    return output


def gradient_penalty(
    critic: Callable[[Tensor, Tensor], Tensor],
    generated: tuple[Tensor, Tensor],
    expert: tuple[Tensor, Tensor],
    mix: Tensor,
) -> Tensor:
    """WGAN-GP: E[(||gradient|| - 1)^2] between generated and expert transitions (Gulrajani et al. 2017).

    generated, expert: features (B, T, N, F) and actions (B, T, N, A). mix: (B, T) in [0, 1], one draw per transition,
    which its agents share. The gradient is that of the sum of all agents' scores, and the norm that of each agent's own
    inputs. So a critic of a single agent gets the usual penalty, and the influence of agents on each other counts too.
    """
    weight = mix[..., None, None]
    inputs = [torch.lerp(g, e, weight).requires_grad_() for g, e in zip(generated, expert, strict=True)]
    gradients = torch.autograd.grad(critic(*inputs).sum(), inputs, create_graph=True)
    norm = torch.cat(gradients, dim=-1).square().sum(dim=-1).add(1e-12).sqrt()  # (B, T, N); differentiable at 0
    return (norm - 1).square().mean(dim=PER_SEED)
