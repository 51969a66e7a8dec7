"""The Y-Junction expert (sections 4.1, B.2): agents in single file on a street along +x that splits into two lanes.

Lengths are in units of the mean approach speed times one step, so that an agent covers about one unit a step. The
street's centre line is y = 0 up to the fork; each lane leaves it on a circular arc and goes on straight at `lane_angle`
to either side. A trajectory is a pure function of its start (position along the street, gaps, speed, lateral offsets)
and of its lane, and the first state shows all of the start: that is what lets the metrics continue one start into
either lane.
"""

import hashlib
import json

import numpy as np

from ssmail.config.sections import YJunctionSpec
from ssmail.data.trajectories import SPLITS, ExpertSet, Floats, Integers, Trajectories
from ssmail.errors import InputError

LANES = (1.0, -1.0)  # sign of y: lane 0 bends to +y, lane 1 to -y
FORK = 0.3  # where the lanes part, as a fraction of the number of steps
FILE = 0.16  # length of the file of agents, same unit
ARC = 0.12  # length of the bend, same unit
SPREADS = {"start": 2.0, "gap": 0.75, "speed": 0.05, "offset": 0.6}  # half-widths of the uniform draws at jitter 1


def generate(params: YJunctionSpec) -> ExpertSet:
    """The expert set of these parameters; equal parameters give equal arrays.

    Raises InputError when an agent could end before the fork, or agents could overtake one another.
    """
    _check(params)
    counts = (params.train, params.validation, params.test)
    seeds = np.random.SeedSequence(params.seed).spawn(len(SPLITS))
    splits = {
        name: _split(params, count, np.random.default_rng(seed))
        for name, count, seed in zip(SPLITS, counts, seeds, strict=True)
    }
    lines = np.stack([centre_line(params, lane) for lane in range(len(LANES))])
    return make_expert_set(splits, lines, params)


def make_expert_set(splits: dict[str, Trajectories], centre_lines: Floats, params: YJunctionSpec) -> ExpertSet:
    """Bundle the splits with their parameters and the hash of both."""
    parameters = params.model_dump(mode="json")
    digest = hashlib.sha256(json.dumps(parameters, sort_keys=True).encode())
    arrays = [
        a for s in SPLITS for a in (splits[s].positions, splits[s].velocities, splits[s].mode, splits[s].continuations)
    ]
    for array in (*arrays, centre_lines):
        digest.update(np.ascontiguousarray(array).tobytes())
    train, validation, test = (splits[split] for split in SPLITS)
    return ExpertSet(train, validation, test, centre_lines, parameters, digest.hexdigest())


def centre_line(params: YJunctionSpec, lane: int, points: int = 200) -> Floats:
    """(points, 2) polyline of the street and one lane, as far as a leader can come."""
    reach = params.steps * (1 + SPREADS["speed"] * params.jitter) + SPREADS["start"] * params.jitter
    s = np.linspace(-FILE * params.steps - (SPREADS["start"] + 1) * params.jitter, reach, points)
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


def _split(params: YJunctionSpec, count: int, rng: np.random.Generator) -> Trajectories:
    """`count` trajectories: the lane of each group is a fair coin."""
    n, jitter = params.agents, params.jitter
    lane: Integers = rng.integers(0, len(LANES), size=count)

    def draw(name: str, *shape: int) -> Floats:
        return rng.uniform(-1, 1, size=shape) * (SPREADS[name] * jitter)

    leader = draw("start", count, 1)
    gaps = FILE * params.steps / max(n - 1, 1) + draw("gap", count, n - 1)
    first = leader - np.concatenate([np.zeros((count, 1)), np.cumsum(gaps, axis=1)], axis=1)  # (B, N)
    speed = 1 + draw("speed", count)
    offset = draw("offset", count, n)

    steps = np.arange(-1, params.steps)  # one step before the first state, for its velocity
    s = first[:, None, :] + speed[:, None, None] * steps[None, :, None]  # (B, T + 1, N) distance along the centre line
    continuations = np.stack([_path(params, s, np.full_like(s, sign), offset[:, None, :]) for sign in LANES])
    chosen = continuations[lane, np.arange(count)]  # (B, T + 1, N, 2)
    return Trajectories(chosen[:, 1:], np.diff(chosen, axis=1), lane, continuations[:, :, 1:])


def _path(params: YJunctionSpec, s: Floats, side: Floats, offset: Floats) -> Floats:
    """Positions (..., 2) at distance s along a lane's centre line, `offset` units to its left."""
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
