"""Which metrics are reported of a set of rollouts, and under which names."""

import numpy as np

from ssmail.data.scaling import Scaling
from ssmail.data.trajectories import Floats, Trajectories
from ssmail.evaluation import metrics


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
