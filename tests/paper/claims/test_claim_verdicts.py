"""How parts make a verdict, what the statements say of samples, and Holm's correction."""

import math

import numpy as np
import pytest

from ssmail.evaluation.hypothesis_tests import ALPHA, UNKNOWN, deviations, rank_test
from ssmail.paper.claims import Decision, Part, Sample, Verdict, holm
from ssmail.paper.hypotheses import above_zero, beside, less_spread, smaller


def sample(*values: float, label: str = "ssail") -> Sample:
    return Sample(label, tuple(range(len(values))), values, tuple(f"run{i}" for i in range(len(values))))


def part(p_for: float, p_against: float, seeds: int | None = 8) -> Part:
    return Part("", "", "", (sample(1, 2, 3),), UNKNOWN, "", p_for, p_against, seeds=seeds)


SUPPORTED, CONTRADICTED, OPEN = part(0.01, 1), part(1, 0.02), part(0.2, 0.9)


@pytest.mark.parametrize(
    ("parts", "verdict"),
    [
        ([SUPPORTED, SUPPORTED], Verdict.SUPPORTED),
        ([SUPPORTED, OPEN], Verdict.INCONCLUSIVE),
        ([SUPPORTED, CONTRADICTED], Verdict.CONTRADICTED),
        ([OPEN, CONTRADICTED], Verdict.CONTRADICTED),
        ([OPEN], Verdict.INCONCLUSIVE),
        ([SUPPORTED, OPEN, CONTRADICTED], Verdict.INCONCLUSIVE),  # 3 * 0.02
    ],
)
def test_all_parts_support_and_any_contradicts_at_alpha_over_their_number(parts: list[Part], verdict: Verdict) -> None:
    assert Decision(tuple(parts)).verdict is verdict


def test_the_p_of_a_claim() -> None:
    both = Decision((part(0.01, 0.99), part(0.04, 0.97)))
    assert (both.p_for, both.p_against, both.p) == (0.04, 1.0, 0.04)  # 2 * 0.97 is no probability
    assert Decision((SUPPORTED, CONTRADICTED)).p == pytest.approx(0.04)  # 2 * 0.02
    assert both.corrected(0.05) is Verdict.SUPPORTED
    assert both.corrected(0.06) is Verdict.INCONCLUSIVE
    assert Decision((SUPPORTED, CONTRADICTED)).corrected(0.04) is Verdict.CONTRADICTED


def test_the_neediest_part_says_how_many_more_seeds() -> None:
    assert Decision((part(0.2, 0.9, seeds=8), part(0.3, 0.8, seeds=20))).more_seeds == 17
    assert Decision((part(0.2, 0.9, seeds=8), part(0.3, 0.8, seeds=None))).more_seeds is None
    assert Decision((part(0.2, 0.9, seeds=2),)).more_seeds == 1  # not settled, so one more at least
    assert Decision((SUPPORTED, SUPPORTED)).more_seeds == 0
    assert Decision((SUPPORTED, SUPPORTED, CONTRADICTED)).more_seeds == 1  # not settled either


def test_holm_by_hand() -> None:
    assert holm([0.01, 0.04, 0.03, 0.005]) == pytest.approx((0.03, 0.06, 0.06, 0.02))
    assert holm([0.9, 0.8]) == (1.0, 1.0)


def test_the_typical_seed_is_above_zero() -> None:
    assert above_zero("", "", sample(1, 2, 3, 4, 5)).verdict is Verdict.SUPPORTED
    assert above_zero("", "", sample(-1, -2, -3, -4, -math.inf)).verdict is Verdict.CONTRADICTED
    four = above_zero("", "", sample(1, 2, 3, 4, -math.inf))
    assert (four.verdict, four.effect_is) == (Verdict.INCONCLUSIVE, "median (4 of 5 seeds above 0)")
    assert four.more_seeds == 13  # 18 in all: P(X >= 13 | 18, 0.8) = 0.87, and P(X >= 13 | 18, 1/2) = 0.048
    assert above_zero("", "", sample(0, 1, 2, 3, 4)).p_for == 6 / 32  # at zero is not above it


def test_what_stands_beside_has_no_part_in_the_verdict() -> None:
    (aside,) = beside(CONTRADICTED)
    found = Decision.of([SUPPORTED, aside])
    assert (found.parts, found.beside, found.every_part) == ((SUPPORTED,), (aside,), (SUPPORTED, aside))
    assert (found.verdict, found.p, found.more_seeds) == (Verdict.SUPPORTED, 0.01, 0)
    assert Decision.of([SUPPORTED, CONTRADICTED]).verdict is Verdict.CONTRADICTED  # the control
    assert beside(smaller("", "", sample(1), Sample("wail"))) == ()


def test_one_group_has_smaller_values() -> None:
    low, high = sample(1, 2, 3, 4, 5), sample(11, 12, 13, 14, math.inf, label="gail")
    found = smaller("", "", low, high)
    assert (found.verdict, found.effect.value) == (Verdict.SUPPORTED, 10.0)
    assert found.effect_is == "shift from ssail to gail; 25 of 25 pairs in order"
    assert smaller("", "", high, low).verdict is Verdict.CONTRADICTED
    mixed = smaller("", "", sample(1, 3, 5), sample(2, 4, 6))
    assert (mixed.verdict, mixed.seeds) == (Verdict.INCONCLUSIVE, 38)  # 6 of 9 pairs: 1.0304 / (1/6)^2 = 37.1


def test_one_group_spreads_less() -> None:
    tight, wide = sample(10, 10.1, 10.2, 10.3, 10.4), sample(1, 3, 6, 8, 11)
    assert less_spread("", "", tight, wide).verdict is Verdict.SUPPORTED  # whichever is greater
    assert less_spread("", "", wide, tight).verdict is Verdict.CONTRADICTED
    alike = less_spread("", "", tight, sample(1, 1.1, 1.2, 1.3, 1.4))
    assert (alike.verdict, alike.seeds) == (Verdict.INCONCLUSIVE, None)
    assert "too few" in less_spread("", "", sample(1), wide).reason


@pytest.mark.parametrize("draw", ["normal", "lognormal", "uniform"])
def test_how_often_the_test_of_spread_errs_without_any_difference(draw: str) -> None:
    generator = np.random.default_rng(0)
    groups = getattr(generator, draw)(size=(800, 2, 5))
    wrong = [rank_test(deviations(a), deviations(b)).less <= ALPHA for a, b in groups]
    assert np.mean(wrong) < 0.09


def test_what_is_missing_is_told() -> None:
    nothing = smaller("", "", Sample("ssail"), Sample("gail"))
    assert nothing.reason == "no runs of ssail; no runs of gail"
    assert (nothing.verdict, nothing.more_seeds) == (Verdict.INCONCLUSIVE, None)
    assert above_zero("", "", sample(1, math.nan, math.nan)).reason == "unknown for seeds 1, 2 of ssail"
