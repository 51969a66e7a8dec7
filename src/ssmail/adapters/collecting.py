"""Expert sets from episodes: play them in any PettingZoo parallel environment, or bring their positions along."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ssmail.data.importing.arrays import add_array
from ssmail.data.importing.dataset import ImportOptions, set_of_rows
from ssmail.data.importing.rows import RowCollector, SourceFile
from ssmail.data.trajectories import ExpertSet, Floats
from ssmail.errors import InputError

Joint = Mapping[Any, Any]
"""One observation or action for each agent, by its name."""


def collect_episodes(
    env: Any,
    policy: Callable[[Joint], Joint],
    positions: Callable[[Joint], Any],
    *,
    episodes: int,
    seed: int = 0,
    steps: int = 1000,
) -> list[Floats]:
    """Play episodes of a PettingZoo parallel environment, and return the positions (F, N, P) of each.

    policy: turns the observations of all agents into their actions; the randomness in it is its own. positions: turns
    the observations into an array (N, P) in the unit of the environment, the same agents in each row.

    Every episode has a seed of its own, which descends from `seed`, so that each can be played alone. An episode is
    recorded until an agent leaves or joins, or for `steps` steps. Raises InputError, with the episode and the step, if
    `positions` returns no finite array (N, P) with 1 to 3 axes, or another N than at the start of the episode.
    """
    seeds = np.random.SeedSequence(seed).generate_state(episodes).tolist()
    return [_episode(env, policy, positions, number, one, steps) for number, one in enumerate(seeds)]


def _episode(
    env: Any,
    policy: Callable[[Joint], Joint],
    positions: Callable[[Joint], Any],
    number: int,
    seed: int,
    steps: int,
) -> Floats:
    observations, _ = env.reset(seed=seed)
    agents = list(env.agents)
    frames = [_checked(positions(observations), number, 0)]
    while env.agents == agents and len(frames) <= steps:
        observations, *_ = env.step(policy(observations))
        if not set(env.agents) <= set(agents) <= observations.keys():
            break
        frame = _checked(positions(observations), number, len(frames))
        if frame.shape != frames[0].shape:
            raise InputError(
                f"`positions` returns {frame.shape} in step {len(frames)} of episode {number}, after {frames[0].shape} "
                "before; return the same agents throughout"
            )
        frames.append(frame)
    return np.stack(frames)


def _checked(found: Any, number: int, step: int) -> Floats:
    frame = np.array(found, dtype=np.float64)
    if frame.ndim != 2 or not frame.size or frame.shape[1] > 3:
        raise InputError(
            f"`positions` returns the shape {frame.shape} in step {step} of episode {number}; return (agents, 1 to 3 "
            "axes)"
        )
    if not np.isfinite(frame).all():
        raise InputError(f"`positions` returns NaN or infinite values in step {step} of episode {number}")
    return frame


def expert_set(scenes: Sequence[Floats], options: ImportOptions | None = None) -> ExpertSet:
    """Make an expert set of the environment `trajectories` from the positions (F, N, P) of scenes, such as episodes.

    They are cut into windows and split by scene as `ssmail import-data` does it, with the same options; a window of T
    states takes T + 1 frames. Row n counts as the same agent in all scenes if these have equally many agents, unless
    `options.same_agents` is False. Raises InputError as it does.
    """
    if not scenes:
        raise InputError("an expert set needs scenes, and there are none; collect some episodes")
    collector = RowCollector()
    for number, scene in enumerate(scenes):
        name = f"scene_{number:05d}"
        add_array(scene[None], "the array", SourceFile(Path(name), name), collector)
    experts, _ = set_of_rows(collector.finish(), options or ImportOptions(), "the scenes")
    return experts
