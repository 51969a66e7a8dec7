"""What the updates of all learners share."""

import math

import pytest
import torch

from ssmail.training.optimization import add_noise, clipped_step, mean_metrics


@pytest.mark.parametrize(("limit", "norm"), [(1.0, 1.0), (100.0, 5.0)])
def test_a_step_goes_down_a_gradient_of_limited_norm(limit: float, norm: float) -> None:
    """The gradient (3, 4) has norm 5; a step of rate 1 is as long as what is left of it."""
    weights = torch.zeros(2, requires_grad=True)
    clipped_step(torch.optim.SGD([weights], lr=1.0), weights @ torch.tensor([3.0, 4.0]), [weights], limit)
    assert weights.tolist() == pytest.approx([-0.6 * norm, -0.8 * norm], rel=1e-5)


def test_noise_has_its_size_and_none_is_drawn_for_nothing() -> None:
    x, generator = torch.zeros(40_000), torch.Generator().manual_seed(0)
    before = generator.get_state()
    assert add_noise(x, 0, generator) is x
    assert torch.equal(generator.get_state(), before)
    noisy = add_noise(x, 0.1, generator)
    assert float(noisy.std()) == pytest.approx(0.1, rel=0.02)
    assert abs(float(noisy.mean())) < 0.002
    assert not torch.equal(generator.get_state(), before)


def test_means_of_records() -> None:
    assert mean_metrics([{"a": 1.0, "b": math.inf}, {"a": 4.0, "b": 0.0}]) == {"a": 2.5, "b": math.inf}
