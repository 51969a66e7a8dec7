"""What a slope is worth: fields in closed form, and controls that must fail."""

import numpy as np
import pytest

from ssmail.evaluation.landscape import (
    CELLS,
    MARGIN,
    NEAR,
    PROGRESS,
    Plane,
    closeness,
    cosines,
    ideal_reward,
    mean_cosine,
    nearest_points,
    slope_share,
)

TRACK = np.array([[0.0, 0.0], [1.0, 0.0], [2.0, 0.0]])


@pytest.fixture
def plane() -> Plane:
    return Plane.around(np.array([[0.0, 0.0], [2.0, 1.0]]))


def linear(plane: Plane, direction: tuple[float, float]) -> tuple[np.ndarray, np.ndarray]:
    return plane.points @ np.array(direction), np.broadcast_to(direction, plane.points.shape)


def ridge(plane: Plane, width: float) -> tuple[np.ndarray, np.ndarray]:
    """A step of that width along x = 1 and its gradient: the reward of a discriminator that is sure of itself."""
    z = (plane.points[..., 0] - 1) / width
    value = 1 / (1 + np.exp(-z))
    slope = value * (1 - value) / width
    return value, np.stack([slope, np.zeros_like(slope)], axis=-1)


def test_the_plane_is_the_box_and_a_margin_with_one_spacing(plane: Plane) -> None:
    assert plane.spacing == pytest.approx((2 + 2 * MARGIN * 2) / CELLS)
    np.testing.assert_allclose(np.diff(plane.y), plane.spacing)
    assert plane.x[[0, -1]] == pytest.approx([-2 * MARGIN, 2 + 2 * MARGIN])
    assert plane.y[0] <= -2 * MARGIN + 1e-9
    assert plane.y[-1] >= 1 + 2 * MARGIN - 1e-9
    assert plane.y.mean() == pytest.approx(0.5)
    assert plane.points.shape == (len(plane.y), len(plane.x), 2)


@pytest.mark.parametrize("direction", [(1.0, 0.0), (0.0, -3.0), (0.6, 0.8), (1e-6, 0.0)])
def test_an_even_slope_has_share_1_in_any_direction_and_at_any_scale(
    plane: Plane, direction: tuple[float, float]
) -> None:
    reward, gradient = linear(plane, direction)
    assert slope_share(reward, gradient, plane) == 1
    assert slope_share(reward, gradient, plane, usable=1.0) == 1  # the even slope is never above the true one


def test_a_cone_has_share_1(plane: Plane) -> None:
    offset = plane.points - np.array([1.0, 0.5])
    distance = np.linalg.norm(offset, axis=-1)
    assert slope_share(-distance, -offset / np.maximum(distance, 1e-12)[..., None], plane) == pytest.approx(
        1, abs=2 / distance.size
    )


def test_a_step_has_the_share_of_its_band(plane: Plane) -> None:
    shares = [slope_share(*ridge(plane, width), plane) for width in (0.01, 0.05, 1.0)]
    # the slope of a step of width w is at least u where |x - 1| <= w * acosh(1 / (2 sqrt(u w))) * 2
    even = 1 / plane.diagonal
    band = 2 * 0.05 * 2 * np.arccosh(1 / (2 * np.sqrt(0.25 * even * 0.05)))
    assert shares[1] == pytest.approx(band / np.ptp(plane.x), abs=1.5 / CELLS)
    assert shares[0] < 0.1 < shares[1] < 0.4 < shares[2]
    assert shares[2] == 1


def test_neither_a_factor_nor_a_constant_changes_the_share(plane: Plane) -> None:
    reward, gradient = ridge(plane, 0.1)
    same = slope_share(reward, gradient, plane)
    assert 0 < same < 1
    assert slope_share(1000 * reward - 5, 1000 * gradient, plane) == same


def test_a_flat_reward_has_share_0(plane: Plane) -> None:
    flat = np.full(plane.points.shape[:2], 0.7)
    assert slope_share(flat, np.zeros(plane.points.shape), plane) == 0


def test_each_agent_has_its_own_even_slope(plane: Plane) -> None:
    (a, da), (b, db) = linear(plane, (1.0, 0.0)), ridge(plane, 0.05)
    both = slope_share(np.stack([100 * a, b]), np.stack([100 * da, db]), plane)
    assert both == pytest.approx((1 + slope_share(b, db, plane)) / 2)


def test_a_reward_that_falls_with_the_distance_points_to_the_nearest_expert_everywhere(plane: Plane) -> None:
    ways = nearest_points(plane.points, TRACK) - plane.points
    toward = ways / np.maximum(np.linalg.norm(ways, axis=-1, keepdims=True), 1e-12)
    assert mean_cosine(3 * toward, ways, plane.spacing) == pytest.approx(1)
    assert mean_cosine(-toward, ways, plane.spacing) == pytest.approx(-1)
    turned = np.stack([-toward[..., 1], toward[..., 0]], axis=-1)
    assert mean_cosine(turned, ways, plane.spacing) == pytest.approx(0)


def test_a_slope_that_is_nil_points_nowhere() -> None:
    ways = np.array([[1.0, 0.0], [1.0, 0.0]])
    assert cosines(np.array([[2.0, 0.0], [0.0, 0.0]]), ways).tolist() == [1, 0]
    assert mean_cosine(np.array([[2.0, 0.0], [0.0, 0.0]]), ways, 0.5) == 0.5


def test_points_on_the_expert_do_not_count() -> None:
    gradient = np.array([[1.0, 0.0], [-1.0, 0.0]])
    assert mean_cosine(gradient, np.array([[1.0, 0.0], [1e-3, 0.0]]), least=0.1) == 1
    assert np.isnan(mean_cosine(gradient, np.full((2, 2), 1e-3), least=0.1))
    assert np.isnan(mean_cosine(gradient, np.full((2, 2), np.nan), least=0.1))


def test_closeness() -> None:
    weights = closeness(np.array([[0.0, 0.0], [0.5, 0.0], [0.5, 7.0]]), TRACK)
    assert weights.sum(axis=-1) == pytest.approx(1)
    by_hand = (np.array([0, 1, 4]) + NEAR**2) ** -2.0
    assert weights[0] == pytest.approx(by_hand / by_hand.sum())
    assert weights[0, 0] > 0.999
    assert weights[1, 0] == weights[1, 1] > 0.49
    assert weights[2].max() < 0.4  # far away all count


def test_the_ideal_reward_falls_with_the_distance_and_rises_along_the_stroke() -> None:
    plane = Plane(np.array([0.0, 1.0, 2.0]), np.array([0.0, 1.0]))
    reward = ideal_reward(plane, TRACK[None])
    np.testing.assert_allclose(reward[0], PROGRESS * np.array([0, 0.5, 1]))
    np.testing.assert_allclose(reward[1], reward[0] - 1)
