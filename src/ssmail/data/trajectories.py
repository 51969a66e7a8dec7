"""Expert trajectories as arrays, whichever environment they come from."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ssmail.data.scaling import Scaling

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
SPLITS = ("train", "validation", "test")


@dataclass(frozen=True)
class Trajectories:
    """B trajectories of N agents over T steps in raw units.

    positions, velocities: (B, T, N, P) with velocities[:, t] = positions[:, t] - positions[:, t - 1] for t >= 1.
    mode: (B,) index of the mode that each trajectory follows, 0 where the environment has only one.
    continuations: (L, B, T, N, P) positions of the expert from the same starts into each of its L modes.
    trial, frame: (B,) of recorded motion, the trial that each was cut from and the number of its first frame there;
    None for an expert that was not recorded.
    """

    positions: Floats
    velocities: Floats
    mode: Integers
    continuations: Floats
    trial: Integers | None = None
    frame: Integers | None = None

    def __len__(self) -> int:
        return len(self.positions)

    def __getitem__(self, index: Integers) -> "Trajectories":
        """Those trajectories of which `index` holds the positions in the set."""
        return Trajectories(
            self.positions[index],
            self.velocities[index],
            self.mode[index],
            self.continuations[:, index],
            None if self.trial is None else self.trial[index],
            None if self.frame is None else self.frame[index],
        )


@dataclass(frozen=True)
class ExpertSet:
    """The three splits of an environment's expert data, with what identifies them.

    centre_lines: (L, P', P) points of each mode's centre line in raw units; of letters, (N, P', P) the letter that each
    agent draws; empty where there is none.
    parameters: what made the set; its "environment", where absent, is yjunction.
    hash: SHA-256 of the arrays and of the parameters that made them, and of the skeleton.
    joints, parents: names of the N agents where they are the joints of a skeleton, and for each the one that it hangs
    on, -1 for the root; empty for agents of other kinds.
    sources: files that the set was made from, with their SHA-256; a record that is no part of `hash`.
    """

    train: Trajectories
    validation: Trajectories
    test: Trajectories
    centre_lines: Floats
    parameters: Mapping[str, object]
    hash: str
    joints: tuple[str, ...] = ()
    parents: tuple[int, ...] = ()
    sources: Mapping[str, str] = field(default_factory=dict)

    @property
    def environment(self) -> str:
        """The environment that the set belongs to."""
        return str(self.parameters.get("environment", "yjunction"))

    @property
    def scaling(self) -> Scaling:
        """Scaling to [-1, 1], fitted to the training split only."""
        return Scaling.fit(self.train.positions, self.train.velocities)
