"""Recorded agents as anyone might have them: tables of positions from simulators of our own, for `ssmail import-data`.

    python -m tests.data.recorded_sets FOLDER    # the four tables
    ssmail import-data FOLDER/boids.parquet --out boids.npz
    ssmail train --env trajectories --set data.path=boids.npz

The boids are those of `tests.data.flock`. The walkers follow social forces (Helbing and Molnár 1995): each accelerates
to its desired velocity, and away from the others and from the pillar in the middle of the square. In both, a fair coin
decides between two ways after half of a window, and nothing gives it away before.
"""

import argparse
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pandas as pd

from ssmail.data.trajectories import Floats
from tests.data.flock import GOALS, Rules, accelerations

RULES = Rules()
FRAMES = 60  # of a scene: a window of 50 states, the frame before it, and a few more
COMMITS = (26, 34)  # frames at which a group commits to its way; 25 are observed
FEWEST, MOST = 3, 12  # boids that come and go
CHANGE = 0.03  # chance that one comes or goes in a frame
FRAME, DT = 5, 0.2  # of the walkers: numbers from one frame to the next, at 25 frames a second, and seconds
SPEED, RELAXATION = 1.3, 0.5  # of walkers: m/s, and seconds to take the desired velocity up
STRENGTH, RANGE, RADIUS = 2.1, 0.35, 0.6  # of the repulsion: m/s², m, and m at which it is at its strength
PILLAR = 0.8  # its radius, in m
SIDE, SCATTER = 2.5, 0.02  # how far beside the pillar walkers pass, and the random part of a step's velocity, m/s


def boids(scenes: int = 120, seed: int = 0, agents: int = 5, axes: int = 2) -> pd.DataFrame:
    """Groups that fly to one of two goals."""
    rng = np.random.default_rng(seed)
    return _table([_flight(rng, agents, axes) for _ in range(scenes)], "flight")


def coming_and_going(scenes: int = 120, seed: int = 0) -> pd.DataFrame:
    """Groups of 3 to 12 boids, which others join and some leave on the way."""
    rng = np.random.default_rng(seed)
    return _table([_flight(rng, int(rng.integers(FEWEST, MOST + 1)), 2, CHANGE) for _ in range(scenes)], "flight")


def crossing(scenes: int = 120, seed: int = 0) -> pd.DataFrame:
    """Three walkers who pass a pillar on one of its sides, and two who cross their way behind it."""
    rng = np.random.default_rng(seed)
    table = _table([_walk(rng) for _ in range(scenes)], "crossing")
    return table.assign(frame=FRAME * table["frame"])


def _table(scenes: Sequence[Sequence[Floats]], name: str) -> pd.DataFrame:
    """Return one row per agent and frame. scenes: of each, the rows (agents, [agent, coordinates]) of its frames."""
    parts = []
    for scene, frames in enumerate(scenes):
        numbers = np.repeat(np.arange(len(frames)), [len(frame) for frame in frames])
        rows = np.concatenate(frames)
        columns = dict(zip("xyz", rows.T[1:], strict=False))
        parts.append(
            pd.DataFrame({"scene": f"{name}{scene:03d}", "frame": numbers, "agent": rows[:, 0].astype(int)} | columns)
        )
    return pd.concat(parts, ignore_index=True)


def _flight(rng: np.random.Generator, agents: int, axes: int, change: float = 0.0) -> list[Floats]:
    """The rows of each frame: in each frame, the boids that are there fly on, and perhaps one joins or leaves."""
    commit, goal = rng.integers(*COMMITS, endpoint=True), GOALS[rng.integers(2)]
    number, joined = np.arange(agents), agents
    place = np.zeros((agents, 3))
    place[:, :axes] = rng.uniform(-4, 4, (agents, axes))
    velocity = np.zeros((agents, 3))
    velocity[:, :axes] = rng.normal(0, 0.1, (agents, axes))
    velocity[:, 0] += 1
    rows = []
    for frame in range(FRAMES):
        rows.append(np.column_stack([number, place[:, :axes]]))
        target = GOALS.mean(axis=0) if frame < commit else goal
        noise = np.zeros_like(place)
        noise[:, :axes] = rng.normal(0, RULES.noise, (len(place), axes))
        velocity = velocity + accelerations(place[None], velocity[None], target[None], RULES)[0] + noise
        place = place + velocity
        if rng.random() >= change:
            continue
        if len(number) > FEWEST and (len(number) == MOST or rng.random() < 0.5):
            stay = np.arange(len(number)) != rng.integers(len(number))
            number, place, velocity = number[stay], place[stay], velocity[stay]
        else:  # one joins beside the group
            beside = place.mean(axis=0) + np.append(rng.uniform(-6, 6, 2), 0)
            number, joined = np.append(number, joined), joined + 1
            place, velocity = np.vstack([place, beside]), np.vstack([velocity, velocity.mean(axis=0)])
    return rows


def _walk(rng: np.random.Generator) -> list[Floats]:
    commit, side = rng.integers(*COMMITS, endpoint=True), rng.choice((-1.0, 1.0))
    place = np.array([[-11.0, 0.7], [-11.8, 0.0], [-11.0, -0.7], [1.5, -9.0], [2.5, 9.0]]) + rng.uniform(
        -0.2, 0.2, (5, 2)
    )
    ways = np.array([[1.0, 0], [1.0, 0], [1.0, 0], [0, 1.0], [0, -1.0]])
    velocity = SPEED * ways
    rows = []
    for frame in range(FRAMES):
        rows.append(np.column_stack([np.arange(5), place]))
        wanted = ways.copy()
        if frame >= commit:  # until they are past the pillar, the three head for a point beside it
            ahead = np.array([0.0, side * SIDE]) - place[:3]
            before = place[:3, 0] < 0
            wanted[:3][before] = (ahead / np.linalg.norm(ahead, axis=-1, keepdims=True))[before]
        force = (SPEED * wanted - velocity) / RELAXATION + _repulsion(place)
        velocity = velocity + DT * force + rng.normal(0, SCATTER, place.shape)
        place = place + DT * velocity
    return rows


def _repulsion(place: Floats) -> Floats:
    """Return the accelerations (N, 2) away from the other walkers and from the pillar."""
    apart = place[:, None] - place[None]  # (N, N, 2): from each other walker to this one
    distance = np.linalg.norm(apart, axis=-1, keepdims=True) + 1e-9
    total: Floats = (STRENGTH * np.exp((RADIUS - distance) / RANGE) * apart / distance).sum(axis=1)
    out = np.linalg.norm(place, axis=-1, keepdims=True)
    return total + STRENGTH * np.exp((PILLAR - out) / RANGE) * place / out


def write_boids(path: Path, scenes: int = 120, seed: int = 0) -> None:
    """Write a Parquet table of 5 boids in the plane."""
    boids(scenes, seed).to_parquet(path, index=False)


def write_coming_and_going(path: Path, scenes: int = 120, seed: int = 0) -> None:
    """Write a Parquet table of 3 to 12 boids."""
    coming_and_going(scenes, seed).to_parquet(path, index=False)


def write_boids_3d(path: Path, scenes: int = 120, seed: int = 0) -> None:
    """Write a Parquet table of 4 boids in space."""
    boids(scenes, seed, agents=4, axes=3).to_parquet(path, index=False)


def write_crossing(path: Path, scenes: int = 120, seed: int = 0) -> None:
    """Write a CSV of walkers, in metres, with frames at 25 a second of which every fifth is given."""
    crossing(scenes, seed).round(4).to_csv(path, index=False)


WRITERS: dict[str, Callable[[Path], None]] = {
    "boids.parquet": write_boids,
    "coming_and_going.parquet": write_coming_and_going,
    "boids_3d.parquet": write_boids_3d,
    "crossing.csv": write_crossing,
}


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m tests.data.recorded_sets", description="Write the four tables.")
    parser.add_argument("folder", type=Path)
    folder = parser.parse_args().folder
    folder.mkdir(parents=True, exist_ok=True)
    for name, write in WRITERS.items():
        write(folder / name)


if __name__ == "__main__":
    main()
