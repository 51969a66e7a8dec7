"""Expert sets in which the number of agents differs: a batch has one number, and the numbers take turns."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch

from ssmail.data.scaling import Scaling
from ssmail.data.trajectories import Integers, Trajectories
from ssmail.training.batches import Batch, ReplayBuffer


def windows_by_number(trajectories: Trajectories) -> dict[int, Integers]:
    """Return the indices of the trajectories with each number of agents, from the most common number to the rarest."""
    if trajectories.agents is None:
        return {trajectories.positions.shape[2]: np.arange(len(trajectories))}
    numbers, counts = np.unique(trajectories.agents, return_counts=True)
    order = np.argsort(-counts, kind="stable")
    return {int(n): np.flatnonzero(trajectories.agents == n) for n in numbers[order]}


def with_agents(trajectories: Trajectories, index: Integers, agents: int) -> Trajectories:
    """Return the trajectories at `index`, which have so many agents, without padding."""
    chosen, kept = trajectories[index], slice(agents)
    return replace(
        chosen,
        positions=chosen.positions[:, :, kept],
        velocities=chosen.velocities[:, :, kept],
        continuations=chosen.continuations[:, :, :, kept],
        agents=None,
    )


def batches_by_number(trajectories: Trajectories, scaling: Scaling, device: torch.device) -> tuple[Batch, ...]:
    """Return the trajectories of each number of agents as a batch, from the most common number to the rarest."""
    return tuple(
        Batch.from_trajectories(with_agents(trajectories, index, agents), scaling, device)
        for agents, index in windows_by_number(trajectories).items()
    )


def turns(windows: Sequence[int], first: int, count: int) -> list[int]:
    """Return which number's turn it is in updates `first` .. `first + count - 1` of a training.

    windows: how many trajectories there are of each number of agents. The turns of a number are evenly spaced, and as
    frequent as its trajectories: its k-th one is due at (k + 1/2) / share, and those that are due first come first.
    Nothing is drawn, so seeds that are trained together take the same turns.
    """
    if len(windows) == 1:
        return [0] * count
    last = first + count
    shares = np.asarray(windows) / sum(windows)
    known = np.ceil((last + len(windows)) * shares).astype(int) + 1  # more than can be due by then
    number = np.repeat(np.arange(len(windows)), known)
    due = np.concatenate([(np.arange(k) + 0.5) / share for k, share in zip(known, shares, strict=True)])
    order: list[int] = number[np.lexsort((number, due))][first:last].tolist()
    return order


def replay_name(agents: int, by_number: Sequence[Batch]) -> str:
    """Return the name of the replay buffer of trajectories with so many agents, in the learner and in checkpoints."""
    return "replay" if len(by_number) == 1 else f"replay_{agents}"


def replay_buffers(capacity: int, by_number: Sequence[Batch]) -> dict[str, ReplayBuffer]:
    """Return a replay buffer for each number of agents, with its share of the capacity."""
    total = sum(map(len, by_number))
    return {
        replay_name(experts.states.shape[2], by_number): ReplayBuffer(max(1, capacity * len(experts) // total), experts)
        for experts in by_number
    }
