"""What the updates of all learners share."""

from collections.abc import Iterable

import torch
from torch import Tensor, nn


def clipped_step(
    optimizer: torch.optim.Optimizer, loss: Tensor, parameters: Iterable[Tensor], gradient_clip: float
) -> None:
    """One step down the gradient of `loss`, its norm over `parameters` kept at or below `gradient_clip`."""
    optimizer.zero_grad(set_to_none=True)
    loss.backward()  # type: ignore[no-untyped-call]
    nn.utils.clip_grad_norm_(parameters, gradient_clip)
    optimizer.step()


def with_noise(x: Tensor, std: float, generator: torch.Generator) -> Tensor:
    """`x` plus Gaussian noise of `std` in its units; nothing is drawn for std 0."""
    if std == 0:
        return x
    return x + std * torch.randn(x.shape, generator=generator).to(x.device)


def mean_of(logs: list[dict[str, float]]) -> dict[str, float]:
    """The mean of each value over records of equal keys."""
    return {name: sum(log[name] for log in logs) / len(logs) for name in logs[0]}
