"""Flocks as own trajectories: windows of scenes in which 3 to 12 boids fly to one of two goals (tests/data/flock.py).

python -m tests.data.flocks flocks.npz --numbers 3 12             # the set, with --seed 0
ssmail train --env trajectories --set data.path=flocks.npz --seeds 0-2
"""

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ssmail.data import expert_sets
from ssmail.data.recorded_sets import SetParameters, recorded_set, windows
from ssmail.data.trajectories import SPLITS, ExpertSet, Floats
from tests.data.flock import Rules, fly

FRAMES = 100  # of a scene
SHARES = {"train": 0.7, "validation": 0.15, "test": 0.15}


def scene(agents: int, axes: int, rng: np.random.Generator, frames: int = FRAMES, rules: Rules | None = None) -> Floats:
    """Return the positions (frames, N, P) of a flock that starts near the origin, flies along x and chooses a goal."""
    rules = rules or Rules(noise=0.02)
    positions = rng.uniform(-4, 4, (1, agents, 3))
    velocities = np.array([1.0, 0, 0]) + rng.normal(0, 0.1, positions.shape)
    if axes == 2:
        positions[..., 2] = velocities[..., 2] = 0
    made = fly(rules, positions, velocities, rng.choice(rules.goals, 1), frames - 1, rng)
    return made[0, ..., :axes]


def generate(
    numbers: Sequence[int] = range(3, 13),
    axes: int = 2,
    scenes: int = 120,
    window: int = 60,
    observed: int = 20,
    stride: int = 13,
    seed: int = 0,
    frames: int = FRAMES,
    identity: bool = False,
) -> ExpertSet:
    """Generate the set; equal arguments yield equal arrays. The scenes have the numbers of boids in turn."""
    rng = np.random.default_rng(seed)
    flights = [scene(numbers[s % len(numbers)], axes, rng, frames) for s in range(scenes)]
    ends = np.cumsum([round(share * scenes) for share in SHARES.values()])[:-1]
    splits, most = {}, max(numbers)
    for split, chosen in zip(SPLITS, np.split(np.arange(scenes), ends), strict=True):
        cuts = [(s, first) for s in chosen.tolist() for first in range(0, frames - window, stride)]
        cut = np.zeros((len(cuts), window + 1, most, axes))
        for b, (s, first) in enumerate(cuts):
            cut[b, :, : flights[s].shape[1]] = flights[s][first : first + window + 1]
        agents = np.array([flights[s].shape[1] for s, _ in cuts])
        splits[split] = windows(cut, agents, *(np.array(column) for column in zip(*cuts, strict=True)))
    parameters = SetParameters(
        axes=axes, window=window, observed=observed, predicted=window - observed, stride=stride, identity=identity
    )
    return recorded_set(splits, [f"flight{s}" for s in range(scenes)], parameters)


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m tests.data.flocks", description="Write flocks as an expert set.")
    parser.add_argument("out", type=Path, help="the .npz to write, replacing it")
    parser.add_argument("--numbers", type=int, nargs=2, default=(3, 12), help="the smallest and the largest flock")
    parser.add_argument("--axes", type=int, default=2, choices=(2, 3))
    parser.add_argument("--seed", type=int, default=0)
    chosen = parser.parse_args()
    least, most = chosen.numbers
    made = generate(range(least, most + 1), axes=chosen.axes, seed=chosen.seed, identity=least == most)
    expert_sets.save(made, chosen.out, force=True)


if __name__ == "__main__":
    main()
