"""Centres, spreads and exact tests: by hand, by brute force, by scipy, and by what must not change them."""

import math
from collections.abc import Sequence
from itertools import permutations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from ssmail.evaluation.hypothesis_tests import MAX_SPLITS, PermutationTest, midranks, permutation_test
from ssmail.evaluation.statistics import Statistic, mean_interval, mean_std, median_quartiles, summarise

inf, nan = math.inf, math.nan
FIVE = [2.0, 4.0, 4.0, 5.0, 10.0]
ALTERNATIVES = ("two-sided", "less", "greater")
whole = st.integers(-20, 20).map(float)  # sums of whole numbers have no rounding errors
groups = st.lists(whole, min_size=1, max_size=4)


# -- centre and spread -------------------------------------------------------------------------------------------------


def test_mean_and_std_by_hand() -> None:
    assert mean_std(FIVE) == (5.0, 2.0, 8.0)  # deviations 9 + 1 + 1 + 0 + 25 = 36 = 4 * 9
    assert mean_std(FIVE).high != pytest.approx(5 + np.std(FIVE))  # not the divisor n


def test_median_and_quartiles_by_hand() -> None:
    assert median_quartiles(FIVE) == (4.0, 4.0, 5.0)
    assert median_quartiles([1.0, 2.0, 3.0, 10.0]) == (2.5, 1.75, 4.75)


def test_the_interval_of_the_mean_by_hand() -> None:
    centre, low, high = mean_interval([1.0, 3.0])  # std sqrt(2), over sqrt(2) runs: 1; t of one degree: tan
    t = math.tan(math.pi * 0.475)
    np.testing.assert_allclose([centre, low, high], [2, 2 - t, 2 + t])
    half = 2.7764451052 * 3 / math.sqrt(5)  # t(0.975, 4) from a printed table
    np.testing.assert_allclose(mean_interval(FIVE), [5, 5 - half, 5 + half], rtol=1e-9)
    assert mean_interval(FIVE).high - 5 > 1.2 * 1.96 * 3 / math.sqrt(5)  # the normal's quantile would be too sure


@pytest.mark.parametrize("confidence", [0.5, 0.9, 0.95, 0.999])
def test_the_interval_is_scipys(confidence: float) -> None:
    expected = stats.t.interval(confidence, len(FIVE) - 1, loc=np.mean(FIVE), scale=stats.sem(FIVE))
    np.testing.assert_allclose(mean_interval(FIVE, confidence)[1:], expected)


def test_the_interval_covers_the_mean_as_often_as_it_says() -> None:
    draws = np.random.default_rng(0).normal(3.0, 2.0, size=(5, 20_000))
    for summary, coverage in ((mean_interval(draws), 0.95), (mean_interval(draws, 0.6), 0.6)):
        assert np.mean((summary.low <= 3) & (summary.high >= 3)) == pytest.approx(coverage, abs=0.01)
    naive = mean_std(draws)
    assert np.mean((naive.low <= 3) & (naive.high >= 3)) < 0.93  # a standard deviation is no such interval


def test_one_run_has_a_centre_and_no_spread() -> None:
    assert mean_std([3.0]).centre == 3
    assert np.isnan(mean_std([3.0])[1:]).all()
    assert mean_interval([3.0]) == (3, -inf, inf)
    assert median_quartiles([3.0]) == (3, 3, 3)


def test_a_diverged_run_is_the_worst_and_an_unknown_one_unknown() -> None:
    table = np.array([[1, 1, 1, 1], [2, 2, inf, inf], [3, inf, inf, nan], [4, 4, 4, 4], [5, 5, 5, 5]], dtype=float)
    np.testing.assert_array_equal(mean_std(table).centre, [3, nan, nan, nan])
    np.testing.assert_array_equal(mean_interval(table).high[1:], [nan, nan, nan])
    centre, low, high = median_quartiles(table)
    np.testing.assert_array_equal(centre, [3, 4, 5, nan])
    np.testing.assert_array_equal(low, [2, 2, 4, nan])
    np.testing.assert_array_equal(high, [4, 5, inf, nan])
    np.testing.assert_array_equal(median_quartiles([1.0, 2.0, inf, inf]), [inf, 1.75, inf])
    survivors = np.median(table[np.isfinite(table[:, 1]), 1])
    assert centre[1] != survivors  # the negative control: dropping the diverged run would flatter the group


def test_summarise_chooses_and_names() -> None:
    table = np.random.default_rng(0).normal(size=(5, 7))
    expected = {"mean-std": mean_std(table), "median-iqr": median_quartiles(table), "mean-ci": mean_interval(table)}
    assert list(expected) == list(Statistic)
    for statistic in Statistic:
        np.testing.assert_array_equal(summarise(table, statistic), expected[statistic])
    assert [item.words for item in Statistic] == ["mean ± std", "median and quartiles", "mean and 95% interval"]
    assert [item.centre for item in Statistic] == ["mean", "median", "mean"]


@given(st.lists(whole, min_size=2, max_size=8), whole, st.sampled_from([0.25, 2.0, 8.0]), st.sampled_from(Statistic))
@settings(max_examples=40)
def test_summaries_follow_shift_and_scale_and_ignore_the_order(
    values: list[float], shift: float, scale: float, statistic: Statistic
) -> None:
    plain = np.array(summarise(values, statistic))
    moved = summarise([scale * value + shift for value in reversed(values)], statistic)
    np.testing.assert_allclose(moved, scale * plain + shift, atol=1e-9)
    assert plain[1] <= plain[0] <= plain[2] or statistic is Statistic.MEDIAN_IQR
    np.testing.assert_allclose(median_quartiles(values), np.quantile(values, [0.5, 0.25, 0.75]), atol=1e-12)


@pytest.mark.parametrize("confidence", [0.0, 1.0, -0.5, 95.0])
def test_a_confidence_is_a_probability(confidence: float) -> None:
    with pytest.raises(ValueError, match="between 0 and 1"):
        mean_interval(FIVE, confidence)


@pytest.mark.parametrize("statistic", Statistic)
def test_no_runs_are_refused(statistic: Statistic) -> None:
    with pytest.raises(ValueError, match="at least one"):
        summarise(np.empty((0, 3)), statistic)


# -- two groups --------------------------------------------------------------------------------------------------------


def brute_force(first: Sequence[float], second: Sequence[float], alternative: str) -> float:
    """p over every order of the pooled ranks, by plain sums: (n1 + n2)! instead of C(n1 + n2, n1) cases."""

    def extremity(values: Sequence[float]) -> float:
        a, b = values[: len(first)], values[len(first) :]
        difference = sum(a) / len(a) - sum(b) / len(b)
        return {"two-sided": abs(difference), "greater": difference, "less": -difference}[alternative]

    ranks = midranks([*first, *second]).tolist()
    cases = [extremity(order) >= extremity(ranks) - 1e-9 for order in permutations(ranks)]
    return sum(cases) / len(cases)


def test_separated_groups_have_the_least_p() -> None:
    low, high = [1.0, 2.0, 3.0, 4.0, 5.0], [6.0, 7.0, 8.0, 9.0, 10.0]
    assert permutation_test(low, high) == PermutationTest(2 / 252, 2 / 252)
    assert permutation_test(low, high, "less") == PermutationTest(1 / 252, 1 / 252)
    assert permutation_test(low, high, "greater") == PermutationTest(1.0, 1 / 252)
    assert permutation_test(low[:3], high[:3]).least == 2 / 20


def test_ties_count_against_the_observed_split() -> None:
    # {0, 1} against {1, 1}: the 0 is in the first group in 3 of 6 splits, and |d| is 1/2 in all
    found = permutation_test([0.0, 1.0], [1.0, 1.0], "less")
    assert (found.p, found.least) == (0.5, 0.5)
    assert permutation_test([0.0, 1.0], [1.0, 1.0]).p == 1
    assert permutation_test([2.0] * 3, [2.0] * 3) == PermutationTest(1.0, 1.0)


@given(groups, groups, st.sampled_from(ALTERNATIVES))
@settings(max_examples=25)
def test_the_test_is_the_brute_force_one(first: list[float], second: list[float], alternative: str) -> None:
    if len(first) + len(second) > 6:
        first, second = first[:3], second[:3]
    assert permutation_test(first, second, alternative).p == pytest.approx(brute_force(first, second, alternative))


@pytest.mark.parametrize("alternative", ALTERNATIVES)
@pytest.mark.parametrize("seed", range(3))
def test_the_test_is_scipys_exact_one(alternative: str, seed: int) -> None:
    generator = np.random.default_rng(seed)
    ranks = midranks(generator.normal(0.0, 1.0, 10) + 0.7 * (np.arange(10) >= 5))
    expected = stats.permutation_test(
        (ranks[:5], ranks[5:]),
        lambda x, y, axis: x.mean(axis=axis) - y.mean(axis=axis),
        vectorized=True,
        alternative=alternative,
    )
    assert permutation_test(ranks[:5], ranks[5:], alternative).p == pytest.approx(expected.pvalue)


@pytest.mark.parametrize("alternative", ALTERNATIVES)
def test_it_is_the_exact_test_of_mann_and_whitney(alternative: str) -> None:
    a, b = [0.1, 3.0, 4.0, 9.0], [5.0, 6.0, 7.0, 1e6, 2.0]
    expected = stats.mannwhitneyu(a, b, alternative=alternative, method="exact").pvalue
    assert permutation_test(a, b, alternative).p == pytest.approx(expected)


def test_diverged_runs_have_the_worst_rank() -> None:
    healthy, broken = [1.0, 2.0, 3.0, 4.0, 5.0], [6.0, 7.0, 8.0, inf, inf]
    assert permutation_test(healthy, broken).p == 2 / 252
    finite = [6.0, 7.0, 8.0, 1e9, 1e9]
    assert permutation_test(healthy, broken) == permutation_test(healthy, finite)
    with pytest.raises(ValueError, match="one known number per run"):
        permutation_test(healthy, [1.0, nan])


@given(groups, groups, whole, st.sampled_from([0.5, 2.0, 16.0]))
@settings(max_examples=50)
def test_neither_shift_nor_scale_nor_order_nor_names_matter(
    first: list[float], second: list[float], shift: float, scale: float
) -> None:
    found = permutation_test(first, second)
    moved = permutation_test([scale * x + shift for x in reversed(first)], [scale * x + shift for x in second])
    assert (moved.p, moved.least) == (found.p, found.least)
    assert permutation_test(second, first).p == pytest.approx(found.p)
    less, greater = permutation_test(first, second, "less"), permutation_test(second, first, "greater")
    assert less.p == pytest.approx(greater.p)
    assert 0 < found.least <= found.p <= 1
    assert less.p + permutation_test(first, second, "greater").p >= 1  # both count the ties


def test_under_the_null_small_p_are_as_rare_as_they_say() -> None:
    draws = np.random.default_rng(1).normal(size=(400, 2, 4))
    p = np.array([permutation_test(a, b).p for a, b in draws])
    for level in (2 / 70, 0.1, 0.5):
        assert np.mean(p <= level + 1e-9) <= level + 3 * math.sqrt(level * (1 - level) / len(p))
    shifted = np.array([permutation_test(a, b + 3).p for a, b in draws[:100]])
    assert np.mean(shifted <= 0.1) > 0.8  # the control: it does find a difference


def test_too_many_runs_are_refused_and_ten_are_not() -> None:
    assert permutation_test(np.arange(10), np.arange(10) + 10.5).p == 2 / math.comb(20, 10)
    assert math.comb(22, 11) > MAX_SPLITS
    with pytest.raises(ValueError, match="705432 splits are too many"):
        permutation_test(np.arange(11), np.arange(11))


def test_midranks_share_ties() -> None:
    np.testing.assert_array_equal(midranks([5.0, 1.0, inf, 5.0, -inf, inf]), [3.5, 2, 5.5, 3.5, 1, 5.5])
    np.testing.assert_array_equal(midranks(FIVE), stats.rankdata(FIVE))
