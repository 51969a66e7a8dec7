import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ssmail.config.sections import YJunctionSpec
from ssmail.data.yjunction import generate
from ssmail.evaluation import metrics
from ssmail.evaluation.metrics import lane_metrics, lane_test_metrics, one_step_mse

PARAMS = YJunctionSpec(train=30, validation=1, test=20, agents=3, steps=50, lane_angle=43.0, jitter=1.0, seed=0)
EXPERTS = generate(PARAMS)
TRUTH = EXPERTS.test


def quick(predicted: np.ndarray) -> dict[str, float]:
    return lane_metrics(predicted, TRUTH.continuations, EXPERTS.centre_lines, EXPERTS.scaling)


@pytest.mark.parametrize("lane", [0, 1])
def test_either_lane_is_perfect(lane: int) -> None:
    values = quick(TRUTH.continuations[lane])
    assert values == {"mode_mse": 0, "on_lane": 1, "lane_balance": 0, "lag": 0, "diverged": 0}


def test_the_lane_of_the_expert_is_not_demanded_but_one_lane_for_the_group_is() -> None:
    mixed = TRUTH.continuations[0].copy()
    mixed[:, :, 1] = TRUTH.continuations[1, :, :, 1]  # the second agent takes the other lane
    values = quick(mixed)
    assert values["on_lane"] == 1
    assert values["mode_mse"] > 0.02


def test_half_and_half_is_balanced() -> None:
    half = np.concatenate([TRUTH.continuations[0, :10], TRUTH.continuations[1, 10:]])
    assert quick(half)["lane_balance"] == 0.5


def test_averaging_the_lanes_is_off_lane() -> None:
    values = quick(TRUTH.continuations.mean(axis=0))
    assert values["on_lane"] == 0
    assert values["mode_mse"] > 0.03


def test_constant_velocity_is_what_the_bars_are_set_against() -> None:
    steps = np.arange(PARAMS.steps)[None, :, None, None]
    values = quick(TRUTH.positions[:, :1] + TRUTH.velocities[:, :1] * steps)
    assert 0.04 < values["mode_mse"] < 0.055
    assert values["on_lane"] == 0


def test_mode_mse_by_hand() -> None:
    predicted = np.zeros((1, 2, 1, 2))
    modes = np.stack([np.full((1, 2, 1, 2), 1.0), np.array([[[[0.0, 2.0]], [[0.0, 0.0]]]])])
    assert metrics.mode_errors(predicted, modes).tolist() == [[1.0], [1.0]]
    assert metrics.mode_mse(predicted + 0.5, modes) == pytest.approx(0.25)


def test_distance_goes_on_along_the_last_segment() -> None:
    line = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0]])
    points = np.array([[0.5, 0.3], [1.0, 50.0], [3.0, 9.0], [-3.0, -4.0]])
    np.testing.assert_allclose(metrics.polyline_distances(points, line, extended=True), [0.3, 0, 2, 5])


@given(delay=st.integers(1, 4))
def test_a_late_group_lags(delay: int) -> None:
    late = TRUTH.continuations[0].copy()
    late[:, delay:] = late[:, :-delay]
    assert quick(late)["lag"] < 0
    early = TRUTH.continuations[0].copy()
    early[:, :-delay] = early[:, delay:]
    assert quick(early)["lag"] > 0


def test_diverged() -> None:
    scaled = np.zeros((4, 5, 3, 2))
    scaled[1, 2, 0, 0], scaled[2, 0, 1, 1], scaled[3, 4, 2, 1] = np.nan, 10.1, -9.9
    assert metrics.diverged(scaled) == 0.5
    assert not np.isfinite(metrics.mode_mse(scaled, np.zeros((2, 4, 5, 3, 2))))


def test_best_of_samples() -> None:
    """min_ade takes the best sample of each start: with one sample per lane it is 0, while ade counts both."""
    values = lane_test_metrics(TRUTH.continuations, TRUTH, EXPERTS.centre_lines, EXPERTS.scaling)
    assert values["min_ade_20"] == values["min_fde_20"] == 0
    assert values["ade"] > 1
    one_lane = lane_test_metrics(TRUTH.continuations[:1], TRUTH, EXPERTS.centre_lines, EXPERTS.scaling)
    assert one_lane["min_ade_20"] > 1


def test_one_step_error_is_the_mean_over_everything() -> None:
    truth = np.zeros((2, 3, 1, 4))
    predicted = truth.copy()
    predicted[0, 1, 0] = [2.0, 0.0, 0.0, 0.0]
    assert one_step_mse(predicted, truth) == 4 / truth.size
