import pytest
import torch

from ssmail.config.experiments import build_spec
from ssmail.config.sections import required
from ssmail.training.adversarial import AdversarialLearner, AdversarialTraining, input_noise
from ssmail.training.batches import Batch
from ssmail.training.loop import TrainingLoop


def learner(*overrides: str, method: str = "ssail") -> tuple[AdversarialLearner, TrainingLoop]:
    loop = TrainingLoop(build_spec(method, "yjunction", "smoke", overrides), 0)
    assert isinstance(loop.learner, AdversarialLearner)
    return loop.learner, loop


def training(*overrides: str, method: str = "ssail") -> AdversarialTraining:
    """The training of seed 0 alone: tensors have an axis of length 1 in front."""
    return AdversarialTraining([learner(*overrides, method=method)[0]])


def updated(made: AdversarialTraining, latest: Batch | None = None) -> dict[str, torch.Tensor]:
    """Take an update on tau_G, by default of a new rollout, which is also all that the replay buffer holds."""
    latest = made.generate(0.0)[0] if latest is None else latest
    return made.update(latest, latest)


def test_learning_rates_go_geometrically_from_first_to_final() -> None:
    made, _ = learner(
        "sac.actor_learning_rate_final=0.01",
        "adversarial.learning_rate_final=0.25",
        "training.decay_start=0.0",
        "training.epochs=5",
    )

    last_epoch = made.training.epochs - 1

    def rates(epoch: int) -> dict[str, float]:
        made.schedule.set(epoch)
        return {name: o.param_groups[0]["lr"] for name, o in made.schedule.optimizers.items()}

    first, middle, last = rates(0), rates(last_epoch // 2), rates(last_epoch)
    assert first["actor"] == made.actor_critic.spec.actor_learning_rate
    assert middle["actor"] == pytest.approx(first["actor"] / 10)
    assert last["actor"] == pytest.approx(first["actor"] / 100)
    assert last["discriminator"] == pytest.approx(first["discriminator"] / 4)


def test_only_states_and_actions_are_blurred() -> None:
    made = training("adversarial.input_noise=0.1", "model.time_input=true")
    x = made.features(made.experts.states[:, :-1], made.experts.states[:, 0]).unsqueeze(0)
    blurred = made._add_input_noise(x, features=4)
    torch.testing.assert_close(blurred[..., 4:], x[..., 4:], rtol=0, atol=0)
    assert float((blurred - x)[..., :4].std()) == pytest.approx(0.1, rel=0.05)
    sharp = training("adversarial.input_noise=0")
    assert torch.equal(sharp._add_input_noise(x, features=4), x)


def test_the_blur_of_d_falls_from_its_start_on() -> None:
    """From 0.2 to a sixteenth over the last half of five epochs; by default it stays."""
    spec = training("adversarial.input_noise=0.2", "adversarial.input_noise_final=0.0625").adversarial
    falling = [input_noise(spec, epoch, 5) for epoch in range(5)]
    assert falling == pytest.approx([0.2, 0.1, 0.05, 0.025, 0.0125])
    late = spec.model_copy(update={"input_noise_start": 0.5})
    assert [input_noise(late, epoch, 5) for epoch in range(5)] == pytest.approx([0.2, 0.2, 0.2, 0.05, 0.0125])
    assert input_noise(training("adversarial.input_noise=0.2").adversarial, 4, 5) == 0.2


def test_the_actors_objective_expands_from_its_start_on(monkeypatch: pytest.MonkeyPatch) -> None:
    made = training("sac.expansion_steps=3", "sac.expansion_start=0.5", "training.epochs=4", "training.updates=1")
    asked: list[int] = []
    update = made.actor_critic.update
    monkeypatch.setattr(
        made.actor_critic, "update", lambda *a, **k: asked.append(k["expansion_steps"]) or update(*a, **k)
    )
    for epoch in range(4):
        made.run_epoch(epoch)
    assert asked == [0, 0, 3, 3]


def test_tau_alpha_lies_between_its_pair() -> None:
    made = training("self_supervision.alpha=[0.5,0.5]")
    generated, _ = made.generate(0.0)
    mixed, alpha = made._mixed(generated, required(made.supervision), "start")
    assert alpha.tolist() == [[0.5] * len(generated)]
    expert = made.experts[generated.source]
    torch.testing.assert_close(mixed.states, (generated.states + expert.states) / 2)
    torch.testing.assert_close(mixed.actions, (generated.actions + expert.actions) / 2)


def test_d_is_trained_on_the_label_of_alpha() -> None:
    """With every alpha 1.5 and D the constant 0, the self-supervised term is the label's square: 1.5 or 0."""
    for label, term in (("identity", 2.25), ("zero-above-one", 0.0), ("[[0,0],[1,1],[2,0]]", 0.25)):
        made = training("self_supervision.alpha=[1.5,1.5]", f"self_supervision.label={label}")
        for parameter in list(made.discriminator.head.parameters())[-2:]:
            torch.nn.init.zeros_(parameter)
        latest, _ = made.generate(0.0)
        terms = made._update_discriminator(latest, latest)
        assert terms["discriminator/self_supervised"].tolist() == [pytest.approx(term)]


def test_targets_follow_and_only_the_critic_learns_from_its_loss() -> None:
    """After one update the target critic has gone `polyak` of the way, and gradients are on again everywhere."""
    made = training("sac.polyak=0.25")
    before = [p.clone() for p in made.actor_critic.target_critic.parameters()]
    updated(made, made.generate(0.5)[0])
    for old, target, source in zip(
        before, made.actor_critic.target_critic.parameters(), made.actor_critic.critic.parameters(), strict=True
    ):
        torch.testing.assert_close(target, old + 0.25 * (source - old))
    assert all(p.requires_grad for p in made.actor_critic.critic.parameters())
    assert not any(p.requires_grad for p in made.actor_critic.target_critic.parameters())


def test_the_temperature_is_fixed_or_learned() -> None:
    for automatic in (True, False):
        made = training(f"sac.automatic_temperature={str(automatic).lower()}", "sac.temperature=0.1")
        updated(made)
        moved = abs(float(made.actor_critic.temperature) - 0.1) > 1e-6
        assert moved is automatic


def test_methods_differ_only_in_what_the_discriminator_is_taught() -> None:
    """Same seed: the same weights, the same first tau_G and the same temperature; then their own terms."""
    made = {method: training(method=method) for method in ("ssail", "gail", "wail")}
    latest = {method: one.generate(0.0)[0] for method, one in made.items()}
    for method in ("gail", "wail"):
        assert torch.equal(latest[method].states, latest["ssail"].states)
        for p, q in zip(made[method].discriminator.parameters(), made["ssail"].discriminator.parameters(), strict=True):
            assert torch.equal(p, q)
    terms = {}
    for method, one in made.items():
        terms[method] = {name for name in updated(one, latest[method]) if name.startswith("discriminator/")}
    both = {"discriminator/loss", "discriminator/generated", "discriminator/expert"}
    assert terms == {
        "ssail": both | {"discriminator/self_supervised"},
        "gail": both,
        "wail": both | {"discriminator/penalty"},
    }


def test_actor_critic_of_gail_and_wail_learns_from_generated_trajectories_only() -> None:
    for method, mixes in (("ssail", True), ("gail", False), ("wail", False)):
        made = training(method=method)
        latest, _ = made.generate(0.0)
        batch = made._actor_batch(latest)
        generated = [any(torch.equal(row, kept) for kept in latest.states[0]) for row in batch.states[0]]
        assert all(generated) is not mixes


def test_clipping_bounds_the_critic_and_the_penalty_does_not() -> None:
    for constraint, bounded in (("clipping", True), ("penalty", False)):
        made = training(f"wasserstein.constraint={constraint}", "wasserstein.clip=0.01", method="wail")
        values = updated(made)
        assert ("discriminator/penalty" in values) is not bounded
        largest = max(float(p.detach().abs().max()) for p in made.discriminator.parameters())
        assert (largest <= 0.01) is bounded


def test_rewards_are_kept_within_their_limit() -> None:
    """After scaling; without a limit they leave it."""
    for limit, within in (("1.0", True), ("null", False)):
        made, loop = learner("adversarial.reward_scale=1000", f"adversarial.reward_limit={limit}")
        states, actions = loop.experts.states[:, :-1], loop.experts.actions
        rewards = made.reward(made.features(states, states[:, 0]), actions)
        assert (float(rewards.abs().max().detach()) <= 1) is within


def test_the_actor_waits_for_its_start_while_its_judges_learn() -> None:
    """Epochs 0 and 1 of 4 with a start at half; from the start on, and without one, the policy moves in every epoch."""
    for start, moving in (("0.5", [False, False, True, True]), ("null", [True] * 4)):
        made, _ = learner(f"sac.actor_start={start}", "training.epochs=4")
        for epoch, moves in enumerate(moving):
            parts = (made.actor_critic.policy, made.actor_critic.critic, made.discriminator)
            before = [[p.clone() for p in part.parameters()] for part in parts]
            temperature = made.actor_critic.log_temperature.clone()
            made.run_epoch(epoch)
            policy, critic, discriminator = (
                any(not torch.equal(old, new) for old, new in zip(olds, part.parameters(), strict=True))
                for olds, part in zip(before, parts, strict=True)
            )
            assert (policy, critic, discriminator) == (moves, True, True)
            assert torch.equal(temperature, made.actor_critic.log_temperature) is not moves


def test_a_truncated_gradient_of_the_encoder_changes_no_value() -> None:
    """The same graphs and entropy; with as many steps as there are, or null, no gradient is missing."""
    made = training("model.graph_noise=edge")
    x = made.features(made.experts.states[:4], made.experts.states[:4, 0]).unsqueeze(0)
    policy, results = made.actor_critic.policy, []
    for steps in (None, 5, 10**6):
        made.actor_critic.spec = made.actor_critic.spec.model_copy(update={"encoder_steps": steps})
        made.generators.seeds[0]["policy"].manual_seed(1)
        graph, entropy = made.actor_critic._graphs(x, made.actor_critic._draw_graph_noise(x))
        policy.zero_grad()
        (graph * torch.arange(2.0)).sum().backward(retain_graph=True)
        results.append((graph.detach(), entropy.detach(), policy.encoder.head.weight.grad.clone()))
    whole, part, more = results
    torch.testing.assert_close(whole[0], part[0])
    torch.testing.assert_close(whole[1], part[1])
    assert 0 < float(part[2].norm()) < float(whole[2].norm())
    torch.testing.assert_close(more[2], whole[2])


def test_without_its_weight_the_discriminator_never_meets_tau_alpha(monkeypatch: pytest.MonkeyPatch) -> None:
    """The actor-critic still does, unless its share is 0: then no alpha is drawn at all."""
    from ssmail.training import adversarial

    drawn: list[int] = []
    real = adversarial.sample_alpha

    def counted(batch: int, *arguments: object) -> torch.Tensor:
        drawn.append(batch)
        return real(batch, *arguments)  # type: ignore[arg-type]

    monkeypatch.setattr(adversarial, "sample_alpha", counted)
    off, share = "self_supervision.discriminator_weight=0", "self_supervision.actor_share=0"
    for overrides, batches in (((), [4, 2]), ((off,), [2]), ((share,), [4, 0]), ((off, share), [0])):
        drawn.clear()
        logs = updated(training(*overrides))
        assert drawn == batches
        assert ("discriminator/self_supervised" in logs) is (off not in overrides)


def test_the_weight_of_tau_alpha_scales_its_term() -> None:
    once, twice = (updated(training(f"self_supervision.discriminator_weight={weight}")) for weight in (1, 2))
    term = "discriminator/self_supervised"
    torch.testing.assert_close(twice[term], 2 * once[term])
    torch.testing.assert_close(twice["discriminator/loss"] - once["discriminator/loss"], once[term])


def test_gails_reward_may_be_its_probability() -> None:
    own, probability = (learner(*given, method="gail")[0] for given in ((), ("adversarial.reward=probability",)))
    x, actions = torch.randn(4, 5, 3, 5), torch.randn(4, 5, 3, 2)
    found = probability.reward(x, actions)
    torch.testing.assert_close(found, torch.sigmoid(probability.discriminator(x, actions)))
    assert not torch.allclose(found, own.reward(x, actions))


def test_a_discriminator_without_velocities_trains_for_several_seeds_as_for_one() -> None:
    given = ("model.discriminator_velocities=false", "model.start_input=true")
    latest = training(*given).generate(0.0)[0]
    alone = updated(training(*given), latest)
    together = AdversarialTraining([learner(*given)[0], learner(*given)[0]])
    both = Batch(*(part.repeat_interleave(2, 0) for part in (latest.states, latest.actions, latest.source)))
    for name, value in together.update(both, both).items():
        torch.testing.assert_close(value, alone[name].expand(2), msg=name)
    assert not torch.allclose(updated(training(given[1]), latest)["discriminator/loss"], alone["discriminator/loss"])
