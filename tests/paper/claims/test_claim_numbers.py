"""The number that each claim takes of a run, worked out by hand."""

import math

import numpy as np
import pytest

from ssmail.paper.fig3_curricula import growth, largest_jump
from ssmail.paper.fig4_stability import fluctuation, remaining_error
from ssmail.paper.fig5_modes import share_between
from ssmail.paper.fig7_noise import bending, late_slope, slope
from ssmail.paper.fig8_alpha import common_level, epochs_to_converge
from ssmail.paper.samples import beginning_mean, end_mean


def curve(*values: float) -> np.ndarray:
    return np.array(values, dtype=np.float64)


def test_the_ends_of_a_curve_are_fifths() -> None:
    rising = np.arange(1.0, 12)
    assert (beginning_mean(rising), end_mean(rising)) == (1.5, 10.5)
    assert (beginning_mean(curve(3, 4)), end_mean(curve(3, 4))) == (3, 4)
    assert math.isnan(end_mean(curve(1, math.inf)))
    assert math.isnan(end_mean(curve()))


def test_a_slope_is_that_of_the_least_squares_line() -> None:
    values = curve(1, 4, 2, 8, 5)
    assert slope(values) == pytest.approx(np.polyfit(range(5), values, 1)[0])
    assert math.isnan(slope(curve(1, math.inf, 2)))
    assert math.isnan(slope(curve(1)))


def test_when_an_error_has_settled() -> None:
    assert epochs_to_converge(curve(5, 1, 3, 1, 1), 2) == 4
    assert epochs_to_converge(curve(1, 1), 2) == 1
    assert epochs_to_converge(curve(1, 3), 2) == math.inf
    assert epochs_to_converge(curve(1, math.nan, 1), 2) == 3


def test_c1_what_is_left_of_the_error() -> None:
    assert remaining_error(curve(9, 2), curve(9, 3), curve(10)) == 0.3
    assert remaining_error(curve(9, 4), curve(9, 3), curve(10)) == 0.4
    assert math.isnan(remaining_error(curve(9, 4), curve(), curve(10)))


def test_c1_fluctuation_looks_at_ratios_of_the_second_half() -> None:
    assert fluctuation(curve(9, 1, 2, 1)) == pytest.approx(math.log(2))
    assert fluctuation(1000 * curve(9, 1, 2, 1)) == pytest.approx(math.log(2))
    assert math.isnan(fluctuation(curve(1, 1, math.inf)))
    assert math.isnan(fluctuation(curve(1)))
    assert fluctuation(curve(1, 0, 0)) == 0


def test_c2_who_ends_between_the_lanes() -> None:
    lanes = np.zeros((2, 1, 2, 4, 2))
    lanes[0, ..., 1], lanes[1, ..., 1] = 4.0, -4.0
    rollouts = np.zeros((1, 1, 2, 4, 2))
    rollouts[0, 0, -1, :, 1] = [0.0, 1.9, 2.1, -9.0]
    rollouts[0, 0, -1, :, 0] = 7.0  # too far along, which is not sideways
    assert share_between(rollouts, lanes) == 0.5
    rollouts[0, 0, -1, 0, 1] = math.nan
    assert share_between(rollouts, lanes) == 0.25


def test_c4_an_error_that_grows_ever_more_slowly() -> None:
    steps = np.arange(1.0, 9)
    assert bending(np.sqrt(steps)) < 0 < bending(steps**2)
    assert bending(3 * steps) == pytest.approx(0)
    assert bending(curve(0, 3, 0, 1)) == pytest.approx(-0.5)  # (1 - 3) / (1 + 3)
    assert bending(1000 * curve(0, 3, 0, 1)) == pytest.approx(-0.5)  # has no unit
    assert bending(curve(0, 3, 1, 0)) == pytest.approx(-1)
    assert bending(np.ones(8)) == 0
    assert late_slope(curve(9, 9, 1, 3)) == pytest.approx(2)
    assert math.isnan(bending(np.full(8, math.inf)))


def test_c5_the_level_belongs_to_no_range() -> None:
    assert common_level([1, 2, 3, math.inf]) == 4
    assert math.isnan(common_level([math.inf]))
    assert epochs_to_converge(curve(5, 1), math.nan) == math.inf


def test_c6_growth_and_the_largest_jump() -> None:
    assert growth(curve(2, 3, 5)) == 2.5
    assert largest_jump(curve(1, 2, 5)) == 0.75
    assert math.isnan(largest_jump(curve(1, 1)))
