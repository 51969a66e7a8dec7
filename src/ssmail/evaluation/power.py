"""How many seeds a test needs, if what was observed is what is: planning, not inference.

The observed effect of a few seeds is itself uncertain, so such a number is a guess that may be wrong by a factor of two
in either direction. POWER is the chance that a test at ALPHA decides with that many seeds. To add seeds until a verdict
comes out is not what it is for: that would raise the share of wrong verdicts above ALPHA.
"""

import math

import numpy as np
from scipy.special import bdtr, ndtri

from ssmail.evaluation.order_statistics import ALPHA

POWER = 0.8
MOST = 1000  # seeds; more than that is told as "no number"


def seeds_for_sign_test(share: float) -> int | None:
    """The least n at which the sign test decides with probability POWER, when `share` (0..1) of all seeds are on one
    side of the bar: exact, by the binomial distribution. None when it is 1/2, or n would exceed MOST.
    """
    side = max(share, 1 - share)
    if side <= 0.5:
        return None
    for n in range(1, MOST + 1):
        most_outside = int((bdtr(np.arange(n), n, 0.5) <= ALPHA).sum()) - 1  # how many may lie on the other side
        if most_outside >= 0 and bdtr(most_outside, n, 1 - side) >= POWER:
            return n
    return None


def seeds_for_rank_test(superiority: float) -> int | None:
    """The least n in each of two groups at which the rank test decides with probability POWER, when a run of one group
    exceeds one of the other with probability `superiority` (0..1): Noether's (1987) normal approximation,

        n = (z(1 - ALPHA) + z(POWER)) ** 2 / (6 * (superiority - 1/2) ** 2),

    which takes the variance without an effect, and so asks for a little too much where the effect is large. None when
    superiority is 1/2, or n would exceed MOST.
    """
    gap = abs(superiority - 0.5)
    needed = (ndtri(1 - ALPHA) + ndtri(POWER)) ** 2 / (6 * gap**2) if gap else math.inf
    return math.ceil(needed) if needed <= MOST else None


def seeds_for_every() -> int:
    """The least n at which n successes of n decide that more than half of all seeds succeed: 2 ** -n <= ALPHA."""
    return math.ceil(-math.log2(ALPHA))
