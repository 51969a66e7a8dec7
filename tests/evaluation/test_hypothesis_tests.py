"""Tests and intervals by order: worked out by hand, against scipy, and what may not change them."""

import math
from itertools import combinations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import binomtest, mannwhitneyu

from ssmail.evaluation.hypothesis_tests import (
    ALPHA,
    deviations,
    median,
    rank_sums,
    rank_test,
    shift,
    sign_test,
    superiority,
)

values = st.lists(st.integers(-20, 20).map(float) | st.just(math.inf), min_size=1, max_size=5)


def test_the_sign_test_is_binomial() -> None:
    assert sign_test([1, 2, 3, 4, 5], 5.5) == (1 / 32, 1.0)
    assert sign_test([1, 2, 3, 4, math.inf], 4.5) == (6 / 32, 31 / 32)
    found = sign_test(np.arange(9), 2.5)
    assert found.less == pytest.approx(binomtest(3, 9, alternative="greater").pvalue)
    assert found.greater == pytest.approx(binomtest(6, 9, alternative="greater").pvalue)


def test_a_value_at_the_bar_is_on_neither_side() -> None:
    assert sign_test([1, 1, 1, 1, 1], 1) == (1.0, 1.0)


def test_the_interval_of_a_median() -> None:
    assert median([5, 1, 4, 2, 3]) == (3, 1, 5)  # 1 - 2/32 of all samples hold the median between their ends
    assert median([1, 2, 3, 4]) == (2.5, -math.inf, math.inf)  # 1 - 2/16 would be less than 90 %
    assert median(range(1, 9)) == (4.5, 2, 7)  # (1 + 8) / 256 <= 0.05 < (1 + 8 + 28) / 256
    assert median([1, 2, 3, 4, math.inf]) == (3, 1, math.inf)


def test_the_interval_of_a_median_holds_what_the_sign_test_does_not_reject() -> None:
    found = median(range(1, 12))
    assert sign_test(range(1, 12), found.low - 0.5).greater <= ALPHA < sign_test(range(1, 12), found.low + 0.5).greater
    assert sign_test(range(1, 12), found.high + 0.5).less <= ALPHA < sign_test(range(1, 12), found.high - 0.5).less


@pytest.mark.parametrize(("first", "second"), [(1, 1), (3, 4), (5, 5), (2, 6)])
def test_the_distribution_of_u(first: int, second: int) -> None:
    places = combinations(range(first + second), first)
    counts = np.bincount([sum(chosen) - first * (first - 1) // 2 for chosen in places], minlength=first * second + 1)
    np.testing.assert_allclose(rank_sums(first, second), counts / counts.sum())


def test_the_rank_test_agrees_with_scipy() -> None:
    a, b = [1.0, 5.0, 2.0, 7.0], [3.0, 8.0, 9.0, 6.0, 4.0]
    found = rank_test(a, b)
    assert found.less == pytest.approx(mannwhitneyu(a, b, alternative="less", method="exact").pvalue)
    assert found.greater == pytest.approx(mannwhitneyu(a, b, alternative="greater", method="exact").pvalue)


def test_five_against_five_can_give_one_in_252() -> None:
    assert rank_test(range(5), range(5, 10)).less == pytest.approx(1 / 252)


def test_many_runs_are_tested_by_the_normal_approximation() -> None:
    generator = np.random.default_rng(0)
    a, b = generator.normal(size=12), generator.normal(0.5, size=12)
    exact = mannwhitneyu(a, b, alternative="less", method="exact").pvalue
    assert rank_test(a, b).less == pytest.approx(exact, abs=0.01)
    assert rank_test([*a, math.inf], [*b, math.inf]).less < 0.5


def test_the_shift_of_hodges_and_lehmann() -> None:
    a, b = np.arange(5.0), np.arange(5.0) + 10
    found = shift(a, b)
    differences = np.sort((b[None] - a[:, None]).ravel())
    assert found == (10, differences[4], differences[-5])  # P(U <= 4) = 12/252 <= 0.05 < P(U <= 5) = 19/252
    assert shift([1, 2], [3, 4]) == (2, -math.inf, math.inf)


def test_the_interval_of_a_shift_holds_what_the_rank_test_does_not_reject() -> None:
    generator = np.random.default_rng(1)
    a, b = generator.normal(size=6), generator.normal(size=5)
    _, low, high = shift(a, b)
    step = 1e-6
    assert rank_test(a, b - low + step).less <= ALPHA < rank_test(a, b - low - step).less
    assert rank_test(a, b - high - step).greater <= ALPHA < rank_test(a, b - high + step).greater


def test_diverged_runs_have_a_place_in_a_shift() -> None:
    found = shift([1, 2, 3, 4, 5], [11, 12, 13, math.inf, math.inf])
    assert found.value == 11
    assert (found.low > 0, found.high) == (True, math.inf)
    assert shift([math.inf] * 3, [math.inf] * 3).value == 0


def test_the_distances_from_the_median() -> None:
    assert deviations([5, 1, 2, 9, 4]).tolist() == [1, 2, 3, 5]  # 4 itself is left out
    assert deviations([1, 2, 4, 9]).tolist() == [1, 2, 6]  # of 1, 1, 2, 6 about 3
    assert deviations([1, 2, 4, math.inf, 3]).tolist() == [1, 1, 2, math.inf]
    assert deviations([1, 2, math.inf, math.inf]).tolist() == [math.inf] * 3
    assert deviations([7]).tolist() == []


@given(values, values, st.randoms(use_true_random=False))
def test_the_order_of_seeds_changes_nothing(first: list[float], second: list[float], random: object) -> None:
    mixed, other = list(first), list(second)
    random.shuffle(mixed)  # type: ignore[attr-defined]
    random.shuffle(other)  # type: ignore[attr-defined]
    assert rank_test(mixed, other) == rank_test(first, second)
    assert shift(mixed, other) == shift(first, second)
    assert median(mixed) == median(first)
    np.testing.assert_array_equal(deviations(mixed), deviations(first))


@given(values, values)
def test_swapping_the_groups_swaps_the_directions(first: list[float], second: list[float]) -> None:
    there, back = rank_test(first, second), rank_test(second, first)
    assert there == pytest.approx((back.greater, back.less))
    assert superiority(first, second) == pytest.approx(1 - superiority(second, first))
    value, low, high = shift(second, first)
    assert shift(first, second) == pytest.approx((-value, -high, -low))
    assert there.less + there.greater > 1


@given(values, values)
def test_a_rising_transformation_changes_no_test(first: list[float], second: list[float]) -> None:
    def risen(numbers: list[float]) -> list[float]:
        return [number**3 + number for number in numbers]

    assert rank_test(risen(first), risen(second)) == pytest.approx(rank_test(first, second))
