"""How learning rates fall in the course of training."""

from collections.abc import Mapping

import torch

from ssmail.config.sections import TrainingSpec


class DecayingRates:
    """Optimisers by name, each with its first rate and the fraction of it that the last epoch has."""

    def __init__(
        self, training: TrainingSpec, optimizers: Mapping[str, torch.optim.Optimizer], final: Mapping[str, float]
    ) -> None:
        self.training, self.optimizers, self.final = training, optimizers, final
        self.first = {name: optimizer.param_groups[0]["lr"] for name, optimizer in optimizers.items()}

    def set(self, epoch: int) -> None:
        """Set the rates of epoch 0 .. epochs - 1: constant up to training.decay_start, then falling geometrically."""
        last = max(self.training.epochs - 1, 1)
        start = self.training.decay_start
        decayed = max(epoch / last - start, 0) / max(1 - start, 1e-9)
        for name, optimizer in self.optimizers.items():
            optimizer.param_groups[0]["lr"] = self.first[name] * self.final[name] ** decayed
