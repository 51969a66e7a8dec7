"""How far drawn letters are from the letters that were meant."""

import numpy as np

from ssmail.data.trajectories import Floats


@np.errstate(over="ignore", invalid="ignore")
def stroke_distances(drawn: Floats, letters: Floats) -> Floats:
    """(B, N) distance between what each agent drew and its letter, in their units.

    drawn: (B, T, N, 2) positions of the steps that belong to the letter. letters: (N, P', 2) polylines with points at
    equal distances. The distance is the larger of two means: from each drawn point to the nearest place of the letter
    (nothing may be drawn beside it), and from each point of the letter to the nearest place of the drawn line (nothing
    may be left out): the modified Hausdorff distance (Dubuisson and Jain 1994). The order and the tempo of drawing do
    not count. A drawing with a non-finite point is NaN.
    """
    paths = np.moveaxis(drawn, 2, 0)  # (N, B, T, 2)
    found = np.empty(paths.shape[:2])
    for n, letter in enumerate(letters):
        beside = polyline_distances(paths[n], letter).mean(axis=-1)
        for b, path in enumerate(paths[n]):
            found[n, b] = np.maximum(beside[b], polyline_distances(letter, path).mean())
    return found.T


def polyline_distances(points: Floats, line: Floats) -> Floats:
    """(...) distances of points (..., 2) to a polyline (P', 2), which may stand still in places."""
    begin, step = line[:-1], np.diff(line, axis=0)
    offset = points[..., None, :] - begin  # (..., segments, 2)
    along = (offset * step).sum(-1) / np.maximum(np.square(step).sum(-1), np.finfo(np.float64).tiny)
    nearest = offset - np.clip(along, 0.0, 1.0)[..., None] * step
    distances: Floats = np.sqrt(np.square(nearest).sum(-1).min(axis=-1))
    return distances
