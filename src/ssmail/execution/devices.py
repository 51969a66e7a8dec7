"""Which device each worker process computes on: the only CPU, or one of the GPUs that PyTorch sees."""

from collections.abc import Sequence

from ssmail.execution.cells import AUTO
from ssmail.store import schema


def visible_gpus() -> list[str]:
    """Return the GPUs that PyTorch sees, which CUDA_VISIBLE_DEVICES may restrict: "cuda:0", "cuda:1", ..."""
    import torch  # late: it takes seconds

    return [f"cuda:{number}" for number in range(torch.cuda.device_count())]


def places(device: str, per_device: int = 1) -> list[str]:
    """Return the device of each process that may run at once; none for "cpu", where there may be any number.

    "cuda" stands for all GPUs, each as often as `per_device` says, "cuda:1" for that one, and "auto" for all GPUs or,
    if there are none, the CPU.
    """
    if device == "cpu":
        return []
    return (visible_gpus() if device in ("cuda", AUTO) else [device]) * per_device


def least_used(places: Sequence[str], used: Sequence[str]) -> str:
    """Return the first of the devices on which the fewest processes run, given the device of each that does."""
    return min(places, key=used.count)


def also_on(before: str, device: str) -> str:
    """Return the recorded devices of a run that goes on with another one: "cuda:0, cpu"; shorter if they are many."""
    names = dict.fromkeys([*before.split(", "), device])
    longest = schema.run.c.device.type.length  # type: ignore[attr-defined]
    text = ", ".join(names)
    return (
        text if len(text) <= longest else ", ".join(dict.fromkeys(name.partition(":")[0] for name in names))[:longest]
    )
