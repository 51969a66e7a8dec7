import pytest
import torch

from ssmail.losses.soft_actor_critic import actor_loss, critic_loss, critic_target, temperature_loss


def test_critic_target_by_hand() -> None:
    """1 + 0.9 * (min(3, 2) - 0.5 * (-4)) = 1 + 0.9 * 4 = 4.6, and no gradient flows into it."""
    next_q = torch.tensor([3.0, 2.0], requires_grad=True).view(1, 1, 1, 2)
    target = critic_target(torch.ones(1, 1, 1), next_q, torch.full((1, 1, 1), -4.0), torch.tensor(0.5), 0.9)
    assert float(target) == pytest.approx(4.6)
    assert not target.requires_grad


def test_a_constant_reward_is_worth_its_geometric_sum() -> None:
    """Bootstrapping at the end (truncation): the fixed point is r / (1 - gamma); cutting it off at the last step would
    be wrong.
    """
    q, reward, gamma = torch.zeros(1, 1, 1, 2), torch.ones(1, 1, 1), 0.9
    for _ in range(200):
        q = critic_target(reward, q, torch.zeros(1, 1, 1), torch.tensor(0.0), gamma).unsqueeze(-1).expand(1, 1, 1, 2)
    assert float(q[..., 0]) == pytest.approx(1 / (1 - gamma), rel=1e-4)
    terminal = sum(gamma**t for t in range(10))
    assert terminal < 0.7 / (1 - gamma)


def test_critic_loss_by_hand() -> None:
    q = torch.tensor([[1.0, 3.0], [2.0, 2.0]]).view(1, 1, 2, 2)
    target = torch.tensor([2.0, 4.0]).view(1, 1, 2)
    assert float(critic_loss(q, target)) == pytest.approx((1 + 4) / 2 + (1 + 4) / 2)


def test_actor_loss_by_hand() -> None:
    q = torch.tensor([[1.0, 3.0], [2.0, -2.0]]).view(1, 1, 2, 2)
    log_prob = torch.tensor([0.5, -1.0]).view(1, 1, 2)
    assert float(actor_loss(q, log_prob, torch.tensor(2.0))) == pytest.approx(((2 * 0.5 - 1) + (2 * -1 + 2)) / 2)


@pytest.mark.parametrize(("log_prob", "rises"), [(5.0, True), (-5.0, False)])
def test_temperature_follows_the_entropy(log_prob: float, rises: bool) -> None:
    """An entropy of -5 is below a target of 0, so the temperature must rise; one of 5 lets it fall."""
    log_temperature = torch.zeros((), requires_grad=True)
    temperature_loss(log_temperature, torch.full((2, 3, 1), log_prob), 0.0).backward()
    assert log_temperature.grad is not None
    assert (float(log_temperature.grad) < 0) is rises
