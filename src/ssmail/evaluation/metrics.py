"""Metrics of predicted trajectories. Positions are (B, T, N, P) arrays over the predicted steps only (the given start
is left out).
"""

import numpy as np

from ssmail.data.trajectories import Floats, Integers

ON_LANE_TOLERANCE = 0.15  # of the final lane separation
DIVERGED = 10.0  # |scaled position|


def mode_errors(predicted: Floats, continuations: Floats) -> Floats:
    """(L, B) mean squared position error of each trajectory to each mode, the whole group in one mode; continuations
    (L, B, T, N, P).
    """
    with np.errstate(over="ignore", invalid="ignore"):
        errors: Floats = np.square(continuations - predicted[None]).mean(axis=(2, 3, 4))
    return errors


def mode_mse(predicted: Floats, continuations: Floats) -> float:
    """Mean over trajectories of the error to the nearest mode; in scaled units when the positions are scaled."""
    return float(mode_errors(predicted, continuations).min(axis=0).mean())


def nearest_mode(predicted: Floats, continuations: Floats) -> Integers:
    """(B,) index of the mode that each trajectory follows most closely."""
    errors = np.nan_to_num(mode_errors(predicted, continuations), nan=np.inf)
    modes: Integers = errors.argmin(axis=0)
    return modes


def lane_balance(predicted: Floats, continuations: Floats) -> float:
    """Share of the rarest mode over all trajectories: 0 when a mode is never used, 1 / L when all are used equally."""
    counts = np.bincount(nearest_mode(predicted, continuations), minlength=continuations.shape[0])
    return float(counts.min() / counts.sum())


def on_lane(predicted: Floats, continuations: Floats, centre_lines: Floats) -> float:
    """Share of agents whose final position is, sideways, within 15 % of the final lane separation of a lane's centre
    line.

    The separation is the distance between the agent's final positions in the two modes; a centre line (L, P', 2) goes
    on straight after its last point, so being early or late is not counted sideways.
    """
    final = predicted[:, -1]  # (B, N, 2)
    separation = np.linalg.norm(continuations[0, :, -1] - continuations[1, :, -1], axis=-1)
    distance = np.min([distance_to_line(final, line) for line in centre_lines], axis=0)
    return float(np.mean(distance <= ON_LANE_TOLERANCE * separation))


def distance_to_line(points: Floats, line: Floats) -> Floats:
    """Distance (...) of points (..., 2) to a polyline (P', 2) whose last segment is continued as a ray."""
    begin, step = line[:-1], np.diff(line, axis=0)
    offset = points[..., None, :] - begin  # (..., segments, 2)
    along = (offset * step).sum(-1) / np.square(step).sum(-1)
    limit = np.append(np.ones(len(step) - 1), np.inf)
    nearest = offset - np.clip(along, 0, limit)[..., None] * step
    distances: Floats = np.linalg.norm(nearest, axis=-1).min(axis=-1)
    return distances


def lag(predicted: Floats, continuations: Floats) -> float:
    """Mean signed error along the direction of travel of the nearest mode; negative is behind the expert."""
    mode = nearest_mode(predicted, continuations)
    target = continuations[mode, np.arange(len(mode))]
    travel = np.gradient(target, axis=1)
    direction = travel / np.maximum(np.linalg.norm(travel, axis=-1, keepdims=True), 1e-12)
    return float(((predicted - target) * direction).sum(axis=-1).mean())


def displacement_errors(samples: Floats, expert: Floats) -> tuple[Floats, Floats]:
    """Average and final displacement error, both (S, B), of samples (S, B, T, N, P) to the expert's trajectory (B, T,
    N, P).
    """
    distance = np.linalg.norm(samples - expert[None], axis=-1)
    return distance.mean(axis=(2, 3)), distance[:, :, -1].mean(axis=2)


def diverged(scaled: Floats) -> float:
    """Share of trajectories with a non-finite or |scaled| > 10 position."""
    bad = ~np.isfinite(scaled) | (np.abs(scaled) > DIVERGED)
    return float(bad.any(axis=tuple(range(1, scaled.ndim))).mean())
