"""Expert trajectories as arrays, for every environment."""

import hashlib
import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ssmail.config.data_sections import LettersSpec, YJunctionSpec
from ssmail.data.scaling import Scaling, ends
from ssmail.errors import InputError

Floats = NDArray[np.float64]  # arrays of any shape; the docstrings give the axes
Integers = NDArray[np.int64]
Booleans = NDArray[np.bool_]
SPLITS = ("train", "validation", "test")
LARGEST_SCALED = 1e6  # of scaled positions and velocities; those to train on are in [-1, 1]
# The same of anyone's trajectories, in which agents may jump. Float32 holds the square of an error of this size, over
# the least variance of a likelihood (1e-12), in sums of millions.
LARGEST_JUMP = 1e9
FIELDS = {  # environment -> the arrays of a split that are hashed and stored, in this order; the rest follows from them
    "yjunction": ("positions", "velocities", "mode", "continuations"),
    "letters": ("positions", "velocities", "mode"),
    "mocap": ("positions", "velocities", "mode", "trial", "frame"),
    "trajectories": ("positions", "velocities", "agents", "scene", "frame"),
}


def largest_scaled(environment: str) -> float:
    """Return how large a scaled position or velocity of this environment may be."""
    return LARGEST_JUMP if environment == "trajectories" else LARGEST_SCALED


@dataclass(frozen=True)
class Trajectories:
    """B trajectories of N agents over T steps, in raw units.

    positions, velocities: (B, T, N, P) with velocities[:, t] = positions[:, t] - positions[:, t - 1] for t >= 1.
    mode: (B,) index of the expert's mode that each trajectory follows; 0 if the environment has only one.
    continuations: (L, B, T, N, P) the expert's positions from the same starts into each of its L modes.
    trial, frame: (B,) for recorded motion, the trial that each trajectory was cut from and the number of its first
    frame there; None otherwise.
    agents: (B,) how many agents each trajectory has: the first so many of the N; the rest is padding, zero in all
    arrays. None if all have N.
    scene: (B,) for sets of trajectories, the index of the scene that each was cut from; None otherwise.
    """

    positions: Floats
    velocities: Floats
    mode: Integers
    continuations: Floats
    trial: Integers | None = None
    frame: Integers | None = None
    agents: Integers | None = None
    scene: Integers | None = None

    @classmethod
    def single_mode(
        cls,
        positions: Floats,
        velocities: Floats,
        trial: Integers | None = None,
        frame: Integers | None = None,
        agents: Integers | None = None,
        scene: Integers | None = None,
    ) -> "Trajectories":
        """Trajectories (B, T, N, P) of an expert with one mode: the continuation is the trajectory itself."""
        mode = np.zeros(len(positions), dtype=np.int64)
        return cls(positions, velocities, mode, positions[None], trial, frame, agents, scene)

    @property
    def present(self) -> NDArray[np.bool_] | None:
        """(B, 1, N, 1) whether there is such an agent, to broadcast over positions; None if there always is."""
        if self.agents is None:
            return None
        return (np.arange(self.positions.shape[2]) < self.agents[:, None])[:, None, :, None]

    def __len__(self) -> int:
        return len(self.positions)

    def __getitem__(self, index: Integers) -> "Trajectories":
        """Return the trajectories at the positions `index` of the set."""
        return Trajectories(
            self.positions[index],
            self.velocities[index],
            self.mode[index],
            self.continuations[:, index],
            *(None if of is None else of[index] for of in (self.trial, self.frame, self.agents, self.scene)),
        )


@dataclass(frozen=True)
class ExpertSet:
    """The three splits of an environment's expert data, and what identifies them.

    centre_lines: (L, P', P) points of each mode's centre line in raw units; for letters, (N, P', P) the letter that
    each agent draws; empty for recorded motion.
    parameters: what the set was made from. Without an "environment" it is a yjunction set.
    hash: SHA-256 of the parameters, the skeleton, the names of the scenes and the arrays.
    joints, parents: for the joints of a skeleton, their N names and the index of each one's parent, -1 for the root;
    empty for other agents.
    sources: the files that the set was made from, with their SHA-256; not part of `hash`.
    scenes: for sets of trajectories, the names of the scenes that `Trajectories.scene` counts; empty otherwise.
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
    scenes: tuple[str, ...] = ()

    @classmethod
    def bundle(
        cls,
        splits: Mapping[str, Trajectories],
        centre_lines: Floats,
        parameters: Mapping[str, object],
        joints: tuple[str, ...] = (),
        parents: tuple[int, ...] = (),
        sources: Mapping[str, str] | None = None,
        scenes: tuple[str, ...] = (),
    ) -> "ExpertSet":
        """Put the splits together and compute their hash. The sources stay out of it: the same numbers from files with
        other line ends are the same data.
        """
        names = [joints, parents] if joints else [scenes] if scenes else []
        described = [parameters, *names] if names else parameters
        digest = hashlib.sha256(json.dumps(described, sort_keys=True).encode())
        fields = FIELDS[str(parameters.get("environment", "yjunction"))]
        for array in (*(getattr(splits[split], name) for split in SPLITS for name in fields), centre_lines):
            digest.update(np.ascontiguousarray(array).tobytes())
        train, validation, test = (splits[split] for split in SPLITS)
        made_from = dict(sources or {})
        return cls(
            train, validation, test, centre_lines, parameters, digest.hexdigest(), joints, parents, made_from, scenes
        )

    @property
    def environment(self) -> str:
        """The environment that the set belongs to."""
        return str(self.parameters.get("environment", "yjunction"))

    @property
    def scaling(self) -> Scaling:
        """The scaling to [-1, 1], fitted to the training split only."""
        return Scaling.fit(self.train.positions, self.train.velocities, self.train.present)

    @property
    def is_scalable(self) -> bool:
        """Whether there is a scaling, and none of the numbers is larger than `largest_scaled` once scaled."""
        try:
            scaling = self.scaling
        except ValueError:
            return False
        positions = [ends(self.centre_lines)] if self.centre_lines.size else []
        velocities = []
        for split in (self.train, self.validation, self.test):
            positions += [ends(array, split.present) for array in (split.positions, split.continuations) if array.size]
            velocities.append(ends(split.velocities, split.present))
        scaled = [scaling.scale_positions(end) for pair in positions for end in pair]
        scaled += [scaling.scale_velocities(end) for pair in velocities for end in pair]
        return all(abs(value) <= largest_scaled(self.environment) for value in scaled)

    def check_scaling(self, source: str, remedy: str, farthest: Callable[[], str] = str) -> None:
        """Raise InputError, with the remedy, if the numbers from this source cannot be scaled.

        farthest: what to add about the numbers that differ too much.
        """
        try:
            _ = self.scaling
        except ValueError:
            raise InputError(f"nothing moves in the training windows of {source}; {remedy}") from None
        if not self.is_scalable:
            which = farthest()
            raise InputError(f"the positions in {source} differ too much in size to be scaled alike{which}; {remedy}")


def generate_splits(
    params: LettersSpec | YJunctionSpec, generate: Callable[[int, np.random.Generator], Trajectories]
) -> dict[str, Trajectories]:
    """Generate as many trajectories for each split as `params` says, each split from a random stream of its own.

    Raises ValueError for parameters without a seed (`expert_sets.generate` fills in that of the run).
    """
    if params.seed is None:
        raise ValueError("data without a seed of their own need that of the run")
    seeds = np.random.SeedSequence(params.seed).spawn(len(SPLITS))
    return {
        split: generate(getattr(params, split), np.random.default_rng(seed))
        for split, seed in zip(SPLITS, seeds, strict=True)
    }
