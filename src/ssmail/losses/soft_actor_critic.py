"""Soft actor-critic (Haarnoja et al. 2018) for N agents that each have their own return. All tensors are (B, T, N)
unless said otherwise.

Where implementations differ silently, ssmail takes: the target entropy as given per action dimension (spec:
sac.target_entropy), the temperature loss on log temperature, and no terminal states, because episodes end by truncation
only.
"""

from torch import Tensor


def critic_target(reward: Tensor, next_q: Tensor, next_log_prob: Tensor, temperature: Tensor, gamma: float) -> Tensor:
    """r + gamma * (min_k Q_k(s', a') - temperature * log pi(a' | s')), with next_q (B, T, N, 2)."""
    soft_value = next_q.min(dim=-1).values - temperature * next_log_prob
    return (reward + gamma * soft_value).detach()


def critic_loss(q: Tensor, target: Tensor) -> Tensor:
    """Mean squared error of both critics, summed over the two; q (B, T, N, 2)."""
    return (q - target.unsqueeze(-1)).square().mean(dim=(0, 1, 2)).sum()


def actor_loss(q: Tensor, log_prob: Tensor, temperature: Tensor) -> Tensor:
    """temperature * log pi(a | s) - min_k Q_k(s, a); q (B, T, N, 2)."""
    return (temperature.detach() * log_prob - q.min(dim=-1).values).mean()


def temperature_loss(log_temperature: Tensor, log_prob: Tensor, target_entropy: float) -> Tensor:
    """-log(temperature) * (log pi + target): raises the temperature while the entropy is below its target (nats per
    agent).
    """
    return -(log_temperature * (log_prob.detach() + target_entropy)).mean()
