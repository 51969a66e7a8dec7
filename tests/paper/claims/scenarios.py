"""What five seeds store where a claim is true, false, cannot be told, or holds of ssail and its comparator alike.

Each function returns {group: [keywords of add_run of seeds 0, 1, ...]} for "true", "false", "open" or "alike". Where
both are alike, ssail has all that the paper says of it, but its runs lie between those that it is compared with.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

Runs = Mapping[Any, Sequence[Mapping[str, Any]]]
EPOCHS = 10
CONSTANT_VELOCITY = 0.05
SEEDS = np.arange(5)


def stability(case: str) -> Runs:
    """False: gail converges, and ssail does not. Open: one seed of ssail does not. Alike: all converge steadily."""
    epochs = np.arange(EPOCHS)

    def run(curve: np.ndarray) -> dict[str, Any]:
        final = {"test_constant_velocity/mode_mse": CONSTANT_VELOCITY, "test/mode_mse": curve.min()}
        return {"epochs": {"train/mode_mse": curve, "validation/mode_mse": curve}, "final": final}

    def falling(shift: float) -> list[dict[str, Any]]:
        return [run(0.05 * (0.5 + 0.02 * seed + shift) ** epochs) for seed in SEEDS]

    wild = [run((0.04 + seed / 500) * np.where(epochs % 2, 3.0 + seed / 20, 1.0)) for seed in SEEDS]
    wildest = run(np.where(epochs % 2, 5.0, 1.0))
    cases = {
        "true": (falling(0), wild),
        "false": (wild, falling(0)),
        "open": ([*falling(0)[:4], wildest], wild),
        "alike": (falling(0), falling(0.01)),
    }
    ssail, gail = cases[case]
    return {"ssail": ssail, "gail": gail, "wail": falling(-0.005) if case == "alike" else wild}


def modes(case: str) -> Runs:
    """False: dnri drives on the lanes, and ssail does not. Open: dnri does on two of five seeds. Alike: both do."""
    steps, starts, samples = 4, 6, 2
    lanes = np.zeros((2, starts, steps, 2, 2))
    lanes[..., 0] = np.arange(steps)[:, None]
    lanes[0, ..., 1], lanes[1, ..., 1] = lanes[0, ..., 0], -lanes[0, ..., 0]
    middle = np.repeat(lanes.mean(axis=0)[None], samples, axis=0)
    on_lanes = np.repeat(lanes[0][None], samples, axis=0)

    def runs(ends: Sequence[np.ndarray], path: np.ndarray, balance: np.ndarray) -> list[dict[str, Any]]:
        metrics = {"on_path": path, "lane_balance": balance}
        return [
            {
                "arrays": {"test/rollouts": ends[seed], "test/lanes": lanes},
                "final": {
                    f"{split}/{name}": values[seed]
                    for split in ("test", "test_last")
                    for name, values in metrics.items()
                },
            }
            for seed in SEEDS
        ]

    good = runs([on_lanes] * 5, 0.90 + SEEDS / 100, 0.40 + SEEDS / 100)
    as_good = runs([on_lanes] * 5, 0.905 + SEEDS / 100, 0.405 + SEEDS / 100)
    bad = runs([middle] * 5, 0.1 + SEEDS / 100, 0.1 + SEEDS / 100)
    half = runs([middle] * 3 + [on_lanes] * 2, 0.1 + SEEDS / 100, 0.1 + SEEDS / 100)
    ssail, dnri = {"true": (good, bad), "false": (bad, good), "open": (good, half), "alike": (good, as_good)}[case]
    return {"ssail": ssail, "dnri": dnri}


def beta(case: str) -> Runs:
    """False: beta 0.15 is as bad as the paper says of 0. Open: at the last epoch all are alike. Alike: always."""
    narrow, wide = 0.002 + 0.0001 * SEEDS, 0.02 + 0.004 * SEEDS
    cases = {
        "true": {0.0: wide, 0.15: narrow, 1.0: wide},
        "false": {0.0: narrow, 0.15: wide, 1.0: wide + 0.001},
        "alike": {0.0: narrow + 0.00005, 0.15: narrow, 1.0: narrow - 0.00003},
    }
    selected, last = {"open": ("true", "alike")}.get(case, (case, case))
    return {
        value: [
            {"final": {"test/mode_mse": cases[selected][value][seed], "test_last/mode_mse": cases[last][value][seed]}}
            for seed in SEEDS
        ]
        for value in (0.0, 0.15, 1.0)
    }


def noise(case: str) -> Runs:
    """False: ssail's error grows ever faster. Open: on two of five seeds it does. Alike: both grow ever more slowly."""
    steps = np.arange(1.0, 13)
    powers = {"true": [0.5] * 5, "false": [2.0] * 5, "open": [0.5, 0.4, 0.3, 1.2, 1.3], "alike": 0.5 + SEEDS / 50}[case]

    def run(curve: np.ndarray, seed: float) -> dict[str, Any]:
        errors = 0.001 * curve * (1 + seed / 10)
        return {"arrays": {"test_noisy/mse": errors, "test_noisy/mse_spread": errors / 2}}

    dnri = [steps ** (0.51 + seed / 50) if case == "alike" else 5 * steps for seed in SEEDS]
    return {
        "ssail": [run(steps ** powers[seed], seed) for seed in SEEDS],
        "dnri": [run(curve, seed) for seed, curve in enumerate(dnri)],
    }


def alpha(case: str) -> Runs:
    """False: negative alpha slows down and ends higher. Open: nearly no difference. Alike: nor here; both fall fast."""

    def run(rate: float, seed: int) -> dict[str, Any]:
        curve = (rate + seed / 100) ** np.arange(EPOCHS)
        return {"epochs": {"train/mse": curve}, "final": {"test/mse": curve.min()}}

    cases = {"true": (0.6, 0.4), "false": (0.4, 0.6), "open": (0.5, 0.502), "alike": (0.1, 0.105)}
    positive, both = cases[case]
    return {
        (0.0, 1.0): [run(positive, seed) for seed in SEEDS],
        (-1.0, 1.0): [run(both, seed) for seed in SEEDS],
    }


def curricula(case: str) -> Runs:
    """False: trajectory forcing jumps at once, sampling rises evenly. Open: three seeds jump. Alike: none does."""
    even, sudden = np.linspace(1, 10, EPOCHS), np.where(np.arange(EPOCHS) < 5, 1.0, 10.0)

    def run(lengths: np.ndarray, seed: float) -> dict[str, Any]:
        bumps = 1 + 0.01 * seed * np.cos(np.arange(EPOCHS))
        return {"epochs": {"curriculum/segment_length": lengths * bumps}}

    forcing, sampling = {
        "true": ([even] * 5, sudden),
        "false": ([sudden] * 5, even),
        "open": ([even] * 2 + [sudden] * 3, sudden),
        "alike": ([even] * 5, even),
    }[case]
    return {
        "teacher-forcing": [run(np.ones(EPOCHS), 0)] * 5,
        "scheduled-sampling": [run(sampling, seed + 0.5) for seed in SEEDS],
        "trajectory-forcing": [run(lengths, seed) for seed, lengths in enumerate(forcing)],
    }


def landscapes(case: str) -> Runs:
    """False: gail's reward has the slope, ssail's has not. Open: on two of five seeds gail's has. Alike: both have."""

    def runs(shares: np.ndarray, cosines: np.ndarray) -> list[dict[str, Any]]:
        numbers = zip(shares, cosines, strict=True)
        return [{"final": {"landscape/slope_share": share, "landscape/cosine": cosine}} for share, cosine in numbers]

    steep, flat = runs(0.95 + SEEDS / 100, 0.8 + SEEDS / 100), runs(0.1 + SEEDS / 100, 0.1 + SEEDS / 100)
    as_steep = runs(0.955 + SEEDS / 100, 0.805 + SEEDS / 100)
    steepest = runs(0.999 + 0 * SEEDS, 0.9 + 0 * SEEDS)
    ssail, gail = {
        "true": (steep, flat),
        "false": (flat, steep),
        "open": (steep, steepest[:2] + flat[2:]),
        "alike": (steep, as_steep),
    }[case]
    return {"ssail": ssail, "gail": gail}


def vector_field(case: str) -> Runs:
    """False: only without negative alpha the field points to the expert. Open: one seed does not. Alike: both do."""
    chance, towards = -0.1 + SEEDS / 50, 0.7 + SEEDS / 50
    positive, both = {
        "true": (chance, towards),
        "false": (towards, chance - 0.1),
        "open": (chance, np.append(towards[:4], -0.3)),
        "alike": (towards + 0.01, towards),
    }[case]
    return {
        alpha: [{"final": {"landscape/behind_cosine": value}} for value in values]
        for alpha, values in (((0.0, 1.0), positive), ((-1.0, 1.0), both))
    }


SCENARIOS: Mapping[str, Callable[[str], Runs]] = {
    "C1": stability,
    "C2": modes,
    "C3": beta,
    "C4": noise,
    "C5": alpha,
    "C6": curricula,
    "C7": landscapes,
    "C8": vector_field,
}
