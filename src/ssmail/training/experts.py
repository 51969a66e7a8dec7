"""Expert trajectories as scaled tensors, and tensors as arrays again."""

import numpy as np
import torch
from torch import Tensor

from ssmail.data.scaling import Scaling
from ssmail.data.trajectories import Floats, Trajectories
from ssmail.training.replay import Batch


def scaled_batch(trajectories: Trajectories, scaling: Scaling, device: torch.device) -> Batch:
    """Scaled states (B, T, N, 2P) and the actions (B, T - 1, N, P) that led from each to the next."""
    velocities = scaling.scale_velocities(trajectories.velocities)
    states = np.concatenate([scaling.scale_positions(trajectories.positions), velocities], axis=-1)
    source = torch.arange(len(trajectories), device=device)
    return Batch(
        torch.as_tensor(states, dtype=torch.float32, device=device),
        torch.as_tensor(velocities[:, 1:], dtype=torch.float32, device=device),
        source,
    )


def as_doubles(tensor: Tensor) -> Floats:
    """Its values in double precision, in the CPU's memory."""
    array: Floats = tensor.double().cpu().numpy()
    return array
