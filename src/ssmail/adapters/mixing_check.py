"""Whether a world lets its trajectories be mixed, as SS-AIL does with tau_alpha (section 3.1.2).

Where the next state is an affine function of state and action, (1 - alpha) * tau_G + alpha * tau_E obeys the dynamics
for every alpha. Walls, contacts and headings break this (docs/adapters.md).
"""

from collections.abc import Callable

from torch import Tensor

from ssmail.losses.self_supervision import mix

Step = Callable[[Tensor, Tensor], Tensor]
"""The dynamics: from states (B, T, ...) and actions (B, T, ...) to the next states (B, T, ...)."""


def violation(step: Step, states: Tensor, actions: Tensor) -> float:
    """Return how far trajectories are from obeying the dynamics, at most: max |step(s[t], a[t]) - s[t + 1]|.

    states: (B, T + 1, ...). actions: (B, T, ...), taken in states[:, :T]. The result has the unit of the states, and is
    0 up to rounding for trajectories of this world.
    """
    return float((step(states[:, :-1], actions) - states[:, 1:]).abs().max())


def mixed_violation(
    step: Step, generated: tuple[Tensor, Tensor], expert: tuple[Tensor, Tensor], alpha: Tensor
) -> float:
    """Return the `violation` of tau_alpha, for states and actions of tau_G and tau_E and alphas (B,)."""
    states, actions = (mix(g, e, alpha) for g, e in zip(generated, expert, strict=True))
    return violation(step, states, actions)
