"""The losses and rewards of gail and wail, on problems whose answer is known."""

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from ssmail.losses.adversarial import (
    gail_loss,
    gail_probability,
    gail_reward,
    gradient_penalty,
    ssail_reward,
    wail_loss,
    wail_reward,
)


def outputs(*values: float) -> torch.Tensor:
    return torch.tensor(values).view(-1, 1, 1)


def test_gail_loss_by_hand() -> None:
    """-log(1 - sigmoid(0)) - log sigmoid(log 3) = log 2 + log(4/3)."""
    loss, terms = gail_loss(outputs(0.0), outputs(math.log(3)))
    assert float(terms["generated"]) == pytest.approx(math.log(2))
    assert float(terms["expert"]) == pytest.approx(math.log(4 / 3))
    assert float(loss) == pytest.approx(math.log(2) + math.log(4 / 3))


def test_gail_reaches_the_logit_of_the_density_ratio() -> None:
    """Two points: the generator is at the first in 3 of 4 cases, the expert in 1 of 4, so the logits are log(1/3) and
    log(3). Negative control: with the labels swapped the optimum has the other sign.
    """
    generated, expert = torch.tensor([0, 0, 0, 1]), torch.tensor([0, 1, 1, 1])
    for swapped in (False, True):
        logits = torch.zeros(2, requires_grad=True)
        optimizer = torch.optim.SGD([logits], lr=2.0)
        for _ in range(400):
            pair = (logits[generated].view(-1, 1, 1), logits[expert].view(-1, 1, 1))
            loss, _ = gail_loss(*(reversed(pair) if swapped else pair))
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
        sign = -1 if swapped else 1
        torch.testing.assert_close(
            logits.detach(), sign * torch.tensor([-1.0, 1.0]) * math.log(3), atol=1e-3, rtol=1e-3
        )


@given(st.floats(-30, 30), st.floats(0.01, 5))
def test_rewards_rise_with_what_is_called_expert(output: float, more: float) -> None:
    for reward in (gail_reward, wail_reward, ssail_reward):
        low, high = reward(torch.tensor([output, output + more], dtype=torch.float64))
        assert high > low


def test_gail_reward_is_minus_log_of_one_minus_the_probability() -> None:
    logits = torch.tensor([-3.0, 0.0, 2.0])
    torch.testing.assert_close(gail_reward(logits), -torch.log(1 - torch.sigmoid(logits)))
    assert float(gail_reward(torch.tensor(0.0))) == pytest.approx(math.log(2))
    assert torch.isfinite(gail_reward(torch.tensor([-1e4, 1e4]))).all()


def test_gail_as_a_probability_is_flat_where_the_discriminator_is_sure() -> None:
    logits = torch.tensor([-20.0, math.log(3), 20.0], requires_grad=True)
    reward = gail_probability(logits)
    torch.testing.assert_close(reward.detach(), torch.tensor([0.0, 0.75, 1.0]), atol=1e-6, rtol=0)
    (slope,) = torch.autograd.grad(reward.sum(), logits)
    torch.testing.assert_close(slope, torch.tensor([0.0, 0.1875, 0.0]), atol=1e-6, rtol=0)
    (own,) = torch.autograd.grad(gail_reward(logits).sum(), logits)
    assert float(own[2]) > 0.99  # negative control: gail's own reward still rises there


def test_wail_loss_is_the_negative_gap() -> None:
    loss, terms = wail_loss(outputs(1.0, 2.0), outputs(4.0, 6.0))
    assert float(loss) == 1.5 - 5.0
    assert float(terms["generated"] + terms["expert"]) == float(loss)


def transitions(generator: torch.Generator) -> tuple[torch.Tensor, torch.Tensor]:
    return (
        torch.randn(3, 4, 2, 5, generator=generator),  # features (B, T, N, F)
        torch.randn(3, 4, 2, 2, generator=generator),  # actions (B, T, N, A)
    )


def test_penalty_of_a_linear_critic_is_known() -> None:
    """The gradient of w . [x, a] is w everywhere: (|w| - 1)^2, wherever the mix falls."""
    generator = torch.Generator().manual_seed(0)
    generated, expert = transitions(generator), transitions(generator)
    weight = torch.tensor([1.0, -2.0, 0.0, 1.0, 1.0, 3.0, 0.0])
    for scale in (1.0, 0.5, 1 / 4):
        for mix in (torch.zeros(3, 4), torch.rand(3, 4, generator=generator)):
            value = gradient_penalty(lambda x, a, s=scale: torch.cat([x, a], -1) @ (s * weight), generated, expert, mix)
            assert float(value) == pytest.approx((4 * scale - 1) ** 2, abs=1e-5)  # |w| = 4


def test_penalty_is_taken_between_generated_and_expert_and_teaches_the_critic() -> None:
    """For D = c x^2 / 2 of one agent with one feature the gradient is c x, so the mix decides the value."""
    generated = (torch.zeros(1, 1, 1, 1), torch.zeros(1, 1, 1, 0))
    expert = (torch.full((1, 1, 1, 1), 2.0), torch.zeros(1, 1, 1, 0))
    c = torch.tensor(3.0, requires_grad=True)
    for mix, expected in ((0.0, 1.0), (0.5, 4.0), (1.0, 25.0)):  # (3 * 2 * mix - 1)^2
        value = gradient_penalty(
            lambda x, a: (c * x.square() / 2).sum(-1) + a.sum(-1), generated, expert, torch.full((1, 1), mix)
        )
        assert value.item() == pytest.approx(expected, abs=1e-4)
    (gradient,) = torch.autograd.grad(value, c)  # d/dc (2 c - 1)^2 = 4 (2 c - 1)
    assert float(gradient) == pytest.approx(20.0, rel=1e-4)


def test_penalty_counts_what_agents_hear_of_each_other() -> None:
    """With D_i = x_i + x_j of two agents the sum is 2 x_1 + 2 x_2: each gradient is 2, not 1."""
    ends = (torch.zeros(1, 1, 2, 1), torch.zeros(1, 1, 2, 0))
    heard = gradient_penalty(lambda x, a: x.sum(dim=(-2, -1)).unsqueeze(-1) + a.sum(-1), ends, ends, torch.zeros(1, 1))
    alone = gradient_penalty(lambda x, a: x.sum(-1) + a.sum(-1), ends, ends, torch.zeros(1, 1))
    assert float(heard) == pytest.approx(1.0, abs=1e-5)
    assert float(alone) == pytest.approx(0.0, abs=1e-5)
