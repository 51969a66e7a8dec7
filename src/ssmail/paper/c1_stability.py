"""C1, stability (section 4.2, Figure 4): SS-AIL converges for every seed, GAIL and WAIL do not, and fluctuate.

The paper's error is of training; a policy that converged has a small validation error as well, so both are asked for.
"Converges to zero" becomes: a tenth of what driving straight on costs. "Fluctuates" is measured on the logarithm of the
error, so that a method is not called unsteady for being worse, which other parts decide.
"""

from collections.abc import Mapping

import numpy as np

from ssmail.paper.claims import Claim, Part, Sample
from ssmail.paper.curve_numbers import Floats, end
from ssmail.paper.statements import every, smaller, typical

CLAIM = Claim(
    name="C1",
    alias="stability",
    sentence="The training error of SS-AIL converges to zero for every initialisation; GAIL and WAIL cannot converge, "
    "and fluctuate considerably.",
    section="4.2",
    figure="fig4",
)
CONVERGED = 0.1  # of constant velocity's error
SMALLEST = 1e-12  # squared scaled units; below it an error counts as this, so that it has a logarithm

ERROR = (
    "mode_mse, mean of the last fifth of the epochs, as a fraction of constant velocity's test error; "
    "the larger of training and validation"
)
FLUCTUATION = "mean |ln(error / error of the epoch before)| of train/mode_mse over the last half of the epochs"


def remaining_error(train: Floats, validation: Floats, constant_velocity: float) -> float:
    """What is left of the error: see ERROR. train and validation: (E,) squared scaled units."""
    return float(np.maximum(end(train), end(validation)) / constant_velocity)


def fluctuation(errors: Floats) -> float:
    """See FLUCTUATION; of (E,) errors. NaN with fewer than two epochs to compare, inf where an error is not finite."""
    last = errors[min(len(errors) // 2, max(len(errors) - 2, 0)) :]
    if not np.isfinite(errors).all():
        return np.inf
    return float(np.abs(np.diff(np.log(np.maximum(last, SMALLEST)))).mean()) if len(last) > 1 else np.nan


def decide(errors: Mapping[str, Sample], fluctuations: Mapping[str, Sample]) -> tuple[Part, ...]:
    """From remaining errors and fluctuations of ssail, gail and wail, by method."""
    others = ("gail", "wail")
    return (
        every("ssail converges on every seed", ERROR, errors["ssail"], "below", CONVERGED),
        *(typical(f"{name} does not converge", ERROR, errors[name], "above", CONVERGED) for name in others),
        *(
            smaller(f"{name} fluctuates more than ssail", FLUCTUATION, fluctuations["ssail"], fluctuations[name])
            for name in others
        ),
    )
