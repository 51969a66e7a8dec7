"""C8, vector field (section 3.1.3, Figure 2): behind the current trajectory, the slope of D points to the expert only
if D has seen negative alpha.

Behind is where alpha is negative: on the far side of the current trajectory, seen from the expert.
"""

from ssmail.paper.claims import Claim, Part, Sample
from ssmail.paper.statements import typical

CLAIM = Claim(
    name="C8",
    alias="vector-field",
    sentence="With alpha from [0, 1] alone the field behind the current trajectory is left to chance; negative alpha "
    "completes it, so that it points to the expert there too.",
    section="3.1.3",
    figure="fig2",
)
POSITIVE, BOTH = (0.0, 1.0), (-1.0, 1.0)  # what alpha is drawn from
TOWARDS = 0.5  # cosine: within 60 degrees

COSINE = (
    "landscape/behind_cosine: mean cosine between D's slope and the direction to the expert at negative alpha, "
    "after half of the epochs"
)


def decide(positive: Sample, both: Sample) -> tuple[Part, ...]:
    """From the cosines of alpha in POSITIVE and in BOTH."""
    return (
        typical(
            "without negative alpha the field behind does not point to the expert", COSINE, positive, "below", TOWARDS
        ),
        typical("with negative alpha it does", COSINE, both, "above", TOWARDS),
    )
