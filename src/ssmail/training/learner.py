"""The interfaces between the training loop and a method: a Learner trains, its Predictor is evaluated."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol, TypedDict, Unpack

import torch
from torch import Tensor, nn

from ssmail.config.spec import RunSpec
from ssmail.envs.integrator import Integrator
from ssmail.models.features import Features
from ssmail.training.agent_numbers import turns
from ssmail.training.batches import Batch
from ssmail.training.checkpoint import Stateful
from ssmail.training.seeding import Generators


@dataclass(frozen=True)
class LearnerContext:
    """Everything that a learner is built from.

    spec: without null or "auto" for what the data decide. experts: the training split, scaled, on the learner's device.
    others: of a set in which the number of agents differs, the trajectories with other numbers than the most common
    one, which `experts` has; a batch for each number.
    """

    spec: RunSpec
    experts: Batch
    integrator: Integrator
    generators: Generators
    others: tuple[Batch, ...] = ()

    @property
    def by_number(self) -> tuple[Batch, ...]:
        """The training split, for each number of agents."""
        return (self.experts, *self.others)

    def turns(self, epoch: int, updates: int) -> list[int]:
        """Return the index in `by_number` of the trajectories that each update of an epoch trains on."""
        return turns([len(batch) for batch in self.by_number], epoch * updates, updates)

    @property
    def device(self) -> torch.device:
        """The device of all tensors."""
        return self.experts.states.device

    @property
    def steps(self) -> int:
        """The number of actions in a training trajectory."""
        return self.experts.actions.shape[1]


def experts_of_seeds(contexts: Sequence[LearnerContext]) -> tuple[Batch, ...]:
    """Return the training split for each number of agents: what all seeds share, or side by side what each has."""
    of_each = [context.by_number for context in contexts]
    if all(torch.equal(a.states, b.states) for own in of_each for a, b in zip(own, of_each[0], strict=True)):
        return of_each[0]
    return tuple(Batch.of_seeds(batches) for batches in zip(*of_each, strict=True))


class Reading(TypedDict, total=False):
    """How a predictor reads and acts in `Predictor.free_run`; by default it samples once, without noise.

    deterministic: replace sampled actions by their means. noise: (B, H + steps - 1, N, D), added to every state read;
    not with several samples. samples: futures of each group; samples * B trajectories are returned, the first sample of
    every group, then the second, and so on.
    """

    deterministic: bool
    noise: Tensor | None
    samples: int


class Predictor(Protocol):
    """Predicts trajectories in scaled units with its model's current weights."""

    @property
    def model(self) -> nn.Module:
        """The network whose weights the loop keeps for the best epoch."""
        ...

    @property
    def features(self) -> Features | None:
        """What the networks read of the states; None if there are no networks."""
        ...

    def free_run(self, observed: Tensor, steps: int, generator: torch.Generator, **reading: Unpack[Reading]) -> Tensor:
        """Predict `steps` states from the `observed` ones (B, H, N, D), feeding each prediction back as input.

        Returns (B, steps + 1, N, D): the last observed state and the predictions.
        """
        ...

    def one_step(self, states: Tensor, generator: torch.Generator) -> Tensor:
        """Predict the mean of states[:, 1:] from states (B, T + 1, N, D), each from its true past: (B, T, N, D)."""
        ...


class Learner(Protocol):
    """One method in training."""

    @property
    def predictor(self) -> Predictor:
        """The predictor to evaluate, with the current weights."""
        ...

    def networks(self) -> Iterable[nn.Module]:
        """Return all trained networks. A weight that is not finite ends the run as diverged."""
        ...

    def run_epoch(self, epoch: int) -> dict[str, float]:
        """Train for epoch 0 .. epochs - 1 and return its metrics."""
        ...

    def parts(self) -> Mapping[str, Stateful]:
        """Return everything that an epoch changes, except the generators, under its name in a checkpoint."""
        ...
