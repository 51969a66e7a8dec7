"""Episodes of a PettingZoo environment become an expert set."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("pettingzoo", reason="pettingzoo is not installed (extra adapters)")

from ssmail.adapters.collecting import collect_episodes, expert_set
from ssmail.adapters.imitation_format import read_imitation, write_imitation
from ssmail.adapters.parallel_env import TrajectoryEnv
from ssmail.data import expert_sets
from ssmail.data.importing.dataset import ImportOptions, import_set
from ssmail.data.trajectories import ExpertSet
from ssmail.errors import InputError
from tests.adapters.bouncing_box import BouncingBox

Joint = Mapping[str, np.ndarray]


def home(observations: Joint) -> Joint:
    """Accelerate towards the middle, and towards the right."""
    return {agent: np.array([0.05, 0.0]) - 0.02 * o[2:] for agent, o in observations.items()}


def positions(observations: Joint) -> np.ndarray:
    return np.stack([observation[2:] for observation in observations.values()])


def collected(episodes: int = 8, seed: int = 0, **world: int) -> list[np.ndarray]:
    return collect_episodes(BouncingBox(**world), home, positions, episodes=episodes, seed=seed)


def collected_set() -> ExpertSet:
    return expert_set(collected(), ImportOptions(window=10, observed=4))


def test_an_episode_is_recorded_from_its_first_to_its_last_observation() -> None:
    world = BouncingBox(steps=5)
    (episode,) = collect_episodes(world, home, positions, episodes=1, seed=3)
    assert episode.shape == (6, 3, 2)
    observations, _ = world.reset(seed=int(np.random.SeedSequence(3).generate_state(1)[0]))
    np.testing.assert_array_equal(episode[0], positions(observations))
    observations, *_ = world.step(home(observations))
    np.testing.assert_array_equal(episode[1], positions(observations))


def test_the_seed_decides_the_episodes_and_more_of_them_change_none() -> None:
    np.testing.assert_array_equal(collected(3, seed=1), collected(5, seed=1)[:3])
    assert (collected(1, seed=1)[0] != collected(1, seed=2)[0]).any()


def test_a_recording_ends_when_an_agent_leaves_or_joins_or_after_so_many_steps() -> None:
    assert collected(1, leaves=7)[0].shape == (8, 3, 2)
    assert collected(1, joins=7)[0].shape == (7, 2, 2)
    (episode,) = collect_episodes(BouncingBox(), home, positions, episodes=1, steps=4)
    assert len(episode) == 5


def test_the_windows_of_a_set_are_pieces_of_the_episodes(tmp_path: Path) -> None:
    episodes, experts = collected(), collected_set()
    assert experts.environment == "trajectories"
    assert experts.parameters["identity"] is True
    assert experts.sources == {}
    windows = experts.test
    assert windows.scene is not None
    assert windows.frame is not None
    for b in range(len(windows)):
        episode = episodes[int(experts.scenes[windows.scene[b]].removeprefix("scene_"))]
        begin = windows.frame[b]
        np.testing.assert_array_equal(windows.positions[b], episode[begin : begin + 10])
        np.testing.assert_array_equal(windows.velocities[b, 0], episode[begin] - episode[begin - 1])
    expert_sets.save(experts, tmp_path / "balls.npz")
    assert expert_sets.load(tmp_path / "balls.npz", "trajectories").hash == experts.hash


def test_a_set_goes_to_imitation_and_back_as_the_same_windows(tmp_path: Path) -> None:
    pytest.importorskip("datasets", reason="datasets is not installed (extra adapters)")
    experts = collected_set()
    write_imitation(experts.train, tmp_path / "train")
    scenes = read_imitation(tmp_path / "train")
    again = expert_set(scenes, ImportOptions(window=10, observed=4))
    found = np.concatenate([getattr(again, split).positions for split in ("train", "validation", "test")])
    assert len(found) == len(experts.train)
    for window in experts.train.positions:
        assert (np.abs(found - window).max(axis=(1, 2, 3)) < 1e-12).sum() == 1


def test_what_a_policy_does_in_a_world_of_ssmail_is_collected_too() -> None:
    """Agents that keep their velocity draw straight lines from where the expert starts."""
    env = TrajectoryEnv(collected_set())
    lines = collect_episodes(
        env,
        policy=lambda observations: {agent: own[2:4] for agent, own in observations.items()},
        positions=lambda observations: [own[:2] for own in observations.values()],
        episodes=4,
    )
    for line in lines:
        assert line.shape == (10, 3, 2)
        assert (np.abs(line[0] - env.trajectories.positions[:, 0]).max(axis=(1, 2)) == 0).any()
        np.testing.assert_allclose(np.diff(line, axis=0), np.broadcast_to(line[1] - line[0], (9, 3, 2)), atol=1e-12)


def test_bad_positions_end_as_one_sentence() -> None:
    world = BouncingBox()
    for bad, message in (
        (
            lambda o: np.zeros((3, 4)),
            r"returns the shape \(3, 4\) in step 0 of episode 0; return \(agents, 1 to 3 axes\)",
        ),
        (lambda o: np.zeros(3), r"returns the shape \(3,\)"),
        (lambda o: np.full((3, 2), np.nan), "returns NaN or infinite values in step 0 of episode 0"),
        (lambda o: np.zeros((2 + world.at, 2)), r"returns \(3, 2\) in step 1 of episode 0, after \(2, 2\)"),
    ):
        with pytest.raises(InputError, match=message):
            collect_episodes(world, home, bad, episodes=1)
    with pytest.raises(InputError, match="the longest possible is --window 30"):
        expert_set(collected(steps=30), ImportOptions(window=40))
    with pytest.raises(InputError, match=r"of scene_00001 has the shape 1x30x2 "):
        expert_set([np.zeros((30, 3, 2)), np.zeros((30, 2))])
    with pytest.raises(InputError, match="collect some episodes"):
        expert_set([])


def test_a_set_of_scenes_is_that_of_their_files(tmp_path: Path) -> None:
    for number, scene in enumerate(collected()):
        np.save(tmp_path / f"scene_{number:05d}.npy", scene[None])
    from_files, _ = import_set([tmp_path], ImportOptions(window=10, observed=4))
    assert collected_set().hash == from_files.hash
