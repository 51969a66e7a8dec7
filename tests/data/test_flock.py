"""The flock: each rule against its closed form, the coin, and the set as ssmail reads it."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ssmail.data import expert_sets
from ssmail.data.trajectories import SPLITS
from tests.data import flock
from tests.data.flock import GOALS, Rules, accelerations, fly, generate, nearer_goal

RULES = Rules()
NONE = Rules(cohesion=0, separation=0, alignment=0, target=0, noise=0)
EXPERTS = generate()
PAIR = np.array([[[0.0, 0, 0], [2.0, 0, 0]]])  # two boids, at rest or with these velocities
APART = np.array([[[1.0, 0, 0], [1.0, 1.0, 0]]])


def distances(positions: np.ndarray) -> np.ndarray:
    """(...) the least distance between two boids of groups (..., N, 3)."""
    apart = np.linalg.norm(positions[..., :, None, :] - positions[..., None, :, :], axis=-1)
    return np.where(np.eye(positions.shape[-2]) > 0, np.inf, apart).min(axis=(-2, -1))


def flown(rules: Rules, positions: np.ndarray, velocities: np.ndarray, steps: int, goal: int = 0) -> np.ndarray:
    """Positions (steps + 1, N, 3) of one group."""
    return fly(rules, positions, velocities, np.array([goal]), steps, np.random.default_rng(0))[0]


@pytest.mark.parametrize(
    ("rule", "weight", "expected"),
    [
        ("cohesion", 0.5, [[1, 0, 0], [-1, 0, 0]]),  # half of the way to the other
        ("separation", 0.5, [[-0.25, 0, 0], [0.25, 0, 0]]),  # half of 1 / distance
        ("alignment", 0.5, [[0, 0.5, 0], [0, -0.5, 0]]),  # half of the difference of velocity
        ("target", 0.5, [[-0.5, 0, 0.5], [-0.5, -0.5, 0.5]]),  # half of the way to the cruising velocity, [0, 0, 1]
    ],
)
def test_each_rule_by_hand(rule: str, weight: float, expected: list[list[float]]) -> None:
    found = accelerations(PAIR, APART, np.array([[1.0, 0, 1e9]]), replace(NONE, **{rule: weight}))
    np.testing.assert_allclose(found[0], expected, atol=1e-8)


def test_two_boids_rest_where_cohesion_and_separation_are_equal() -> None:
    rules = replace(RULES, target=0, noise=0)
    found, rest = flown(rules, PAIR, 0 * PAIR, 500), np.sqrt(rules.separation / rules.cohesion)
    assert distances(found[-1]) == pytest.approx(rest, rel=1e-6)
    assert distances(flown(replace(rules, separation=0), PAIR, 0 * PAIR, 500)[-1]) < 1e-6
    assert distances(flown(replace(rules, cohesion=0), PAIR, 0 * PAIR, 500)[-1]) > 2 * rest


def test_velocities_become_equal_geometrically() -> None:
    """Each of two boids takes a tenth of their difference, so eight tenths of it remain."""
    velocities = np.diff(flown(replace(NONE, alignment=0.1), PAIR, APART, 10), axis=0)
    assert velocities[:, 1, 1] - velocities[:, 0, 1] == pytest.approx(0.8 ** np.arange(1, 11))


def test_the_middle_of_a_group_feels_no_rule_but_its_target() -> None:
    draw = np.random.default_rng(1)
    start, speed = draw.normal(0, 3, (1, 5, 3)), draw.normal(size=(1, 5, 3))
    free = flown(replace(RULES, target=0, noise=0), start, speed, 30).mean(axis=1)
    np.testing.assert_allclose(free, start[0].mean(axis=0) + np.arange(31)[:, None] * speed[0].mean(axis=0), atol=1e-9)
    assert np.abs(flown(replace(RULES, noise=0), start, speed, 30).mean(axis=1) - free).max() > 1


def test_a_boid_takes_up_the_cruising_velocity_and_slows_down_where_it_arrives() -> None:
    rules = replace(NONE, target=0.1, commits=(10**6, 10**6))
    path = flown(rules, np.zeros((1, 1, 3)), np.zeros((1, 1, 3)), 400)[:, 0]
    np.testing.assert_allclose(np.diff(path, axis=0)[:40, 0], 1 - 0.9 ** np.arange(1, 41))
    np.testing.assert_allclose(path[-1], GOALS.mean(axis=0), atol=1e-6)


def test_nothing_gives_the_goal_away_before_the_group_commits() -> None:
    one, other = (
        flown(RULES, EXPERTS.test.positions[:1, 0], EXPERTS.test.velocities[:1, 0], 90, goal) for goal in (0, 1)
    )
    differ = (one != other).any(axis=(1, 2))
    first, last = RULES.commits
    assert not differ[: first + 1].any()
    assert differ[last + 1 :].all()
    assert nearer_goal(np.stack([one[-1], other[-1]])).tolist() == [0, 1]


def test_the_coin_is_fair() -> None:
    tosses = nearer_goal(flock._trials(RULES, 400, np.random.default_rng(0))[:, -1])
    assert abs(tosses.mean() - 0.5) < 4 * 0.5 / np.sqrt(400)
    loaded = nearer_goal(flock._trials(replace(RULES, goals=(1,)), 20, np.random.default_rng(0))[:, -1])
    assert set(loaded) == {1}


@pytest.mark.parametrize("split", SPLITS)
def test_every_split_has_both_goals_and_ends_there(split: str) -> None:
    ends = getattr(EXPERTS, split).positions[:, -1]
    if split != "test":
        ends = ends[1::2]  # of two windows of a trial, the second reaches a goal
    chosen = nearer_goal(ends)
    assert 0.25 < chosen.mean() < 0.75
    assert np.linalg.norm(ends.mean(axis=1) - GOALS[chosen], axis=-1).max() < 5


def test_boids_keep_apart_and_overlap_without_separation() -> None:
    assert distances(EXPERTS.test.positions[:, 25:]).min() > 2
    merged = generate(rules=replace(RULES, separation=0)).test.positions
    assert np.median(distances(merged[:, -1])) < 0.2


def test_windows_are_cut_as_those_of_recorded_motion() -> None:
    assert [getattr(EXPERTS, split).positions.shape for split in SPLITS] == [
        (100, 50, 5, 3), (40, 50, 5, 3), (40, 100, 5, 3)
    ]  # fmt: skip
    train = EXPERTS.train
    assert (train.trial is not None, train.frame is not None) == (True, True)
    np.testing.assert_allclose(np.diff(train.positions, axis=1), train.velocities[:, 1:], atol=1e-12)
    np.testing.assert_allclose(
        train.positions[1::2, 0] - train.positions[::2, -1], train.velocities[1::2, 0], atol=1e-12
    )
    numbers = [set(getattr(EXPERTS, split).trial) for split in SPLITS]
    assert [len(found) for found in numbers] == [50, 20, 40]
    assert len(set.union(*numbers)) == 110


def test_it_is_an_expert_set_of_mocap_and_follows_from_its_seed(tmp_path: Path) -> None:
    expert_sets.save(generate(), tmp_path / "flock.npz")
    loaded = expert_sets.load(tmp_path / "flock.npz", "mocap")
    assert loaded.hash == EXPERTS.hash
    np.testing.assert_array_equal(loaded.test.positions, EXPERTS.test.positions)
    assert generate(1).hash != EXPERTS.hash
