"""How drawn letters are evaluated: names, references, what is best, and the untrained policy that Figure 1 shows."""

import math
from pathlib import Path

import numpy as np
import pytest
import torch

from ssmail.config.experiments import build_spec
from ssmail.config.names import METHODS
from ssmail.config.spec import RunSpec
from ssmail.training.evaluators import LetterEvaluator
from ssmail.training.loop import TrainingLoop


def toy(method: str, *overrides: str) -> RunSpec:
    return build_spec(method, "letters", "smoke", overrides)


def test_the_expert_is_the_best_and_constant_velocity_draws_nothing() -> None:
    values, arrays = TrainingLoop(toy("constant-velocity"), 0).final_evaluation()
    assert values["test_expert/stroke_distance"] < 0.03
    distance = values["test_constant_velocity/stroke_distance"]
    assert values["test/stroke_distance"] == pytest.approx(distance)
    assert distance > 0.8
    ruled = (
        arrays["test/expert"][:, :1]
        + np.arange(60)[None, :, None, None] * np.diff(arrays["test/rollouts"][0], axis=1)[:, :1]
    )
    np.testing.assert_allclose(arrays["test/rollouts"][0], ruled, atol=1e-4)


def test_metrics_and_arrays_have_their_names_and_shapes() -> None:
    loop = TrainingLoop(toy("ssail"), 0)
    record = loop.run_epoch()
    every = ("mse", "mse_40", "ade", "fde", "diverged", "stroke_distance", "stroke_distance_0", "stroke_distance_1")
    assert {f"{split}/{name}" for split in ("train", "validation") for name in every} <= record.keys()
    values, arrays = loop.final_evaluation()
    prefixes = ("test", "test_mean", "test_last", "test_constant_velocity")
    assert {f"{prefix}/{name}" for prefix in prefixes for name in every} <= values.keys()
    assert {"test/one_step_mse", "test_constant_velocity/one_step_mse"} <= values.keys()
    for prefix in prefixes:
        each = [values[f"{prefix}/stroke_distance_{n}"] for n in (0, 1)]
        assert values[f"{prefix}/stroke_distance"] == pytest.approx(np.mean(each))
    shapes = {name: array.shape for name, array in arrays.items()}
    assert shapes == {
        "test/rollouts": (3, 16, 60, 2, 2),
        "test/expert": (16, 60, 2, 2),
        "train/expert": (16, 60, 2, 2),
        "letters": (2, 120, 2),
        "first_letter_step": (1,),
        "initial/rollouts": (16, 60, 2, 2),
        "initial_mean/rollouts": (16, 60, 2, 2),
    }
    np.testing.assert_allclose(arrays["initial/rollouts"][:, 0], arrays["test/expert"][:, 0], atol=1e-5)


@pytest.mark.parametrize("method", METHODS)
def test_every_method_draws(method: str) -> None:
    loop = TrainingLoop(toy(method, "data.letters.word=V", "data.letters.train=8", "evaluation.samples=2"), 0)
    if loop.spec.epochs:
        assert loop.run_epoch()["validation/stroke_distance"] > 0
    assert loop.final_evaluation()[0]["test/stroke_distance"] > 0


def untrained_rollouts(loop: TrainingLoop) -> dict[str, np.ndarray]:
    """Those that the evaluator would draw if the current policy were the untrained one."""
    assert isinstance(loop.evaluator, LetterEvaluator)
    return loop.evaluator._untrained_rollouts(loop.learner.predictor, loop.evaluator.states(loop.data.test))


def test_the_untrained_policy_is_that_of_before_training_even_in_a_resumed_run(tmp_path: Path) -> None:
    """And it stays in the lower half by its mean; the trained one is another (negative control)."""
    loop = TrainingLoop(toy("ssail"), 3)
    before = untrained_rollouts(loop)
    loop.run_epoch()
    torch.save(loop.state_dict(), tmp_path / "state.pt")
    resumed = TrainingLoop(toy("ssail"), 3)
    resumed.load_state_dict(torch.load(tmp_path / "state.pt", weights_only=True))
    _, arrays = resumed.final_evaluation()
    for name in ("initial/rollouts", "initial_mean/rollouts"):
        np.testing.assert_array_equal(arrays[name], before[name])
    assert arrays["initial_mean/rollouts"][..., 1].max() < 0
    after = untrained_rollouts(resumed)
    assert not np.array_equal(after["initial/rollouts"], before["initial/rollouts"])


def test_looking_at_the_untrained_policy_changes_no_number() -> None:
    plain, curious = TrainingLoop(toy("bc"), 0), TrainingLoop(toy("bc"), 0)
    untrained_rollouts(curious)
    first, second = ({k: v for k, v in loop.run_epoch().items() if k != "seconds"} for loop in (plain, curious))
    assert first == second


def test_the_best_epoch_draws_best_whatever_its_mse() -> None:
    evaluator = TrainingLoop(toy("constant-velocity"), 0).evaluator
    distances = [0.3, math.inf, 0.1, math.nan, 0.2]
    records = [{"validation/stroke_distance": d, "validation/mse": -d, "train/stroke_distance": -d} for d in distances]
    ranked = sorted(range(5), key=lambda i: evaluator.rank(records[i]))
    assert ranked[:3] == [2, 4, 0]
