"""How recorded motion is evaluated: the answer of constant velocity, the noise that all share, and what is best."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from ssmail.data import expert_sets
from ssmail.data.mocap.dataset import NO_LINES, MocapParameters
from ssmail.data.trajectories import SPLITS, ExpertSet, Trajectories
from ssmail.errors import InputError
from ssmail.training.baselines import Baseline, CopyLast
from ssmail.training.evaluators import ForecastEvaluator
from ssmail.training.loop import TrainingLoop
from tests.training.conftest import ToySpec

SHORT = ("forecast.observed=3", "forecast.predicted=5")
PULL = np.array([0.5, -0.25, 0.125])  # change of every velocity from frame to frame


def forecast(loop: TrainingLoop) -> ForecastEvaluator:
    assert isinstance(loop.evaluator, ForecastEvaluator)
    return loop.evaluator


@pytest.fixture
def falling(tmp_path: Path) -> str:
    """The override of data.path with a set in which two joints move with constant acceleration."""
    draw = np.random.default_rng(0)
    splits = {}
    for split, frames in zip(SPLITS, (6, 6, 8), strict=True):
        velocities = draw.normal(size=(3, 1, 2, 3)) + PULL * np.arange(frames).reshape(1, -1, 1, 1)
        positions = draw.normal(size=(3, 1, 2, 3)) + velocities.cumsum(axis=1)
        count = np.zeros(3, dtype=np.int64)
        splits[split] = Trajectories.single_mode(positions, velocities, count, count)
    params = MocapParameters(subject=35, train=(1,), validation=(2,), test=(3,), window=6, test_window=8)
    values = params.model_dump(mode="json")
    falling = ExpertSet.bundle(splits, NO_LINES, values, ("root", "hand"), (-1, 0), {})
    expert_sets.save(falling, tmp_path / "falling.npz")
    return f"data.path={tmp_path / 'falling.npz'}"


@pytest.mark.parametrize("method", ["constant-velocity", "copy-last"])
def test_constant_velocity_against_the_answer_by_hand(falling: str, toy: ToySpec, method: str) -> None:
    """After h steps without the pull a, v is off by h a and p by h (h + 1) / 2 a, in raw units. The mean is over three
    positions and three velocities, whose scaled units are 2 / range.
    """
    loop = TrainingLoop(toy(method, falling, *SHORT), 0)
    h = np.arange(1, 6)
    of_position, of_velocity = 2 / loop.scaling.position_span, 2 / loop.scaling.velocity_span
    per_axis = (h * (h + 1) / 2 * of_position) ** 2 + (h * of_velocity) ** 2
    expected = np.square(PULL).sum() * per_axis / 6
    values, arrays = loop.final_evaluation()
    np.testing.assert_allclose(arrays["test_constant_velocity/mse"], expected, rtol=1e-3)
    assert values["test_constant_velocity/mse_1"] == pytest.approx(expected[0], rel=1e-3)
    assert values["test_constant_velocity/one_step_mse"] == pytest.approx(expected[0], rel=1e-3)
    distance = np.linalg.norm(PULL) * h * (h + 1) / 2
    assert values["test_constant_velocity/ade"] == pytest.approx(distance.mean(), rel=1e-3)
    assert values["test_constant_velocity/fde"] == pytest.approx(distance[-1], rel=1e-3)
    is_constant_velocity = np.allclose(arrays["test/mse"], expected, rtol=1e-3)
    assert is_constant_velocity is (method == "constant-velocity")  # negative control: not everybody's answer
    every_epoch = loop.evaluator.epoch(loop.evaluator.constant_velocity)  # from the first of six frames: five steps too
    assert every_epoch["validation/mse"] == pytest.approx(expected.mean(), rel=1e-3)
    assert every_epoch["train/mse"] == pytest.approx(expected.mean(), rel=1e-3)


@pytest.mark.parametrize("method", ["constant-velocity", "copy-last"])
def test_a_reference_has_one_answer_as_a_method_and_beside_others(toy: ToySpec, method: str) -> None:
    """Clean and noisy, though draws of noise are few."""
    values, _ = TrainingLoop(toy(method), 0).final_evaluation()
    other, _ = TrainingLoop(toy("bc"), 1).final_evaluation()
    beside = f"test_{method.replace('-', '_')}"
    for noisy in ("", "_noisy"):
        for name in ("mse", "mse_10", "ade", "fde"):
            assert values[f"test{noisy}/{name}"] == pytest.approx(values[f"{beside}{noisy}/{name}"])
            assert other[f"{beside}{noisy}/{name}"] == pytest.approx(values[f"{beside}{noisy}/{name}"])
    assert values["test_noisy/mse"] > values["test/mse"]


class Listener(Baseline):
    """Copies the last state and keeps the noise that it is given, in order."""

    def __init__(self) -> None:
        self.heard: list[Tensor | None] = []

    def free_run(self, observed: Tensor, *given: Any, deterministic: bool, noise: Tensor | None) -> Tensor:
        self.heard.append(noise)
        assert noise is None or observed.shape[0] == noise.shape[0]
        return CopyLast().free_run(observed, *given)

    def one_step(self, states: Tensor, generator: torch.Generator) -> Tensor:
        return states[:, :-1]


def noises_of(loop: TrainingLoop) -> list[Tensor]:
    listener = Listener()
    loop.evaluator.final(listener, listener, listener)
    assert None in listener.heard  # clean
    return [noise for noise in listener.heard if noise is not None]


def noise_of(loop: TrainingLoop) -> Tensor:
    return noises_of(loop)[0]


def test_all_methods_and_seeds_meet_the_same_noise(toy: ToySpec) -> None:
    first = noise_of(TrainingLoop(toy("ssail"), 0))
    assert first.shape == (3 * 3, 6 + 10 - 1, 5, 6)  # samples times windows; each state that is read
    assert torch.equal(noise_of(TrainingLoop(toy("dnri"), 1)), first)
    trained = TrainingLoop(toy("bc"), 2)
    trained.run_epoch()  # the generators are elsewhere now
    assert torch.equal(noise_of(trained), first)
    assert not torch.equal(noise_of(TrainingLoop(toy("ssail", "forecast.noise_seed=1"), 0)), first)
    assert float(first.std()) == pytest.approx(0.05, rel=0.05)
    torch.testing.assert_close(noise_of(TrainingLoop(toy("ssail", "forecast.noise=0.1"), 0)), 2 * first)
    assert not torch.equal(first[:3], first[3:6])  # each sample has its own


def test_noise_on_the_history_ends_with_it_and_noise_on_predictions_begins_there(toy: ToySpec) -> None:
    everywhere, history, predictions = (
        noise_of(TrainingLoop(toy("bc", f"forecast.noise_on={on}"), 0)) for on in ("all", "history", "predictions")
    )
    assert torch.equal(history[:, :6], everywhere[:, :6])
    assert not history[:, 6:].any()
    assert torch.equal(history + predictions, everywhere)
    assert bool(predictions[:, 6:].any())


def test_every_run_has_the_errors_of_both_kinds_of_noise(toy: ToySpec) -> None:
    *_, history, predictions = noises_of(TrainingLoop(toy("bc"), 0))
    assert bool(history[:, :6].any())
    assert not history[:, 6:].any()
    assert not predictions[:, :6].any()
    values, _ = TrainingLoop(toy("constant-velocity"), 0).final_evaluation()
    clean, whole = values["test/mse"], values["test_noisy/mse"]
    # constant velocity reads the last observed state for its first step, and its own prediction for each one after that
    assert values["test_noisy_history/mse_1"] == pytest.approx(values["test_noisy/mse_1"])
    assert values["test_noisy_predictions/mse_1"] == pytest.approx(values["test/mse_1"])
    assert clean < values["test_noisy_predictions/mse"] < whole
    assert clean < values["test_noisy_history/mse"] < whole


def test_the_best_epoch_is_finite_before_it_is_small(toy: ToySpec) -> None:
    evaluator = forecast(TrainingLoop(toy("bc"), 0))
    errors = [0.3, math.inf, 0.1, math.nan, 0.2]
    ranked = sorted(range(5), key=lambda i: evaluator.rank({"validation/mse": errors[i], "train/mse": -errors[i]}))
    assert ranked[:3] == [2, 4, 0]


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_an_epoch_that_is_not_finite_is_never_the_best(toy: ToySpec, bad: float) -> None:
    loop = TrainingLoop(toy("bc"), 0)
    kept = []
    for loop.epoch, error in enumerate([bad, 0.3, bad, 0.4, 0.2], 1):
        loop._select(*loop.evaluator.rank({"validation/mse": error}))
        kept.append(loop.best["epoch"])
    assert kept == [0, 2, 2, 2, 5]


def test_metrics_and_arrays_have_their_names_and_shapes(toy: ToySpec) -> None:
    loop = TrainingLoop(toy("ssail"), 0)
    record = loop.run_epoch()
    every = ("mse", "mse_1", "ade", "fde", "diverged")
    assert {f"{split}/{name}" for split in ("train", "validation") for name in every} <= record.keys()
    values, arrays = loop.final_evaluation()
    prefixes = ("test", "test_mean", "test_constant_velocity", "test_copy_last")
    prefixes = (*prefixes, *(f"{prefix}_noisy" for prefix in prefixes), "test_last")
    assert {f"{prefix}/{name}" for prefix in prefixes for name in (*every, "mse_10")} <= values.keys()
    assert {"test/one_step_mse", "test_constant_velocity/one_step_mse"} <= values.keys()
    for prefix in prefixes:
        assert arrays[f"{prefix}/mse"].shape == arrays[f"{prefix}/mse_spread"].shape == (10,)
    truth = loop.data.test.positions[:, 6:16]
    np.testing.assert_allclose(arrays["test/expert"], truth, atol=1e-4)
    for prefix in ("test", "test_noisy"):
        assert arrays[f"{prefix}/predictions"].shape == truth.shape
    assert not np.allclose(arrays["test/predictions"], arrays["test_noisy/predictions"])


def test_the_windows_must_be_long_enough(toy: ToySpec) -> None:
    with pytest.raises(InputError) as caught:
        TrainingLoop(toy("bc", "forecast.observed=7"), 0)
    assert str(caught.value) == (
        "forecast.observed 7 and forecast.predicted 10 need 17 frames, but the test windows of the data have 16; "
        "lower one of the two with --set."
    )
