"""C3, beta (section 4.5, Figure 6): about 15 % gives a low mean and a low spread; 0 % has both high, 100 % the spread.

The value 0.15 is the paper's and fixed beforehand: the best of several would win by luck alone. "Considerably" is left
out: any difference counts that cannot be chance.
"""

from ssmail.paper.claims import Claim, Part, Sample
from ssmail.paper.statements import smaller, steadier

CLAIM = Claim(
    name="C3",
    alias="beta",
    sentence="A beta of about 15 % lowers both mean and standard deviation of the test error; without teacher forcing "
    "both are high, and with complete teacher forcing the standard deviation is.",
    section="4.5",
    figure="fig6",
)
NONE, CHOSEN, COMPLETE = 0.0, 0.15, 1.0  # beta

ERROR = "test/mode_mse of the model of best validation, squared scaled units"


def decide(none: Sample, chosen: Sample, complete: Sample) -> tuple[Part, ...]:
    """From the test errors of beta = NONE, CHOSEN and COMPLETE."""
    return (
        smaller("beta 0.15 has a lower error than beta 0", ERROR, chosen, none),
        steadier("beta 0.15 spreads less than beta 0", ERROR, chosen, none),
        steadier("beta 0.15 spreads less than beta 1", ERROR, chosen, complete),
    )
