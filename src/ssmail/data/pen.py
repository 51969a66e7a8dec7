"""A pen on paper: how fast a hand goes along a stroke, as a closed form of time.

A stroke is a polyline. Corners (turns of more than CORNER degrees) cut it into parts; along each part the pen
follows the minimum-jerk profile from rest to rest (Flash and Hogan 1985), not in arc length but in effort, of which a
bend costs more than a straight line; and a part begins a little before the one before it has ended (OVERLAP). So the
pen slows down in bends, is slow at a corner, rounds it slightly and does not stop.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Self

import numpy as np

from ssmail.data.trajectories import Floats

CORNER = 35.0  # degrees: a turn of the polyline that is larger is a corner
BEND = 0.2  # effort of a radian of turning, as a length
OVERLAP = 0.25  # of the shorter of two neighbouring parts
TEMPO = 0.6  # durations of parts grow as their effort to this power: longer ones are drawn faster


def progress(u: Floats) -> Floats:
    """Minimum jerk from 0 at u = 0 to 1 at u = 1, at rest on both ends and outside."""
    v = np.clip(u, 0.0, 1.0)
    return v**3 * (10 - 15 * v + 6 * v**2)


def approach(begin: Floats, velocity: Floats, end: Floats, times: Floats, duration: float) -> Floats:
    """(B, T, 2) positions at `times` (B, T) of pens that are at `begin` (B, 2) with `velocity` (B, 2) at time 0 and
    come to rest at `end` (B, 2) after `duration`: the quintic without acceleration on either end. Before time 0 the
    velocity is constant.
    """
    u = np.clip(times / duration, 0.0, 1.0)[..., None]
    coasting = duration * (u - 6 * u**3 + 8 * u**4 - 3 * u**5) + np.minimum(times, 0.0)[..., None]
    positions: Floats = begin[:, None] + (end - begin)[:, None] * progress(u) + velocity[:, None] * coasting
    return positions


def parts_of(stroke: Floats) -> list[Floats]:
    """The polylines (P', 2) between the corners of a stroke (P, 2) without repeated points."""
    corners = [0, *(np.flatnonzero(turns(stroke) > np.deg2rad(CORNER)) + 1), len(stroke) - 1]
    return [stroke[a : b + 1] for a, b in pairwise(corners)]


def turns(line: Floats) -> Floats:
    """(P - 2,) angle of 0 to pi by which a polyline (P, 2) turns at each of its inner points."""
    step = np.diff(line, axis=0)
    change = np.diff(np.arctan2(step[:, 1], step[:, 0]))
    angles: Floats = np.abs((change + np.pi) % (2 * np.pi) - np.pi)
    return angles


def arc_lengths(line: Floats) -> Floats:
    """(P,) distance along a polyline (P, 2) of each of its points from the first."""
    lengths: Floats = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1)))
    return lengths


def efforts(line: Floats) -> Floats:
    """(P,) effort from the first point of a polyline (P, 2) to each: its length and BEND times its turning, of which
    half is spent on either side of a point.
    """
    turned = np.concatenate([[0.0], turns(line), [0.0]])
    return arc_lengths(line) + BEND * np.append(0.0, np.cumsum((turned[1:] + turned[:-1]) / 2))


def along(line: Floats, measure: Floats, at: Floats) -> Floats:
    """(..., 2) points of a polyline (P, 2) where its `measure` (P,), such as `arc_lengths`, has the values `at`."""
    return np.stack([np.interp(at, measure, line[:, axis]) for axis in (0, 1)], axis=-1)


@dataclass(frozen=True)
class Timeline:
    """When each part of a stroke begins and how long it takes, in steps."""

    parts: Sequence[Floats]
    begins: tuple[float, ...]
    durations: tuple[float, ...]

    @classmethod
    def of(cls, stroke: Floats, begin: float, end: float, overlap: float = OVERLAP) -> Self:
        """That of a stroke (P, 2) which is drawn from `begin` to `end`."""
        parts = parts_of(stroke)
        relative = np.array([efforts(part)[-1] for part in parts]) ** TEMPO
        waits = relative[:-1] - overlap * np.minimum(relative[:-1], relative[1:])
        starts = np.append(0.0, np.cumsum(waits))
        unit = (end - begin) / (starts[-1] + relative[-1])
        return cls(parts, tuple((begin + unit * starts).tolist()), tuple((unit * relative).tolist()))

    def positions(self, times: Floats) -> Floats:
        """(..., 2) where the pen is at `times` (...): the first point, plus what each part has moved it by then."""
        total = np.broadcast_to(self.parts[0][0], (*times.shape, 2)).astype(np.float64)
        for part, begin, duration in zip(self.parts, self.begins, self.durations, strict=True):
            spent = efforts(part)
            total = total + along(part, spent, spent[-1] * progress((times - begin) / duration)) - part[0]
        return total
