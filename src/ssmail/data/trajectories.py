"""Expert trajectories as arrays, whichever environment they come from."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ssmail.data.scaling import Scaling

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]


@dataclass(frozen=True)
class Trajectories:
    """B trajectories of N agents over T steps in raw units.

    positions, velocities: (B, T, N, P) with velocities[:, t] = positions[:, t] - positions[:, t - 1] for t >= 1.
    mode: (B,) index of the mode that each trajectory follows, 0 where the environment has only one.
    continuations: (L, B, T, N, P) positions of the expert from the same starts into each of its L modes.
    """

    positions: Floats
    velocities: Floats
    mode: Integers
    continuations: Floats

    def __len__(self) -> int:
        return len(self.positions)

    def __getitem__(self, index: Integers) -> "Trajectories":
        """Those trajectories of which `index` holds the positions in the set."""
        continuations = self.continuations[:, index]
        return Trajectories(self.positions[index], self.velocities[index], self.mode[index], continuations)


@dataclass(frozen=True)
class ExpertSet:
    """The three splits of an environment's expert data, with what identifies them.

    centre_lines: (L, P', P) points of each mode's centre line in raw units; empty where there is none.
    hash: SHA-256 of the arrays and of the parameters that made them.
    """

    train: Trajectories
    validation: Trajectories
    test: Trajectories
    centre_lines: Floats
    parameters: Mapping[str, object]
    hash: str

    @property
    def scaling(self) -> Scaling:
        """Scaling to [-1, 1], fitted to the training split only."""
        return Scaling.fit(self.train.positions, self.train.velocities)
