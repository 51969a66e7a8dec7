"""Intervals and tests that need nothing but the order of a few runs' values, where a diverged run (+-inf) has a place.

All tests are one-sided and exact; every interval is two-sided with CONFIDENCE = 1 - 2 * ALPHA, so each of its ends is
the bound that a one-sided test at ALPHA does not reject. What the order of n values cannot say is infinite: the
interval of the median of four values reaches from -inf to inf.
"""

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.special import bdtr  # the binomial distribution without scipy.stats, which takes a second to import

from ssmail.evaluation.statistics import LARGEST, midranks, permutation_test

Floats = npt.NDArray[np.float64]

ALPHA = 0.05
CONFIDENCE = 1 - 2 * ALPHA


class Estimate(NamedTuple):
    """A number and the ends of its interval; NaN throughout when there is nothing to say."""

    value: float
    low: float
    high: float


UNKNOWN = Estimate(math.nan, math.nan, math.nan)


class OneSided(NamedTuple):
    """p of the same data in both directions. Each is valid at its own level; together they are at least 1."""

    less: float
    greater: float


def sign_test(values: npt.ArrayLike, bar: float) -> OneSided:
    """Whether the median of all seeds' values (R,) is less or greater than `bar`: P(X >= count) for X ~ Bin(R, 1/2).

    A value equal to the bar counts for neither side and stays in R, which is conservative.
    """
    table = np.asarray(values, dtype=np.float64)
    below, above = int((table < bar).sum()), int((table > bar).sum())
    return OneSided(_at_least(below, len(table)), _at_least(above, len(table)))


def median(values: npt.ArrayLike) -> Estimate:
    """Median of (R,) values and the interval between two order statistics that the sign test does not reject."""
    table = np.sort(np.asarray(values, dtype=np.float64))
    count = len(table)
    place = int((bdtr(np.arange(count), count, 0.5) <= ALPHA).sum())
    return _between(table, place)


def rank_test(first: npt.ArrayLike, second: npt.ArrayLike) -> OneSided:
    """Whether `first` (R1,) is less or greater than `second` (R2,): the rank test of Wilcoxon, Mann and Whitney.

    Exact, by all splits with midranks for ties, as far as they can be enumerated; by its normal approximation with
    correction for ties and continuity beyond (more than 10 against 10 runs).
    """
    a, b = np.asarray(first, dtype=np.float64), np.asarray(second, dtype=np.float64)
    if math.comb(len(a) + len(b), len(a)) <= LARGEST:
        less, greater = (permutation_test(a, b, side, on="ranks").p for side in ("less", "greater"))
        return OneSided(less, greater)
    from scipy.stats import mannwhitneyu

    ranks = midranks(np.concatenate([a, b]))
    x, y = ranks[: len(a)], ranks[len(a) :]
    less, greater = (
        float(mannwhitneyu(x, y, alternative=side, method="asymptotic").pvalue) for side in ("less", "greater")
    )
    return OneSided(less, greater)


def shift(first: npt.ArrayLike, second: npt.ArrayLike) -> Estimate:
    """How much greater `second` (R2,) is than `first` (R1,), by Hodges and Lehmann: the median of all R1 * R2
    differences, and the interval of the shifts that the rank test does not reject. Two infinities differ by 0.
    """
    a, b = np.asarray(first, dtype=np.float64), np.asarray(second, dtype=np.float64)
    x, y = np.broadcast_arrays(a[:, None], b[None])
    same = x == y
    differences = np.sort(np.where(same, 0.0, np.where(same, 0.0, y) - np.where(same, 0.0, x)), axis=None)
    place = int((rank_sums(len(a), len(b)).cumsum() <= ALPHA).sum())
    return _between(differences, place)


def superiority(first: npt.ArrayLike, second: npt.ArrayLike) -> float:
    """Share of the pairs in which the run of `second` (R2,) exceeds that of `first` (R1,), ties half."""
    a, b = np.asarray(first, dtype=np.float64)[:, None], np.asarray(second, dtype=np.float64)[None]
    return float(np.mean((b > a) + 0.5 * (b == a)))


def deviations(values: npt.ArrayLike) -> Floats:
    """Distances of (R,) values from their median, ascending, without the smallest: (R - 1,); for tests of spread.

    The smallest says nothing: it is 0 by construction for an odd R, and equal to the next for an even one (the
    "structural zero" of Brown and Forsythe's test; Hines and Hines 2000). A diverged run is infinitely far away, and
    once half of the runs diverged all are.
    """
    table = np.asarray(values, dtype=np.float64)
    centre = float(np.median(table)) if np.isfinite(table).sum() > len(table) / 2 else math.inf
    with np.errstate(invalid="ignore"):
        distances = np.abs(table - centre)
    return np.sort(np.where(np.isfinite(table) & math.isfinite(centre), distances, np.inf))[1:]


def rank_sums(first: int, second: int) -> Floats:
    """P(U = u) of the Mann-Whitney statistic without ties, (first * second + 1,): a Gaussian binomial's terms."""
    counts = np.zeros(first * second + 1)
    counts[0] = 1
    for k in range(1, first + 1):
        for u in range(len(counts) - 1, second + k - 1, -1):  # times 1 - q ** (second + k)
            counts[u] -= counts[u - second - k]
        for u in range(k, len(counts)):  # over 1 - q ** k
            counts[u] += counts[u - k]
    shares: Floats = counts / counts.sum()
    return shares


def _at_least(count: int, of: int) -> float:
    return float(bdtr(of - count, of, 0.5))  # P(X >= count) = P(X <= of - count), by symmetry


def _between(ordered: Floats, place: int) -> Estimate:
    """Median of sorted values, and the interval that leaves `place` - 1 of them outside at each end; none: infinite."""
    middle = len(ordered) // 2
    lower, upper = float(ordered[(len(ordered) - 1) // 2]), float(ordered[middle])
    value = lower if lower == upper else (lower + upper) / 2
    if not place:
        return Estimate(value, -math.inf, math.inf)
    return Estimate(value, float(ordered[place - 1]), float(ordered[-place]))
