"""What the reader of curves and bands has to be told beside them: what a scale cuts off, and how groups compare."""

import math
from collections.abc import Sequence

import numpy as np

from ssmail.evaluation.hypothesis_tests import MAX_SPLITS, permutation_test
from ssmail.plots import style
from ssmail.plots.curves import CEILING, Band, Curve


def of_errors(bands: Sequence[Band]) -> tuple[str, ...]:
    """All notes on errors over epochs."""
    return (*high(bands), *cut(bands), *comparisons(bands))


def cut(bands: Sequence[Band]) -> tuple[str, ...]:
    """Whose band a logarithmic scale does not show whole."""
    labels = [shown.label for shown in bands if shown.is_cut]
    if not labels:
        return ()
    where = f"is cut a factor {style.REACH:g} below the lowest run"
    return (f"the band of {'; '.join(labels)} {where}; the CSV has its numbers.",)


def high(bands: Sequence[Band], end: float = CEILING) -> tuple[str, ...]:
    """How many runs rise above the end of a scale."""
    counts = {shown.label: sum(_rises(curve, end) for curve in shown.curves) for shown in bands}
    return tuple(
        f"{label}: {n} of the runs rise above {end:.3g}, where the scale ends." for label, n in counts.items() if n
    )


def _rises(curve: Curve, end: float) -> bool:
    return bool((np.isfinite(curve.values) & (curve.values > end)).any())


def comparisons(bands: Sequence[Band]) -> tuple[str, ...]:
    """The first group against each other one at the end of training, a diverged run being the worst."""
    notes = []
    for other in bands[1:]:
        a, b = (shown.last for shown in (bands[0], other))
        unfinished, many = np.isnan([*a, *b]).any(), math.comb(len(a) + len(b), len(a)) > MAX_SPLITS
        if unfinished or many:
            continue  # there is no last epoch, or no enumerating all splits
        found = permutation_test(a, b, on="ranks")
        notes.append(
            f"{bands[0].label} against {other.label} at the last epoch: medians {np.median(a):.3g} and "
            f"{np.median(b):.3g}, exact two-sided permutation test on ranks p = {found.p:.2g} (least "
            f"possible {found.least:.2g})."
        )
    return tuple(notes)
