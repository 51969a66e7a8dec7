"""Rows as tracks: each agent's uninterrupted run of steps in a scene.

The frames of a scene may be numbered in steps, such as 0, 10, 20; the step is the one most often found from one row of
an agent to its next. In the tracks, frames are counted in such steps.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ssmail.data.importing.rows import MOST_ROWS, Codes, Rows, quoted
from ssmail.data.trajectories import Floats, Integers
from ssmail.errors import InputError

LARGEST_FRAME = 2**40
ROUNDING = 0.05  # of a frame that is given as a time
JUMP = 100  # times the median speed


@dataclass(frozen=True)
class Tracks:
    """K tracks in the order of scene, agent and time, on positions (R, P) that lie one track after the other.

    scene, agent: (K,). begin: (K,) the first step of each in its scene. length: (K,) its frames. row: (K,) the index of
    its first position. first, step: (scenes,) the frame of step 0, and how far it is from one step to the next.
    """

    scene: Codes
    agent: Codes
    begin: Integers
    length: Integers
    row: Integers
    positions: Floats
    first: Integers
    step: Integers

    def __getitem__(self, index: Integers | NDArray[np.bool_]) -> "Tracks":
        """Return some of the tracks, on the same positions."""
        per_track = ("scene", "agent", "begin", "length", "row")
        return replace(self, **{name: getattr(self, name)[index] for name in per_track})

    def between(self, begin: Integers, end: Integers) -> "Tracks":
        """Return the tracks within the steps [begin, end) of each scene (scenes,)."""
        first = np.maximum(self.begin, begin[self.scene])
        length = np.minimum(self.begin + self.length, end[self.scene]) - first
        return replace(self, begin=first, length=length, row=self.row + first - self.begin)[length > 0]


@dataclass(frozen=True)
class Repairs:
    """What became of the rows: frames interpolated in so many gaps, tracks cut at others, rows between the steps.

    measured: (R,) which positions of the tracks are of rows, and not interpolated.
    """

    gaps_filled: int
    frames_filled: int
    gaps_cut: int
    off_step: int
    measured: NDArray[np.bool_]


def make_tracks(rows: Rows, dt: float | None, fill_gaps: int) -> tuple[Tracks, Repairs]:
    """Sort the rows into tracks. A gap of up to `fill_gaps` frames is interpolated linearly, a longer one cuts a track.

    dt: seconds of a frame; then the frames may be times. Raises InputError for a frame that is no whole number, an
    agent that is twice in a frame, and a scene with a single frame.
    """
    frame = _whole_frames(rows, dt)
    order = np.lexsort((frame, rows.agent, rows.scene))
    scene, agent, frame = rows.scene[order], rows.agent[order], frame[order]
    same = (np.diff(scene) == 0) & (np.diff(agent) == 0)
    ahead = np.diff(frame)
    if (twice := same & (ahead == 0)).any():
        raise _duplicate(rows, order, int(twice.argmax()))
    first, last = _extent(scene, frame, len(rows.scenes))
    if (single := first == last).any():
        raise _single_frame(rows, int(single.argmax()))

    # the steps of each scene, and the rows on them
    step = _most_frequent(scene[1:][same], ahead[same], len(rows.scenes))
    rest = (frame - first[scene]) % step[scene]
    phase = _most_frequent(scene, rest + 1, len(rows.scenes)) - 1
    first = first + phase
    on = rest == phase[scene]
    order, scene, agent, frame = order[on], scene[on], agent[on], frame[on]
    tick = (frame - first[scene]) // step[scene]
    positions = rows.positions[order]

    # gaps
    same = (np.diff(scene) == 0) & (np.diff(agent) == 0)
    missing = np.where(same, np.diff(tick) - 1, 0)
    filled = (missing > 0) & (missing <= fill_gaps)
    repeats = np.ones(len(tick), dtype=np.int64)
    repeats[:-1][filled] += missing[filled]
    if repeats.sum() > MOST_ROWS:
        raise InputError(f"filled gaps make more than {MOST_ROWS:,} rows; lower --fill-gaps")
    breaks = np.flatnonzero(np.append(True, ~same | (missing > fill_gaps)))
    length = np.add.reduceat(repeats, breaks)
    measured = np.zeros(int(repeats.sum()), dtype=bool)
    measured[np.cumsum(repeats) - repeats] = True
    repairs = Repairs(
        *(int(filled.sum()), int(missing[filled].sum()), int((missing > fill_gaps).sum())),
        *(len(rows) - len(order), measured),
    )
    tracks = Tracks(
        *(scene[breaks], agent[breaks], tick[breaks], length, np.cumsum(length) - length),
        *(_interpolated(positions, repeats), first, step),
    )
    return tracks, repairs


def has_times(rows: Rows) -> bool:
    """Return whether the frames are times, which not all are whole numbers."""
    return bool((rows.frame % 1 != 0).any())


def _whole_frames(rows: Rows, dt: float | None) -> Integers:
    """Return the frames as whole numbers; times become numbers of frames."""
    frame = rows.frame
    if has_times(rows):
        counted = frame / (dt or 1.0)
        frame = np.rint(counted)
        wrong = np.abs(counted - frame) > (ROUNDING if dt else 0)
        if wrong.any():
            row = int(wrong.argmax())
            remedy = f"that is no multiple of --dt {dt:g}" if dt else "for times, give the seconds of a frame with --dt"
            raise InputError(f"{rows.place(row)}: the frame {rows.frame[row]:.10g} is no whole number; {remedy}")
    if (wrong := (frame < 0) | (frame >= LARGEST_FRAME)).any():
        row = int(wrong.argmax())
        raise InputError(
            f"{rows.place(row)}: the frame {rows.frame[row]:.10g} is out of range; number frames from 0 on"
        )
    return frame.astype(np.int64)


def _duplicate(rows: Rows, order: Integers, index: int) -> InputError:
    one, other = sorted(order[index : index + 2].tolist())
    who = f"agent {quoted(rows.agents[rows.agent[one]])} in frame {rows.frame[one]:.15g}"
    where = f"of scene {quoted(rows.scenes[rows.scene[one]])}"
    return InputError(
        f"{rows.place(other)}: {who} {where} is there already ({rows.place(one)}); leave one out, or name the column "
        "that tells scenes apart with --scene"
    )


def _single_frame(rows: Rows, scene: int) -> InputError:
    row = int((rows.scene == scene).argmax())
    return InputError(
        f"{rows.place(row)}: the scene {quoted(rows.scenes[scene])} has one frame only, so nothing moves in it; leave "
        "it out, or name the right columns with --scene and --frame"
    )


def _extent(scene: Codes, frame: Integers, count: int) -> tuple[Integers, Integers]:
    """Return the first and the last frame of each scene. scene: (R,) sorted, every scene occurs."""
    starts = np.searchsorted(scene, np.arange(count))
    return np.minimum.reduceat(frame, starts), np.maximum.reduceat(frame, starts)


def _most_frequent(scene: Codes, value: Integers, count: int) -> Integers:
    """Return the value that each scene has most often, the least of several; 1 for a scene without any."""
    found = np.ones(count, dtype=np.int64)
    if len(value):
        size = int(value.max()) + 1
        pairs, times = np.unique(scene.astype(np.int64) * size + value, return_counts=True)
        order = np.lexsort((-pairs, times))  # the last of a scene counts
        found[pairs[order] // size] = pairs[order] % size
    return found


def _interpolated(positions: Floats, repeats: Integers) -> Floats:
    """Put repeats - 1 positions between each one and its next, at equal distances."""
    if len(positions) == repeats.sum():
        return positions
    source = np.repeat(np.arange(len(positions)), repeats)
    begin = np.repeat(np.cumsum(repeats) - repeats, repeats)
    share = ((np.arange(len(source)) - begin) / repeats[source])[:, None]
    following = np.minimum(source + 1, len(positions) - 1)
    between: Floats = positions[source] + share * (positions[following] - positions[source])
    return between


def speeds(tracks: Tracks) -> tuple[Floats, Integers]:
    """Return the distances from one step to the next, within tracks, and the index of the position each starts from."""
    distance = np.linalg.norm(np.diff(tracks.positions, axis=0), axis=-1)
    inside = np.ones(len(distance), dtype=bool)
    inside[tracks.row[1:] - 1] = False
    return distance[inside], np.flatnonzero(inside)
