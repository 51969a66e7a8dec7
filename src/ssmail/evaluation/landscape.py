"""The plane on which a learned reward is looked at, and what its slope is worth (section 1 with Figure 1; 3.1.3 with
Figure 2). Everything is in scaled units; docs/paper.md says why each number is defined as it is.
"""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from ssmail.data.trajectories import Floats

CELLS = 36  # of the grid along the longer side of the plane
MARGIN = 0.15  # of the plane around the expert's bounding box, as a share of the box's longer side
USABLE = 0.25  # a slope is usable from this fraction of the even slope on
NEAR = 0.1  # expert states that are nearer than this have about the same weight
PROGRESS = 0.5  # what the whole way along the stroke is worth in the ideal reward, scaled units


@dataclass(frozen=True, eq=False)
class Plane:
    """A grid with one spacing on both axes. x: (W,), y: (H,), rising."""

    x: Floats
    y: Floats

    @classmethod
    def around(cls, positions: Floats) -> "Plane":
        """The grid over the bounding box of positions (..., 2) and MARGIN more on each side."""
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
        """The distance between neighbours."""
        return float(self.x[1] - self.x[0])

    @property
    def diagonal(self) -> float:
        """The longest distance in the plane."""
        return float(np.hypot(np.ptp(self.x), np.ptp(self.y)))

    @property
    def points(self) -> Floats:
        """(H, W, 2)."""
        return np.stack(np.meshgrid(self.x, self.y), axis=-1)


def slope_share(reward: Floats, gradient: Floats, plane: Plane, usable: float = USABLE) -> float:
    """Share of the plane where the slope of `reward` (..., H, W), the norm of its gradient (..., H, W, 2), is usable:
    at least `usable` times the even slope, the reward's range on the plane divided by the plane's diagonal.

    Each agent (leading axes) has its own even slope; the mean over agents is returned. A reward that rises evenly, in
    whatever direction, has share 1, a step only the band of the step; a factor or a constant changes nothing.
    """
    even = np.ptp(reward, axis=(-2, -1)) / plane.diagonal
    slopes = np.linalg.norm(gradient, axis=-1)
    return float(np.mean((slopes >= usable * even[..., None, None]) & (slopes > 0)))


def cosines(gradient: Floats, direction: Floats) -> Floats:
    """(...) cosines between vectors (..., 2); 0 where the gradient is nil, for there it points nowhere."""
    lengths = np.linalg.norm(gradient, axis=-1) * np.linalg.norm(direction, axis=-1)
    inner = (gradient * direction).sum(axis=-1)
    found: Floats = np.divide(inner, lengths, out=np.zeros_like(inner), where=lengths > 0)
    return found


def mean_cosine(gradient: Floats, direction: Floats, least: float) -> float:
    """Mean cosine between `gradient` and `direction` (..., 2), over the points from which it is at least `least` to
    go; NaN when there are none.
    """
    far = np.linalg.norm(direction, axis=-1) >= least
    return float(cosines(gradient, direction)[far].mean()) if far.any() else float("nan")


def nearest_points(points: Floats, track: Floats) -> Floats:
    """(..., 2) the position of `track` (M, 2) that is nearest to each of `points` (..., 2)."""
    found: Floats = track[cKDTree(track).query(points)[1]]
    return found


def closeness(points: Floats, places: Floats) -> Floats:
    """(..., K) weights of `places` (K, 2) for each of `points` (..., 2): the inverse square of d**2 + NEAR**2, with d
    the distance; their sum is 1.
    """
    squares = np.square(points[..., None, :] - places).sum(axis=-1) + NEAR**2
    weights = np.square(squares.min(axis=-1, keepdims=True) / squares)
    normal: Floats = weights / weights.sum(axis=-1, keepdims=True)
    return normal


def ideal_reward(plane: Plane, expert: Floats) -> Floats:
    """(H, W) the reward of Figure 1b for one agent, from expert positions (R, T, 2): minus the distance to the nearest
    expert position, plus PROGRESS times the fraction of its trajectory's length that lies behind that position.
    """
    moves = np.linalg.norm(np.diff(expert, axis=1), axis=-1)
    done = np.concatenate([np.zeros((len(expert), 1)), np.cumsum(moves, axis=1)], axis=1)
    progress = (done / np.maximum(done[:, -1:], 1e-12)).reshape(-1)
    track, points = expert.reshape(-1, 2), plane.points
    distance, index = cKDTree(track).query(points)
    reward: Floats = PROGRESS * progress[index] - distance
    return reward
