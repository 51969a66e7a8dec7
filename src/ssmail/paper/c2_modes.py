"""C2, modes (section 4.3, Figure 5): SS-AIL ends on either lane, DNRI averages the lanes.

To average is to end nearer to the middle between the two continuations of a start than to either of them. A policy that
takes one lane alone does not differentiate between the lanes either, so both have to be used.
"""

import numpy as np
import numpy.typing as npt

from ssmail.paper.claims import Claim, Part, Sample
from ssmail.paper.statements import typical

CLAIM = Claim(
    name="C2",
    alias="modes",
    sentence="SS-AIL converges to the different modes of the expert and tells them apart; DNRI averages over them.",
    section="4.3",
    figure="fig5",
)
ON_LANE = 0.9  # of the agents
BOTH_LANES = 0.1  # of the rollouts take the rarer lane
AVERAGES = 0.5  # of the agents

ENDS = "test/on_lane: share of agents of sampled test rollouts that end on a lane"
BALANCE = "test/lane_balance: share of sampled test rollouts that take the rarer lane"
BETWEEN = (
    "share of agents of the test rollouts that figure 5 shows that end, along the line between the expert's two "
    "continuations of their start, nearer to its middle than to either end"
)


def between(rollouts: npt.NDArray[np.floating], lanes: npt.NDArray[np.floating]) -> float:
    """See BETWEEN. rollouts (S, B, T, N, P), lanes (2, B, T, N, P), both raw; an end that is not finite is nowhere."""
    left, right = lanes[0, :, -1].astype(np.float64), lanes[1, :, -1].astype(np.float64)  # (B, N, P)
    across = right - left
    with np.errstate(invalid="ignore", over="ignore", divide="ignore"):
        place = ((rollouts[:, :, -1] - left) * across).sum(axis=-1) / np.square(across).sum(axis=-1)
        return float(np.mean(np.abs(place - 0.5) < 0.25))


def decide(ends: Sample, balance: Sample, averaged: Sample) -> tuple[Part, ...]:
    """From on_lane and lane_balance of ssail, and the share of agents between the lanes of dnri."""
    return (
        typical("ssail ends on a lane", ENDS, ends, "above", ON_LANE),
        typical("ssail takes both lanes", BALANCE, balance, "above", BOTH_LANES),
        typical("dnri ends between the lanes", BETWEEN, averaged, "above", AVERAGES),
    )
