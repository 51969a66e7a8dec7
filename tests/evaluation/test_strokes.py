"""The distance to a letter, against answers by hand and against drawings that must not do well."""

import numpy as np
import pytest

from ssmail.config.data_sections import LettersSpec
from ssmail.data import letters
from ssmail.data.trajectories import Floats
from ssmail.evaluation.metrics import polyline_distances, stroke_distances

BAR = np.stack([np.linspace(0, 1, 101), np.zeros(101)], axis=1)  # a stroke of length 1


def distance(path: Floats, letter: Floats = BAR) -> float:
    """Of one drawing (T, 2) of one letter."""
    return float(stroke_distances(path[None, :, None], letter[None])[0, 0])


def test_polyline_distances_by_hand() -> None:
    points = np.array([[0.5, 2.0], [-3.0, 4.0], [2.0, 0.0]])
    np.testing.assert_allclose(polyline_distances(points, BAR), [2, 5, 1])
    standing = np.zeros((4, 2))
    np.testing.assert_allclose(polyline_distances(points, standing), np.linalg.norm(points, axis=1))


def test_the_letter_itself_has_distance_zero_in_any_order_and_tempo() -> None:
    assert distance(BAR) == 0
    assert distance(BAR[::-1]) == 0
    assert distance(BAR[[0, 100]]) == 0  # two points, but the whole line
    assert distance(BAR[[0, 0, 0, 50, 100, 100]]) == 0


def test_a_line_beside_the_letter_is_as_far_as_it_is_beside() -> None:
    assert distance(BAR + np.array([0, 0.2])) == pytest.approx(0.2)


def test_half_a_letter_is_not_a_letter() -> None:
    """What is drawn is exact; the points of the other half are 0 to 1/2 away, 1/4 on average, and those of the whole
    letter 1/8. Of a point in the middle all are 1/4 away on average. The mean of both ways would be half of that.
    """
    assert distance(BAR[:51]) == pytest.approx(1 / 8, rel=0.02)
    assert distance(BAR[[50, 50]]) == pytest.approx(1 / 4, rel=0.02)


def test_scribbling_around_the_letter_is_not_a_letter() -> None:
    """Over the letter and then 3 beside it, half of the time each."""
    beside = np.repeat([[0.0, 3.0]], 101, axis=0)
    assert distance(np.concatenate([BAR, beside])) == pytest.approx(1.5)


def test_a_drawing_that_is_not_finite_is_nan() -> None:
    broken = BAR.copy()
    broken[7] = np.nan
    both = stroke_distances(np.stack([BAR, broken])[:, :, None], BAR[None])[:, 0]
    assert both[0] == 0
    assert np.isnan(both[1])


def test_the_expert_does_well_and_nothing_lazy_does() -> None:
    p = LettersSpec(word="ML", train=20, validation=1, test=1, steps=60, jitter=1.0, seed=0)
    experts = letters.generate(p)
    begin, positions = letters.first_letter_step(p.steps), experts.train.positions
    ruled = positions[:, :1] + experts.train.velocities[:, :1] * np.arange(60)[None, :, None, None]
    still = np.repeat(positions[:, :1], 60, axis=1)
    half = positions[:, np.minimum(np.arange(60), (60 + begin) // 2)]
    centre = np.broadcast_to(experts.centre_lines.mean(axis=1), positions.shape)
    swapped = positions[:, :, ::-1]

    def mean(drawn: Floats) -> Floats:
        found: Floats = stroke_distances(drawn[:, begin:], experts.centre_lines).mean(axis=0)
        return found

    assert (mean(positions) < 0.025).all()
    late = positions[:, np.maximum(np.arange(60) - 3, 0)]
    assert (mean(late) < 0.04).all()
    for lazy, least in ((ruled, 0.8), (still, 0.8), (centre, 0.35), (half, 0.2), (swapped, 0.75)):
        assert (mean(lazy) > least).all()
