"""The pen's motion against what can be worked out by hand."""

import numpy as np
import pytest

from ssmail.data import letters

ELL = np.array([[1.0, 0.0], [0.0, 0.0], [0.0, 2.0]])  # a corner of 90 degrees between lengths 1 and 2


def test_minimum_jerk_begins_and_ends_at_rest() -> None:
    """10 u^3 - 15 u^4 + 6 u^5: half way at half time, 1.875 times the mean speed there, no speed or acceleration at
    either end.
    """
    assert letters.progress(np.array([-1.0, 0.0, 0.25, 0.5, 1.0, 2.0])).tolist() == [0, 0, 0.103515625, 0.5, 1, 1]
    h = 1e-4
    change = letters.progress(np.array([h, 0.5 + h, 1.0])) - letters.progress(np.array([0.0, 0.5 - h, 1.0 - h]))
    speed = change / [h, 2 * h, h]
    np.testing.assert_allclose(speed, [0, 1.875, 0], atol=1e-6)
    assert letters.progress(np.array(h)) < 1e-10  # of third order: no acceleration


def test_an_approach_keeps_its_first_velocity_and_arrives_at_rest() -> None:
    begin, velocity, end = np.array([[0.0, -1.0]]), np.array([[0.5, 0.0]]), np.array([[2.0, 3.0]])
    h = 1e-4
    times = np.array([[-2.0, -1.0, 0.0, h, 8 - h, 8.0, 9.0]])
    (made,) = letters.approach(begin, velocity, end, times, 8.0)
    np.testing.assert_allclose(made[:3], [[-1, -1], [-0.5, -1], [0, -1]])
    np.testing.assert_allclose((made[3] - made[2]) / h, velocity[0], atol=1e-6)
    np.testing.assert_allclose((made[5] - made[4]) / h, 0, atol=1e-6)
    np.testing.assert_allclose(made[5:], [end[0]] * 2)


def test_a_stroke_is_cut_at_its_corners_alone() -> None:
    assert [part.tolist() for part in letters.parts_of(ELL)] == [[[1, 0], [0, 0]], [[0, 0], [0, 2]]]
    angle = np.linspace(0, np.pi, 13)
    arc = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    assert len(letters.parts_of(arc)) == 1
    there_and_back = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 0.0]])
    assert len(letters.parts_of(there_and_back)) == 2
    np.testing.assert_allclose(letters.turns(ELL), np.pi / 2)
    np.testing.assert_allclose(letters.turns(there_and_back), np.pi)


def test_lengths_and_efforts_by_hand() -> None:
    assert letters.arc_lengths(ELL).tolist() == [0, 1, 3]
    quarter = letters.BEND * np.pi / 2
    np.testing.assert_allclose(letters.efforts(ELL), [0, 1 + quarter / 2, 3 + quarter])
    np.testing.assert_array_equal(
        letters.along(ELL, letters.arc_lengths(ELL), np.array([0.25, 2.0])), [[0.75, 0], [0, 1]]
    )


def test_without_overlap_the_pen_is_in_the_corner_when_a_part_ends() -> None:
    """Durations are as effort ** TEMPO, here 1 : 2 ** TEMPO."""
    drawn = letters.Timeline.of(ELL, 10.0, 40.0, overlap=0.0)
    first = 30 / (1 + 2**letters.TEMPO)
    np.testing.assert_allclose(drawn.durations, [first, 30 - first])
    np.testing.assert_allclose(drawn.begins, [10, 10 + first])
    times = np.array([0.0, 10.0, 10 + first / 2, 10 + first, (50 + first) / 2, 40.0, 50.0])
    np.testing.assert_allclose(
        drawn.positions(times), [[1, 0], [1, 0], [0.5, 0], [0, 0], [0, 1], [0, 2], [0, 2]], atol=1e-12
    )


@pytest.mark.parametrize("overlap", [0.0, letters.OVERLAP])
def test_an_overlap_rounds_the_corner_and_keeps_the_pen_moving(overlap: float) -> None:
    """With overlap the second part begins before the first has ended: at no time does the pen stand still in between,
    and it misses the corner by little.
    """
    drawn = letters.Timeline.of(ELL, 0.0, 30.0, overlap)
    assert drawn.begins[1] + drawn.durations[1] == pytest.approx(30)
    fine = drawn.positions(np.linspace(1.0, 29.0, 5601))
    slowest = np.linalg.norm(np.diff(fine, axis=0), axis=1).min() / 0.005
    missed = np.linalg.norm(fine, axis=1).min()
    if overlap:
        assert slowest > 0.005
        assert 0 < missed < 0.05
    else:
        assert slowest < 1e-5
        assert missed < 1e-6
    np.testing.assert_allclose(drawn.positions(np.array([0.0, 30.0])), ELL[[0, 2]], atol=1e-12)
