"""The three kinds of hypotheses that claims are made of, each with its test, its effect and its power calculation.

Two of them compare two groups. The third compares one group with zero, where zero is what no effect would give. A
hypothesis stays untested where a sample has no runs or an unknown value; the part then states the reason.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from ssmail.evaluation import hypothesis_tests
from ssmail.evaluation.hypothesis_tests import (
    UNKNOWN,
    Estimate,
    seeds_for_rank_test,
    seeds_for_sign_test,
)
from ssmail.paper.claims import Part, Sample

LEAST_FOR_SPREAD = 2  # seeds: a single one has no spread


class _Tested(NamedTuple):
    """The results of a test, under the names of Part."""

    effect: Estimate
    effect_is: str
    p_for: float
    p_against: float
    seeds: int | None


def above_zero(statement: str, statistic: str, sample: Sample) -> Part:
    """Test that the median over all seeds is above zero, with a sign test."""

    def tested() -> _Tested:
        above = int((np.array(sample.values) > 0).sum())
        less, greater = hypothesis_tests.sign_test(sample.values, 0.0)
        what = f"median ({above} of {len(sample.values)} seeds above 0)"
        needed = seeds_for_sign_test(above / len(sample.values))
        return _Tested(hypothesis_tests.median(sample.values), what, greater, less, needed)

    return _part(statement, statistic, "exact sign test of the median, above 0", (sample,), tested)


def smaller(statement: str, statistic: str, small: Sample, great: Sample) -> Part:
    """Test that runs of `small` have smaller values than those of `great`: rank test, shift of Hodges and Lehmann."""

    def tested() -> _Tested:
        needed = seeds_for_rank_test(hypothesis_tests.superiority(small.values, great.values))
        effect = hypothesis_tests.shift(small.values, great.values)
        what = f"shift from {small.label} to {great.label}; {_ordered(small.values, great.values)}"
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
        what = f"shift of the distance from the median, from {tight.label} to {wide.label}; {_ordered(near, far)}"
        seeds = None if needed is None else needed + 1  # for the distance that is left out
        return _Tested(hypothesis_tests.shift(near, far), what, *hypothesis_tests.rank_test(near, far), seeds)

    test = "exact rank test of the distances from each group's median (Brown and Forsythe, structural zeros left out)"
    return _part(statement, statistic, test, (tight, wide), tested, least=LEAST_FOR_SPREAD)


def beside(*parts: Part) -> tuple[Part, ...]:
    """Mark parts that stand beside a claim, as evidence that decides nothing. Those without runs are left out."""
    return tuple(replace(part, beside=True) for part in parts if part.fewest)


def _ordered(small: npt.ArrayLike, great: npt.ArrayLike) -> str:
    """Say in how many pairs the hypothesis holds; it is all of them where the worst run beats the other's best."""
    pairs = np.size(small) * np.size(great)
    return f"{hypothesis_tests.superiority(small, great) * pairs:g} of {pairs} pairs in order"


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
        lacks = f", without a stored {' or '.join(sample.not_stored)}" if sample.not_stored else ""
        return f"unknown for seed{several} {', '.join(map(str, sample.unknown))} of {sample.label}{lacks}"
    return f"{len(sample.seeds)} seed of {sample.label} is too few" if len(sample.seeds) < least else ""
