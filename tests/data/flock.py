"""A flock as recorded motion: five boids that fly to one of two goals, for which a fair coin decides.

Each boid accelerates towards the others (cohesion), away from those that are near (separation), to the velocity of the
others (alignment), and to the cruising velocity towards its target (Reynolds 1987). Until a random step, the target is
the middle between the goals, so nothing gives the goal away before. The unit of length is what a boid flies in a step.

    python -m tests.data.flock flock.npz                              # the set, with --seed 0
    ssmail train --env mocap --set data.path=flock.npz --seeds 0-2
"""

import argparse
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ssmail.data import expert_sets
from ssmail.data.mocap.dataset import NO_LINES, MocapParameters
from ssmail.data.trajectories import SPLITS, ExpertSet, Floats, Integers, Trajectories

BOIDS, SUBJECT = 5, 900
GOALS = np.array([[60.0, 30.0, 0.0], [60.0, -30.0, 0.0]])
ARRIVAL = 12.0  # distance from a target at which boids begin to slow down
WINDOW, TEST_WINDOW = 50, 100  # frames
TRIALS = {"train": 50, "validation": 20, "test": 40}  # of 100 frames each: 100, 40 and 40 windows


@dataclass(frozen=True)
class Rules:
    """The weights of the rules, per step, and what is random.

    Two boids come to rest at the distance sqrt(separation / cohesion), which is 3.
    """

    cohesion: float = 0.02
    separation: float = 0.18
    alignment: float = 0.1
    target: float = 0.1
    noise: float = 0.005  # standard deviation of each component of the acceleration
    commits: tuple[int, int] = (20, 40)  # steps at which a group commits to its goal, uniformly
    goals: tuple[int, ...] = (0, 1)  # those that the coin decides between


def accelerations(positions: Floats, velocities: Floats, targets: Floats, rules: Rules) -> Floats:
    """Return the accelerations (B, N, 3), without noise, of boids that fly to targets (B, 3)."""
    others = max(positions.shape[1] - 1, 1)
    apart = positions[:, None] - positions[:, :, None]  # (B, N, N, 3): of each boid, the way to every boid
    squared = np.square(apart).sum(axis=-1, keepdims=True)
    near = apart / np.where(squared > 0, squared, 1)
    faster = velocities[:, None] - velocities[:, :, None]
    way = targets[:, None] - positions
    distance = np.linalg.norm(way, axis=-1, keepdims=True)
    wanted = way / np.maximum(distance, ARRIVAL)  # the cruising velocity: 1, less near the target
    acceleration: Floats = (
        rules.cohesion * apart.sum(axis=2) / others
        - rules.separation * near.sum(axis=2)
        + rules.alignment * faster.sum(axis=2) / others
        + rules.target * (wanted - velocities)
    )
    return acceleration


def fly(
    rules: Rules, positions: Floats, velocities: Floats, goals: Integers, steps: int, rng: np.random.Generator
) -> Floats:
    """Return the positions (B, steps + 1, N, 3) of groups that start so and commit to these goals (B,) on their way."""
    commit = rng.integers(*rules.commits, size=len(goals), endpoint=True)
    made = [positions]
    for step in range(steps):
        targets = np.where((step < commit)[:, None], GOALS.mean(axis=0), GOALS[goals])
        change = accelerations(positions, velocities, targets, rules) + rng.normal(0, rules.noise, positions.shape)
        velocities = velocities + change
        positions = positions + velocities
        made.append(positions)
    return np.stack(made, axis=1)


def generate(seed: int = 0, rules: Rules | None = None) -> ExpertSet:
    """Generate the set, as recorded motion; equal arguments yield equal arrays."""
    streams = np.random.SeedSequence(seed).spawn(len(SPLITS))
    first, splits, numbers = 1, {}, {}
    for split, stream in zip(SPLITS, streams, strict=True):
        numbers[split] = tuple(range(first, first + TRIALS[split]))
        first += TRIALS[split]
        window = TEST_WINDOW if split == "test" else WINDOW
        splits[split] = _cut(
            _trials(rules or Rules(), TRIALS[split], np.random.default_rng(stream)), numbers[split], window
        )
    parameters = MocapParameters(subject=SUBJECT, **numbers, window=WINDOW, test_window=TEST_WINDOW)
    names = tuple(f"boid{number}" for number in range(1, BOIDS + 1))
    parents = (-1, *[0] * (BOIDS - 1))  # a skeleton has a root; every other boid hangs on the first
    return ExpertSet.bundle(splits, NO_LINES, parameters.model_dump(mode="json"), names, parents)


def _trials(rules: Rules, count: int, rng: np.random.Generator) -> Floats:
    """Return the positions (count, 101, N, 3) of trials, which start near the origin and fly along x."""
    positions = rng.uniform(-4, 4, (count, BOIDS, 3))
    velocities = np.array([1.0, 0, 0]) + rng.normal(0, 0.1, positions.shape)
    return fly(rules, positions, velocities, rng.choice(rules.goals, count), TEST_WINDOW, rng)


def _cut(trials: Floats, numbers: Sequence[int], window: int) -> Trajectories:
    """Cut trials (B, 101, N, 3) into windows that follow one another, the windows of a trial together."""
    parts = TEST_WINDOW // window
    locations, velocities = (
        array.reshape(len(trials) * parts, window, BOIDS, 3) for array in (trials[:, 1:], np.diff(trials, axis=1))
    )
    frames = np.tile(2 + window * np.arange(parts), len(trials))
    return Trajectories.single_mode(locations, velocities, np.repeat(numbers, parts), frames)


def nearer_goal(positions: Floats) -> Integers:
    """Return the goal (...) to which the middle of a group (..., N, 3) is nearer."""
    distance = np.linalg.norm(positions.mean(axis=-2, keepdims=True) - GOALS, axis=-1)
    nearer: Integers = distance.argmin(axis=-1)
    return nearer


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m tests.data.flock", description="Write the flock as an expert set.")
    parser.add_argument("out", type=Path, help="the .npz to write, replacing it")
    parser.add_argument("--seed", type=int, default=0)
    chosen = parser.parse_args()
    expert_sets.save(generate(chosen.seed), chosen.out, force=True)


if __name__ == "__main__":
    main()
