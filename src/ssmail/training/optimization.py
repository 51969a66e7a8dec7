"""Parts of a training epoch that all learners share."""

from collections.abc import Iterable, Mapping

import torch
from torch import Tensor, nn

from ssmail.config.sections import TrainingSpec
from ssmail.training.seeding import Source, normal_like


def clipped_step(
    optimizer: torch.optim.Optimizer, loss: Tensor, parameters: Iterable[Tensor], gradient_clip: float
) -> None:
    """Take one optimizer step on `loss`, with the gradient's norm over `parameters` clipped to `gradient_clip`."""
    optimizer.zero_grad(set_to_none=True)
    loss.backward()  # type: ignore[no-untyped-call]
    nn.utils.clip_grad_norm_(parameters, gradient_clip)
    optimizer.step()


def add_noise(x: Tensor, std: float, source: Source) -> Tensor:
    """Return `x` plus Gaussian noise with standard deviation `std`. Draws nothing for std 0."""
    if std == 0:
        return x
    return x + std * normal_like(x, source)


def mean_metrics(logs: list[dict[str, float]]) -> dict[str, float]:
    """Return the mean of each metric over the updates of an epoch. All logs have the same keys."""
    return {name: sum(log[name] for log in logs) / len(logs) for name in logs[0]}


class LearningRateSchedule:
    """Constant learning rates up to `training.decay_start`, then geometric decay.

    `final` holds, per optimizer, the last epoch's rate as a fraction of the first one.
    """

    def __init__(
        self, training: TrainingSpec, optimizers: Mapping[str, torch.optim.Optimizer], final: Mapping[str, float]
    ) -> None:
        self.training, self.optimizers, self.final = training, optimizers, final
        self.first = {name: optimizer.param_groups[0]["lr"] for name, optimizer in optimizers.items()}

    def set(self, epoch: int) -> None:
        """Set the learning rates of epoch 0 .. epochs - 1."""
        last = max(self.training.epochs - 1, 1)
        start = self.training.decay_start
        decayed = max(epoch / last - start, 0) / max(1 - start, 1e-9)
        for name, optimizer in self.optimizers.items():
            optimizer.param_groups[0]["lr"] = self.first[name] * self.final[name] ** decayed
