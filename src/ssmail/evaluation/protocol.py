"""Which metrics are reported of a set of rollouts, and under which names."""

import numpy as np

from ssmail.data.scaling import Scaling
from ssmail.data.trajectories import Floats, Trajectories
from ssmail.evaluation import metrics
from ssmail.evaluation.strokes import stroke_distances


def quick_metrics(predicted: Floats, truth: Trajectories, centre_lines: Floats, scaling: Scaling) -> dict[str, float]:
    """The metrics of every epoch, from raw positions (B, T, N, P) of one rollout per start, the start included.

    mode_mse and lag are in scaled units, on_lane, lane_balance and diverged are shares.
    """
    rollout, modes = predicted[:, 1:], truth.continuations[:, :, 1:]
    scaled, scaled_modes = scaling.scale_positions(rollout), scaling.scale_positions(modes)
    return {
        "mode_mse": metrics.mode_mse(scaled, scaled_modes),
        "on_lane": metrics.on_lane(rollout, modes, centre_lines),
        "lane_balance": metrics.lane_balance(rollout, modes),
        "lag": metrics.lag(scaled, scaled_modes),
        "diverged": metrics.diverged(scaled),
    }


def full_metrics(samples: Floats, truth: Trajectories, centre_lines: Floats, scaling: Scaling) -> dict[str, float]:
    """The metrics of a final evaluation, from raw samples (S, B, T, N, P), the start included.

    All S rollouts of all starts count in the quick metrics, and in ade and fde (raw units); min_ade_20 and min_fde_20
    take the best of the S samples of each start.
    """
    s, b = samples.shape[:2]
    repeated = Trajectories(
        positions=np.tile(truth.positions, (s, 1, 1, 1)),
        velocities=np.tile(truth.velocities, (s, 1, 1, 1)),
        mode=np.tile(truth.mode, s),
        continuations=np.tile(truth.continuations, (1, s, 1, 1, 1)),
    )
    values = quick_metrics(samples.reshape(s * b, *samples.shape[2:]), repeated, centre_lines, scaling)
    ade, fde = metrics.displacement_errors(samples[:, :, 1:], truth.positions[:, 1:])
    return values | {
        "ade": float(ade.mean()),
        "fde": float(fde.mean()),
        "min_ade_20": float(ade.min(axis=0).mean()),
        "min_fde_20": float(fde.min(axis=0).mean()),
    }


def one_step_mse(predicted: Floats, truth: Floats) -> float:
    """Mean squared error of one-step predictions from the true past; both (B, T, N, D), scaled positions and
    velocities.
    """
    return float(np.square(predicted - truth).mean())


STEPS = (1, 10, 20, 40, 48)  # predicted steps whose error is a metric of its own


@np.errstate(over="ignore", invalid="ignore")
def forecast_metrics(
    predicted: Floats, truth: Floats, scaling: Scaling
) -> tuple[dict[str, float], dict[str, np.ndarray]]:
    """The metrics of predicted motion, and its error per predicted step.

    predicted (S, B, T, N, 2P) and truth (B, T, N, 2P) are scaled states. mse is the mean squared error over all six
    features (DNRI's protocol), over samples, windows, steps and agents; mse_h that of step h = 1 .. T; ade and fde the
    mean and final distance in raw units; diverged the share of predictions with a non-finite or |scaled| > 10 position.
    Arrays: mse (T,), and mse_spread (T,), the standard deviation (n - 1) over windows of their mean over samples.
    """
    errors = np.square(predicted - truth).mean(axis=(-2, -1))  # (S, B, T)
    curve, windows = errors.mean(axis=(0, 1)), errors.mean(axis=0)
    axes = truth.shape[-1] // 2
    raw = scaling.unscale_positions(predicted[..., :axes]), scaling.unscale_positions(truth[..., :axes])
    ade, fde = metrics.displacement_errors(*raw)
    values = {"mse": float(curve.mean()), "ade": float(ade.mean()), "fde": float(fde.mean())}
    values |= {f"mse_{h}": float(curve[h - 1]) for h in STEPS if h <= len(curve)}
    values["diverged"] = metrics.diverged(predicted[..., :axes].reshape(-1, *predicted.shape[2:-1], axes))
    spread = windows.std(axis=0, ddof=1) if len(windows) > 1 else np.full(len(curve), np.nan)
    return values, {"mse": curve.astype(np.float64), "mse_spread": spread.astype(np.float64)}


def letter_metrics(
    predicted: Floats, truth: Floats, letters: Floats, first_letter_step: int, scaling: Scaling
) -> dict[str, float]:
    """The metrics of drawn letters.

    predicted (S, B, T, N, 4) and truth (B, T, N, 4) are scaled states, the start included; letters (N, P', 2) raw
    polylines. mse, mse_h, ade, fde and diverged as in `forecast_metrics`, of the predicted steps 1 .. T - 1.
    stroke_distance in letter heights (the raw unit), mean over samples, starts and agents, and stroke_distance_n of
    agent n = 0 .. N - 1: of the states from `first_letter_step` on.
    """
    values, _ = forecast_metrics(predicted[:, :, 1:], truth[:, 1:], scaling)
    drawn = scaling.unscale_positions(predicted[:, :, first_letter_step:, :, :2])
    found = stroke_distances(drawn.reshape(-1, *drawn.shape[2:]), letters).mean(axis=0)  # (N,)
    values["stroke_distance"] = float(found.mean())
    return values | {f"stroke_distance_{n}": float(distance) for n, distance in enumerate(found)}
