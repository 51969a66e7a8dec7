"""The letters expert (sections 1, A.2): one agent for each letter of a word, drawing it in the plane.

Lengths are in letter heights, time in steps. Letters stand side by side on the line y = 0 in the upper half of the
picture. A pen starts in the lower half, below its letter, with a small velocity to the right: a policy that keeps its
velocity draws a short line there. The expert leads the pen up to the beginning of the letter in the first LEAD of the
time and then draws it in one stroke. The strokes are data: strokes.yaml.

Jitter varies where a pen starts and how fast, the size and slant of the letter, a smooth wobble, and the tempo. Only
the start is visible in the first state, so no policy can know the rest of a trajectory's jitter.

How fast the pen moves along a stroke is a closed form of time (`Timeline`). Corners (turns of more than CORNER degrees)
cut the polyline into parts. Along each part the pen follows the minimum-jerk profile from rest to rest (Flash and Hogan
1985), not in arc length but in effort, of which a bend costs more than a straight line. A part begins a little before
the one before it has ended (OVERLAP). So the pen slows down in bends, is slow at a corner, rounds it slightly and does
not stop.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache, partial
from itertools import pairwise
from pathlib import Path
from typing import Self

import numpy as np

from ssmail.config import strict_yaml
from ssmail.config.data_sections import LettersSpec
from ssmail.data.trajectories import ExpertSet, Floats, Trajectories, generate_splits

WIDTH, GAP = 0.8, 0.4  # of a letter and between letters
START = np.array([0.2, -0.55])  # where a pen starts, relative to the lower left corner of its letter
LINE = 0.4  # length of the line that a pen draws if it keeps its first velocity
LEAD = 0.24  # share of the time that leads the pen to the letter
REST = 0.3  # of the lead is still to come when the letter's own motion begins, so that the pen does not stop there
WAVES = 3  # sine waves in a wobble
# half-widths of the uniform draws at jitter 1: lengths; scale, pace and tempo as fractions; slant as x per y
SPREADS = {"start": 0.06, "pace": 0.25, "scale": 0.04, "slant": 0.06, "wobble": 0.02, "tempo": 0.08}
POINTS = 120  # of the polyline of a letter
CORNER = 35.0  # degrees: a turn of the polyline that is larger is a corner
BEND = 0.2  # effort of turning by one radian, as a length
OVERLAP = 0.25  # of the shorter of two neighbouring parts
TEMPO = 0.6  # durations of parts grow as their effort to this power: longer ones are drawn faster


def generate(params: LettersSpec) -> ExpertSet:
    """Generate the expert set; equal parameters yield equal arrays."""
    splits = generate_splits(params, partial(_generate_split, params))
    return ExpertSet.bundle(splits, letter_lines(params), {"environment": "letters", **params.model_dump(mode="json")})


@cache
def strokes() -> dict[str, Floats]:
    """Return the polyline (P, 2) of each capital letter, WIDTH wide."""
    read = strict_yaml.read(Path(__file__).with_name("strokes.yaml"))
    return {letter: np.array(points, dtype=np.float64) * [WIDTH, 1.0] for letter, points in read.items()}


def corners(params: LettersSpec) -> Floats:
    """Return the lower left corners (N, 2) of the letters' boxes, WIDTH wide and 1 high."""
    return np.stack([np.arange(len(params.word)) * (WIDTH + GAP), np.zeros(len(params.word))], axis=1)


def first_letter_step(steps: int) -> int:
    """Return the index of the first of the `steps` states that belongs to the letter and not to the way there."""
    return math.ceil(_lead(steps) * (1 - REST / 2))


def letter_lines(params: LettersSpec) -> Floats:
    """Return the letters as drawn without jitter, (N, POINTS, 2), at equal distances along the line."""
    fine = np.linspace(_lead(params.steps) * (1 - REST / 2), params.steps - 1, 2000)
    drawn = _positions(params, fine[None], _still(params, 1))[0]  # (2000, N, 2)
    lengths = [arc_lengths(line) for line in np.moveaxis(drawn, 1, 0)]
    evenly = [along(drawn[:, n], measure, np.linspace(0.0, measure[-1], POINTS)) for n, measure in enumerate(lengths)]
    return np.stack(evenly)


def _lead(steps: int) -> float:
    """Return the number of steps that lead the pen to the letter."""
    return LEAD * (steps - 1)


Jitter = dict[str, Floats]


def _still(params: LettersSpec, count: int) -> Jitter:
    """Return zero jitter: (B, N, ...) for each name in SPREADS, and the phases of the wobble."""
    n = len(params.word)
    shapes = {"start": (2,), "pace": (), "scale": (), "slant": (), "tempo": (), "wobble": (WAVES, 2)}
    return {name: np.zeros((count, n, *shape)) for name, shape in shapes.items()} | {
        "phase": np.zeros((count, n, WAVES, 2))
    }


def _generate_split(params: LettersSpec, count: int, rng: np.random.Generator) -> Trajectories:
    """Generate `count` trajectories; every pen in every trajectory has its own jitter."""
    times = np.tile(np.arange(-1.0, params.steps), (count, 1))  # one step before the first state, for its velocity
    zeros = _still(params, count)
    jitter = {name: rng.uniform(-1, 1, zeros[name].shape) * (SPREADS[name] * params.jitter) for name in SPREADS}
    jitter["phase"] = rng.uniform(0, 2 * np.pi, zeros["phase"].shape)
    positions = _positions(params, times, jitter)
    return Trajectories.single_mode(positions[:, 1:], np.diff(positions, axis=1))


def _positions(params: LettersSpec, times: Floats, jitter: Jitter) -> Floats:
    """Return the positions (B, T, N, 2) of all pens at `times` (B, T)."""
    pens = []
    for n, (letter, box) in enumerate(zip(params.word, corners(params), strict=True)):
        own = {name: value[:, n] for name, value in jitter.items()}
        pens.append(_pen(strokes()[letter], box, params.steps, times, own))
    return np.stack(pens, axis=2)


def _pen(stroke: Floats, box: Floats, steps: int, times: Floats, jitter: Jitter) -> Floats:
    """Return the positions (B, T, 2) of one pen, whose letter has its lower left corner at `box` (2,)."""
    end, lead = steps - 1, _lead(steps)
    # tempo: time runs faster or slower in the middle
    share = np.clip(times / end, 0.0, 1.0)
    warped = times + jitter["tempo"][:, None] * end * np.sin(np.pi * share) / np.pi  # equal at both ends
    # the letter, and the way from the start to its first point
    letter = Timeline.of(stroke, lead * (1 - REST), end).positions(warped)  # (B, T, 2)
    letter, first = (_shaped(points, box, jitter) for points in (letter, np.broadcast_to(stroke[0], letter.shape)))
    velocity = np.stack([LINE / end * (1 + jitter["pace"]), np.zeros(len(times))], axis=-1)
    led = approach(box + START + jitter["start"], velocity, first[:, 0], warped, lead)
    return led + letter - first + _wobble(share, jitter) * progress(share / LEAD)[..., None]


def _shaped(points: Floats, box: Floats, jitter: Jitter) -> Floats:
    """Move points (B, T, 2) of a stroke to their place, scaled about the middle of its foot and slanted."""
    middle = np.array([WIDTH / 2, 0.0])
    centred = (points - middle) * (1 + jitter["scale"][:, None, None])
    slanted = centred[..., 0] + jitter["slant"][:, None] * centred[..., 1]
    shaped: Floats = np.stack([slanted, centred[..., 1]], axis=-1) + middle + box
    return shaped


def _wobble(share: Floats, jitter: Jitter) -> Floats:
    """Return a few slow waves (B, T, 2) with the amplitudes of the jitter; share (B, T) is the fraction of time."""
    wave = np.arange(1, WAVES + 1)[:, None]
    angle = 2 * np.pi * wave * share[:, :, None, None] + jitter["phase"][:, None]  # (B, T, WAVES, 2)
    waves: Floats = (jitter["wobble"][:, None] * np.sin(angle)).sum(axis=2) / np.sqrt(WAVES)
    return waves


def progress(u: Floats) -> Floats:
    """Minimum-jerk profile from 0 at u = 0 to 1 at u = 1, at rest on both ends and outside."""
    v = np.clip(u, 0.0, 1.0)
    return v**3 * (10 - 15 * v + 6 * v**2)


def approach(begin: Floats, velocity: Floats, end: Floats, times: Floats, duration: float) -> Floats:
    """Return the positions (B, T, 2) at `times` (B, T) of pens on their way from `begin` to `end`, both (B, 2).

    They have `velocity` (B, 2) at time 0 and come to rest after `duration`, on the quintic without acceleration on
    either end. Before time 0 the velocity is constant.
    """
    u = np.clip(times / duration, 0.0, 1.0)[..., None]
    coasting = duration * (u - 6 * u**3 + 8 * u**4 - 3 * u**5) + np.minimum(times, 0.0)[..., None]
    positions: Floats = begin[:, None] + (end - begin)[:, None] * progress(u) + velocity[:, None] * coasting
    return positions


def parts_of(stroke: Floats) -> list[Floats]:
    """Cut a stroke (P, 2) at its corners into polylines (P', 2)."""
    corners = [0, *(np.flatnonzero(turns(stroke) > np.deg2rad(CORNER)) + 1), len(stroke) - 1]
    return [stroke[a : b + 1] for a, b in pairwise(corners)]


def turns(line: Floats) -> Floats:
    """Return the angles (P - 2,), 0 to pi, by which a polyline (P, 2) turns at its inner points."""
    step = np.diff(line, axis=0)
    change = np.diff(np.arctan2(step[:, 1], step[:, 0]))
    angles: Floats = np.abs((change + np.pi) % (2 * np.pi) - np.pi)
    return angles


def arc_lengths(line: Floats) -> Floats:
    """Return the distance (P,) of each point of a polyline (P, 2) from the first, along the line."""
    lengths: Floats = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1)))
    return lengths


def efforts(line: Floats) -> Floats:
    """Return the effort (P,) from the first point of a polyline (P, 2) to each: length plus BEND times turning.

    Half of the turning at a point is spent on either side of it.
    """
    turned = np.concatenate([[0.0], turns(line), [0.0]])
    return arc_lengths(line) + BEND * np.append(0.0, np.cumsum((turned[1:] + turned[:-1]) / 2))


def along(line: Floats, measure: Floats, at: Floats) -> Floats:
    """Return the points (..., 2) of a polyline (P, 2) where `measure` (P,), such as `arc_lengths`, equals `at`."""
    return np.stack([np.interp(at, measure, line[:, axis]) for axis in (0, 1)], axis=-1)


@dataclass(frozen=True)
class Timeline:
    """When each part of a stroke begins, and how long it takes, in steps."""

    parts: Sequence[Floats]
    begins: tuple[float, ...]
    durations: tuple[float, ...]

    @classmethod
    def of(cls, stroke: Floats, begin: float, end: float, overlap: float = OVERLAP) -> Self:
        """Return the timeline of a stroke (P, 2) that is drawn from time `begin` to `end`."""
        parts = parts_of(stroke)
        relative = np.array([efforts(part)[-1] for part in parts]) ** TEMPO
        waits = relative[:-1] - overlap * np.minimum(relative[:-1], relative[1:])
        starts = np.append(0.0, np.cumsum(waits))
        unit = (end - begin) / (starts[-1] + relative[-1])
        return cls(parts, tuple((begin + unit * starts).tolist()), tuple((unit * relative).tolist()))

    def positions(self, times: Floats) -> Floats:
        """Return the positions (..., 2) at `times` (...): the first point plus the motion of each part so far."""
        total = np.broadcast_to(self.parts[0][0], (*times.shape, 2)).astype(np.float64)
        for part, begin, duration in zip(self.parts, self.begins, self.durations, strict=True):
            spent = efforts(part)
            total = total + along(part, spent, spent[-1] * progress((times - begin) / duration)) - part[0]
        return total
