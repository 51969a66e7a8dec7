"""Metrics of predicted trajectories: first the metrics that each environment reports, then the measures behind them.

Positions are arrays (B, T, N, P) in raw units unless a docstring says that they are scaled; S samples of each add a
leading axis. The measures take predicted steps only, without the given start.
"""

import numpy as np

from ssmail.data.scaling import Scaling
from ssmail.data.trajectories import Booleans, Floats, Integers, Trajectories

ON_LANE_TOLERANCE = 0.15  # of the final lane separation
ON_PATH_TOLERANCE = 1.0  # step lengths; the expert stays within 0.6
TURNED = (
    1.5  # step lengths sideways of its start, at which an agent has turned; where it turns is in ssmail.data.yjunction
)
TURNING = ("turn_own", "turn_others", "turn_group", "turn_lead")
BETWEEN = 0.25  # of the final lane separation, from the middle: as far from there as from a lane
DIVERGED = 10.0  # |scaled position|
BLOCK = 2**14  # distances that are computed at a time
FORECAST_STEPS = (1, 10, 20, 40, 48)  # predicted steps whose error is a metric of its own


# -- reported metrics --------------------------------------------------------------------------------------------------


def lane_metrics(predicted: Floats, continuations: Floats, centre_lines: Floats, scaling: Scaling) -> dict[str, float]:
    """Y-Junction: the metrics of every epoch.

    predicted (B, T, N, P) holds one rollout per start, and continuations (L, B, T, N, P) the expert from that start
    into each mode; both include the start. mode_mse and lag are in scaled units, path_rms in step lengths; on_lane,
    between_lanes, on_path, lane_balance and diverged are shares.
    """
    rollout, modes = predicted[:, 1:], continuations[:, :, 1:]
    scaled, scaled_modes = scaling.scale_positions(rollout), scaling.scale_positions(modes)
    return {
        "mode_mse": mode_mse(scaled, scaled_modes),
        "on_lane": on_lane(rollout, modes, centre_lines),
        "between_lanes": between_lanes(rollout, modes),
        **path_metrics(rollout, centre_lines),
        "lane_balance": lane_balance(rollout, modes),
        "lag": lag(scaled, scaled_modes),
        "diverged": diverged(scaled),
    }


def lane_test_metrics(samples: Floats, truth: Trajectories, centre_lines: Floats, scaling: Scaling) -> dict[str, float]:
    """Y-Junction: the metrics of the final evaluation, from samples (S, B, T, N, P) that include the start.

    All S rollouts of all starts enter `lane_metrics`, `turning`, and ade and fde (raw units). min_ade_20 and min_fde_20
    take the best of the S samples of each start.
    """
    s, b = samples.shape[:2]
    continuations = np.tile(truth.continuations, (1, s, 1, 1, 1))
    rollouts = samples.reshape(s * b, *samples.shape[2:])
    values = lane_metrics(rollouts, continuations, centre_lines, scaling) | turning(rollouts, continuations)
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


@np.errstate(over="ignore", invalid="ignore", divide="ignore")
def between_lanes(predicted: Floats, continuations: Floats) -> float:
    """Share of agents that end nearer to the middle between their two lanes than to either: what averaging leads to.

    Measured along the line between the agent's final positions in the two modes. predicted is (B, T, N, 2), or
    (S, B, T, N, 2). An agent whose position is not finite does not count as between the lanes.
    """
    one, other = continuations[:2, :, -1]  # (B, N, 2) each
    separation, offset = other - one, predicted[..., -1, :, :] - (one + other) / 2
    place = (offset * separation).sum(axis=-1) / np.square(separation).sum(axis=-1)  # -1/2 and 1/2 on the lanes
    return float(np.mean(np.abs(place) < BETWEEN))


@np.errstate(over="ignore", invalid="ignore")
def path_metrics(predicted: Floats, centre_lines: Floats) -> dict[str, float]:
    """Return how far agents go sideways of the lanes on their whole path, from positions (B, T, N, 2) in step lengths.

    on_path: share of agents that are `stays_on_path`. path_rms: root mean square of the `path_distances`, inf if a
    position is not finite. Neither sees tempo: an agent that stands still on the street is on its path.
    """
    own = path_distances(predicted, centre_lines)
    return {"on_path": float(stays_on_path(own).mean()), "path_rms": float(np.sqrt(np.square(own).mean()))}


def stays_on_path(distances: Floats) -> Booleans:
    """Return (B, N) whether an agent stays within ON_PATH_TOLERANCE at every step, from its `path_distances`."""
    stays: Booleans = distances.max(axis=1) <= ON_PATH_TOLERANCE
    return stays


@np.errstate(over="ignore", invalid="ignore")
def path_distances(predicted: Floats, centre_lines: Floats) -> Floats:
    """Return the distances (B, T, N) of positions (B, T, N, 2) from each agent's own centre line of (L, P', 2).

    It is the one that the agent's path is nearest to, in the mean square, and goes on beyond its last point. A position
    that is not finite is infinitely far away.
    """
    distances = np.stack([polyline_distances(predicted, corners(line), extended=True) for line in centre_lines])
    distances = np.nan_to_num(distances, nan=np.inf)  # (L, B, T, N)
    lane = np.square(distances).mean(axis=2, keepdims=True).argmin(axis=0, keepdims=True)
    own: Floats = np.take_along_axis(distances, lane, axis=0)[0]
    return own


@np.errstate(over="ignore", invalid="ignore")
def turning(predicted: Floats, continuations: Floats) -> dict[str, float]:
    """Return when agents turn into a lane, from positions (B, T, N, 2) in step lengths that include the start.

    An agent turns at the (interpolated) step at which it is TURNED sideways of its start. A least-squares fit over the
    B trajectories gives how much later it turns when an agent starts one step length further ahead: the agent itself
    (turn_own), one of the others (turn_others), or all of them (turn_group); each is a mean over agents. The expert of
    the Y-Junction has -1 / speed, 0 and -1 / speed, because its agents turn where the road does. A group that turns by
    the clock has 0, 0 and 0; if the followers copy the leader, turn_own is small. turn_lead is the mean number of steps
    by which agents turn before the expert, in the mode nearest to the trajectory. Trajectories in which an agent does
    not turn are left out. All values are NaN if fewer than 2 (N + 1) trajectories remain, or if their starts do not
    tell the agents apart.
    """
    modes = nearest_mode(predicted, continuations)
    target = continuations[modes, np.arange(len(modes))]
    when, expert = turn_steps(predicted), turn_steps(target)  # (B, N)
    known = np.isfinite(when).all(axis=1) & np.isfinite(expert).all(axis=1)
    agents = when.shape[1]
    if known.sum() < 2 * (agents + 1):
        return dict.fromkeys(TURNING, float("nan"))
    starts = predicted[known, 0, :, 0]  # along the street, (B', N)
    design = np.concatenate([starts - starts.mean(axis=0), np.ones((len(starts), 1))], axis=1)
    fit, _, rank, _ = np.linalg.lstsq(design, when[known], rcond=None)
    if rank <= agents:
        return dict.fromkeys(TURNING, float("nan"))
    slopes = fit[:agents]  # (start of, turn of)
    own, group = np.diag(slopes), slopes.sum(axis=0)
    return {
        "turn_own": float(own.mean()),
        "turn_others": float((group - own).mean() / max(agents - 1, 1)),
        "turn_group": float(group.mean()),
        "turn_lead": float((expert - when)[known].mean()),
    }


@np.errstate(invalid="ignore", divide="ignore")
def turn_steps(positions: Floats) -> Floats:
    """Return the step (B, N), interpolated, at which each agent of (B, T, N, 2) is TURNED; NaN if it never is."""
    aside = np.abs(positions[..., 1] - positions[:, :1, :, 1])  # (B, T, N)
    step = (aside >= TURNED).argmax(axis=1)  # 0 if never: no agent is aside at its start
    before, after = (np.take_along_axis(aside, at[:, None], axis=1)[:, 0] for at in (np.maximum(step - 1, 0), step))
    steps: Floats = np.where(step > 0, step - 1 + (TURNED - before) / (after - before), np.nan)
    return steps


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


def corners(line: Floats) -> Floats:
    """Return the points (C, 2) of a polyline (P', 2) at which it bends, and its ends."""
    steps = np.diff(line, axis=0)
    cross = steps[:-1, 0] * steps[1:, 1] - steps[:-1, 1] * steps[1:, 0]
    length = np.linalg.norm(steps, axis=1)
    bends = np.abs(cross) > 1e-9 * length[:-1] * length[1:]
    kept: Floats = line[np.concatenate([[True], bends, [True]])]
    return kept


def polyline_distances(points: Floats, line: Floats, extended: bool = False) -> Floats:
    """Return the distances (...) of points (..., 2) to a polyline (P', 2), which may have segments of length 0.

    With `extended` the last segment continues as a ray.
    """
    (begin_x, begin_y), (step_x, step_y) = line[:-1].T, np.diff(line, axis=0).T
    limit = np.append(np.ones(len(step_x) - 1), np.inf if extended else 1.0)
    length = np.maximum(np.square(step_x) + np.square(step_y), np.finfo(np.float64).tiny)  # squared
    flat = points.reshape(-1, 2)
    squared = np.empty(len(flat))
    block = max(1, BLOCK // len(step_x))
    for first in range(0, len(flat), block):  # so many points at a time, to each segment, as fit into the cache
        some = slice(first, first + block)
        x, y = flat[some, 0, None] - begin_x, flat[some, 1, None] - begin_y  # (block, segments)
        along = np.clip((x * step_x + y * step_y) / length, 0.0, limit)
        squared[some] = (np.square(x - along * step_x) + np.square(y - along * step_y)).min(axis=-1)
    distances: Floats = np.sqrt(squared).reshape(points.shape[:-1])
    return distances
