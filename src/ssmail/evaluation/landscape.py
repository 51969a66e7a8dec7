"""The plane on which a reward landscape is computed, and measures of its slope.

Section 1 with Figure 1, and section 3.1.3 with Figure 2. Everything is in scaled units. docs/paper.md explains the
definition of each measure.
"""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from ssmail.data.trajectories import Floats

CELLS = 36  # grid cells along the longer side of the plane
MARGIN = 0.15  # around the expert's bounding box, as a share of the box's longer side
USABLE = 0.25  # the fraction of the even slope from which a slope counts as usable
NEAR = 0.1  # expert states closer than this have about the same weight
PROGRESS = 0.5  # reward for the whole way along the stroke in the ideal reward, in scaled units


@dataclass(frozen=True, eq=False)
class Plane:
    """A grid with the same spacing on both axes. x: (W,), y: (H,), both ascending."""

    x: Floats
    y: Floats

    @classmethod
    def around(cls, positions: Floats) -> "Plane":
        """Make the grid over the bounding box of positions (..., 2), extended by MARGIN on each side."""
        flat = positions.reshape(-1, 2)
        low, high = flat.min(axis=0), flat.max(axis=0)
        sides = (high - low) + 2 * MARGIN * (high - low).max()
        spacing = sides.max() / CELLS
        axes = [
            middle + spacing * (np.arange(np.ceil(side / spacing) + 1) - np.ceil(side / spacing) / 2)
            for middle, side in zip((low + high) / 2, sides, strict=True)
        ]
        return cls(*axes)

    @property
    def spacing(self) -> float:
        """The distance between neighboring points."""
        return float(self.x[1] - self.x[0])

    @property
    def diagonal(self) -> float:
        """The largest distance in the plane."""
        return float(np.hypot(np.ptp(self.x), np.ptp(self.y)))

    @property
    def points(self) -> Floats:
        """The grid points (H, W, 2)."""
        return np.stack(np.meshgrid(self.x, self.y), axis=-1)


def slope_share(reward: Floats, gradient: Floats, plane: Plane, usable: float = USABLE) -> float:
    """Share of the plane where the reward's slope, the norm of its `gradient` (..., H, W, 2), is usable.

    A slope is usable if it is at least `usable` times the even slope: the range of `reward` (..., H, W) on the plane
    divided by the plane's diagonal. Each agent (leading axes) has its own even slope; the result is the mean over
    agents. A reward that rises evenly in any direction has share 1, a step function only the band of the step. The
    share does not change with the reward's scale or offset.
    """
    even = np.ptp(reward, axis=(-2, -1)) / plane.diagonal
    slopes = np.linalg.norm(gradient, axis=-1)
    return float(np.mean((slopes >= usable * even[..., None, None]) & (slopes > 0)))


def cosines(gradient: Floats, direction: Floats) -> Floats:
    """Return the cosines (...) between vectors (..., 2); 0 where the gradient is zero and has no direction."""
    lengths = np.linalg.norm(gradient, axis=-1) * np.linalg.norm(direction, axis=-1)
    inner = (gradient * direction).sum(axis=-1)
    found: Floats = np.divide(inner, lengths, out=np.zeros_like(inner), where=lengths > 0)
    return found


def mean_cosine(gradient: Floats, direction: Floats, least: float) -> float:
    """Mean cosine between `gradient` and `direction` (..., 2) where `direction` is at least `least` long; else NaN."""
    far = np.linalg.norm(direction, axis=-1) >= least
    return float(cosines(gradient, direction)[far].mean()) if far.any() else float("nan")


def nearest_points(points: Floats, track: Floats) -> Floats:
    """Return the position (..., 2) of `track` (M, 2) nearest to each of `points` (..., 2)."""
    found: Floats = track[cKDTree(track).query(points)[1]]
    return found


def closeness(points: Floats, places: Floats) -> Floats:
    """Return weights (..., K) of `places` (K, 2) for `points` (..., 2): (d**2 + NEAR**2)**-2, normalized to sum 1."""
    squares = np.square(points[..., None, :] - places).sum(axis=-1) + NEAR**2
    weights = np.square(squares.min(axis=-1, keepdims=True) / squares)
    normal: Floats = weights / weights.sum(axis=-1, keepdims=True)
    return normal


def ideal_reward(plane: Plane, expert: Floats) -> Floats:
    """Return the reward (H, W) of Figure 1b for one agent, from expert positions (R, T, 2).

    It is minus the distance to the nearest expert position, plus PROGRESS times the fraction of that trajectory's
    length that lies behind this position.
    """
    moves = np.linalg.norm(np.diff(expert, axis=1), axis=-1)
    done = np.concatenate([np.zeros((len(expert), 1)), np.cumsum(moves, axis=1)], axis=1)
    progress = (done / np.maximum(done[:, -1:], 1e-12)).reshape(-1)
    track, points = expert.reshape(-1, 2), plane.points
    distance, index = cKDTree(track).query(points)
    reward: Floats = PROGRESS * progress[index] - distance
    return reward
