"""The Y-Junction expert (sections 4.1, B.2): agents in single file on a street along +x that splits into two lanes.

The unit of length is the mean approach speed times one step, so an agent covers about one unit per step. The street's
centre line is y = 0 up to the fork; each lane leaves it on a circular arc and continues straight at `lane_angle` to
either side. A trajectory is a pure function of its start (position along the street, gaps, speed, lateral offsets) and
of its lane. The first state reveals the whole start, so the metrics can continue one start into either lane.
"""

from functools import partial

import numpy as np

from ssmail.config.data_sections import YJunctionSpec
from ssmail.data.trajectories import ExpertSet, Floats, Integers, Trajectories, generate_splits
from ssmail.errors import InputError

LANES = (1.0, -1.0)  # sign of y: lane 0 bends to +y, lane 1 to -y
FORK = 0.3  # where the lanes part, as a fraction of the number of steps
FILE = 0.16  # length of the file of agents, as the same fraction
ARC = 0.12  # length of the bend, as the same fraction
POINTS = 200  # of the polyline of a lane
SPREADS = {"start": 2.0, "gap": 0.75, "speed": 0.05, "offset": 0.6}  # half-widths of the uniform draws at jitter 1


def generate(params: YJunctionSpec) -> ExpertSet:
    """Generate the expert set; equal parameters yield equal arrays.

    Raises InputError if an agent could end before the fork, or agents could overtake one another.
    """
    _check(params)
    splits = generate_splits(params, partial(_generate_split, params))
    lines = np.stack([centre_line(params, lane) for lane in range(len(LANES))])
    return ExpertSet.bundle(splits, lines, params.model_dump(mode="json"))


def centre_line(params: YJunctionSpec, lane: int, points: int = POINTS) -> Floats:
    """Return the polyline (points, 2) of the street and one lane, as far as a leader can get."""
    farthest = params.steps * (1 + SPREADS["speed"] * params.jitter) + SPREADS["start"] * params.jitter
    s = np.linspace(-FILE * params.steps - (SPREADS["start"] + 1) * params.jitter, farthest, points)
    return _path(params, s, np.full_like(s, LANES[lane]), np.zeros_like(s))


def _check(params: YJunctionSpec) -> None:
    gap = FILE * params.steps / max(params.agents - 1, 1)
    if params.agents > 1 and 2 * SPREADS["gap"] * params.jitter >= gap:
        raise InputError(
            f"{params.agents} agents with a mean gap of {gap:.2g} overtake one another at jitter {params.jitter:g}; "
            "lower data.yjunction.jitter or agents, or raise steps"
        )
    travelled = (params.steps - 1) * (1 - SPREADS["speed"] * params.jitter)
    needed = (FORK + FILE) * params.steps + (SPREADS["start"] + (params.agents - 1) * SPREADS["gap"]) * params.jitter
    if travelled <= needed + ARC * params.steps / 2:
        raise InputError(
            f"the last agent would not pass the fork within {params.steps} steps at jitter {params.jitter:g}; "
            "raise data.yjunction.steps or lower jitter"
        )


def _generate_split(params: YJunctionSpec, count: int, rng: np.random.Generator) -> Trajectories:
    """Generate `count` trajectories; a fair coin decides the lane of each group."""
    n, jitter = params.agents, params.jitter
    lane: Integers = rng.integers(0, len(LANES), size=count)

    def draw(name: str, *shape: int) -> Floats:
        return rng.uniform(-1, 1, size=shape) * (SPREADS[name] * jitter)

    # starts: where the leader is, the gaps behind it, one speed for the group, an offset for each agent
    leader = draw("start", count, 1)
    gaps = FILE * params.steps / max(n - 1, 1) + draw("gap", count, n - 1)
    first = leader - np.concatenate([np.zeros((count, 1)), np.cumsum(gaps, axis=1)], axis=1)  # (B, N)
    speed = 1 + draw("speed", count)
    offset = draw("offset", count, n)

    # motion along the centre line of either lane, then the lane that the coin chose
    steps = np.arange(-1, params.steps)  # one step before the first state, for its velocity
    s = first[:, None, :] + speed[:, None, None] * steps[None, :, None]  # (B, T + 1, N) distance along the centre line
    continuations = np.stack([_path(params, s, np.full_like(s, sign), offset[:, None, :]) for sign in LANES])
    chosen = continuations[lane, np.arange(count)]  # (B, T + 1, N, 2)
    return Trajectories(chosen[:, 1:], np.diff(chosen, axis=1), lane, continuations[:, :, 1:])


def _path(params: YJunctionSpec, s: Floats, side: Floats, offset: Floats) -> Floats:
    """Return positions (..., 2) at distance s along a lane's centre line, `offset` units to its left.

    side: 1.0 for the lane that bends to +y, -1.0 for the other.
    """
    angle = np.deg2rad(params.lane_angle)
    arc = ARC * params.steps
    begin = FORK * params.steps - arc / 2
    radius = arc / angle
    turned = np.clip(s - begin, 0, arc) / radius  # heading, 0 .. angle
    past = np.maximum(s - begin - arc, 0)
    x = np.minimum(s, begin) + radius * np.sin(turned) + past * np.cos(angle)
    y = radius * (1 - np.cos(turned)) + past * np.sin(angle)
    heading = side * turned
    return np.stack([x - offset * np.sin(heading), side * y + offset * np.cos(heading)], axis=-1)
