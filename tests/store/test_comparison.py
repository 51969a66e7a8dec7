"""The statistics of `ssmail runs compare`, against values worked out by hand."""

import math

import pytest

from ssmail.store import RunState
from ssmail.store.comparison import Comparison


def comparison(*values: float | None) -> Comparison:
    by_seed = dict(enumerate(values))
    states = {seed: RunState.FAILED if value is None else RunState.FINISHED for seed, value in by_seed.items()}
    return Comparison("ssail", "yjunction", "quick", "0" * 16, {}, "test/mode_mse", by_seed, states)


def test_mean_std_and_median() -> None:
    found = comparison(1.0, 2.0, 6.0)
    assert (found.mean, found.median) == (3.0, 2.0)
    assert found.std == pytest.approx(math.sqrt((4 + 1 + 9) / 2))  # divisor n - 1; with n it would be sqrt(14 / 3)
    assert found.std != pytest.approx(math.sqrt(14 / 3))


def test_a_missing_value_is_left_out_of_the_numbers_and_kept_in_sight() -> None:
    found = comparison(1.0, None, 3.0)
    assert (found.mean, found.median, found.known) == (2.0, 2.0, [1.0, 3.0])
    assert found.values[1] is None
    assert found.states[1] is RunState.FAILED


@pytest.mark.parametrize("values", [(), (None,)])
def test_nothing_to_compute_from(values: tuple[None, ...]) -> None:
    found = comparison(*values)
    assert (found.mean, found.std, found.median) == (None, None, None)


def test_one_value_has_no_spread() -> None:
    assert (comparison(2.0).mean, comparison(2.0).std) == (2.0, None)


def test_values_that_are_not_finite_are_not_hidden() -> None:
    infinite, unknown = comparison(1.0, math.inf), comparison(1.0, 2.0, math.nan)
    assert infinite.mean == math.inf
    assert math.isnan(infinite.std or 0.0)
    assert all(math.isnan(value or 0.0) for value in (unknown.mean, unknown.std, unknown.median))
    both = comparison(math.inf, -math.inf)
    assert math.isnan(both.mean or 0.0)
