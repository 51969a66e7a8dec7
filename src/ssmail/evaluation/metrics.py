"""Metrics of predicted trajectories: first the metrics that each environment reports, then the measures behind them.

Positions are arrays (B, T, N, P) in raw units unless a docstring says that they are scaled; S samples of each add a
leading axis. The measures take predicted steps only, without the given start.
"""

import numpy as np

from ssmail.data.scaling import Scaling
from ssmail.data.trajectories import Floats, Integers, Trajectories

ON_LANE_TOLERANCE = 0.15  # of the final lane separation
DIVERGED = 10.0  # |scaled position|
FORECAST_STEPS = (1, 10, 20, 40, 48)  # predicted steps whose error is a metric of its own


# -- reported metrics --------------------------------------------------------------------------------------------------


def lane_metrics(predicted: Floats, continuations: Floats, centre_lines: Floats, scaling: Scaling) -> dict[str, float]:
    """Y-Junction: the metrics of every epoch.

    predicted (B, T, N, P) holds one rollout per start, and continuations (L, B, T, N, P) the expert from that start
    into each mode; both include the start. mode_mse and lag are in scaled units; on_lane, lane_balance and diverged are
    shares.
    """
    rollout, modes = predicted[:, 1:], continuations[:, :, 1:]
    scaled, scaled_modes = scaling.scale_positions(rollout), scaling.scale_positions(modes)
    return {
        "mode_mse": mode_mse(scaled, scaled_modes),
        "on_lane": on_lane(rollout, modes, centre_lines),
        "lane_balance": lane_balance(rollout, modes),
        "lag": lag(scaled, scaled_modes),
        "diverged": diverged(scaled),
    }


def lane_test_metrics(samples: Floats, truth: Trajectories, centre_lines: Floats, scaling: Scaling) -> dict[str, float]:
    """Y-Junction: the metrics of the final evaluation, from samples (S, B, T, N, P) that include the start.

    All S rollouts of all starts enter `lane_metrics`, and ade and fde (raw units). min_ade_20 and min_fde_20 take the
    best of the S samples of each start.
    """
    s, b = samples.shape[:2]
    continuations = np.tile(truth.continuations, (1, s, 1, 1, 1))
    values = lane_metrics(samples.reshape(s * b, *samples.shape[2:]), continuations, centre_lines, scaling)
    ade, fde = displacement_errors(samples[:, :, 1:], truth.positions[:, 1:])
    return values | {
        "ade": float(ade.mean()),
        "fde": float(fde.mean()),
        "min_ade_20": float(ade.min(axis=0).mean()),
        "min_fde_20": float(fde.min(axis=0).mean()),
    }


@np.errstate(over="ignore", invalid="ignore")
def forecast_metrics(predicted: Floats, truth: Floats, scaling: Scaling) -> tuple[dict[str, float], dict[str, Floats]]:
    """Recorded motion: the metrics of predicted states, and their error per predicted step.

    predicted (S, B, T, N, 2P) and truth (B, T, N, 2P) are scaled states. mse is the mean squared error over all
    features (six for recorded motion: DNRI's protocol), samples, windows, steps and agents; mse_h is the error of step
    h = 1 .. T; ade and fde are the mean and the final distance in raw units; diverged is the share of predictions with
    a non-finite or |scaled| > 10 position. Arrays: mse (T,), and mse_spread (T,), the standard deviation (n - 1) over
    windows of their mean over samples.
    """
    errors = np.square(predicted - truth).mean(axis=(-2, -1))  # (S, B, T)
    curve, windows = errors.mean(axis=(0, 1)), errors.mean(axis=0)
    axes = truth.shape[-1] // 2
    raw = scaling.unscale_positions(predicted[..., :axes]), scaling.unscale_positions(truth[..., :axes])
    ade, fde = displacement_errors(*raw)
    values = {"mse": float(curve.mean()), "ade": float(ade.mean()), "fde": float(fde.mean())}
    values |= {f"mse_{h}": float(curve[h - 1]) for h in FORECAST_STEPS if h <= len(curve)}
    values["diverged"] = diverged(predicted[..., :axes].reshape(-1, *predicted.shape[2:-1], axes))
    spread = windows.std(axis=0, ddof=1) if len(windows) > 1 else np.full(len(curve), np.nan)
    return values, {"mse": curve.astype(np.float64), "mse_spread": spread.astype(np.float64)}


def letter_metrics(
    predicted: Floats, truth: Floats, letters: Floats, first_letter_step: int, scaling: Scaling
) -> dict[str, float]:
    """Letters: the metrics of drawn letters.

    predicted (S, B, T, N, 4) and truth (B, T, N, 4) are scaled states that include the start; letters (N, P', 2) are
    raw polylines. mse, mse_h, ade, fde and diverged are those of `forecast_metrics` over the predicted steps
    1 .. T - 1. stroke_distance, in letter heights (the raw unit), is a mean over samples, starts and agents, and
    stroke_distance_n that of agent n = 0 .. N - 1; both read the states from `first_letter_step` on.
    """
    values, _ = forecast_metrics(predicted[:, :, 1:], truth[:, 1:], scaling)
    drawn = scaling.unscale_positions(predicted[:, :, first_letter_step:, :, :2])
    found = stroke_distances(drawn.reshape(-1, *drawn.shape[2:]), letters).mean(axis=0)  # (N,)
    values["stroke_distance"] = float(found.mean())
    return values | {f"stroke_distance_{n}": float(distance) for n, distance in enumerate(found)}


def one_step_mse(predicted: Floats, truth: Floats) -> float:
    """Mean squared error of one-step predictions from the true past; both (B, T, N, D), scaled states."""
    return float(np.square(predicted - truth).mean())


# -- measures ----------------------------------------------------------------------------------------------------------


def mode_errors(predicted: Floats, continuations: Floats) -> Floats:
    """Return the mean squared position error (L, B) of each trajectory to each mode, the whole group in one mode.

    predicted is (B, T, N, P), continuations (L, B, T, N, P).
    """
    with np.errstate(over="ignore", invalid="ignore"):
        errors: Floats = np.square(continuations - predicted[None]).mean(axis=(2, 3, 4))
    return errors


def mode_mse(predicted: Floats, continuations: Floats) -> float:
    """Mean over trajectories of the error to the nearest mode; in scaled units when the positions are scaled."""
    return float(mode_errors(predicted, continuations).min(axis=0).mean())


def nearest_mode(predicted: Floats, continuations: Floats) -> Integers:
    """Return the index (B,) of the mode that each trajectory follows most closely."""
    errors = np.nan_to_num(mode_errors(predicted, continuations), nan=np.inf)
    modes: Integers = errors.argmin(axis=0)
    return modes


def lane_balance(predicted: Floats, continuations: Floats) -> float:
    """Share of the rarest mode among all trajectories: 0 if a mode is never used, 1 / L if all are used equally."""
    counts = np.bincount(nearest_mode(predicted, continuations), minlength=continuations.shape[0])
    return float(counts.min() / counts.sum())


def on_lane(predicted: Floats, continuations: Floats, centre_lines: Floats) -> float:
    """Share of agents that end within 15 % of the final lane separation of a lane's centre line, measured sideways.

    The separation is the distance between the agent's final positions in the two modes. A centre line (L, P', 2) is
    extended beyond its last point, so an early or late agent does not count as beside the lane.
    """
    final = predicted[:, -1]  # (B, N, 2)
    separation = np.linalg.norm(continuations[0, :, -1] - continuations[1, :, -1], axis=-1)
    distance = np.min([polyline_distances(final, line, extended=True) for line in centre_lines], axis=0)
    return float(np.mean(distance <= ON_LANE_TOLERANCE * separation))


def lag(predicted: Floats, continuations: Floats) -> float:
    """Mean signed error along the direction of travel of the nearest mode; negative means behind the expert."""
    mode = nearest_mode(predicted, continuations)
    target = continuations[mode, np.arange(len(mode))]
    travel = np.gradient(target, axis=1)
    direction = travel / np.maximum(np.linalg.norm(travel, axis=-1, keepdims=True), 1e-12)
    return float(((predicted - target) * direction).sum(axis=-1).mean())


def displacement_errors(samples: Floats, expert: Floats) -> tuple[Floats, Floats]:
    """Return average and final displacement errors, both (S, B), of samples (S, B, T, N, P) to expert (B, T, N, P)."""
    distance = np.linalg.norm(samples - expert[None], axis=-1)
    return distance.mean(axis=(2, 3)), distance[:, :, -1].mean(axis=2)


def diverged(scaled: Floats) -> float:
    """Share of trajectories (B, ...) with a position that is not finite or above DIVERGED in size."""
    bad = ~np.isfinite(scaled) | (np.abs(scaled) > DIVERGED)
    return float(bad.any(axis=tuple(range(1, scaled.ndim))).mean())


@np.errstate(over="ignore", invalid="ignore")
def stroke_distances(drawn: Floats, letters: Floats) -> Floats:
    """Return the distance (B, N) between what each agent drew and its letter, in their units.

    drawn (B, T, N, 2) holds the positions of the steps that belong to the letter; letters (N, P', 2) are polylines with
    equidistant points. The distance is the modified Hausdorff distance (Dubuisson and Jain 1994): the larger of the
    mean distance from the drawn points to the letter (nothing may be drawn beside it) and the mean distance from the
    letter's points to the drawn line (nothing may be left out). The order and the tempo of drawing do not count. A
    drawing with a non-finite point has distance NaN.
    """
    paths = np.moveaxis(drawn, 2, 0)  # (N, B, T, 2)
    found = np.empty(paths.shape[:2])
    for n, letter in enumerate(letters):
        beside = polyline_distances(paths[n], letter).mean(axis=-1)
        for b, path in enumerate(paths[n]):
            found[n, b] = np.maximum(beside[b], polyline_distances(letter, path).mean())
    return found.T


def polyline_distances(points: Floats, line: Floats, extended: bool = False) -> Floats:
    """Return the distances (...) of points (..., 2) to a polyline (P', 2), which may have segments of length 0.

    With `extended` the last segment continues as a ray.
    """
    begin, step = line[:-1], np.diff(line, axis=0)
    limit = np.append(np.ones(len(step) - 1), np.inf if extended else 1.0)
    offset = points[..., None, :] - begin  # (..., segments, 2)
    along = (offset * step).sum(-1) / np.maximum(np.square(step).sum(-1), np.finfo(np.float64).tiny)
    nearest = offset - np.clip(along, 0.0, limit)[..., None] * step
    distances: Floats = np.sqrt(np.square(nearest).sum(-1).min(axis=-1))
    return distances
