"""The actor's objective through the known dynamics, and the averaged policy."""

from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import pytest
import torch
from torch import Tensor

from ssmail.config.experiments import build_spec
from ssmail.envs.integrator import Integrator
from ssmail.losses.soft_actor_critic import soft_value
from ssmail.training.actor_critic import Reward, SoftActorCritic, Transitions
from ssmail.training.adversarial import AdversarialLearner, AdversarialTraining
from ssmail.training.checkpoint import UnfitState, load_checkpoint, save_checkpoint
from ssmail.training.loop import TrainingLoop

GAMMA, STEPS = 0.9, 49
NO_TEMPERATURE = torch.zeros(1, 1, 1, 1)


def learner(*overrides: str) -> tuple[AdversarialLearner, TrainingLoop]:
    loop = TrainingLoop(build_spec("ssail", "yjunction", "smoke", [f"sac.gamma={GAMMA}", *overrides]), 0)
    assert isinstance(loop.learner, AdversarialLearner)
    return loop.learner, loop


class Setting:
    """Transitions of generated trajectories at four time steps, the last of which is that of the trajectories."""

    def __init__(self, expansion_steps: int, *overrides: str) -> None:
        one, _ = learner(*overrides)
        self.training = training = AdversarialTraining([one])
        self.generators, self.expansion_steps = one.generators, expansion_steps
        self.sac: SoftActorCritic = training.actor_critic
        batch, _ = training.generate(0.0)
        self.at: Transitions = self.sac._transitions(batch, torch.tensor([[7, 0, STEPS - 2, STEPS - 1]]))

    def critics_say(self, value: float) -> None:
        """Make both critics constant."""
        with torch.no_grad():
            self.sac.critic.last.weight.zero_()
            self.sac.critic.last.bias.fill_(value)

    def loss(self, reward: Reward, temperature: Tensor = NO_TEMPERATURE) -> tuple[Tensor, Tensor]:
        self.generators["policy"].manual_seed(3)
        return self.sac._actor_loss(self.at, temperature, reward, self.expansion_steps)


def always(value: float) -> Reward:
    return lambda x, actions: torch.full(x.shape[:-1], value)


def test_without_expansion_it_is_the_plain_loss() -> None:
    """The critics' estimate of the policy's actions at the stored states; the rewards are not asked for."""
    setting, temperature = Setting(0), torch.full((1, 1, 1, 1), 0.3)
    loss, log_prob = setting.loss(lambda x, actions: pytest.fail("asked for a reward"), temperature)
    setting.generators["policy"].manual_seed(3)
    at, sac = setting.at, setting.sac
    action, expected_log_prob = sac._sample(sac.policy.actor, at.x, at.graph, at.states[..., 2:])
    action = sac.features.normalize_actions(action)
    value = soft_value(sac.critic(at.x, action, at.graph), expected_log_prob, temperature)
    assert torch.equal(loss, -value.mean(dim=(-3, -2, -1)))
    assert torch.equal(log_prob, expected_log_prob)
    expanded, _ = Setting(1).loss(always(0.0), temperature)  # negative control
    assert not torch.equal(loss, expanded)


@pytest.mark.parametrize("steps", [0, 1, 3])
def test_a_constant_reward_is_worth_its_discounted_sum(steps: int) -> None:
    """With critics that say 0: sum of gamma^k r, k < steps; that they say 5 adds gamma^steps * 5."""
    setting = Setting(steps)
    earned = sum(GAMMA**k * 2.0 for k in range(steps))
    for rest in (0.0, 5.0):
        setting.critics_say(rest)
        loss, _ = setting.loss(always(2.0))
        assert loss.tolist() == [pytest.approx(-earned - GAMMA**steps * rest, rel=1e-5)]
    without, _ = setting.loss(always(0.0))  # negative control
    assert (float(without.detach()) == float(loss.detach())) is (steps == 0)


@pytest.mark.parametrize("steps", [0, 3])
def test_with_a_finite_horizon_nothing_counts_after_the_last_step(steps: int) -> None:
    """Of rewards of 2 and critics of 5, a transition with m steps left counts min(m, steps) rewards, and the critics if
    m > steps.
    """
    endless, finite = Setting(steps), Setting(steps, "sac.finite_horizon=true")
    left = [STEPS - step for step in (7, 0, STEPS - 2, STEPS - 1)]
    expected = [sum(GAMMA**k * 2.0 for k in range(min(m, steps))) + (m > steps) * GAMMA**steps * 5.0 for m in left]
    for setting, same in ((finite, True), (endless, steps == 0)):  # the second is the negative control
        setting.critics_say(5.0)
        loss, _ = setting.loss(always(2.0))
        assert (float(loss.detach()) == pytest.approx(-sum(expected) / len(expected), rel=1e-5)) is same


def test_with_a_finite_horizon_critics_learn_that_nothing_follows_the_last_step() -> None:
    """Critics that say 0 are to learn 2 + gamma * 5, of target critics that say 5, and 2 at the last step."""
    fixed_temperature = ("sac.automatic_temperature=false", "sac.temperature=0")
    for horizon, at_the_end in (("true", 2.0), ("false", 2.0 + GAMMA * 5.0)):
        setting = Setting(0, *fixed_temperature, f"sac.finite_horizon={horizon}")
        sac, before = setting.sac, 2.0 + GAMMA * 5.0
        for critic, value in ((sac.critic, 0.0), (sac.target_critic, 5.0)):
            with torch.no_grad():
                critic.last.weight.zero_()
                critic.last.bias.fill_(value)
        batch, _ = setting.training.generate(0.0)
        losses = sac.update(batch, torch.tensor([[STEPS - 2, STEPS - 1]]), always(2.0))
        assert losses["critic/loss"].tolist() == [pytest.approx(before**2 + at_the_end**2, rel=1e-5)]


def test_every_step_pays_for_its_log_probability() -> None:
    """With rewards and critics of 0 the loss is the sum of gamma^k * temperature * log pi: that of the first step,
    which is returned, and then those of the others.
    """
    single, double = Setting(0), Setting(1)
    temperature = torch.full((1, 1, 1, 1), 0.5)
    for setting in (single, double):
        setting.critics_say(0.0)
    (first, log_prob), (both, same) = (setting.loss(always(0.0), temperature) for setting in (single, double))
    assert torch.equal(log_prob, same)
    assert float(first.detach()) == pytest.approx(0.5 * float(log_prob.detach().mean()), rel=1e-5)
    later = float((both - first).detach()) / (GAMMA * 0.5)
    assert later == pytest.approx(float(log_prob.detach().mean()), abs=0.5)  # of the next states: close, not the same
    assert later != float(log_prob.detach().mean())
    half, _ = double.loss(always(0.0), temperature / 2)
    assert float(half.detach()) == pytest.approx(float(both.detach()) / 2, rel=1e-4)


def test_the_states_follow_the_dynamics_and_the_other_features_their_time() -> None:
    """States move by the policy's own actions, the step advances until the end, and the first state stays."""
    setting = Setting(3, "model.start_input=true", "model.time_input=true")
    seen: list[tuple[Tensor, Tensor]] = []

    def watching(x: Tensor, actions: Tensor) -> Tensor:
        seen.append((x.detach(), actions.detach()))
        return torch.zeros(x.shape[:-1])

    setting.loss(watching)
    assert len(seen) == 3
    assert torch.equal(seen[0][0], setting.at.x)
    for (x, actions), (following, _) in pairwise(seen):
        torch.testing.assert_close(following[..., :4], setting.sac.integrator.step(x[..., :4], actions))
        assert not torch.equal(following[..., :4], x[..., :4])
        assert torch.equal(following[..., 5:], x[..., 5:])
    indices = torch.tensor([[7, 0, 47, 48], [8, 1, 48, 49], [9, 2, 49, 49]])
    for (x, _), steps in zip(seen, indices, strict=True):
        torch.testing.assert_close(x[0, 0, :, 0, 4], 2 * steps / STEPS - 1)


def test_the_gradient_follows_the_policy_through_the_dynamics() -> None:
    """The position after one step depends on the action before it; the stored position does not."""

    def position(x: Tensor, actions: Tensor) -> Tensor:
        return x[..., 0]

    for steps, moves in ((1, False), (2, True)):
        setting = Setting(steps)
        setting.critics_say(0.0)
        loss, _ = setting.loss(position)
        (gradient,) = torch.autograd.grad(
            loss.sum(), [setting.sac.policy.actor.head[-1].bias], allow_unused=True, materialize_grads=True
        )
        assert bool(gradient.any()) is moves


def test_the_policy_that_acts_afterwards_is_given() -> None:
    """A reward for the second action reaches the weights through the first one alone: not if the states forget it."""
    for forgets in (True, False):
        setting = Setting(2)
        setting.critics_say(0.0)
        step = setting.sac.integrator.step
        if forgets:
            following = SimpleNamespace(step=lambda states, actions, step=step: step(states, actions).detach())
            setting.sac.integrator = cast(Integrator, following)
        factors = iter((0.0, 1.0))
        loss, _ = setting.loss(lambda x, actions, factors=factors: next(factors) * actions[..., 0])
        (gradient,) = torch.autograd.grad(loss.sum(), [setting.sac.policy.actor.head[-1].bias])
        assert bool(gradient.any()) is not forgets


def weights(network: torch.nn.Module) -> Tensor:
    return torch.cat([p.detach().flatten() for p in network.parameters()])


def test_the_average_is_the_exponential_moving_average_of_the_policys_weights() -> None:
    """By hand over two updates: a = w_0, then a + 0.25 (w - a) twice, and so 0.5625 w_0 + 0.1875 w_1 + 0.25 w_2."""
    one, _ = learner("sac.average=0.25")
    averaged = one.actor_critic.averaged
    assert averaged is not None
    training = AdversarialTraining([one])
    latest, _ = training.generate(0.0)
    passed = [weights(one.actor_critic.policy)]
    assert torch.equal(weights(averaged), passed[0])
    for _ in range(2):
        training.update(latest, latest)
        passed.append(weights(one.actor_critic.policy))
    expected = 0.5625 * passed[0] + 0.1875 * passed[1] + 0.25 * passed[2]
    torch.testing.assert_close(weights(averaged), expected, rtol=1e-5, atol=1e-7)
    assert not torch.allclose(weights(averaged), passed[2], rtol=1e-5, atol=1e-7)  # negative control
    assert not any(p.requires_grad for p in averaged.parameters())


def test_the_averaged_policy_is_what_is_evaluated_and_the_current_one_what_explores() -> None:
    for average in ("0.1", "null"):
        one, loop = learner(f"sac.average={average}")
        loop.run_epoch()
        evaluated, policy = one.predictor.model, one.actor_critic.policy
        assert torch.equal(weights(evaluated), weights(policy)) is (average == "null")
        best = loop.best_state_dict()["policy"]
        assert all(torch.equal(best[name], value) for name, value in evaluated.state_dict().items())
        training = AdversarialTraining([one])
        assert torch.equal(weights(training.predictor.model), weights(policy))
        states, draw = loop.experts.states[:2, :1], torch.Generator()
        before = one.predictor.free_run(states, 3, draw.manual_seed(0))
        with torch.no_grad():
            for p in policy.parameters():
                p.add_(1.0)
        after = one.predictor.free_run(states, 3, draw.manual_seed(0))
        assert torch.equal(before, after) is (average != "null")


def test_a_checkpoint_holds_the_average(tmp_path: Path) -> None:
    one, loop = learner("sac.average=0.1")
    loop.run_epoch()
    save_checkpoint(tmp_path / "last.pt", loop.state_dict())
    fresh, resumed = learner("sac.average=0.1")
    averaged, own = fresh.actor_critic.averaged, one.actor_critic.averaged
    assert averaged is not None
    assert own is not None
    assert not torch.equal(weights(averaged), weights(own))
    resumed.load_state_dict(load_checkpoint(tmp_path / "last.pt"))
    assert torch.equal(weights(averaged), weights(own))
    assert fresh.predictor.model is averaged
    _, plain = learner()
    with pytest.raises(UnfitState, match="actor_critic has other entries"):
        plain.load_state_dict(load_checkpoint(tmp_path / "last.pt"))
    with pytest.raises(UnfitState, match="actor_critic has other entries"):
        resumed.load_state_dict(plain.state_dict())


@pytest.mark.parametrize("steps", [[7, 30], [30, 48]])
def test_the_next_graph_has_read_the_next_state_of_the_dynamics(steps: list[int]) -> None:
    """After an intervention at step 31, which the rollout's own graph of that step has read. The last step has none."""
    sac, generators = (setting := Setting(0, "model.graph_noise=edge")).sac, setting.generators
    with torch.no_grad():
        sac.policy.encoder.head.weight.mul_(100)  # so that the graphs depend on what is read
    batch, _ = setting.training.generate(0.0)
    batch.states[:, :, 31:] = torch.randn(batch.states[:, :, 31:].shape, generator=torch.Generator().manual_seed(1))
    generators["policy"].manual_seed(3)
    at = sac._transitions(batch, torch.tensor([steps]))
    generators["policy"].manual_seed(3)
    noise = sac._draw_graph_noise(at.histories)
    as_stored, _, _ = sac.policy.graphs(at.histories, noise)
    for place, step in enumerate(steps):
        history = torch.cat([at.histories[:, :, : step + 1], at.next_x[:, :, place : place + 1]], dim=2)
        graphs, _, _ = sac.policy.graphs(history, noise[:, :, : step + 2])
        found = at.next_graph[:, :, place].round()
        assert torch.equal(found, graphs[:, :, -1].round())
        unchanged = torch.equal(found, as_stored[:, :, step + 1].round())
        assert unchanged is (step != 30)  # the negative control
