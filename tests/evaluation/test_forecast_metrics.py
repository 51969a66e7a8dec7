"""The metrics of predicted motion, worked out by hand."""

import warnings

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ssmail.data.scaling import Scaling
from ssmail.data.trajectories import Floats
from ssmail.evaluation.metrics import FORECAST_STEPS, forecast_metrics, letter_metrics

SCALING = Scaling(0.0, 10.0, -1.0, 1.0)  # one scaled unit of position is five raw ones
S, B, T, N = 2, 2, 3, 1


def example() -> tuple[Floats, Floats]:
    """Two samples of two windows of three steps, scaled states of six features; all is right but for five numbers."""
    truth = np.random.default_rng(0).normal(size=(B, T, N, 6))
    error = np.zeros((S, B, T, N, 6))
    error[0, 0, 0, 0, 0] = 3.0  # sample 0, window 0, step 1: a position
    error[0, 0, 2, 0, :2] = 0.6, 0.8  # step 3: two positions, a distance of 1
    error[1, 0, 0, 0, 5] = 1.0  # sample 1, window 0, step 1: a velocity
    error[1, 1, 2, 0, 4] = 2.0  # window 1, step 3: a velocity
    return truth + error, truth


def test_errors_of_each_predicted_step_by_hand() -> None:
    """Over all six features: step 1 (9 + 1) / 24, step 2 none, step 3 (1 + 4) / 24."""
    values, curves = forecast_metrics(*example(), SCALING)
    np.testing.assert_allclose(curves["mse"], [10 / 24, 0, 5 / 24], atol=1e-15)
    assert values["mse"] == pytest.approx(15 / 72)
    assert values["mse_1"] == pytest.approx(10 / 24)
    of_positions = np.square(np.subtract(*example())[..., :3]).mean()  # negative control: not of positions alone
    assert values["mse"] != pytest.approx(of_positions)


def test_the_spread_is_that_of_windows_and_not_of_samples() -> None:
    """Step 1: window 0 has (9 / 6 + 1 / 6) / 2 = 5 / 6 over its samples, window 1 none; (n - 1) of two is |a - b| / √2.

    Step 3: 1 / 12 and 4 / 12. One window has no spread.
    """
    predicted, truth = example()
    _, curves = forecast_metrics(predicted, truth, SCALING)
    np.testing.assert_allclose(curves["mse_spread"], [5 / 6 / 2**0.5, 0, 3 / 12 / 2**0.5], atol=1e-15)
    _, alone = forecast_metrics(predicted[:, :1], truth[:1], SCALING)
    assert np.isnan(alone["mse_spread"]).all()


def test_displacements_are_raw_distances_of_positions() -> None:
    """3 and 1 scaled are 15 and 5 raw; over 2 samples, 2 windows and 3 steps, or the last step."""
    values, _ = forecast_metrics(*example(), SCALING)
    assert values["ade"] == pytest.approx((15 + 5) / 12)
    assert values["fde"] == pytest.approx(5 / 4)
    unscaled, _ = forecast_metrics(*example(), Scaling(-1.0, 1.0, -1.0, 1.0))  # negative control: other units
    assert unscaled["ade"] == pytest.approx(4 / 12)


def test_diverged_counts_each_sample_of_each_window() -> None:
    predicted, truth = example()
    assert forecast_metrics(predicted, truth, SCALING)[0]["diverged"] == 0
    predicted[0, 1, 1, 0, 2] = -10.1
    predicted[1, 0, 2, 0, 0] = np.nan
    predicted[1, 0, 0, 0, 0] = np.inf  # the same trajectory
    predicted[0, 0, 0, 0, 3] = 99.0  # a velocity
    assert forecast_metrics(predicted, truth, SCALING)[0]["diverged"] == 2 / 4


@pytest.mark.parametrize("bad", [np.inf, -np.inf, np.nan, 1e200])
def test_what_is_not_finite_is_told_and_not_warned_of(bad: float) -> None:
    predicted, truth = example()
    predicted[0, 0, 1, 0, 0] = bad
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        values, curves = forecast_metrics(predicted, truth, SCALING)
    assert not np.isfinite(values["mse"])
    assert values["diverged"] == 1 / 4
    assert np.isfinite(curves["mse"]).tolist() == [True, False, True]
    assert np.isfinite(curves["mse_spread"]).tolist() == [True, False, True]


@given(steps=st.integers(1, 60), seed=st.integers(0, 2**16))
def test_steps_have_metrics_of_their_own_as_far_as_there_are_so_many(steps: int, seed: int) -> None:
    draw = np.random.default_rng(seed)
    predicted, truth = draw.normal(size=(2, 3, steps, 2, 4)), draw.normal(size=(3, steps, 2, 4))
    values, curves = forecast_metrics(predicted, truth, SCALING)
    assert {name for name in values if name.startswith("mse_")} == {f"mse_{h}" for h in FORECAST_STEPS if h <= steps}
    assert all(values[f"mse_{h}"] == curves["mse"][h - 1] for h in FORECAST_STEPS if h <= steps)
    assert values["mse"] == pytest.approx(np.square(predicted - truth).mean())
    perfect, _ = forecast_metrics(truth[None], truth, SCALING)
    assert set(perfect.values()) == {0.0}


def test_letter_metrics_of_each_agent_by_hand() -> None:
    """Two agents, bars of length 1 (raw) at different heights: the first drawn 0.25 too high, the second exactly; what
    comes before the letter's first step counts in the mse alone.
    """
    scaling = Scaling(0.0, 4.0, -1.0, 1.0)
    bars = np.stack([np.stack([np.linspace(0, 1, 11), np.full(11, height)], axis=1) for height in (1.0, 3.0)])
    raw = np.concatenate([np.full((3, 2, 2), 2.0), np.moveaxis(bars, 0, 1)])  # (T, N, 2), three steps on the way
    truth = np.concatenate([scaling.scale_positions(raw), np.zeros_like(raw)], axis=-1)[None]
    predicted = np.repeat(truth[None], 2, axis=0)
    predicted[:, :, 3:, 0, 1] += 0.25 * 2 / scaling.position_span
    values = letter_metrics(predicted, truth, bars, 3, scaling)
    assert values["stroke_distance_0"] == pytest.approx(0.25)
    assert values["stroke_distance_1"] == pytest.approx(0)
    assert values["stroke_distance"] == pytest.approx(0.125)
    assert values["mse"] == pytest.approx(0.125**2 * 11 / 13 / 8)
    assert values["ade"] == pytest.approx(0.125 * 11 / 13)
    early = letter_metrics(predicted, truth, bars, 0, scaling)  # negative control: with the way there
    assert early["stroke_distance_1"] > 0.1
