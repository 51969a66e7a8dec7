"""Runs on own trajectories: a small set with two, three and four agents in two axes."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ssmail.config.experiments import build_spec
from ssmail.config.names import METHODS
from ssmail.config.spec import RunSpec
from ssmail.data import expert_sets
from ssmail.data.trajectories import LARGEST_JUMP, SPLITS, ExpertSet
from ssmail.errors import InputError
from ssmail.training.loop import TrainingLoop
from ssmail.training.trajectory_evaluator import TrajectoryEvaluator
from tests.data.flocks import generate
from tests.execution.recorded import plain
from tests.training.test_together import numbers, together

SMALL = ("evaluation.train_rollouts=4", "evaluation.validation_samples=2")
SHORT = ("training.epochs=2", "training.updates=4")
BASELINES = ("constant-velocity", "copy-last")
Make = Callable[..., RunSpec]


@pytest.fixture(scope="module")
def make(tmp_path_factory: pytest.TempPathFactory) -> Make:
    """make("dnri", "forecast.noise=0.1") -> the spec of a run of a second: 4 frames observed, 5 predicted."""
    path = tmp_path_factory.mktemp("own") / "flocks.npz"
    expert_sets.save(generate([2, 3, 4], scenes=24, window=9, observed=4, frames=14), path)

    def spec(method: str, *overrides: str) -> RunSpec:
        short = () if method in BASELINES else SHORT
        return build_spec(method, "trajectories", "smoke", [f"data.path={path}", *SMALL, *short, *overrides])

    return spec


def trained(spec: RunSpec, seed: int = 0) -> TrainingLoop:
    loop = TrainingLoop(spec, seed)
    while loop.epoch < spec.epochs:
        loop.run_epoch()
    return loop


@pytest.mark.parametrize("method", METHODS)
def test_every_method_trains_with_any_number_of_agents(make: Make, method: str) -> None:
    loop = trained(make(method, "forecast.collision_distance=0.5", "forecast.noise=0.05"))
    values, arrays = loop.final_evaluation()
    assert all(np.isfinite(value) for value in values.values())
    for prefix in ("test", "test_mean", "test_last", "test_constant_velocity", "test_copy_last", "test_noisy"):
        assert values[f"{prefix}/min_fde_1"] == pytest.approx(values[f"{prefix}/fde"])
        assert 0 <= values[f"{prefix}/collisions"] <= 1
        assert 0 <= values[f"{prefix}/coverage"] <= 1
        assert arrays[f"{prefix}/mse"].shape == (5,)
    if method in BASELINES:
        for name in ("fde", "energy", "mse_last", "coverage"):
            assert values[f"test/{name}"] == pytest.approx(values[f"test_{method.replace('-', '_')}/{name}"])


def jumping(length: float) -> ExpertSet:
    """A set in which an agent of a validation window and of a test window jumps so far, in spans of the velocities."""
    made = generate([3], scenes=24, window=9, observed=4, frames=14)
    splits = {split: getattr(made, split) for split in SPLITS}
    for split in ("validation", "test"):
        positions, velocities = splits[split].positions.copy(), splits[split].velocities.copy()
        positions[0, 3:, 1, 0] += length * made.scaling.velocity_span
        velocities[0, 3, 1, 0] += length * made.scaling.velocity_span
        splits[split] = replace(
            splits[split], positions=positions, velocities=velocities, continuations=positions[None]
        )
    return ExpertSet.bundle(splits, made.centre_lines, made.parameters, scenes=made.scenes)


@pytest.mark.parametrize("method", ["bc", "dnri", "ssail"])
def test_the_largest_jump_that_a_set_may_have_leaves_all_numbers_finite(tmp_path: Path, method: str) -> None:
    assert not jumping(0.51 * LARGEST_JUMP).is_scalable
    expert_sets.save(jumping(0.49 * LARGEST_JUMP), tmp_path / "a.npz")
    spec = build_spec(method, "trajectories", "smoke", [f"data.path={tmp_path / 'a.npz'}", *SMALL, *SHORT])
    loop = TrainingLoop(spec, 0)
    values = loop.run_epoch() | loop.run_epoch() | loop.final_evaluation()[0]
    assert values["test_constant_velocity/fde"] > 1e5
    assert all(np.isfinite(value) for value in values.values())


@pytest.mark.parametrize("curriculum", ["trajectory-forcing", "teacher-forcing", "scheduled-sampling"])
def test_every_curriculum_moves_groups_of_their_own_number(make: Make, curriculum: str) -> None:
    for method in ("ssail", "dnri"):
        loop = TrainingLoop(make(method, f"curriculum.name={curriculum}", "curriculum.beta=0.5"), 0)
        assert loop.run_epoch()["curriculum/intervention_frequency"] > 0


def test_the_test_may_be_bounded_to_windows_evenly_over_the_split(make: Make) -> None:
    """The test errors of constant velocity are those of these windows, and these are kept."""
    specs = make("constant-velocity", "evaluation.test_windows=3"), make("constant-velocity")
    assert specs[0].hash() != specs[1].hash()
    bounded, whole = (TrainingLoop(spec, 0) for spec in specs)
    test = whole.data.test
    chosen = np.linspace(0, len(test) - 1, 3).round().astype(int)
    assert isinstance(bounded.evaluator, TrajectoryEvaluator)
    np.testing.assert_array_equal(bounded.evaluator.test.positions, test.positions[chosen])
    (values, arrays), (all_values, _) = (loop.final_evaluation() for loop in (bounded, whole))
    assert values["test/fde"] != pytest.approx(all_values["test/fde"])
    np.testing.assert_allclose(arrays["test/future"], test.positions[chosen, 4:], rtol=1e-6)
    np.testing.assert_array_equal(arrays["test/window"], chosen)


def test_the_kept_windows_are_those_of_the_set(make: Make) -> None:
    loop = trained(make("dnri"))
    assert isinstance(loop.evaluator, TrajectoryEvaluator)
    _, arrays = loop.final_evaluation()
    test = loop.data.test
    kept = np.linspace(0, len(test) - 1, 6).round().astype(int)
    assert test.agents is not None
    assert test.scene is not None
    assert test.frame is not None
    np.testing.assert_array_equal(arrays["test/agents"], test.agents[kept])
    np.testing.assert_array_equal(arrays["test/window"], kept)
    np.testing.assert_array_equal(arrays["test/frame"], test.frame[kept])
    scenes = [bytes(name).rstrip(b"\0").decode() for name in arrays["test/scene"]]
    assert scenes == [loop.data.scenes[scene] for scene in test.scene[kept]]
    assert len({*scenes}) > 1
    np.testing.assert_allclose(arrays["test/observed"], test.positions[kept, :4], rtol=1e-6)
    np.testing.assert_allclose(arrays["test/future"], test.positions[kept, 4:], rtol=1e-6)
    samples = arrays["test/samples"]
    assert samples.shape == (3, 6, 5, 4, 2)
    for window, agents in enumerate(test.agents[kept].tolist()):
        assert not samples[:, window, :, agents:].any()  # padding
        step = np.abs(samples[:, window, 0, :agents] - test.positions[kept[window], 3, :agents])
        assert 0 < step.max() < 10  # the first predicted position is near the last observed one


def test_every_kept_sample_of_a_baseline_is_its_forecast(make: Make) -> None:
    """A figure that draws all samples would draw lines to the origin otherwise."""
    _, arrays = trained(make("constant-velocity")).final_evaluation()
    first, *others = arrays["test/samples"]
    assert np.abs(first).sum() > 0
    for other in others:
        np.testing.assert_array_equal(other, first)


@pytest.mark.parametrize("method", ["ssail", "nri"])
def test_a_resumed_run_equals_an_uninterrupted_one(make: Make, method: str) -> None:
    spec = make(method)
    loop = TrainingLoop(spec, 0)
    loop.run_epoch()
    other = TrainingLoop(spec, 0)
    other.load_state_dict(loop.state_dict())
    assert numbers(other.run_epoch()) == numbers(loop.run_epoch())
    assert plain(other.state_dict()) == plain(loop.state_dict())
    assert other.final_evaluation()[0] == loop.final_evaluation()[0]


def test_seeds_trained_together_equal_seeds_trained_alone(make: Make) -> None:
    # batches that fill the processor's vectors (tests/training/test_together.py): 16 rollouts of 2, 3 and 4 agents
    spec = make("ssail", "training.batch=16", "adversarial.rollouts=48", "training.epochs=4")
    loops = [TrainingLoop(spec, seed) for seed in (0, 1)]
    alone = [together([TrainingLoop(spec, seed)])[0] for seed in (0, 1)]
    assert together(loops) == alone


def test_rare_numbers_get_their_turns_too(make: Make) -> None:
    loop = TrainingLoop(make("bc"), 0)
    context = loop.evaluator.context
    assert {batch.states.shape[2] for batch in context.by_number} == {2, 3, 4}
    assert set(context.turns(0, 4)) == {0, 1, 2}
    assert context.turns(0, 4) + context.turns(1, 4) == context.turns(0, 8)


def test_windows_that_are_too_short_for_the_forecast_are_an_error(make: Make) -> None:
    with pytest.raises(InputError, match=r"forecast\.observed 4 and forecast\.predicted 6 need 10 frames.* have 9"):
        TrainingLoop(make("bc", "forecast.predicted=6"), 0)


def test_a_single_agent_can_be_trained_on(tmp_path: Path) -> None:
    path = tmp_path / "alone.npz"
    expert_sets.save(generate([1, 2], scenes=24, window=9, observed=4, frames=14), path)
    for method in ("ssail", "dnri", "nri"):
        loop = trained(build_spec(method, "trajectories", "smoke", [f"data.path={path}", *SMALL, *SHORT]))
        assert np.isfinite(loop.final_evaluation()[0]["test/energy"])
