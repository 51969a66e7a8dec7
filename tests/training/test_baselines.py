"""Constant velocity and the copied last state, with and without noise on what they read."""

import pytest
import torch
from torch import Tensor

from ssmail.data.scaling import Scaling
from ssmail.envs.integrator import Integrator
from ssmail.training.baselines import BaselineLearner, ConstantVelocity, CopyLast

SCALING = Scaling(-20.0, 45.0, -0.7, 1.1)
INTEGRATOR = Integrator(SCALING)
B, H, N, D, STEPS = 3, 4, 2, 6, 7


def drawn(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


OBSERVED, NOISE = drawn(B, H, N, D), drawn(B, H + STEPS - 1, N, D, seed=1)


def free_run(predictor: ConstantVelocity | CopyLast, noise: Tensor | None = None) -> Tensor:
    return predictor.free_run(OBSERVED, STEPS, torch.Generator(), noise=noise)


def test_constant_velocity_goes_straight_on_from_the_last_observed_state() -> None:
    raw = SCALING.unscale_positions(free_run(ConstantVelocity(INTEGRATOR))[..., :3])
    last = OBSERVED[:, -1:]
    velocity = SCALING.unscale_velocities(last[..., 3:])
    expected = SCALING.unscale_positions(last[..., :3]) + velocity * torch.arange(STEPS + 1).view(1, -1, 1, 1)
    torch.testing.assert_close(raw, expected)


def test_noise_on_velocities_adds_up_and_noise_on_positions_does_nothing_to_constant_velocity() -> None:
    """With e_t on the velocity read at t: v_T is off by the sum of e_t, and p_T by the sum of what v was off so far."""
    predictor = ConstantVelocity(INTEGRATOR)
    error = free_run(predictor, NOISE) - free_run(predictor)
    of_velocity = NOISE[:, H - 1 :, :, 3:].cumsum(dim=1)
    of_position = of_velocity.cumsum(dim=1) * (SCALING.velocity_span / SCALING.position_span)
    assert not error[:, 0].any()
    torch.testing.assert_close(error[:, 1:], torch.cat([of_position, of_velocity], dim=-1))
    only_positions = NOISE.clone()
    only_positions[..., 3:] = 0
    torch.testing.assert_close(free_run(predictor, only_positions), free_run(predictor))


def test_a_copy_is_of_the_last_state_as_it_was_read() -> None:
    """Once read it is copied: the noise of later steps is not in it, that of the last observed one in all copies."""
    copies = free_run(CopyLast(), NOISE)
    assert torch.equal(copies[:, 0], OBSERVED[:, -1])
    as_read = (OBSERVED + NOISE[:, :H])[:, -1:]
    assert torch.equal(copies[:, 1:], as_read.expand(-1, STEPS, -1, -1))
    assert torch.equal(free_run(CopyLast()), OBSERVED[:, -1:].expand(-1, STEPS + 1, -1, -1))


@pytest.mark.parametrize("predictor", [ConstantVelocity(INTEGRATOR), CopyLast()])
def test_what_was_read_before_the_last_observed_state_does_not_matter(predictor: ConstantVelocity | CopyLast) -> None:
    early, late = NOISE.clone(), NOISE.clone()
    early[:, : H - 1] += 1
    late[:, H - 1] += 1
    assert torch.equal(free_run(predictor, early), free_run(predictor, NOISE))
    assert not torch.equal(free_run(predictor, late), free_run(predictor, NOISE))


def test_one_step_by_hand() -> None:
    """Positions of range 2 and velocities too: scaled and raw units are the same."""
    states = torch.tensor([[[[0.5, 0.25]], [[0.25, 0.5]], [[0.0, 0.0]]]])
    unit = ConstantVelocity(Integrator(Scaling(-1.0, 1.0, -1.0, 1.0)))
    assert unit.one_step(states, torch.Generator()).tolist() == [[[[0.75, 0.25]], [[0.75, 0.5]]]]
    assert torch.equal(CopyLast().one_step(states, torch.Generator()), states[:, :-1])


def test_there_is_nothing_to_learn_or_save() -> None:
    learner = BaselineLearner(CopyLast())
    assert (learner.networks(), learner.parts(), learner.predictor.model.state_dict()) == ([], {}, {})
    with pytest.raises(NotImplementedError, match="nothing to learn"):
        learner.run_epoch(0)
