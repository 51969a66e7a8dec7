"""Hypothesis tests and confidence intervals for a few runs, and the number of seeds that a test needs.

All tests depend on the order of the values alone, so a diverged run has a place in them: its error is +inf, it shares
the last rank with the other diverged runs, and it loses against every finite run. All tests are exact, except the rank
test of large groups.

`sign_test` and `rank_test` are one-sided. The intervals of `median` and `shift` invert them: each end is the bound that
a one-sided test at level ALPHA does not reject, so an interval has confidence 1 - 2 * ALPHA. Where n values are too few
for a bound, it is infinite: the interval of the median of four values reaches from -inf to inf.

A few seeds can only give large p-values. The smallest two-sided p of 5 against 5 different values is 2/252 = 0.0079,
and of 3 against 3 it is 2/20 = 0.1. Every permutation test reports its own (`PermutationTest.least`).
"""

import math
from typing import Literal, NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.special import bdtr, ndtri  # scipy.stats takes a second to import

from ssmail.data.trajectories import Floats, Integers
from ssmail.evaluation.statistics import as_table

Alternative = Literal["two-sided", "less", "greater"]

ALPHA = 0.05
POWER = 0.8  # the probability with which a planned test at ALPHA decides
MAX_SPLITS = 200_000  # that a permutation test counts: 10 against 10 runs
MAX_SEEDS = 1000  # beyond which a planned test counts as out of reach


class Estimate(NamedTuple):
    """A value and the ends of its confidence interval; NaN throughout when there is no estimate."""

    value: float
    low: float
    high: float


UNKNOWN = Estimate(math.nan, math.nan, math.nan)


class OneSided(NamedTuple):
    """The p-values of the same data in both directions. Each is valid at its own level; their sum is at least 1."""

    less: float
    greater: float


class PermutationTest(NamedTuple):
    """The result of an exact permutation test."""

    p: float  # share of all splits at least as extreme as the observed one, which is among them: never 0
    least: float  # the smallest p that any split of these values has


# -- one sample --------------------------------------------------------------------------------------------------------


def sign_test(values: npt.ArrayLike, bar: float) -> OneSided:
    """Test whether the median of all seeds' values (R,) is less or greater than `bar`.

    p is P(X >= count) for X ~ Bin(R, 1/2). A value equal to the bar counts for neither side and stays in R, which is
    conservative.
    """
    table = np.asarray(values, dtype=np.float64)
    below, above = int((table < bar).sum()), int((table > bar).sum())
    return OneSided(_at_least(below, len(table)), _at_least(above, len(table)))


def median(values: npt.ArrayLike) -> Estimate:
    """Median of (R,) values, and the interval between the two order statistics that the sign test does not reject."""
    table = np.sort(np.asarray(values, dtype=np.float64))
    count = len(table)
    place = int((bdtr(np.arange(count), count, 0.5) <= ALPHA).sum())
    return _order_interval(table, place)


def deviations(values: npt.ArrayLike) -> Floats:
    """Distances of (R,) values from their median in ascending order, without the smallest: (R - 1,).

    For tests of spread. The smallest distance carries no information: it is 0 by construction for an odd R, and equal
    to the next one for an even R (the "structural zero" of Brown and Forsythe's test; Hines and Hines 2000). A diverged
    run is infinitely far away; once half of the runs have diverged, all are.
    """
    table = np.asarray(values, dtype=np.float64)
    centre = float(np.median(table)) if np.isfinite(table).sum() > len(table) / 2 else math.inf
    with np.errstate(invalid="ignore"):
        distances = np.abs(table - centre)
    return np.sort(np.where(np.isfinite(table) & math.isfinite(centre), distances, np.inf))[1:]


# -- two samples -------------------------------------------------------------------------------------------------------


def permutation_test(
    first: npt.ArrayLike, second: npt.ArrayLike, alternative: Alternative = "two-sided"
) -> PermutationTest:
    """Exact test of the difference between two independent groups on midranks (Wilcoxon, Mann and Whitney).

    All C(R1 + R2, R1) splits of the pooled values, which may be +-inf, are counted. With d the rank sum of the first
    group less its expectation, p is the share of splits with a d >= the observed one ("greater"), <= it ("less"), or as
    large in size ("two-sided"), ties included. Raises ValueError for an empty group, NaN, and more than MAX_SPLITS
    splits.
    """
    a, b = as_table(first), as_table(second)
    pooled = np.concatenate([a, b])
    splits = math.comb(len(pooled), len(a))
    if pooled.ndim != 1 or np.isnan(pooled).any():
        raise ValueError("a permutation test needs one known number per run")
    if splits > MAX_SPLITS:
        raise ValueError(f"{splits} splits are too many to count; {MAX_SPLITS} are the most")
    doubled = (2 * midranks(pooled)).astype(np.int64)  # whole numbers
    counts = _doubled_sums(doubled, len(a))
    excess = np.arange(len(counts)) - len(a) * (len(pooled) + 1)
    extremity = {"two-sided": np.abs(excess), "greater": excess, "less": -excess}[alternative]
    bounds = extremity[doubled[: len(a)].sum()], extremity[counts > 0].max()
    return PermutationTest(*(float(counts[extremity >= bound].sum() / splits) for bound in bounds))


def _doubled_sums(doubled: Integers, size: int) -> Floats:
    """Count the subsets with `size` members of the doubled ranks (R,) by their sum: (sum of all + 1,)."""
    counts = np.zeros((size + 1, int(doubled.sum()) + 1))  # of the subsets of the ranks seen so far, by size and sum
    counts[0, 0] = 1
    for rank in doubled:
        counts[1:, rank:] += counts[:-1, :-rank].copy()
    found: Floats = counts[size]
    return found


def midranks(values: npt.ArrayLike) -> Floats:
    """Ranks of (R,) values, starting at 1. Equal values, equal infinities included, share the mean of their ranks."""
    _, place, counts = np.unique(as_table(values), return_inverse=True, return_counts=True)
    ranks: Floats = (np.cumsum(counts) - (counts - 1) / 2)[place]
    return ranks


def rank_test(first: npt.ArrayLike, second: npt.ArrayLike) -> OneSided:
    """Test whether `first` (R1,) is less or greater than `second` (R2,): the test of Wilcoxon, Mann and Whitney.

    Exact with midranks for ties while the splits can be counted. For larger groups (more than 10 against 10 runs),
    the normal approximation with corrections for ties and continuity.
    """
    a, b = np.asarray(first, dtype=np.float64), np.asarray(second, dtype=np.float64)
    if math.comb(len(a) + len(b), len(a)) <= MAX_SPLITS:
        return OneSided(*(permutation_test(a, b, side).p for side in ("less", "greater")))
    from scipy.stats import mannwhitneyu

    ranks = midranks(np.concatenate([a, b]))
    x, y = ranks[: len(a)], ranks[len(a) :]
    found = (mannwhitneyu(x, y, alternative=side, method="asymptotic") for side in ("less", "greater"))
    return OneSided(*(float(test.pvalue) for test in found))


def two_sided(first: npt.ArrayLike, second: npt.ArrayLike) -> float:
    """The p-value of a difference between two groups in either direction: of `permutation_test` while it can be exact.

    For larger groups twice the smaller p of `rank_test`, 1 at most.
    """
    a, b = np.asarray(first, dtype=np.float64), np.asarray(second, dtype=np.float64)
    if math.comb(len(a) + len(b), len(a)) <= MAX_SPLITS:
        return permutation_test(a, b).p
    return min(1.0, 2 * min(rank_test(a, b)))


def shift(first: npt.ArrayLike, second: npt.ArrayLike) -> Estimate:
    """How much greater `second` (R2,) is than `first` (R1,), after Hodges and Lehmann.

    The median of all R1 * R2 differences, and the interval of the shifts that the rank test does not reject. Two equal
    infinities differ by 0.
    """
    a, b = np.asarray(first, dtype=np.float64), np.asarray(second, dtype=np.float64)
    x, y = np.broadcast_arrays(a[:, None], b[None])
    same = x == y
    differences = np.sort(np.where(same, 0.0, np.where(same, 0.0, y) - np.where(same, 0.0, x)), axis=None)
    place = int((rank_sums(len(a), len(b)).cumsum() <= ALPHA).sum())
    return _order_interval(differences, place)


def superiority(first: npt.ArrayLike, second: npt.ArrayLike) -> float:
    """Share of all pairs in which the run of `second` (R2,) exceeds the run of `first` (R1,); a tie counts half."""
    a, b = np.asarray(first, dtype=np.float64)[:, None], np.asarray(second, dtype=np.float64)[None]
    return float(np.mean((b > a) + 0.5 * (b == a)))


def rank_sums(first: int, second: int) -> Floats:
    """P(U = u) of the Mann-Whitney statistic without ties, (first * second + 1,): terms of a Gaussian binomial."""
    counts = np.zeros(first * second + 1)
    counts[0] = 1
    for k in range(1, first + 1):
        for u in range(len(counts) - 1, second + k - 1, -1):  # times 1 - q ** (second + k)
            counts[u] -= counts[u - second - k]
        for u in range(k, len(counts)):  # over 1 - q ** k
            counts[u] += counts[u - k]
    shares: Floats = counts / counts.sum()
    return shares


# -- power: how many seeds a test needs --------------------------------------------------------------------------------
#
# For planning only. The effect observed in a few seeds is itself uncertain, so the number may be wrong by a factor of
# two in either direction. Do not add seeds until a test decides: that raises the share of wrong decisions above ALPHA.


def seeds_for_sign_test(share: float) -> int | None:
    """Smallest n at which the sign test decides with probability POWER, if `share` (0..1) of all seeds are on one side.

    Exact, by the binomial distribution. None if `share` is 1/2 or n would exceed MAX_SEEDS.
    """
    side = max(share, 1 - share)
    if side <= 0.5:
        return None
    for n in range(1, MAX_SEEDS + 1):
        most_outside = int((bdtr(np.arange(n), n, 0.5) <= ALPHA).sum()) - 1  # how many may lie on the other side
        if most_outside >= 0 and bdtr(most_outside, n, 1 - side) >= POWER:
            return n
    return None


def seeds_for_rank_test(superiority: float) -> int | None:
    """Smallest n per group at which the rank test decides with probability POWER.

    `superiority` (0..1) is the probability that a run of one group exceeds a run of the other. The normal approximation
    of Noether (1987),

        n = (z(1 - ALPHA) + z(POWER)) ** 2 / (6 * (superiority - 1/2) ** 2),

    uses the variance without an effect and is slightly too large for large effects. None if `superiority` is 1/2 or n
    would exceed MAX_SEEDS.
    """
    gap = abs(superiority - 0.5)
    needed = (ndtri(1 - ALPHA) + ndtri(POWER)) ** 2 / (6 * gap**2) if gap else math.inf
    return math.ceil(needed) if needed <= MAX_SEEDS else None


def _at_least(count: int, of: int) -> float:
    return float(bdtr(of - count, of, 0.5))  # P(X >= count) = P(X <= of - count), by symmetry


def _order_interval(ordered: Floats, place: int) -> Estimate:
    """Median of sorted values and the interval from the `place`-th smallest to the `place`-th largest of them.

    The interval is infinite if `place` is 0.
    """
    middle = len(ordered) // 2
    lower, upper = float(ordered[(len(ordered) - 1) // 2]), float(ordered[middle])
    value = lower if lower == upper else (lower + upper) / 2
    if not place:
        return Estimate(value, -math.inf, math.inf)
    return Estimate(value, float(ordered[place - 1]), float(ordered[-place]))
