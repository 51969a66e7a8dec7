"""Expert trajectories as tensors, and batches of them."""

import numpy as np
import torch

from ssmail.data.scaling import Scaling
from ssmail.data.trajectories import Trajectories
from ssmail.training.batches import Batch


def test_states_and_actions_are_scaled_and_an_action_is_the_next_velocity() -> None:
    """Positions 0 .. 10 and velocities 0 .. 4 become -1 .. 1."""
    positions = np.array([0.0, 4.0, 5.0]).reshape(1, 3, 1, 1)
    velocities = np.array([2.0, 4.0, 1.0]).reshape(1, 3, 1, 1)
    trajectories = Trajectories(positions, velocities, np.zeros(1, dtype=np.int64), positions[None])
    batch = Batch.from_trajectories(trajectories, Scaling(0.0, 10.0, 0.0, 4.0), torch.device("cpu"))
    assert batch.states[0, :, 0].tolist() == [[-1.0, 0.0], [torch.tensor(-0.2).item(), 1.0], [0.0, -0.5]]
    assert batch.actions[0, :, 0].tolist() == [[1.0], [-0.5]]
    assert batch.states.dtype == batch.actions.dtype == torch.float32
    assert batch.source.tolist() == [0]


def test_draws_are_uniform_with_replacement_and_know_where_they_are_from() -> None:
    positions = np.arange(4.0).reshape(4, 1, 1, 1).repeat(2, axis=1)
    trajectories = Trajectories(positions, positions, np.zeros(4, dtype=np.int64), positions[None])
    experts = Batch.from_trajectories(trajectories, Scaling(-1.0, 1.0, -1.0, 1.0), torch.device("cpu"))
    drawn = experts.draw(4000, torch.Generator().manual_seed(0))
    assert torch.equal(drawn.states[:, 0, 0, 0], drawn.source.float())
    assert (torch.bincount(drawn.source) - 1000).abs().max() < 120  # more than four standard deviations
