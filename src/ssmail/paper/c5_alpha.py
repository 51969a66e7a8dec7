"""C5, alpha (section 4.7, Figure 8): negative alpha lowers the final error and lets training converge sooner.

The paper's "training loss" is read as the free-running error on training trajectories, because the loss of Eq. 3 cannot
be compared between ranges of alpha (docs/paper.md). Both ranges are asked for the same level, which favours neither.
"""

from collections.abc import Sequence

import numpy as np

from ssmail.paper.claims import Claim, Part, Sample
from ssmail.paper.curve_numbers import Floats, end, settled_after
from ssmail.paper.statements import smaller

CLAIM = Claim(
    name="C5",
    alias="alpha",
    sentence="Sampling negative alpha too improves the final loss and speeds up training.",
    section="4.7",
    figure="fig8",
)
POSITIVE, BOTH = (0.0, 1.0), (-1.0, 1.0)  # what alpha is drawn from
LEVEL = 2.0  # times the median final error of all runs of both ranges

FINAL = "train/mse, mean of the last fifth of the epochs, squared scaled units"
EPOCHS = "epochs until train/mse stays at or below twice the median final error of all runs of both ranges"


def common_level(finals: Sequence[float]) -> float:
    """LEVEL times the median of the final errors that are finite; NaN when none is."""
    finite = [value for value in finals if np.isfinite(value)]
    return LEVEL * float(np.median(finite)) if finite else np.nan


def final_error(errors: Floats) -> float:
    """See FINAL; of (E,) errors."""
    return end(errors)


def epochs_to_converge(errors: Floats, level: float) -> float:
    """See EPOCHS; of (E,) errors. inf when they end above it."""
    return settled_after(errors, level)


def decide(
    final_both: Sample, final_positive: Sample, epochs_both: Sample, epochs_positive: Sample
) -> tuple[Part, ...]:
    """From the final errors of alpha in BOTH and in POSITIVE, and from the epochs of both."""
    return (
        smaller("negative alpha lowers the final error", FINAL, final_both, final_positive),
        smaller("negative alpha converges sooner", EPOCHS, epochs_both, epochs_positive),
    )
