"""Real training, minutes long: SS-AIL learns the Y-Junction, and does not where its discriminator is switched off."""

import numpy as np
import pytest

from ssmail.config.experiments import build_spec
from ssmail.data import expert_sets
from ssmail.training.loop import TrainingLoop
from tests.data import flock
from tests.training.judge_flock import KNOWN, OPEN, best_predictor, error_ratios, goals

VALIDATION_SEED = 110  # not one of the reported seeds, nor one that a setting was chosen with


@pytest.mark.slow
def test_ssail_learns_both_lanes() -> None:
    """The bars of the Y-Junction experiment on the test split, for one seed at profile quick."""
    loop = TrainingLoop(build_spec("ssail", "yjunction", "quick"), VALIDATION_SEED)
    while loop.epoch < loop.spec.training.epochs:
        loop.run_epoch()
    values, _ = loop.final_evaluation()
    assert values["test/mode_mse"] <= 0.010 < values["test_constant_velocity/mode_mse"]
    assert values["test/on_lane"] >= 0.85
    assert values["test/lane_balance"] >= 0.10
    assert values["test/diverged"] == 0


@pytest.mark.slow
@pytest.mark.parametrize(("overrides", "learns"), [([], True), (["adversarial.learning_rate=1e-9"], False)])
def test_a_quarter_of_the_budget_beats_constant_velocity(overrides: list[str], learns: bool) -> None:
    """After 20 of 80 epochs; negative control: without a learning discriminator there is nothing to climb."""
    loop = TrainingLoop(build_spec("ssail", "yjunction", "quick", overrides), VALIDATION_SEED)
    errors = [loop.run_epoch()["validation/mode_mse"] for _ in range(20)]
    assert (float(np.median(errors[-5:])) < 0.04) is learns


@pytest.fixture(scope="module")
def flock_trained(tmp_path_factory: pytest.TempPathFactory) -> tuple[TrainingLoop, dict[str, float]]:
    """SS-AIL after its training on the flock, as on recorded motion, and the final evaluation."""
    path = tmp_path_factory.mktemp("flock") / "flock.npz"
    expert_sets.save(flock.generate(), path)
    loop = TrainingLoop(build_spec("ssail", "mocap", "quick", [f"data.path={path}"]), 0)
    while loop.epoch < loop.spec.training.epochs:
        loop.run_epoch()
    return loop, loop.final_evaluation()[0]


@pytest.mark.slow
def test_ssail_follows_a_flock_to_the_goal_that_it_has_chosen(
    flock_trained: tuple[TrainingLoop, dict[str, float]],
) -> None:
    """After 50 frames, when the goal shows in them. Control: the untrained model gets to none."""
    loop, values = flock_trained
    assert error_ratios(values)[40] < 0.8
    found = goals(loop, best_predictor(loop), KNOWN)
    assert found.rarer >= 0.1
    assert found.right >= 0.95
    untrained = goals(loop, loop.untrained, KNOWN)
    assert untrained.reached < found.reached


@pytest.mark.slow
@pytest.mark.xfail(
    strict=True, reason="worse than constant velocity at steps 1 and 10 (docs/experiments.md, The flock)"
)
def test_ssail_beats_constant_velocity_on_a_flock_at_all_horizons(
    flock_trained: tuple[TrainingLoop, dict[str, float]],
) -> None:
    _, values = flock_trained
    assert max(error_ratios(values).values()) < 1


@pytest.mark.slow
@pytest.mark.xfail(strict=True, reason="one goal is hardly ever reached (docs/experiments.md, The flock)")
def test_ssail_takes_a_flock_to_either_goal_while_both_are_open(
    flock_trained: tuple[TrainingLoop, dict[str, float]],
) -> None:
    loop, _ = flock_trained
    assert goals(loop, best_predictor(loop), OPEN).rarer >= 0.1
