"""How many seeds a test needs: closed forms, and simulations of the tests themselves."""

import numpy as np
import pytest
from scipy.special import ndtr, ndtri
from scipy.stats import binom, mannwhitneyu

from ssmail.evaluation.hypothesis_tests import (
    ALPHA,
    POWER,
    rank_sums,
    rank_test,
    seeds_for_rank_test,
    seeds_for_sign_test,
    sign_test,
)


def test_five_of_five_are_the_fewest() -> None:
    assert seeds_for_sign_test(1.0) == seeds_for_sign_test(0.0) == 5


def test_without_an_effect_no_number_is_enough() -> None:
    assert seeds_for_sign_test(0.5) is None
    assert seeds_for_rank_test(0.5) is None
    assert seeds_for_rank_test(0.51) is None  # 10,305 in each group


@pytest.mark.parametrize("share", [0.8, 0.65, 0.2])
def test_the_sign_test_has_its_power_at_that_number_and_not_below(share: float) -> None:
    def power(n: int) -> float:
        critical = next(k for k in range(n + 2) if binom.sf(k - 1, n, 0.5) <= ALPHA)
        return float(binom.sf(critical - 1, n, max(share, 1 - share)))

    needed = seeds_for_sign_test(share)
    assert needed is not None
    assert power(needed) >= POWER
    assert max(power(n) for n in range(1, needed)) < POWER


def test_the_normal_approximation_of_the_rank_test() -> None:
    # (1.6449 + 0.8416)^2 / 6 = 1.0304, over 0.25^2 and 0.4^2
    assert seeds_for_rank_test(0.75) == 17
    assert seeds_for_rank_test(0.1) == 7


def test_the_rank_test_decides_about_as_often_as_it_is_said_to() -> None:
    superiority = float(ndtr(0.75 / np.sqrt(2)))  # of two normal groups 0.75 standard deviations apart
    needed = seeds_for_rank_test(superiority)
    assert needed == 26
    generator = np.random.default_rng(0)
    a, b = generator.normal(size=(2000, needed)), generator.normal(0.75, size=(2000, needed))
    p = mannwhitneyu(a, b, alternative="less", axis=1, method="asymptotic").pvalue
    assert np.mean(p <= ALPHA) == pytest.approx(POWER, abs=0.05)


def test_the_sign_test_errs_no_more_often_than_it_may() -> None:
    generator = np.random.default_rng(0)
    wrong = [sign_test(generator.normal(size=7), 0).less <= ALPHA for _ in range(2000)]
    assert np.mean(wrong) <= ALPHA + 0.01
    assert rank_test([0], [1]).less == 0.5  # one against one decides nothing


@pytest.mark.parametrize(
    ("n", "least", "ordered", "after_holm", "on_one_side"),
    [(5, 252, 0.90, 0.99, 0.96), (6, 924, 0.88, 0.96, 0.96), (10, 184756, 0.81, 0.89, 0.92)],
)
def test_the_power_that_docs_claims_states(
    n: int, least: int, ordered: float, after_holm: float, on_one_side: float
) -> None:
    """Of normal groups with one spread, of which this share of pairs is in order."""
    generator = np.random.default_rng(0)
    assert rank_test(range(n), range(n, 2 * n)).less == pytest.approx(1 / least)
    chances = rank_sums(n, n).cumsum()  # of as many pairs out of order, or fewer

    def decided(superiority: float, level: float) -> float:
        low, high = generator.normal(size=(2, 4000, n)) + np.sqrt(2) * ndtri([[[0.5]], [[superiority]]])
        return float(np.mean(chances[(high[:, None] < low[:, :, None]).sum(axis=(1, 2))] <= level))

    for superiority, level in ((ordered, ALPHA), (after_holm, ALPHA / 8)):
        assert decided(superiority, level) == pytest.approx(POWER, abs=0.06)
        assert decided(superiority - 0.1, level) < 0.7  # negative control
    needed = next(k for k in range(n + 1) if binom.sf(k - 1, n, 0.5) <= ALPHA)
    assert binom.sf(needed - 1, n, on_one_side) == pytest.approx(POWER, abs=0.03)
