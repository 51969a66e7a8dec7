"""What the training loop asks of a method: something that learns, and something that predicts."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, Protocol

import torch
from torch import Tensor, nn

from ssmail.config.spec import RunSpec
from ssmail.envs.integrator import Integrator
from ssmail.training.replay import Batch
from ssmail.training.seeding import Generators


@dataclass(frozen=True)
class Setting:
    """What a learner is made from. `experts` holds the scaled training trajectories; all tensors are on its device."""

    spec: RunSpec
    experts: Batch
    integrator: Integrator
    generators: Generators

    @property
    def device(self) -> torch.device:
        """Where the tensors are."""
        return self.experts.states.device

    @property
    def steps(self) -> int:
        """Actions in a trajectory."""
        return self.experts.actions.shape[1]


class Predictor(Protocol):
    """Predicts trajectories in scaled units, from the weights that it has now."""

    def free_run(
        self,
        observed: Tensor,
        steps: int,
        generator: torch.Generator,
        *,
        deterministic: bool = False,
        noise: Tensor | None = None,
    ) -> Tensor:
        """States (B, steps + 1, N, D): the last of those `observed` (B, H, N, D), then each predicted from the
        predictions before. `noise` (B, H + steps - 1, N, D) is added to every state that is read.
        """
        ...

    def one_step(self, states: Tensor, generator: torch.Generator) -> Tensor:
        """(B, T, N, D): the mean prediction of states[:, 1:] from states (B, T + 1, N, D), each from the true past."""
        ...

    def state_dict(self) -> dict[str, Any]:
        """The weights."""
        ...

    def load_state_dict(self, state: dict[str, Any]) -> object:
        """Inverse of `state_dict`."""
        ...


class Learner(Protocol):
    """One method in training."""

    @property
    def predictor(self) -> Predictor:
        """What is evaluated, with the weights of now."""
        ...

    def networks(self) -> Iterable[nn.Module]:
        """All networks that learn; a weight that is not finite ends the run as diverged."""
        ...

    def run_epoch(self, epoch: int) -> dict[str, float]:
        """Train for epoch 0 .. epochs - 1 and return its metrics."""
        ...

    def state_dict(self) -> dict[str, Any]:
        """Everything that an epoch changes, but for the generators: tensors and plain data only."""
        ...

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Inverse of `state_dict`."""
        ...
