"""Metrics of sampled forecasts of any agents, one value for each forecast window; `summarize` takes their means.

Positions and distances are in raw units unless a docstring says that they are scaled. The metrics of a group ("joint")
ask one sample for all of its agents; those whose names end in _agent let every agent have a sample of its own.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from ssmail.config.sections import ForecastSpec
from ssmail.data.scaling import Scaling
from ssmail.data.trajectories import Floats
from ssmail.evaluation.metrics import DIVERGED, FORECAST_STEPS

BEST_OF = (1, 5, 20)  # the K of min_ade_K, min_fde_K and miss_rate_K
NEIGHBOURS = 5  # of a true end, for coverage
MOST_ENDS = 2000  # agents whose ends coverage compares


@dataclass(frozen=True)
class MeasuredForecasts:
    """What is measured of the forecasts of B windows, to be joined with those of other windows.

    windows: the value (B,) of each window, by the name of the metric. curves: its error (B, T') at each predicted step,
    by name. ends, true_ends: (S, M, P) and (M, P), how far each of the M agents comes from its last observed position.
    """

    windows: dict[str, Floats]
    curves: dict[str, Floats]
    ends: Floats
    true_ends: Floats

    @staticmethod
    def join(parts: "Sequence[MeasuredForecasts]") -> "MeasuredForecasts":
        """Put the windows of all parts together."""
        first = parts[0]
        return MeasuredForecasts(
            {name: np.concatenate([part.windows[name] for part in parts]) for name in first.windows},
            {name: np.concatenate([part.curves[name] for part in parts]) for name in first.curves},
            np.concatenate([part.ends for part in parts], axis=1),
            np.concatenate([part.true_ends for part in parts]),
        )


@np.errstate(over="ignore", invalid="ignore")
def measure(
    predicted: Floats, truth: Floats, last: Floats, scaling: Scaling, forecast: ForecastSpec, samples: int
) -> MeasuredForecasts:
    """Measure forecasts (S, B, T', N, 2P) of the states (B, T', N, 2P) after the `last` observed ones (B, N, 2P).

    All states are scaled. samples: how many there would be of a forecast that chance can change, for S = 1; the K of
    BEST_OF up to this number are reported. mse and energy are in scaled units, see docs/paper.md for all.
    """
    axes = truth.shape[-1] // 2
    raw, true, start = (scaling.unscale_positions(states[..., :axes]) for states in (predicted, truth, last))
    distance = _finite(np.linalg.norm(raw - true, axis=-1))  # (S, B, T', N)
    squared = _finite(np.square(predicted - truth).mean(axis=(-2, -1)))  # (S, B, T')
    ade, fde = distance.mean(axis=2), distance[:, :, -1]  # (S, B, N)
    assert forecast.miss_distance is not None  # resolved by then
    scaled = predicted[..., :axes]
    windows = {
        "mse": squared.mean(axis=(0, 2)),
        "ade": ade.mean(axis=(0, 2)),
        "fde": fde.mean(axis=(0, 2)),
        "energy": energy_scores(scaled, truth[..., :axes]),
        "diverged": (~np.isfinite(scaled) | (np.abs(scaled) > DIVERGED)).any(axis=(2, 3, 4)).mean(axis=0),
    }
    for k in BEST_OF:
        if k <= samples:
            for name, of_agents in (("ade", ade), ("fde", fde)):
                windows[f"min_{name}_{k}"] = best_of(of_agents.mean(axis=2), k)
                windows[f"min_{name}_{k}_agent"] = best_of(of_agents, k).mean(axis=1)
            missed = fde.mean(axis=2) > forecast.miss_distance, fde > forecast.miss_distance
            windows[f"miss_rate_{k}"] = best_of(missed[0].astype(float), k)
            windows[f"miss_rate_{k}_agent"] = best_of(missed[1].astype(float), k).mean(axis=1)
    if forecast.collision_distance is not None:
        windows["collisions"] = collisions(raw, forecast.collision_distance)
    curves = {"mse": squared.mean(axis=0), "distance": distance.mean(axis=(0, 3))}
    samples_of_ends = (raw[:, :, -1] - start).reshape(len(raw), -1, axes)
    return MeasuredForecasts(windows, curves, samples_of_ends, (true[:, -1] - start).reshape(-1, axes))


@np.errstate(invalid="ignore")
def summarize(measured: MeasuredForecasts) -> tuple[dict[str, float], dict[str, Floats]]:
    """Return the metrics and the error per predicted step, as means over windows, which all count the same.

    Values: those of each window, mse_h of the steps h in FORECAST_STEPS, mse_last of the last one, and coverage.
    Arrays (T'): mse, scaled; mse_spread, the standard deviation (n - 1) of mse over windows; distance.
    """
    values = {name: float(each.mean()) for name, each in measured.windows.items()}
    curves = {name: each.mean(axis=0) for name, each in measured.curves.items()}
    values |= {f"mse_{h}": float(curves["mse"][h - 1]) for h in FORECAST_STEPS if h <= len(curves["mse"])}
    values["mse_last"] = float(curves["mse"][-1])
    covered = coverage(measured.ends, measured.true_ends)
    if math.isfinite(covered):
        values["coverage"] = covered
    each = measured.curves["mse"]
    curves["mse_spread"] = each.std(axis=0, ddof=1) if len(each) > 1 else np.full(each.shape[1], np.nan)
    return values, curves


def best_of(values: Floats, k: int) -> Floats:
    """Return the least of k of the S values (S, ...): (...), the mean over all ways to choose the k.

    The i-th smallest of S values is the least of comb(S - i, k - 1) of all comb(S, k) choices. With fewer than k values
    the least of all.
    """
    count = len(values)
    k = min(k, count)
    weights = np.array([math.comb(count - i, k - 1) for i in range(1, count - k + 2)]) / math.comb(count, k)
    least: Floats = np.tensordot(weights, np.sort(values, axis=0)[: len(weights)], axes=1)
    return least


def energy_scores(samples: Floats, truth: Floats) -> Floats:
    """Return the energy score (B,) of samples (S, B, T', N, P) of the scaled positions (B, T', N, P).

    The mean distance from the samples to the truth, less half the mean distance between two samples (Gneiting and
    Raftery 2007). It is least in expectation for samples of the true distribution: both a forecast that leaves a future
    out and one that guesses the middle of two futures cost. The distance of two futures is the root mean square over
    steps, agents and axes. For one sample it is the distance to the truth.
    """
    flat, true = samples.reshape(*samples.shape[:2], -1), truth.reshape(len(truth), -1)
    accuracy = _rms(flat - true).mean(axis=0)
    count = len(flat)
    pairs = [_rms(flat[s] - flat[s + 1 :]).sum(axis=0) for s in range(count - 1)]
    spread = sum(pairs) / (count * (count - 1)) if pairs else 0.0
    scores: Floats = _finite(accuracy - spread)
    return scores


def collisions(positions: Floats, distance: float) -> Floats:
    """Return the share of agents (B,) that are nearer than `distance` to another one at some step.

    positions (S, B, T', N, P); the share is over samples and agents.
    """
    samples, windows, _, agents, _ = positions.shape
    near = np.zeros((samples, windows, agents), dtype=bool)
    apart = ~np.eye(agents, dtype=bool)
    for step in np.moveaxis(positions, 2, 0):
        squared = np.square(step[:, :, :, None] - step[:, :, None]).sum(axis=-1)
        near |= ((squared < distance**2) & apart).any(axis=-1)
    share: Floats = near.mean(axis=(0, 2))
    return share


def coverage(ends: Floats, true_ends: Floats) -> float:
    """Return the share of true ends that have a forecast end in their neighbourhood (Naeem et al. 2020, eq. 9).

    ends (S, M, P) are S sets of forecast ends, which are compared with the M true ends (M, P) one by one, and the mean
    is returned. The neighbourhood of a true end reaches to its fifth nearest true end. Forecasts that follow the true
    distribution cover 1 - (M-1)...(M-5) / ((2M-1)...(2M-5)), about 0.97; forecasts that leave out one of two equally
    frequent clusters cover half of that. NaN for fewer than two ends. At most MOST_ENDS agents are compared.
    """
    chosen = np.unique(np.linspace(0, len(true_ends) - 1, MOST_ENDS).round().astype(int))
    true, k = true_ends[chosen], min(NEIGHBOURS, len(chosen) - 1)
    if k < 1:
        return math.nan
    reach = np.asarray(cKDTree(true).query(true, k + 1)[0])[:, -1]
    shares = []
    for sampled in ends[:, chosen]:
        known = sampled[np.isfinite(sampled).all(axis=-1)]
        shares.append(float((cKDTree(known).query(true)[0] <= reach).mean()) if len(known) else 0.0)
    return sum(shares) / len(shares)


def _rms(differences: Floats) -> Floats:
    root: Floats = np.sqrt(np.square(differences).mean(axis=-1))
    return root


def _finite(values: Floats) -> Floats:
    """Return the values with infinity for what is not a number, as it comes from infinite positions."""
    finite: Floats = np.where(np.isnan(values), np.inf, values)
    return finite
