from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ssmail.config.data_sections import YJunctionSpec
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
    assert values.pop("path_rms") == pytest.approx(0.6 / np.sqrt(3), rel=0.15)  # of offsets drawn from [-0.6, 0.6]
    found = {"mode_mse": 0, "on_lane": 1, "between_lanes": 0, "on_path": 1, "lane_balance": 0, "lag": 0, "diverged": 0}
    assert values == found


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
    assert values["between_lanes"] == 1
    assert values["mode_mse"] > 0.03


@pytest.mark.parametrize(("share", "between"), [(0.0, 0), (0.24, 0), (0.26, 1), (0.74, 1), (0.76, 0), (1.3, 0)])
def test_between_the_lanes_is_nearer_to_the_middle_than_to_a_lane(share: float, between: float) -> None:
    one, other = TRUTH.continuations
    assert quick(one + share * (other - one))["between_lanes"] == between


def test_a_diverged_agent_is_not_between_the_lanes() -> None:
    middle = TRUTH.continuations.mean(axis=0)
    middle[0] = np.nan
    assert quick(middle)["between_lanes"] == pytest.approx(1 - 1 / len(middle))


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


@pytest.mark.parametrize(("aside", "share"), [(0.35, 1.0), (0.5, 0.95), (1.7, 0.0)])
def test_a_path_beside_the_road_is_seen_at_any_step(aside: float, share: float) -> None:
    """Also where the end is right, which is all that on_lane looks at."""
    wide = TRUTH.continuations[0].copy()
    wide[:, 10:13, :, 1] += aside  # on the street, which has the direction of x
    values = quick(wide)
    assert values["on_lane"] == 1
    assert values["on_path"] == pytest.approx(share, abs=0.1 if 0 < share < 1 else 0)


def test_path_rms_by_hand() -> None:
    lines = np.array([[[0.0, 0.0], [1.0, 0.0], [2.0, 0.0]], [[0.0, 5.0], [1.0, 5.0], [2.0, 5.0]]])
    path = np.array([[0.0, 0.0], [1.0, 2.0], [9.0, 0.0]])[None, :, None]  # the last is beyond the end of the line
    assert metrics.path_metrics(path, lines) == {"on_path": 0.0, "path_rms": pytest.approx(np.sqrt(4 / 3))}
    assert metrics.path_metrics(path * [1, 0.5], lines)["on_path"] == 1.0
    path[0, 1] = np.nan
    assert metrics.path_metrics(path, lines) == {"on_path": 0.0, "path_rms": np.inf}


@given(st.lists(st.tuples(st.integers(-3, 3), st.integers(-3, 3)), min_size=3, max_size=8), st.integers(0, 99))
def test_distances_need_the_corners_alone(points: list[tuple[int, int]], seed: int) -> None:
    line = np.unique(np.array(points, dtype=float), axis=0)
    if len(line) < 2:
        return
    fine = np.concatenate([np.linspace(a, b, 5)[:-1] for a, b in pairwise(line)] + [line[-1:]])
    somewhere = np.random.default_rng(seed).uniform(-4, 4, (20, 2))
    assert len(metrics.corners(fine)) <= len(line)
    for extended in (False, True):
        expected = metrics.polyline_distances(somewhere, fine, extended)
        assert metrics.polyline_distances(somewhere, metrics.corners(fine), extended) == pytest.approx(expected)


def test_the_expert_turns_where_the_road_does() -> None:
    many = generate(PARAMS.model_copy(update={"test": 1000})).test
    values = metrics.turning(many.positions, many.continuations)
    assert values["turn_own"] == pytest.approx(-1, abs=0.06)  # the speed is within 5 % of 1
    assert values["turn_others"] == pytest.approx(0, abs=0.06)
    assert values["turn_group"] == pytest.approx(-1, abs=0.06)
    assert values["turn_lead"] == 0


def test_turning_by_the_clock_and_after_the_leader_is_told_from_turning_where_the_road_does() -> None:
    draw = np.random.default_rng(0)
    ahead, one = draw.integers(0, 4, size=40), TRUTH.continuations[0, 0]
    speed = one[1, 0, 0] - one[0, 0, 0]
    by_place = np.stack([one[steps : steps + 40] for steps in ahead])  # start ahead, and turn as much earlier
    aside = draw.normal(size=(40, 1, PARAMS.agents))
    aside[..., 0] = 0
    after_leader = by_place.copy()
    after_leader[..., 0] += aside  # followers start elsewhere, and turn when the leader does
    by_clock = np.stack([one[:40]] * 40)
    by_clock[..., 0] += draw.normal(size=(40, 1, PARAMS.agents))
    modes = np.stack([by_place, -by_place])
    leader, clock = (metrics.turning(positions, modes) for positions in (after_leader, by_clock))
    assert [leader[f"turn_{who}"] for who in ("own", "others", "group")] == pytest.approx(
        [-1 / 3 / speed, -1 / 3 / speed, -1 / speed]
    )
    assert [clock[f"turn_{who}"] for who in ("own", "others", "group")] == pytest.approx([0, 0, 0])


def test_an_early_group_leads() -> None:
    early = TRUTH.positions.copy()
    early[:, 1:-2] = TRUTH.positions[:, 3:]
    assert metrics.turning(early, TRUTH.continuations)["turn_lead"] == pytest.approx(2, abs=0.01)


def test_who_never_turns_has_no_turn() -> None:
    straight = TRUTH.positions.copy()
    straight[..., 1] = straight[:, :1, :, 1]
    assert np.isnan(metrics.turn_steps(straight)).all()
    assert all(np.isnan(value) for value in metrics.turning(straight, TRUTH.continuations).values())


def test_equal_starts_do_not_tell_who_makes_whom_turn() -> None:
    alike = np.repeat(TRUTH.continuations[:, :1], 40, axis=1)
    assert np.isfinite(metrics.turn_steps(alike[0])).all()
    assert all(np.isnan(value) for value in metrics.turning(alike[0], alike).values())


def test_many_points_are_as_far_as_each_by_itself() -> None:
    """Distances are computed in blocks; a point has the same one in any of them."""
    line = np.array([[0.0, 0.0], [3.0, 1.0], [4.0, -2.0], [4.0, -2.0], [9.0, 0.0]])
    points = np.random.default_rng(0).normal(size=(3, metrics.BLOCK // 4, 2)) * 5
    found = metrics.polyline_distances(points, line)
    assert found.shape == points.shape[:2]
    some = [(0, 0), (1, 7), (2, -1)]
    assert [found[place] for place in some] == [metrics.polyline_distances(points[place], line) for place in some]
    assert metrics.polyline_distances(points[:0], line).shape == (0, metrics.BLOCK // 4)


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


@pytest.mark.parametrize("chunk", [1, 7, 50])
def test_distances_of_many_points_are_those_of_each_of_them(monkeypatch: pytest.MonkeyPatch, chunk: int) -> None:
    rng = np.random.default_rng(0)
    points, line = rng.normal(size=(5, 3, 2, 2)), rng.normal(size=(4, 2))
    expected = metrics.polyline_distances(points, line)
    monkeypatch.setattr(metrics, "BLOCK", chunk)
    found = metrics.polyline_distances(points, line)
    assert found.shape == (5, 3, 2)
    np.testing.assert_array_equal(found, expected)
    assert found[4, 2, 1] == metrics.polyline_distances(points[4, 2, 1], line)
