import pytest
import torch

from ssmail.losses.soft_actor_critic import critic_loss, critic_target, soft_value, temperature_loss


def test_critic_target_by_hand() -> None:
    """1 + 0.9 * (min(3, 2) - 0.5 * (-4)) = 1 + 0.9 * 4 = 4.6, and no gradient flows into it."""
    next_q = torch.tensor([3.0, 2.0], requires_grad=True).view(1, 1, 1, 2)
    next_value = soft_value(next_q, torch.full((1, 1, 1), -4.0), torch.tensor(0.5))
    target = critic_target(torch.ones(1, 1, 1), next_value, 0.9)
    assert float(target) == pytest.approx(4.6)
    assert not target.requires_grad


@pytest.mark.parametrize("steps", [1, 10])
def test_a_constant_reward_is_worth_its_geometric_sum(steps: int) -> None:
    """Bootstrapping at the end (truncation): the fixed point is r / (1 - gamma). With a gamma of 0 at the last step it
    is the sum over the steps that are left, which is less.
    """
    endless, finite, gamma = torch.zeros(1, 1, 1), torch.zeros(1, steps + 1, 1), 0.9
    last = torch.arange(steps).view(1, -1, 1) == steps - 1
    for _ in range(200):
        endless = critic_target(torch.ones(1, 1, 1), endless, gamma)
        finite[:, :-1] = critic_target(torch.ones(1, steps, 1), finite[:, 1:], gamma * ~last)
    assert float(endless) == pytest.approx(1 / (1 - gamma), rel=1e-4)
    assert float(finite[0, 0, 0]) == pytest.approx(sum(gamma**t for t in range(steps)))
    assert float(finite[0, 0, 0]) < 0.7 * float(endless)


def test_critic_loss_by_hand() -> None:
    q = torch.tensor([[1.0, 3.0], [2.0, 2.0]]).view(1, 1, 2, 2)
    target = torch.tensor([2.0, 4.0]).view(1, 1, 2)
    assert float(critic_loss(q, target)) == pytest.approx((1 + 4) / 2 + (1 + 4) / 2)


def test_soft_value_by_hand() -> None:
    q = torch.tensor([[1.0, 3.0], [2.0, -2.0]]).view(1, 1, 2, 2)
    log_prob = torch.tensor([0.5, -1.0]).view(1, 1, 2)
    assert soft_value(q, log_prob, torch.tensor(2.0)).flatten().tolist() == [1 - 2 * 0.5, -2 + 2 * 1]


@pytest.mark.parametrize(("log_prob", "rises"), [(5.0, True), (-5.0, False)])
def test_temperature_follows_the_entropy(log_prob: float, rises: bool) -> None:
    """An entropy of -5 is below a target of 0, so the temperature must rise; one of 5 lets it fall."""
    log_temperature = torch.zeros((), requires_grad=True)
    temperature_loss(log_temperature, torch.full((2, 3, 1), log_prob), 0.0).backward()
    assert log_temperature.grad is not None
    assert (float(log_temperature.grad) < 0) is rises
