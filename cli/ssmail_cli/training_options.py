"""Options that the commands that train share, and what they mean."""

from enum import StrEnum
from typing import Annotated

import typer

from ssmail.errors import InputError
from ssmail.execution import Resume

MOST_SEEDS = 1000


class Device(StrEnum):
    """Where to compute."""

    AUTO = "auto"
    CPU = "cpu"
    CUDA = "cuda"


ProfileName = Annotated[
    str, typer.Option("--profile", help="smoke (seconds), quick (minutes) or paper (the paper's scale).")
]
Seeds = Annotated[str, typer.Option("--seeds", help="Seeds, one run each: 0-4, or 0,2,5, or 0-2,7.")]
Jobs = Annotated[int, typer.Option("--jobs", "-j", min=1, help="Runs at the same time, a process each.")]
Settings = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="KEY=VALUE", help="Replace a value of the spec, as sac.gamma=0.9; repeatable."),
]
ResumeOption = Annotated[
    Resume,
    typer.Option("--resume", help="Continue an unfinished run: if there is one, never, or fail without one."),
]
DeviceOption = Annotated[Device, typer.Option("--device", help="auto takes a GPU when there is one.")]
DryRun = Annotated[bool, typer.Option("--dry-run", help="Print what would run, and train nothing.")]


def parse_seeds(text: str) -> list[int]:
    """ "0-2,7" -> [0, 1, 2, 7], in the order given and each once. Raises InputError for anything else."""
    seeds: dict[int, None] = {}
    for part in text.split(","):
        first, dash, last = part.strip().partition("-")
        if not first.isdecimal() or (dash and not last.isdecimal()):
            raise InputError(f"--seeds takes whole numbers and ranges such as 0-4 or 0,2,5, not '{text}'.")
        low, high = int(first), int(last or first)
        if low > high:
            raise InputError(f"the range {part.strip()} in --seeds runs backwards; write {high}-{low}.")
        if high - low >= MOST_SEEDS or high >= 2**31:
            raise InputError(f"--seeds {text} is more than {MOST_SEEDS} seeds or a seed above 2147483647; give less.")
        seeds.update(dict.fromkeys(range(low, high + 1)))
    return list(seeds)


def pick_device(choice: Device) -> str:
    """ "cpu" or "cuda". Raises InputError for cuda without one."""
    if choice is Device.CPU:
        return "cpu"
    import torch

    if torch.cuda.is_available():
        return "cuda"
    if choice is Device.CUDA:
        raise InputError("--device cuda needs a CUDA GPU and none is found; use --device cpu.")
    return "cpu"
