"""The arrays of a tiny Y-Junction run, small enough to work out by hand."""

import numpy as np

STARTS, SAMPLES, STEPS, AGENTS = 3, 2, 5, 2
OBSERVED = 4


def lanes() -> np.ndarray:
    """(2, B, T, N, 2): agent n starts n + b/10 behind the leader, drives along +x, and from x = 2 on also to +-y."""
    x = np.arange(STEPS)[None, :, None] - np.arange(AGENTS) - np.arange(STARTS)[:, None, None] / 10
    y = np.maximum(x - 2, 0)
    return np.stack([np.stack([x, sign * y], axis=-1) for sign in (1, -1)]).astype(np.float32)


def forecasts(level: float, slope: float = 0.5, steps: int = STEPS) -> dict[str, np.ndarray]:
    """What a finished mocap run stores of its error per predicted step: level * (1 + slope * step) and, with noise,
    three times as much. Of constant velocity it is 0.001 * step, and with noise 0.002 * step; of copies of the last
    state 0.004 * step.
    """
    step = np.arange(1.0, steps + 1)
    clean = level * (1 + slope * step)
    return {
        "test/mse": clean,
        "test_noisy/mse": 3 * clean,
        "test_constant_velocity/mse": 0.001 * step,
        "test_constant_velocity_noisy/mse": 0.002 * step,
        "test_copy_last/mse": 0.004 * step,
    }


def windows(axes: int = 2) -> dict[str, np.ndarray]:
    """What a finished run on the user's own trajectories stores of three test windows with 3, 2 and 1 agents, of which
    OBSERVED steps are observed and STEPS predicted. Agent n of window w is at t + n + 10 w at step t, and on the other
    axes at n; step 0 is the last observed one. Sample s is 0.1 (s + 1) t beside it on the last axis.
    """
    step = np.arange(1.0 - OBSERVED, STEPS + 1)
    agent, window = np.arange(3.0), np.arange(3.0)
    positions = np.broadcast_to(agent[:, None], (3, len(step), 3, axes)).copy()
    positions[..., 0] += step[:, None] + 10 * window[:, None, None]
    agents = np.array([3, 2, 1])
    positions *= (agent < agents[:, None])[:, None, :, None]
    observed, future = positions[:, :OBSERVED], positions[:, OBSERVED:]
    samples = np.repeat(future[None], SAMPLES, axis=0)
    samples[..., -1] += 0.1 * (np.arange(SAMPLES) + 1)[:, None, None, None] * step[OBSERVED:, None]
    found = {"test/observed": observed, "test/future": future, "test/samples": samples}
    return {name: values.astype(np.float32) for name, values in found.items()} | {"test/agents": agents}


def arrays(shift: float = 0.0) -> dict[str, np.ndarray]:
    """What a finished run stores. Rollout (s, b) takes lane (s + b) % 2, 0.01 (3 s + b) + shift to the left of it."""
    modes = lanes()
    rollouts = np.stack([[modes[(s + b) % 2, b] for b in range(STARTS)] for s in range(SAMPLES)])
    rollouts[..., 1] += 0.01 * np.arange(SAMPLES * STARTS).reshape(SAMPLES, STARTS, 1, 1) + shift
    x = np.arange(-2.0, 6.0)
    centres = np.stack([np.stack([x, sign * np.maximum(x - 2, 0)], axis=-1) for sign in (1, -1)])
    lane = np.array([1, 0, 1])
    return {
        "test/rollouts": rollouts.astype(np.float32),
        "test/lanes": modes,
        "train/expert": modes[lane, np.arange(STARTS)],
        "train/lane": lane,
        "lane_centres": centres.astype(np.float32),
    }
