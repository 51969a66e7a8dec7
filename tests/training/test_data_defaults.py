"""What a spec leaves to the data."""

import math
from collections.abc import Sequence

import numpy as np
import pytest
import torch

from ssmail.config.experiments import build_spec
from ssmail.data.recorded_sets import SetParameters, recorded_set, windows
from ssmail.data.trajectories import SPLITS, ExpertSet, Floats
from ssmail.envs.integrator import Integrator
from ssmail.errors import InputError
from ssmail.models.normalization import SPARE, ActionBounds
from ssmail.training.agent_numbers import batches_by_number
from ssmail.training.batches import Batch
from ssmail.training.data_defaults import NOISE_SHARE, VARIANCE_SHARE, resolve, wanders
from ssmail.training.rollout import PolicyPredictor


def made_of(frames: Floats, identity: bool = False) -> tuple[ExpertSet, Sequence[Batch]]:
    """A set whose three splits have the windows of these frames (B, T + 1, N, P), half of them observed."""
    count, length, agents, axes = frames.shape
    cut = {
        split: windows(frames, np.full(count, agents), np.full(count, number), np.arange(count))
        for number, split in enumerate(SPLITS)
    }
    half = (length - 1) // 2
    parameters = SetParameters(
        axes=axes, window=length - 1, observed=half, predicted=length - 1 - half, stride=1, identity=identity
    )
    data = recorded_set(cut, SPLITS, parameters)
    return data, batches_by_number(data.train, data.scaling, torch.device("cpu"))


def zigzag(change: float, count: int = 40, frames: int = 9) -> Floats:
    """One agent on a line whose velocity alternates between -change / 2 and change / 2."""
    velocities = np.where(np.arange(frames - 1) % 2, change / 2, -change / 2)
    positions = np.concatenate([[0.0], velocities.cumsum()])
    return np.tile(positions.reshape(1, -1, 1, 1), (count, 1, 1, 1))


@pytest.mark.parametrize("units", [1.0, 1000.0])
def test_noise_reach_and_variance_follow_the_changes_of_velocity(units: float) -> None:
    """All of them alternate, so scaled velocities are -1 and 1: the change is 2, two standard deviations."""
    data, experts = made_of(zigzag(units))
    policy = resolve(build_spec("ssail", "trajectories", "smoke"), data, experts)
    assert policy.model is not None
    assert policy.sac is not None
    bounds = PolicyPredictor.create(policy.model, experts, Integrator(data.scaling)).model.actor
    assert float(bounds.step) == pytest.approx(SPARE * 2, rel=0.01)
    assert float(bounds.high) == pytest.approx(SPARE * 1, rel=0.01)  # of the centre of an action
    expected = math.log(NOISE_SHARE * 2) + 0.5 * math.log(2 * math.pi * math.e)
    assert policy.sac.target_entropy == pytest.approx(expected)
    free = resolve(build_spec("ssail", "trajectories", "smoke", ["model.standardize=false"]), data, experts)
    assert free.model is not None
    bounds = PolicyPredictor.create(free.model, experts, Integrator(data.scaling)).model.actor
    assert float(bounds.step) == pytest.approx(SPARE * 2, rel=0.01)
    dnri = resolve(build_spec("dnri", "trajectories", "smoke"), data, experts).variational
    assert dnri is not None
    moved = 2 * units / data.scaling.position_span  # by which constant velocity is off in position; 2 in velocity
    assert dnri.variance == pytest.approx(VARIANCE_SHARE * (moved**2 + 4) / 2)


def test_each_axis_has_the_reach_of_its_own_changes() -> None:
    """The second axis changes ten times as much as the first."""
    velocities = torch.tensor([[1.0, 10.0], [-1.0, -10.0]] * 4).view(1, 8, 1, 2)
    spec = build_spec("ssail", "trajectories", "smoke").model
    assert spec is not None
    bounds = ActionBounds.of(spec, None, [velocities])
    torch.testing.assert_close(bounds.step, SPARE * torch.tensor([2.0, 20.0]))
    torch.testing.assert_close(bounds.high, SPARE * torch.tensor([3.0, 30.0]))


def test_what_is_given_stays() -> None:
    data, experts = made_of(zigzag(1.0))
    given = ["model.action_step=0.7", "sac.target_entropy=-2.5", "forecast.observed=2", "forecast.miss_distance=0.1"]
    spec = resolve(build_spec("ssail", "trajectories", "smoke", given), data, experts)
    assert spec.model is not None
    assert spec.sac is not None
    assert spec.forecast is not None
    assert (spec.model.action_step, spec.sac.target_entropy) == (0.7, -2.5)
    assert (spec.forecast.observed, spec.forecast.predicted, spec.forecast.miss_distance) == (2, 4, 0.1)


def test_a_spec_that_leaves_nothing_open_stays_as_it_is() -> None:
    data, experts = made_of(zigzag(1.0))
    for method in ("ssail", "dnri", "copy-last"):
        spec = build_spec(method, "letters", "smoke")
        assert resolve(spec, data, experts) == spec


@pytest.mark.parametrize("same", [True, False])
def test_agents_are_told_apart_only_where_they_are_the_same(same: bool) -> None:
    data, experts = made_of(zigzag(1.0), identity=same)
    for method, section in (("ssail", "model"), ("nri", "variational")):
        found = getattr(resolve(build_spec(method, "trajectories", "smoke"), data, experts), section)
        assert (found.agent_input, found.standardize) == ((True, True) if same else (False, "pooled"))


@pytest.mark.parametrize(("key", "remedy"), [("agent_input", "false"), ("standardize", "pooled")])
def test_to_ask_for_agents_that_differ_is_an_error(key: str, remedy: str) -> None:
    data, experts = made_of(zigzag(1.0))
    spec = build_spec("ssail", "trajectories", "smoke", [f"model.{key}=true"])
    with pytest.raises(
        InputError, match=rf"^model.{key} needs the same agents in all scenes.*set model.{key}={remedy}"
    ):
        resolve(spec, data, experts)


def test_frames_that_nobody_states_are_asked_for() -> None:
    data, experts = made_of(zigzag(1.0))
    other = ExpertSet(**{**vars(data), "parameters": {"environment": "mocap"}})
    spec = build_spec("ssail", "mocap", "smoke", ["forecast.observed=null"])
    with pytest.raises(InputError, match=r"does not say how many frames are observed; set forecast\.observed"):
        resolve(spec, other, experts)


def test_a_miss_is_a_fifth_of_the_way() -> None:
    """Two agents that go 3 and 1 in each of four predicted frames."""
    frames = np.arange(9.0).reshape(1, 9, 1, 1) * np.array([3.0, 1.0]).reshape(1, 1, 2, 1)
    data, experts = made_of(np.tile(frames, (4, 1, 1, 1)))
    spec = resolve(build_spec("bc", "trajectories", "smoke"), data, experts)
    assert spec.forecast is not None
    assert spec.forecast.miss_distance == pytest.approx(0.2 * 4 * (3 + 1) / 2)


def test_groups_wander_that_are_seen_in_more_places_than_windows_can_tell_of() -> None:
    draw = np.random.default_rng(0)
    steps = draw.normal(size=(100, 1, 3, 2)).cumsum(axis=1) + draw.normal(size=(100, 9, 3, 2)).cumsum(axis=1)
    assert not wanders(made_of(steps)[1])
    far = steps + 1000 * draw.normal(size=(100, 1, 1, 2))
    assert wanders(made_of(far)[1])
    assert wanders(made_of(far * [1.0, 0.0])[1])  # a single direction is enough
    for frames, relative in ((steps, False), (far, True)):
        data, experts = made_of(frames)
        model = resolve(build_spec("ssail", "trajectories", "smoke"), data, experts).model
        assert model is not None
        assert model.centre_relative is relative
