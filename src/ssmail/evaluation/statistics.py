"""What a handful of seeds allows to say: centre and spread of a group of runs, and exact permutation tests.

Runs that fail are not left out. Everywhere here NaN is *unknown* (nothing was recorded), and +inf is an error that is
*worse than any other*: what a diverged run counts as. Hence

- a mean needs finite values: once a run diverged it has no number, and is NaN;
- a median and its quartiles put +inf last, so they stay finite while few runs diverged; one unknown value makes them
  NaN;
- a permutation test on values refuses what is not finite; on ranks +inf is the last rank, shared by all that diverged:
  a diverged run loses against each finite one, however far it went.

What five seeds cannot say: the least p of an exact two-sided test of 5 against 5 different values is 2/252 = 0.0079, of
3 against 3 it is 2/20 = 0.1, and of 5 pairs 2/32 = 0.0625. Every test tells its own (`PermutationTest.least`).
"""

import math
from enum import StrEnum
from itertools import chain, combinations
from typing import Literal, NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.special import stdtrit  # quantiles of Student's t without scipy.stats, which takes a second to import

Floats = npt.NDArray[np.float64]
Alternative = Literal["two-sided", "less", "greater"]
Scale = Literal["values", "ranks"]

CONFIDENCE = 0.95
LARGEST = 200_000  # splits or sign patterns that a test enumerates at most: 10 against 10 runs, 17 pairs
_ROUNDING = 1e-12  # differences that are equal but for this, relative to the largest value, count as ties


class Statistic(StrEnum):
    """Which centre and spread of a group of runs are shown."""

    MEAN_STD = "mean-std"
    MEDIAN_IQR = "median-iqr"
    MEAN_CI = "mean-ci"

    @property
    def centre(self) -> str:
        """What the centre is called."""
        return "median" if self is Statistic.MEDIAN_IQR else "mean"

    @property
    def words(self) -> str:
        """Centre and spread, for a legend."""
        spread = {"mean-std": "± std", "median-iqr": "and quartiles", "mean-ci": f"and {CONFIDENCE:.0%} interval"}
        return f"{self.centre} {spread[self.value]}"


class Summary(NamedTuple):
    """Centre and spread of R runs, each of the shape that one run has."""

    centre: Floats
    low: Floats
    high: Floats


class PermutationTest(NamedTuple):
    """What an exact permutation test found."""

    difference: float  # observed: mean of the first group minus that of the second (of the ranks, on ranks)
    p: float  # share of all splits at least as extreme, the observed one among them: never 0
    least: float  # the smallest p that these values could have given, in whichever split
    splits: int  # how many there are


def summarise(values: npt.ArrayLike, statistic: Statistic) -> Summary:
    """Centre, low and high of (R, ...) values over the R >= 1 runs: the rule of every figure; see the three below."""
    if statistic is Statistic.MEDIAN_IQR:
        return median_quartiles(values)
    return mean_std(values) if statistic is Statistic.MEAN_STD else mean_interval(values)


def mean_std(values: npt.ArrayLike) -> Summary:
    """Mean and mean -+ one standard deviation (divisor R - 1) of (R, ...); no spread (NaN) with one run."""
    table = _finite_columns(values)
    mean = table.mean(axis=0)
    std = table.std(axis=0, ddof=1) if len(table) > 1 else np.full_like(mean, np.nan)
    return Summary(mean, mean - std, mean + std)


def mean_interval(values: npt.ArrayLike, confidence: float = CONFIDENCE) -> Summary:
    """Mean of (R, ...) and Student's t-interval of it: mean -+ t * std / sqrt(R), with R - 1 degrees of freedom.

    It covers the mean of all seeds' runs with probability `confidence` (above 0, below 1) where the runs are normal.
    A single run bounds nothing: its interval is (-inf, inf).
    """
    if not 0 < confidence < 1:
        raise ValueError(f"a confidence lies between 0 and 1, not {confidence}")
    table = _finite_columns(values)
    mean = table.mean(axis=0)
    if len(table) == 1:
        half = np.where(np.isnan(mean), np.nan, np.inf)
    else:
        quantile = float(stdtrit(len(table) - 1, (1 + confidence) / 2))
        half = quantile * table.std(axis=0, ddof=1) / math.sqrt(len(table))
    return Summary(mean, mean - half, mean + half)


def median_quartiles(values: npt.ArrayLike) -> Summary:
    """Median and quartiles of (R, ...), linear between order statistics; NaN where a value is NaN, +inf sorted last."""
    table = np.sort(_table(values), axis=0)
    low, centre, high = (_quantile(table, share) for share in (0.25, 0.5, 0.75))
    return Summary(centre, low, high)


def permutation_test(
    first: npt.ArrayLike, second: npt.ArrayLike, alternative: Alternative = "two-sided", on: Scale = "values"
) -> PermutationTest:
    """Exact test of two independent groups: is the difference of their means more than a random split would give?

    All C(R1 + R2, R1) splits are enumerated. p is the share of them whose difference d is >= the observed one
    ("greater"), <= it ("less"), or |d| >= its size ("two-sided"), ties included. `on` "ranks" takes midranks of the
    pooled values first (Wilcoxon, Mann and Whitney), which makes +-inf usable. Raises ValueError for an empty group,
    NaN, infinities on "values", and more than LARGEST splits.
    """
    a, b = _table(first), _table(second)
    pooled = np.concatenate([a, b])
    splits = math.comb(len(pooled), len(a))
    _check(pooled, on, splits)
    if on == "ranks":
        pooled = midranks(pooled)
    tolerance = _ROUNDING * np.abs(pooled).max()
    centred = pooled - pooled.mean()
    chosen = np.fromiter(chain.from_iterable(combinations(range(len(pooled)), len(a))), dtype=np.intp)
    sums = centred[chosen.reshape(splits, len(a))].sum(axis=1)  # (splits,), the observed split first
    return _result(sums / len(a) - (centred.sum() - sums) / len(b), tolerance, alternative)


def paired_permutation_test(
    first: npt.ArrayLike, second: npt.ArrayLike, alternative: Alternative = "two-sided", on: Scale = "values"
) -> PermutationTest:
    """Exact test of pairs, such as runs of one seed under two specs: all 2 ** R signs of their R differences.

    p as in `permutation_test`, of the mean difference; on "ranks", of the mean signed midrank of the sizes (Wilcoxon;
    pairs without a difference keep their rank, of sign 0: Pratt). Two equal infinities differ by 0. Raises ValueError
    for unequal lengths, no pair, NaN, infinities on "values", and more than LARGEST sign patterns.
    """
    a, b = _table(first), _table(second)
    if len(a) != len(b):
        raise ValueError(f"{len(a)} and {len(b)} values make no pairs")
    _check(np.concatenate([a, b]), on, 2 ** len(a))
    same = a == b
    differences = np.where(same, 0.0, a - np.where(same, 0.0, b))
    tolerance = _ROUNDING * max(np.abs(a).max(), np.abs(b).max())
    if on == "ranks":
        differences = np.sign(differences) * midranks(np.abs(differences))
        tolerance = _ROUNDING * len(a)
    patterns = np.arange(2 ** len(a))[:, None] >> np.arange(len(a)) & 1  # (2 ** R, R), the observed signs first
    return _result((1 - 2 * patterns) @ differences / len(a), tolerance, alternative)


def midranks(values: npt.ArrayLike) -> Floats:
    """Ranks from 1 of (R,) values; equal ones, equal infinities too, share the mean of their ranks."""
    _, place, counts = np.unique(_table(values), return_inverse=True, return_counts=True)
    ranks: Floats = (np.cumsum(counts) - (counts - 1) / 2)[place]
    return ranks


def _table(values: npt.ArrayLike) -> Floats:
    table = np.asarray(values, dtype=np.float64)
    if not table.ndim or not len(table):
        raise ValueError("a statistic needs at least one value")
    return table


def _finite_columns(values: npt.ArrayLike) -> Floats:
    """The table, NaN throughout where the value of any run is not finite."""
    table = _table(values)
    finite: Floats = np.where(np.isfinite(table).all(axis=0), table, np.nan)
    return finite


def _quantile(ordered: Floats, share: float) -> Floats:
    """The value at (R - 1) * share in (R, ...) sorted values; np.quantile makes NaN of infinite neighbours."""
    below, part = divmod((len(ordered) - 1) * share, 1)
    lower, upper = ordered[int(below)], ordered[min(int(below) + 1, len(ordered) - 1)]
    with np.errstate(invalid="ignore"):  # between -inf and inf there is no number
        between = np.where(lower == upper, lower, (1 - part) * lower + part * upper) if part else lower
    return np.where(np.isnan(ordered[-1]), np.nan, between)  # NaN is sorted last


def _check(pooled: Floats, on: Scale, splits: int) -> None:
    if pooled.ndim != 1 or np.isnan(pooled).any():
        raise ValueError("a permutation test takes one known number for each run")
    if on == "values" and not np.isfinite(pooled).all():
        raise ValueError("means have no place for infinite values; test on ranks, where a diverged run is the worst")
    if splits > LARGEST:
        raise ValueError(f"{splits} splits are too many to enumerate; {LARGEST} are the most")


def _result(differences: Floats, tolerance: float, alternative: Alternative) -> PermutationTest:
    """From the difference of every split, the observed one first."""
    extremity = {"two-sided": np.abs(differences), "greater": differences, "less": -differences}[alternative]
    p, least = (float(np.mean(extremity >= bound - tolerance)) for bound in (extremity[0], extremity.max()))
    return PermutationTest(float(differences[0]), p, least, len(differences))
