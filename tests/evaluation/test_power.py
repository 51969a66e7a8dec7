"""How many seeds a test needs: closed forms, and simulations of the tests themselves."""

import numpy as np
import pytest
from scipy.special import ndtr
from scipy.stats import binom, mannwhitneyu

from ssmail.evaluation.hypothesis_tests import (
    ALPHA,
    POWER,
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
