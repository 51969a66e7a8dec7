"""The number that each claim takes of a run, worked out by hand."""

import math

import numpy as np
import pytest

from ssmail.paper import c1_stability, c2_modes, c4_noise, c5_alpha, c6_curricula
from ssmail.paper.curve_numbers import beginning, end, settled_after, slope


def curve(*values: float) -> np.ndarray:
    return np.array(values, dtype=np.float64)


def test_the_ends_of_a_curve_are_fifths() -> None:
    rising = np.arange(1.0, 12)
    assert (beginning(rising), end(rising)) == (1.5, 10.5)
    assert (beginning(curve(3, 4)), end(curve(3, 4))) == (3, 4)
    assert end(curve(1, math.nan)) == math.inf
    assert math.isnan(end(curve()))


def test_a_slope_is_that_of_the_least_squares_line() -> None:
    values = curve(1, 4, 2, 8, 5)
    assert slope(values) == pytest.approx(np.polyfit(range(5), values, 1)[0])
    assert slope(curve(1, math.inf, 2)) == math.inf
    assert math.isnan(slope(curve(1)))


def test_when_an_error_has_settled() -> None:
    assert settled_after(curve(5, 1, 3, 1, 1), 2) == 4
    assert settled_after(curve(1, 1), 2) == 1
    assert settled_after(curve(1, 3), 2) == math.inf
    assert settled_after(curve(1, math.nan, 1), 2) == 3


def test_c1_what_is_left_of_the_error() -> None:
    assert c1_stability.remaining_error(curve(9, 2), curve(9, 3), 10) == 0.3
    assert c1_stability.remaining_error(curve(9, 4), curve(9, 3), 10) == 0.4
    assert math.isnan(c1_stability.remaining_error(curve(9, 4), curve(), 10))


def test_c1_fluctuation_looks_at_ratios_of_the_second_half() -> None:
    assert c1_stability.fluctuation(curve(9, 1, 2, 1)) == pytest.approx(math.log(2))
    assert c1_stability.fluctuation(1000 * curve(9, 1, 2, 1)) == pytest.approx(math.log(2))
    assert c1_stability.fluctuation(curve(1, 1, math.inf)) == math.inf
    assert math.isnan(c1_stability.fluctuation(curve(1)))
    assert c1_stability.fluctuation(curve(1, 0, 0)) == 0


def test_c2_who_ends_between_the_lanes() -> None:
    lanes = np.zeros((2, 1, 2, 4, 2))
    lanes[0, ..., 1], lanes[1, ..., 1] = 4.0, -4.0
    rollouts = np.zeros((1, 1, 2, 4, 2))
    rollouts[0, 0, -1, :, 1] = [0.0, 1.9, 2.1, -9.0]
    rollouts[0, 0, -1, :, 0] = 7.0  # too far along, which is not sideways
    assert c2_modes.between(rollouts, lanes) == 0.5
    rollouts[0, 0, -1, 0, 1] = math.nan
    assert c2_modes.between(rollouts, lanes) == 0.25


def test_c4_an_error_that_grows_ever_more_slowly() -> None:
    steps = np.arange(1.0, 9)
    assert c4_noise.bending(np.sqrt(steps)) < 0 < c4_noise.bending(steps**2)
    assert c4_noise.bending(3 * steps) == pytest.approx(0)
    assert c4_noise.late_slope(curve(9, 9, 1, 3)) == 2
    assert c4_noise.bending(np.full(8, math.inf)) == math.inf


def test_c5_the_level_belongs_to_no_range() -> None:
    assert c5_alpha.common_level([1, 2, 3, math.inf]) == 4
    assert math.isnan(c5_alpha.common_level([math.inf]))
    assert c5_alpha.epochs_to_converge(curve(5, 1), math.nan) == math.inf


def test_c6_growth_and_the_largest_jump() -> None:
    assert c6_curricula.growth(curve(2, 3, 5)) == 2.5
    assert c6_curricula.largest_jump(curve(1, 2, 5)) == 0.75
    assert math.isnan(c6_curricula.largest_jump(curve(1, 1)))
