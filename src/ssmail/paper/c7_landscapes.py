"""C7, landscapes (section 1, Figure 1): GAIL's reward is nearly flat, SS-AIL's slopes towards the expert everywhere.

The slope at a point of the plane is usable when it is at least a quarter of what an even rise over the plane would have
(ssmail.evaluation.landscape); the cosine is that between the slope and the direction to the expert.
"""

from ssmail.paper.claims import Claim, Part, Sample
from ssmail.paper.statements import typical

CLAIM = Claim(
    name="C7",
    alias="landscapes",
    sentence="GAIL's reward is almost constant but for a sliver at its boundary; SS-AIL's has a clear slope towards "
    "the expert everywhere.",
    section="1",
    figure="fig1",
)
FLAT = 0.5  # of the plane: less than this has a slope where a reward is nearly flat
EVERYWHERE = 0.9  # of the plane
TOWARDS = 0.5  # cosine: within 60 degrees

SHARE = "landscape/slope_share: share of the plane where the learned reward has a usable slope, after training"
COSINE = "landscape/cosine: mean cosine between that slope and the direction to the expert, after training"


def decide(share_gail: Sample, share_ssail: Sample, cosine_ssail: Sample) -> tuple[Part, ...]:
    """From the slope shares of gail and ssail, and the cosines of ssail."""
    return (
        typical("gail's reward is nearly flat", SHARE, share_gail, "below", FLAT),
        typical("ssail's reward has a slope everywhere", SHARE, share_ssail, "above", EVERYWHERE),
        typical("ssail's reward slopes towards the expert", COSINE, cosine_ssail, "above", TOWARDS),
    )
