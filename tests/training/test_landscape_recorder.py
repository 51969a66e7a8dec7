"""Looking at a reward while it is learned: fields known in closed form, and that looking changes nothing."""

from collections.abc import Callable
from copy import copy
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from ssmail.config.experiments import ablation_specs, build_spec, figure_requirements
from ssmail.config.spec import RunSpec
from ssmail.models.discriminator import Discriminator
from ssmail.models.features import Features
from ssmail.models.normalization import Normalization
from ssmail.training.adversarial import AdversarialLearner
from ssmail.training.baselines import ConstantVelocity
from ssmail.training.batches import Batch
from ssmail.training.landscape_recorder import (
    LandscapeRecorder,
    RewardInputs,
    current_epoch,
    landscape_epochs,
    position_gradient,
)
from ssmail.training.learner import LearnerContext
from ssmail.training.loop import TrainingLoop

from .conftest import ToySpec

Reward = Callable[[Tensor, Tensor], Tensor]


@pytest.fixture(scope="module")
def loop() -> TrainingLoop:
    return TrainingLoop(build_spec("ssail", "yjunction", "smoke", ["evaluation.landscapes=1"]), 0)


class Handmade:
    """A learner with a reward in closed form, whose policy drives straight on."""

    def __init__(self, loop: TrainingLoop, reward: Reward, features: Features) -> None:
        self.reward, self.features, self.predictor = reward, features, ConstantVelocity(loop.integrator)

    def agent_reward(self, agent: int, own: Tensor, x: Tensor, actions: Tensor) -> Tensor:
        """The reward of the whole group after the agent has moved."""
        moved = x.expand(*own.shape[:-1], *x.shape[-2:]).clone()
        moved[..., agent, :] = own
        return self.reward(moved, actions.expand(*own.shape[:-1], *actions.shape[-2:]))[..., agent]


def looking(loop: TrainingLoop, reward: Reward) -> LandscapeRecorder:
    """At a handmade reward."""
    assert loop.landscapes is not None
    return LandscapeRecorder(loop.landscapes.context, Handmade(loop, reward, Features(False, False, 50)))


def linear(x: Tensor, actions: Tensor) -> Tensor:
    """3 p_x - 4 p_y, and what does not depend on the agent's own position."""
    return 3 * x[..., 0] - 4 * x[..., 1] + actions.sum(dim=-1) + x[..., :1, 2]


def test_the_gradient_is_of_the_agents_own_position_alone(loop: TrainingLoop) -> None:
    def reward(x: Tensor, actions: Tensor) -> Tensor:
        others = x.sum(dim=(-2, -1), keepdim=True)[..., 0] - x.sum(dim=-1)
        return x[..., 0] ** 2 + 5 * x[..., 1] + 7 * others + x[..., 4]

    states = torch.randn(2, 4, 3, 4)
    learner = Handmade(loop, reward, Features(True, True, 4))
    at = RewardInputs.from_trajectories(learner.features, states, torch.zeros(2, 3, 3, 2))
    assert at.other_features.shape == (2, 3, 3, 1 + 4)  # the step and the first state
    values, gradient = position_gradient(learner, at, 1)
    expected = torch.stack([2 * states[:, :-1, 1, 0], torch.full((2, 3), 5.0)], dim=-1)
    torch.testing.assert_close(gradient, expected)
    torch.testing.assert_close(values, reward(learner.features(states[:, :-1], states[:, 0]), at.actions)[..., 1])


def test_the_gradient_is_in_scaled_units_whatever_the_networks_read(loop: TrainingLoop) -> None:
    states = loop.experts.states
    plain = Features(False, False, 50)
    features = replace(plain, normalization=Normalization.fit(states))
    learner = Handmade(loop, lambda x, actions: x[..., 0], features)
    _, gradient = position_gradient(learner, RewardInputs.from_trajectories(features, states, loop.experts.actions), 2)
    expected = 1 / Normalization.fit(states).std[2, 0]
    torch.testing.assert_close(gradient[..., 0].max(), expected)
    assert expected != 1


@pytest.mark.parametrize("root_relative", [False, True])
def test_moving_one_agent_is_scored_as_the_whole_group_would_be(loop: TrainingLoop, root_relative: bool) -> None:
    """Rewards and gradients of an agent on other positions, against the reward of all agents in all pairs."""
    known = loop.experts.states[:2]
    plain = Features(True, True, 50, root_relative=root_relative)
    features = replace(plain, normalization=Normalization.fit(plain._relative(known)))
    assert isinstance(loop.learner, AdversarialLearner)
    learner = copy(loop.learner)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        learner.discriminator = Discriminator(features.size(4) + 2, 16)
    learner.features = features
    at = RewardInputs.from_trajectories(features, known, loop.experts.actions[:2])
    offsets = 0.02 * torch.randn(4, 1, 1, 3, 2, generator=torch.Generator().manual_seed(0))
    everyone = at.states[..., :2] + offsets  # four positions for each of the states, which are shared
    for agent in range(3):
        positions = everyone[..., agent, :]
        expected_position = positions.clone().requires_grad_()
        moved = at.states.expand(4, -1, -1, -1, -1).clone()
        moved[..., agent, :2] = expected_position
        x = torch.cat([features.normalize_states(moved), at.other_features.expand(4, -1, -1, -1, -1)], dim=-1)
        rewards = learner.reward(x, at.actions.expand(4, -1, -1, -1, -1))
        (expected,) = torch.autograd.grad(rewards[..., agent].sum(), expected_position, retain_graph=True)
        values, gradient = position_gradient(learner, at, agent, positions)
        torch.testing.assert_close(values, rewards[..., agent])
        torch.testing.assert_close(gradient, expected)
        assert gradient.abs().max() > 1e-3
        (others,) = torch.autograd.grad(rewards.sum(), expected_position)  # negative control: the reward of them all
        assert not torch.allclose(gradient, others)


def test_a_linear_reward_is_a_plane_with_share_1(loop: TrainingLoop) -> None:
    look = looking(loop, linear)
    _, gradient = look.reward_field()
    np.testing.assert_allclose(gradient, np.broadcast_to([3.0, -4.0], gradient.shape), atol=1e-5)
    assert values_of(look)["landscape/slope_share"] == 1


def test_a_reward_of_the_distance_has_cosine_1_and_its_opposite_minus_1(loop: TrainingLoop) -> None:
    middle = torch.tensor([0.1, 0.2])

    def towards(x: Tensor, actions: Tensor) -> Tensor:
        return -(x[..., :2] - middle).norm(dim=-1)

    look = looking(loop, towards)
    look.to_expert = np.broadcast_to(
        middle.numpy() - look.plane.points, look.to_expert.shape
    )  # an expert that stands there
    assert values_of(look)["landscape/cosine"] == pytest.approx(1, abs=1e-5)
    away = looking(loop, lambda x, actions: -towards(x, actions))
    away.to_expert = look.to_expert
    assert values_of(away)["landscape/cosine"] == pytest.approx(-1, abs=1e-5)


def test_the_reference_is_an_expert_state_that_is_near(loop: TrainingLoop) -> None:
    def speed(x: Tensor, actions: Tensor) -> Tensor:
        return x[..., 3] + 10 * actions[..., 1]

    look = looking(loop, speed)
    reward, gradient = look.reward_field()
    assert not gradient.any()
    for agent in range(3):
        at = look.references.states[:, agent]
        for k in (0, 17, -1):  # on a reference itself, that reference decides
            row = np.abs(look.plane.y - float(at[k, 1])).argmin()
            column = np.abs(look.plane.x - float(at[k, 0])).argmin()
            here = look.weights[agent, row, column]
            assert here.argmax() in np.flatnonzero(
                np.linalg.norm(at[:, :2] - at[k, :2], axis=1) < 2 * look.plane.spacing
            )
    assert reward.min() < reward.max()


def values_of(look: LandscapeRecorder) -> dict[str, float]:
    values, _ = look.record(3)
    return values


def test_around_the_current_trajectory_a_reward_towards_the_expert_has_cosine_1(loop: TrainingLoop) -> None:
    look, made = beside(looking(loop, lambda x, actions: -x[..., 1].abs()), loop)
    values, arrays = look.vector_field(made)
    assert values["landscape/behind_cosine"] > 0.9  # not 1 where the nearest expert is further along
    opposite, _ = beside(looking(loop, lambda x, actions: x[..., 1].abs()), loop)
    assert opposite.vector_field(made)[0]["landscape/behind_cosine"] == pytest.approx(
        -values["landscape/behind_cosine"]
    )
    alpha, current, expert = (arrays[f"vector_field/{name}"] for name in ("alpha", "current", "expert"))
    assert (alpha.min(), alpha.max()) == (-1, 0.875)
    assert arrays["vector_field/gradient"].shape == (16, *current.shape)
    assert current.shape == expert.shape == (8, 49, 3, 2)


def beside(look: LandscapeRecorder, loop: TrainingLoop) -> tuple[LandscapeRecorder, Tensor]:
    """The same with experts on y = 0, and eight rollouts beside the first of them on y = 0.9, all the way."""
    experts = loop.experts.states.clone()
    experts[..., 1] = 0.0
    made = experts[:8].clone()
    made[..., 1] = 0.9
    known = Batch(experts, loop.experts.actions, loop.experts.source)
    look.context = LearnerContext(look.context.spec, known, loop.integrator, loop.generators)
    return look, made


def test_a_field_that_only_knows_what_lies_ahead_is_told_from_one_that_knows_what_lies_behind(
    loop: TrainingLoop,
) -> None:
    """The negative control of claim C8: right ahead of the trajectory and wrong behind it."""

    def cut(x: Tensor, actions: Tensor) -> Tensor:
        y = x[..., 1]
        return torch.where(y > 0.9, y - 0.9, 0.9 - y)  # highest on the expert and as far on the other side

    look, made = beside(looking(loop, cut), loop)
    values, _ = look.vector_field(made)
    assert values["landscape/ahead_cosine"] > 0.7
    assert values["landscape/behind_cosine"] < -0.9


def test_when_it_is_looked_at() -> None:
    def spec(epochs: int, kept: str) -> RunSpec:
        return build_spec("ssail", "yjunction", "smoke", [f"training.epochs={epochs}", f"evaluation.landscapes={kept}"])

    assert landscape_epochs(spec(40, "null")) == ()
    assert landscape_epochs(spec(40, "1")) == (0, 20, 40)
    assert landscape_epochs(spec(40, "4")) == (0, 10, 20, 30, 40)
    assert landscape_epochs(spec(3, "12")) == (0, 1, 2, 3)
    assert landscape_epochs(spec(1, "1")) == (0, 1)
    assert landscape_epochs(spec(40, "3")) == (0, 13, 20, 27, 40)
    assert current_epoch(spec(80, "null")) == 40


def test_what_has_no_plane_or_no_reward_has_no_landscape(toy: ToySpec) -> None:
    asked = "evaluation.landscapes=1"
    assert TrainingLoop(build_spec("bc", "yjunction", "smoke", [asked]), 0).landscapes is None
    recorded = TrainingLoop(toy("ssail", asked), 0)
    assert recorded.landscapes is None
    assert recorded.snapshot == {}


@pytest.mark.parametrize("figure", ["fig1", "fig2"])
def test_the_runs_of_the_figures_of_landscapes_record_them(figure: str) -> None:
    needed = figure_requirements(figure)
    specs = [build_spec(method, needed.environment, "quick") for method in needed.methods]
    if needed.ablation is not None:
        specs = list(ablation_specs(needed.ablation, "quick", environment=needed.environment).values())
    for spec in specs:
        assert {0, current_epoch(spec), spec.epochs} <= set(landscape_epochs(spec))


def test_a_run_that_nobody_asked_records_none() -> None:
    loop = TrainingLoop(build_spec("ssail", "yjunction", "smoke"), 0)
    assert loop.landscapes is None
    assert loop.snapshot == {}
    assert not any(name.startswith("landscape") for name in loop.run_epoch())


def test_looking_changes_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    spec = build_spec("gail", "yjunction", "smoke", ["evaluation.landscapes=3"])

    def trained() -> tuple[list[dict[str, float]], list[Tensor]]:
        loop = TrainingLoop(spec, 3)
        records = [loop.run_epoch() for _ in range(3)]
        kept = [
            {name: v for name, v in record.items() if name != "seconds" and not name.startswith("landscape")}
            for record in records
        ]
        return kept, [p.detach() for network in loop.learner.networks() for p in network.parameters()]

    seen = trained()
    monkeypatch.setattr(LandscapeRecorder, "for_learner", lambda *_: None)
    unseen = trained()
    assert seen[0] == unseen[0]
    assert all(torch.equal(a, b) for a, b in zip(seen[1], unseen[1], strict=True))


def test_the_snapshots_of_a_resumed_run_are_those_of_an_uninterrupted_one() -> None:
    spec = build_spec("ssail", "yjunction", "smoke", ["evaluation.landscapes=3"])
    whole = TrainingLoop(spec, 0)
    expected = [whole.snapshot]
    states = []
    for _ in range(3):
        states.append(whole.state_dict())
        values = whole.run_epoch()
        expected.append(whole.snapshot)
    assert {"landscape/slope_share", "landscape/cosine"} <= values.keys()
    assert [sorted(arrays)[0][:14] for arrays in expected[1:]] == [f"landscape/{e:04d}" for e in (1, 2, 3)]
    assert {name for name in expected[2] if name.startswith("vector_field")} == {
        f"vector_field/{name}" for name in ("alpha", "current", "expert", "gradient")
    }
    other = TrainingLoop(spec, 0)
    other.run_epoch()
    state = other.state_dict()
    resumed = TrainingLoop(spec, 0)
    assert resumed.snapshot.keys() == expected[0].keys()
    resumed.load_state_dict(state)
    assert resumed.snapshot == {}
    for epoch in (2, 3):
        resumed.run_epoch()
        for name, array in expected[epoch].items():
            np.testing.assert_array_equal(resumed.snapshot[name], array)
    first, last = (expected[e][f"landscape/{e:04d}/reward"] for e in (1, 3))
    assert not np.array_equal(first, last)  # negative control: training does change them


def test_a_run_is_small(loop: TrainingLoop) -> None:
    """Below 300 KB for thirteen snapshots of two agents, as on letters: here three agents, so half as much again."""
    assert loop.landscapes is not None
    fresh = TrainingLoop(loop.spec, 0)
    size = sum(array.nbytes for name, array in fresh.snapshot.items() if name.startswith("landscape/0000"))
    assert 13 * size * 2 / 3 < 400_000  # before compression
