"""Notes on curves and bands: what the scale cuts off, and how the groups compare."""

import math
from collections.abc import Sequence

import numpy as np
import pandas as pd

from ssmail.evaluation.hypothesis_tests import MAX_SPLITS, permutation_test
from ssmail.plots import style
from ssmail.plots.curves import CEILING, Band
from ssmail.plots.formatting import counted
from ssmail.store import RunRow, Store


def of_errors(bands: Sequence[Band]) -> tuple[str, ...]:
    """Return all notes on errors over epochs."""
    return (*high(bands), *cut(bands), *comparisons(bands))


def cut(bands: Sequence[Band]) -> tuple[str, ...]:
    """Name the groups whose band a logarithmic scale cuts off."""
    labels = [shown.label for shown in bands if shown.is_cut]
    if not labels:
        return ()
    where = f"is cut a factor {style.REACH:g} below the lowest run"
    return (f"the band of {'; '.join(labels)} {where}; the CSV has its numbers.",)


def high(bands: Sequence[Band], end: float = CEILING) -> tuple[str, ...]:
    """Count the runs of each group that rise above the end of the scale."""
    counts = {
        shown.label: sum(bool((np.isfinite(run.values) & (run.values > end)).any()) for run in shown.curves)
        for shown in bands
    }
    return tuple(
        f"{label}: {n} of the runs rise above {end:.3g}, where the scale ends." for label, n in counts.items() if n
    )


def compact(store: Store, metric: str, runs: Sequence[RunRow], values: pd.DataFrame) -> tuple[str, ...]:
    """Say of how many runs a compact database kept the last value of the metric alone.

    values: the stored ones, a row for each run and step. A metric of the test has no other value anyway.
    """
    steps = {str(run_id): list(own) for run_id, own in values.groupby("run_id")["step"]}
    of_run = {run.id: steps.get(run.id, []) for run in runs}
    single = [run for run in runs if len(of_run[run.id]) == 1 < of_run[run.id][0] and store.is_compact(run)]
    if not single or metric.startswith("test"):
        return ()
    return (
        f"{metric}: of {counted(len(single), 'run')} the last value alone is stored, for {store.where} is compact: it "
        "keeps the curves that figures and claims read.",
    )


def comparisons(bands: Sequence[Band]) -> tuple[str, ...]:
    """Compare the first group with each other group at the last epoch. A diverged run ranks worst."""
    notes = []
    for other in bands[1:]:
        a, b = (shown.last for shown in (bands[0], other))
        unfinished, many = np.isnan([*a, *b]).any(), math.comb(len(a) + len(b), len(a)) > MAX_SPLITS
        if unfinished or many:
            continue  # some run has no value at the last epoch, or there are too many splits to enumerate
        found = permutation_test(a, b)
        notes.append(
            f"{bands[0].label} against {other.label} at the last epoch: medians {np.median(a):.3g} and "
            f"{np.median(b):.3g}, exact two-sided permutation test on ranks p = {found.p:.2g} (least "
            f"possible {found.least:.2g})."
        )
    return tuple(notes)
