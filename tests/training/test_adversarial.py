import pytest
import torch

from ssmail.experiments import build_spec
from ssmail.training.adversarial import AdversarialLearner
from ssmail.training.loop import TrainingLoop


def learner(*overrides: str) -> tuple[AdversarialLearner, TrainingLoop]:
    loop = TrainingLoop(build_spec("ssail", "yjunction", "smoke", overrides), 0)
    return loop.learner, loop


def test_learning_rates_go_geometrically_from_first_to_final() -> None:
    made, _ = learner("sac.actor_learning_rate_final=0.01", "adversarial.learning_rate_final=0.25")

    def rates(decayed: float) -> dict[str, float]:
        made.set_learning_rates(decayed)
        return {name: o.param_groups[0]["lr"] for name, o in made.optimizers.items()}

    first, middle, last = rates(0), rates(0.5), rates(1)
    assert first["actor"] == made.spec.sac.actor_learning_rate
    assert middle["actor"] == pytest.approx(first["actor"] / 10)
    assert last["actor"] == pytest.approx(first["actor"] / 100)
    assert last["discriminator"] == pytest.approx(first["discriminator"] / 4)


def test_only_states_and_actions_are_blurred() -> None:
    made, loop = learner("adversarial.input_noise=0.1", "model.time_input=true")
    x = made._inputs(loop.experts)
    blurred = made._blurred(x, features=4)
    torch.testing.assert_close(blurred[..., 4:], x[..., 4:], rtol=0, atol=0)
    assert float((blurred - x)[..., :4].std()) == pytest.approx(0.1, rel=0.05)
    sharp, _ = learner("adversarial.input_noise=0")
    assert sharp._blurred(x, features=4) is x


def test_tau_alpha_lies_between_its_pair() -> None:
    made, loop = learner("adversarial.alpha_low=0.5", "adversarial.alpha_high=0.5")
    generated, _ = loop._generate(0.0)
    mixed, alpha = made._mixed(generated, "start")
    assert alpha.tolist() == [0.5] * len(generated)
    expert = loop.experts[generated.source]
    torch.testing.assert_close(mixed.states, (generated.states + expert.states) / 2)
    torch.testing.assert_close(mixed.actions, (generated.actions + expert.actions) / 2)


def test_targets_follow_and_only_the_critic_learns_from_its_loss() -> None:
    """After one update the target critic has gone `polyak` of the way, and gradients are on again everywhere."""
    made, loop = learner("sac.polyak=0.25")
    latest, _ = loop._generate(0.5)
    loop.replay.add(latest)
    before = [p.clone() for p in made.target_critic.parameters()]
    made.update(latest, loop.replay)
    for old, target, source in zip(before, made.target_critic.parameters(), made.critic.parameters(), strict=True):
        torch.testing.assert_close(target, old + 0.25 * (source - old))
    assert all(p.requires_grad for p in made.critic.parameters())
    assert not any(p.requires_grad for p in made.target_critic.parameters())


def test_the_temperature_is_fixed_or_learned() -> None:
    for automatic in (True, False):
        made, loop = learner(f"sac.automatic_temperature={str(automatic).lower()}", "sac.temperature=0.1")
        latest, _ = loop._generate(0.0)
        loop.replay.add(latest)
        made.update(latest, loop.replay)
        moved = abs(float(made.temperature) - 0.1) > 1e-6
        assert moved is automatic
