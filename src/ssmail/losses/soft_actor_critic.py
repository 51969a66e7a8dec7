"""Soft actor-critic (Haarnoja et al. 2018) for N agents that each have a return of their own.

Tensors are (B, T, N) and Q-values of the twin critics (B, T, N, 2), with an axis of S seeds in front or without; losses
are scalars, or (S,). Temperatures are scalars or broadcast to the tensors.

Implementations of SAC differ silently in some choices. In ssmail the target entropy is given per action dimension
(spec: sac.target_entropy), the temperature loss is on the log temperature, and episodes end by truncation: no state is
terminal, unless sac.finite_horizon sets the value after a trajectory's last step to zero.
"""

import torch
from torch import Tensor

from ssmail.losses import PER_SEED


def soft_value(q: Tensor, log_prob: Tensor, temperature: Tensor) -> Tensor:
    """min_k Q_k(s, a) - temperature * log pi(a | s), for an action a of the policy."""
    return torch.minimum(*q.unbind(dim=-1)) - temperature * log_prob


def critic_target(reward: Tensor, next_value: Tensor, gamma: Tensor | float) -> Tensor:
    """r + gamma * V(s'), without a gradient. gamma broadcasts to the rewards; it is 0 where s' is terminal."""
    return (reward + gamma * next_value).detach()


def critic_loss(q: Tensor, target: Tensor) -> Tensor:
    """Mean squared error of each critic, summed over the two."""
    return (q - target.unsqueeze(-1)).square().sum(dim=-1).mean(dim=PER_SEED)


def temperature_loss(log_temperature: Tensor, log_prob: Tensor, target_entropy: float) -> Tensor:
    """Mean of -log(temperature) * (log pi + target entropy), in nats per agent.

    It raises the temperature while the entropy is below its target.
    """
    return -(log_temperature * (log_prob.detach() + target_entropy)).mean(dim=PER_SEED)
