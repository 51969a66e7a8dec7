"""tau_alpha is a trajectory of the integrator's world, and not of one with walls, contacts or headings."""

from collections.abc import Callable

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from ssmail.adapters.mixing_check import Step, mixed_violation, violation
from ssmail.data.scaling import Scaling
from ssmail.envs.integrator import Integrator

INTEGRATOR = Integrator(Scaling(-20.0, 45.0, -0.7, 1.1)).step


def walls(state: Tensor, action: Tensor) -> Tensor:
    """Agents in the square [-1, 1]²: a wall stops what would pass it."""
    position = (state[..., :2] + action).clamp(-1, 1)
    return torch.cat([position, position - state[..., :2]], dim=-1)


def contacts(state: Tensor, action: Tensor) -> Tensor:
    """Discs of radius 0.3 that push each other apart where they would overlap."""
    position = state[..., :2] + action
    apart = position.unsqueeze(-3) - position.unsqueeze(-2)  # (B, T, N, N, 2): of each agent, the way to every agent
    distance = apart.norm(dim=-1, keepdim=True).clamp_min(1e-9)
    position = position - (apart / distance * (0.6 - distance).clamp_min(0) / 2).sum(dim=-2)
    return torch.cat([position, position - state[..., :2]], dim=-1)


def headings(state: Tensor, action: Tensor) -> Tensor:
    """Vehicles [x, y, heading, speed] that are steered: an action is a turn and an acceleration."""
    x, y, heading, speed = state.unbind(dim=-1)
    turned, faster = heading + action[..., 0], speed + action[..., 1]
    return torch.stack([x + faster * turned.cos(), y + faster * turned.sin(), turned, faster], dim=-1)


def damped(state: Tensor, action: Tensor) -> Tensor:
    """Particles with linear friction that are pushed, as those of MPE where nothing touches: an action is a force."""
    velocity = 0.75 * state[..., 2:] + 0.1 * action
    return torch.cat([state[..., :2] + 0.1 * velocity, velocity], dim=-1)


def roll(step: Step, seed: int) -> tuple[Tensor, Tensor]:
    """States (4, 13, 3, 4) and actions (4, 12, 3, 2) of random trajectories that obey the dynamics."""
    draw = torch.Generator().manual_seed(seed)
    actions = 0.5 * torch.randn(4, 12, 3, 2, generator=draw, dtype=torch.float64)
    states = [2 * torch.rand(4, 1, 3, 4, generator=draw, dtype=torch.float64) - 1]
    for t in range(actions.shape[1]):
        states.append(step(states[-1], actions[:, t : t + 1]))
    return torch.cat(states, dim=1), actions


AFFINE = [INTEGRATOR, damped]
OTHERS = [walls, contacts, headings]


@pytest.mark.parametrize("step", AFFINE + OTHERS)
def test_a_trajectory_obeys_the_dynamics_that_made_it(step: Step) -> None:
    states, actions = roll(step, seed=0)
    assert violation(step, states, actions) < 1e-12
    assert violation(step, states, actions + 0.01) > 1e-3


@given(alpha=st.floats(-1, 1.5), seed=st.integers(0, 1000))
def test_where_the_dynamics_are_affine_every_mix_is_a_trajectory(alpha: float, seed: int) -> None:
    for step in AFFINE:
        alphas = torch.full((4,), alpha, dtype=torch.float64)
        assert mixed_violation(step, roll(step, seed), roll(step, seed + 1), alphas) < 1e-6


@pytest.mark.parametrize("alpha", [-0.5, 0.5])
@pytest.mark.parametrize("step", OTHERS)
def test_walls_contacts_and_headings_make_a_mix_infeasible(step: Callable[..., Tensor], alpha: float) -> None:
    alphas = torch.full((4,), alpha, dtype=torch.float64)
    assert mixed_violation(step, roll(step, 0), roll(step, 1), alphas) > 0.05


def test_of_a_convex_area_a_mix_leaves_only_beyond_the_expert_or_behind_the_policy() -> None:
    """Within walls that nobody touches the dynamics are affine, but only an alpha in [0, 1] stays within them."""
    positions = torch.tensor([[[-0.9, 0.0]], [[0.9, 0.0]]], dtype=torch.float64)
    states = torch.cat([positions, torch.zeros_like(positions)], dim=-1).unsqueeze(1).repeat(1, 3, 1, 1)
    still = torch.zeros(1, 2, 1, 2, dtype=torch.float64)
    generated, expert = ((s.unsqueeze(0), still) for s in states)
    for alpha, most in ((0.3, 1e-12), (1.0, 1e-12)):
        assert mixed_violation(walls, generated, expert, torch.tensor([alpha], dtype=torch.float64)) < most
    for alpha in (-0.5, 1.5):
        assert mixed_violation(walls, generated, expert, torch.tensor([alpha], dtype=torch.float64)) > 0.5
