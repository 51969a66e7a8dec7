"""C6, curricula (section 3.3, Figure 3): trajectory forcing lengthens the segments between interventions, gradually.

The lengths are those measured in each run, not the closed form, which is the same for all seeds. Gradual is judged
against scheduled sampling, the curriculum that the paper calls less smooth (in a passage that is commented out).
"""

import numpy as np

from ssmail.paper.claims import Claim, Part, Sample
from ssmail.paper.curve_numbers import Floats, beginning, end
from ssmail.paper.statements import smaller, typical

CLAIM = Claim(
    name="C6",
    alias="curricula",
    sentence="Trajectory forcing lengthens the generated segments gradually over training, more smoothly than "
    "scheduled sampling does.",
    section="3.3",
    figure="fig3",
)
FORCING, SAMPLING = "trajectory-forcing", "scheduled-sampling"
LONGER = 2.0  # times

GROWTH = "curriculum/segment_length, mean of the last fifth of the epochs over that of the first fifth"
JUMP = "largest rise of curriculum/segment_length from an epoch to the next, as a share of the whole rise"


def growth(lengths: Floats) -> float:
    """See GROWTH; of (E,) lengths in steps."""
    return end(lengths) / beginning(lengths)


def largest_jump(lengths: Floats) -> float:
    """See JUMP; of (E,) lengths in steps. The whole rise is from shortest to longest; NaN when there is none."""
    whole = np.ptp(lengths) if len(lengths) > 1 else 0.0
    return float(np.diff(lengths).max() / whole) if whole > 0 else np.nan


def decide(grown: Sample, jump: Sample, jump_sampling: Sample) -> tuple[Part, ...]:
    """From growth and largest jump under FORCING, and the largest jump under SAMPLING."""
    return (
        typical("trajectory forcing at least doubles the segments", GROWTH, grown, "above", LONGER),
        smaller("trajectory forcing is smoother than scheduled sampling", JUMP, jump, jump_sampling),
    )
