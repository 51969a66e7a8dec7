"""The four kinds of hypotheses that claims are made of, each with its test, its effect and its power calculation.

A hypothesis stays untested where a sample has no runs or an unknown value; the part then states the reason.
"""

from collections.abc import Callable
from typing import Literal, NamedTuple

import numpy as np

from ssmail.evaluation import hypothesis_tests
from ssmail.evaluation.hypothesis_tests import (
    SEEDS_FOR_EVERY,
    UNKNOWN,
    Estimate,
    seeds_for_rank_test,
    seeds_for_sign_test,
)
from ssmail.paper.claims import Part, Sample

Side = Literal["below", "above"]

LEAST_FOR_SPREAD = 2  # seeds: a single one has no spread


class _Tested(NamedTuple):
    """The results of a test, under the names of Part."""

    effect: Estimate
    effect_is: str
    p_for: float
    p_against: float
    seeds: int | None


def every_seed(statement: str, statistic: str, sample: Sample, side: Side, bar: float) -> Part:
    """Test that every seed of a method is below (above) the bar: one counterexample contradicts it.

    n of n seeds support it once they rule out that only half of all seeds are: p = 2 ** -n, from five seeds on.
    """

    def tested() -> _Tested:
        inside = _inside(sample, side, bar)
        p = (0.5**inside, 1.0) if inside == len(sample.values) else (1.0, 0.0)
        return _Tested(*_median(sample, side, bar), *p, SEEDS_FOR_EVERY)

    test = f"every seed {side} {bar:g}: exact binomial test against half of them; one seed that is not contradicts"
    return _part(statement, statistic, test, (sample,), tested)


def median_seed(statement: str, statistic: str, sample: Sample, side: Side, bar: float) -> Part:
    """Test that the median over all seeds of a method is below (above) the bar, with a sign test."""

    def tested() -> _Tested:
        found = hypothesis_tests.sign_test(sample.values, bar)
        p = (found.less, found.greater) if side == "below" else (found.greater, found.less)
        needed = seeds_for_sign_test(_inside(sample, side, bar) / len(sample.values))
        return _Tested(*_median(sample, side, bar), *p, needed)

    return _part(statement, statistic, f"exact sign test of the median, {side} {bar:g}", (sample,), tested)


def smaller(statement: str, statistic: str, small: Sample, great: Sample) -> Part:
    """Test that runs of `small` have smaller values than those of `great`: rank test, Hodges-Lehmann shift."""

    def tested() -> _Tested:
        needed = seeds_for_rank_test(hypothesis_tests.superiority(small.values, great.values))
        effect = hypothesis_tests.shift(small.values, great.values)
        what = f"shift from {small.label} to {great.label} (Hodges-Lehmann)"
        return _Tested(effect, what, *hypothesis_tests.rank_test(small.values, great.values), needed)

    return _part(statement, statistic, "exact rank test (Wilcoxon, Mann, Whitney)", (small, great), tested)


def less_spread(statement: str, statistic: str, tight: Sample, wide: Sample) -> Part:
    """Test that runs of `tight` spread less than those of `wide`: rank test of distances from each group's own median.

    This is Brown and Forsythe's test on ranks, without the structural zero of each group. Distances within a group
    depend on each other, so its level is only close to ALPHA (tests/paper/claims/test_claim_verdicts.py measures it).
    """

    def tested() -> _Tested:
        near, far = hypothesis_tests.deviations(tight.values), hypothesis_tests.deviations(wide.values)
        needed = seeds_for_rank_test(hypothesis_tests.superiority(near, far))
        what = f"shift of the distance from the median, from {tight.label} to {wide.label} (Hodges-Lehmann)"
        seeds = None if needed is None else needed + 1  # for the distance that is left out
        return _Tested(hypothesis_tests.shift(near, far), what, *hypothesis_tests.rank_test(near, far), seeds)

    test = "exact rank test of the distances from each group's median (Brown and Forsythe, structural zeros left out)"
    return _part(statement, statistic, test, (tight, wide), tested, least=LEAST_FOR_SPREAD)


def _inside(sample: Sample, side: Side, bar: float) -> int:
    """Count the values strictly beyond the bar on that side."""
    values = np.array(sample.values)
    return int((values < bar).sum() if side == "below" else (values > bar).sum())


def _median(sample: Sample, side: Side, bar: float) -> tuple[Estimate, str]:
    count = f"{_inside(sample, side, bar)} of {len(sample.values)} seeds"
    return hypothesis_tests.median(sample.values), f"median ({count} {side} {bar:g})"


def _part(
    statement: str,
    statistic: str,
    test: str,
    samples: tuple[Sample, ...],
    tested: Callable[[], _Tested],
    least: int = 1,
) -> Part:
    """The part with the results of `tested`, which runs only when no sample lacks anything."""
    what = (statement, statistic, test, samples)
    reasons = [text for sample in samples if (text := _lacking(sample, least))]
    if reasons:
        return Part(*what, UNKNOWN, "", 1.0, 1.0, reason="; ".join(reasons))
    return Part(*what, **tested()._asdict())


def _lacking(sample: Sample, least: int) -> str:
    """Why a sample cannot be tested; empty when it can."""
    if not sample.seeds:
        return f"no runs of {sample.label}"
    if sample.unknown:
        several = "s" * (len(sample.unknown) > 1)
        return f"unknown for seed{several} {', '.join(map(str, sample.unknown))} of {sample.label}"
    return f"{len(sample.seeds)} seed of {sample.label} is too few" if len(sample.seeds) < least else ""
