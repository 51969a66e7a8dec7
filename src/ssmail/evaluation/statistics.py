"""Centre and spread of a handful of runs.

Failed runs stay in the group. Everywhere here NaN means *unknown* (nothing was recorded), and +inf is an error *worse
than any other*, which is what a diverged run counts as. Therefore:

- A mean needs finite values. Once a run has diverged, the mean is NaN.
- A median and its quartiles sort +inf last and stay finite while few runs have diverged. One unknown value makes them
  NaN.

The tests in `hypothesis_tests` follow the same convention.
"""

import math
from enum import StrEnum
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.special import stdtrit  # quantiles of Student's t without scipy.stats, which takes a second to import

from ssmail.data.trajectories import Floats

CONFIDENCE = 0.95


class Statistic(StrEnum):
    """Which centre and spread of a group of runs a figure shows."""

    MEAN_STD = "mean-std"
    MEDIAN_IQR = "median-iqr"
    MEAN_CI = "mean-ci"

    @property
    def centre(self) -> str:
        """The name of the centre."""
        return "median" if self is Statistic.MEDIAN_IQR else "mean"

    @property
    def words(self) -> str:
        """The names of centre and spread, for a legend."""
        spread = {"mean-std": "± std", "median-iqr": "and quartiles", "mean-ci": f"and {CONFIDENCE:.0%} interval"}
        return f"{self.centre} {spread[self.value]}"


class Summary(NamedTuple):
    """Centre and spread of R runs, each with the shape of one run's values."""

    centre: Floats
    low: Floats
    high: Floats


def summarise(values: npt.ArrayLike, statistic: Statistic) -> Summary:
    """Return centre, low and high of (R, ...) values over R >= 1 runs, by one of the three statistics below."""
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
    """Mean of (R, ...) and its Student's t-interval: mean -+ t * std / sqrt(R), with R - 1 degrees of freedom.

    If the runs are normal, the interval covers the mean over all seeds with probability `confidence`. The interval of a
    single run is (-inf, inf). Raises ValueError unless `confidence` lies between 0 and 1.
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
    table = np.sort(as_table(values), axis=0)
    low, centre, high = (_quantile(table, share) for share in (0.25, 0.5, 0.75))
    return Summary(centre, low, high)


def as_table(values: npt.ArrayLike) -> Floats:
    """Return values (R, ...) as an array. Raises ValueError if there is none."""
    table = np.asarray(values, dtype=np.float64)
    if not table.ndim or not len(table):
        raise ValueError("a statistic needs at least one value")
    return table


def _finite_columns(values: npt.ArrayLike) -> Floats:
    """The table, NaN throughout where the value of any run is not finite."""
    table = as_table(values)
    finite: Floats = np.where(np.isfinite(table).all(axis=0), table, np.nan)
    return finite


def _quantile(ordered: Floats, share: float) -> Floats:
    """The value at (R - 1) * share in (R, ...) sorted values; np.quantile makes NaN of infinite neighbours."""
    below, part = divmod((len(ordered) - 1) * share, 1)
    lower, upper = ordered[int(below)], ordered[min(int(below) + 1, len(ordered) - 1)]
    with np.errstate(invalid="ignore"):  # between -inf and inf there is no number
        between = np.where(lower == upper, lower, (1 - part) * lower + part * upper) if part else lower
    return np.where(np.isnan(ordered[-1]), np.nan, between)  # NaN is sorted last
