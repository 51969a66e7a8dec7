"""ssmail's environments as PettingZoo sees them."""

import warnings

import numpy as np
import pytest

pytest.importorskip("pettingzoo", reason="pettingzoo is not installed (extra adapters)")

from pettingzoo.test import parallel_api_test, parallel_seed_test

from ssmail.adapters.collecting import expert_set
from ssmail.adapters.parallel_env import TrajectoryEnv
from ssmail.config.data_sections import LettersSpec, YJunctionSpec
from ssmail.data import letters, yjunction
from ssmail.data.importing.dataset import ImportOptions
from ssmail.data.mocap.dataset import NO_LINES, MocapParameters
from ssmail.data.trajectories import SPLITS, ExpertSet, Trajectories
from ssmail.errors import InputError


def yjunction_set() -> ExpertSet:
    return yjunction.generate(
        YJunctionSpec(train=6, validation=2, test=2, agents=3, steps=20, lane_angle=43.0, jitter=0.5, seed=0)
    )


def letters_set() -> ExpertSet:
    return letters.generate(LettersSpec(word="ML", train=4, validation=2, test=2, steps=20, jitter=1.0, seed=0))


def mocap_set() -> ExpertSet:
    """Three joints that wander in space, and longer windows in the test split, as recorded motion has."""
    draw = np.random.default_rng(0)
    splits = {}
    for split, steps in zip(SPLITS, (10, 10, 20), strict=True):
        path = draw.normal(size=(5, steps + 1, 3, 3)).cumsum(axis=1)
        cut = np.arange(5)
        splits[split] = Trajectories.single_mode(path[:, 1:], np.diff(path, axis=1), cut, cut)
    params = MocapParameters(subject=1, train=(1,), validation=(2,), test=(3,), window=10, test_window=20)
    return ExpertSet.bundle(splits, NO_LINES, params.model_dump(mode="json"), ("hip", "knee", "foot"), (-1, 0, 1))


def trajectories_set() -> ExpertSet:
    """Walks on a line, of two agents in half of the scenes and of three in the others."""
    draw = np.random.default_rng(0)
    scenes = [draw.normal(size=(25, 2 + number % 2, 1)).cumsum(axis=0) for number in range(12)]
    return expert_set(scenes, ImportOptions(window=12, split=(1, 1, 1)))


SETS = {"yjunction": yjunction_set, "letters": letters_set, "mocap": mocap_set, "trajectories": trajectories_set}


@pytest.fixture(params=SETS)
def experts(request: pytest.FixtureRequest) -> ExpertSet:
    made: ExpertSet = SETS[request.param]()
    return made


@pytest.mark.parametrize("split", SPLITS)
def test_pettingzoo_accepts_every_environment(experts: ExpertSet, split: str) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        if experts.environment == "trajectories":  # a window may lack agents of the set
            warnings.filterwarnings("ignore", message="No agents present but not all possible_agents")
        parallel_api_test(TrajectoryEnv(experts, split), num_cycles=50)
        parallel_seed_test(lambda: TrajectoryEnv(experts, split), num_cycles=50)


def played(env: TrajectoryEnv, window: int, actions: np.ndarray) -> tuple[np.ndarray, list[dict[str, bool]]]:
    """The joint states (T', N, 2P) from the start of a window on, and the truncations of each step."""
    env.reset(options={"window": window})
    count = len(env.possible_agents)
    states, ends = [env.state().reshape(count, -1)], []
    for velocities in actions:
        *_, truncations, _ = env.step(dict(zip(env.agents, velocities, strict=False)))
        states.append(env.state().reshape(count, -1))
        ends.append(truncations)
    return np.stack(states), ends


@pytest.mark.parametrize("observed", [1, 5])
def test_the_experts_velocities_lead_along_its_path_to_the_end_of_the_window(experts: ExpertSet, observed: int) -> None:
    env, windows = TrajectoryEnv(experts, "test", observed=observed), experts.test
    states, ends = played(env, 1, windows.velocities[1, observed:])
    axes = windows.positions.shape[-1]
    np.testing.assert_allclose(states[..., :axes], windows.positions[1, observed - 1 :], atol=1e-12)
    np.testing.assert_allclose(states[..., axes:], windows.velocities[1, observed - 1 :], atol=1e-12)
    assert [all(step.values()) for step in ends] == [False] * (len(ends) - 1) + [True]
    assert env.agents == []
    assert env.step({}) == ({}, {}, {}, {}, {})


def test_a_window_has_the_first_of_the_agents() -> None:
    experts = trajectories_set()
    env = TrajectoryEnv(experts)
    assert env.possible_agents == ["agent_0", "agent_1", "agent_2"]
    assert experts.train.agents is not None
    assert set(experts.train.agents) == {2, 3}
    for window, count in enumerate(experts.train.agents):
        observations, _ = env.reset(options={"window": window})
        assert list(observations) == env.agents == env.possible_agents[:count]
        actions = {agent: np.ones(1) for agent in env.agents}
        assert set(env.step(actions)[0]) == set(actions)
        assert (env.state().reshape(3, 2)[count:] == 0).all()


def test_an_observation_begins_with_the_agents_own_state() -> None:
    experts = yjunction_set()
    env = TrajectoryEnv(experts)
    observations, infos = env.reset(options={"window": 2})
    rows = np.concatenate([experts.train.positions[2, 0], experts.train.velocities[2, 0]], axis=-1)
    np.testing.assert_array_equal(observations["agent_1"], rows[[1, 0, 2]].ravel())
    np.testing.assert_array_equal(env.state(), rows.ravel())
    assert infos["agent_1"] == {"window": 2}


def test_a_seed_decides_the_windows() -> None:
    env = TrajectoryEnv(yjunction_set())

    def drawn(seed: int) -> list[int]:
        return [env.reset(seed=seed if n == 0 else None)[1]["agent_0"]["window"] for n in range(20)]

    assert drawn(1) == drawn(1)
    assert drawn(1) != drawn(2)
    assert set(drawn(1)) == set(range(6))


def test_the_reward_is_of_the_agents_and_zero_by_default() -> None:
    experts = yjunction_set()

    def progress(state: np.ndarray, action: np.ndarray, following: np.ndarray) -> np.ndarray:
        np.testing.assert_allclose(following[:, :2] - state[:, :2], action, atol=1e-12)
        moved: np.ndarray = following[:, 0] - state[:, 0]
        return moved

    actions = {f"agent_{n}": np.array([n + 1.0, 0.0]) for n in range(3)}
    for reward, expected in ((progress, [1.0, 2.0, 3.0]), (None, [0.0, 0.0, 0.0])):
        env = TrajectoryEnv(experts, reward=reward)
        env.reset(seed=0)
        assert list(env.step(actions)[1].values()) == pytest.approx(expected)


def test_every_velocity_of_the_expert_is_an_action_with_room_on_both_sides() -> None:
    experts = yjunction_set()
    space = TrajectoryEnv(experts).action_space("agent_0")
    lowest, highest = experts.train.velocities.min(), experts.train.velocities.max()
    np.testing.assert_allclose(space.low, lowest - (highest - lowest) / 2)
    np.testing.assert_allclose(space.high, highest + (highest - lowest) / 2)


def test_bad_arguments_end_as_one_sentence() -> None:
    experts = yjunction_set()
    with pytest.raises(InputError, match="unknown split 'testing'; did you mean test"):
        TrajectoryEnv(experts, "testing")
    with pytest.raises(InputError, match="20 observed states leave no step of windows of 20; observe 1 to 19"):
        TrajectoryEnv(experts, observed=20)
    for window in (6, -1, "first"):
        with pytest.raises(InputError, match=r"there is no window .*; the split has the windows 0 to 5"):
            TrajectoryEnv(experts).reset(options={"window": window})
