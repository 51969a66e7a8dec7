"""Checkpoints on disk: written whole or not at all, and read without running any code they hold."""

import zipfile
from pathlib import Path
from typing import Any

import torch

from ssmail.data.atomic_file import atomic_write
from ssmail.errors import InputError


def save_checkpoint(path: Path, state: dict[str, Any]) -> None:
    """Write `state` (nested dicts and lists of tensors and plain data) to `path`, making its folder if need be.

    A process that dies at any moment leaves the old file or the new one, and so does a power cut. Raises InputError
    when the file cannot be written.
    """
    try:
        with atomic_write(path) as partial, partial.open("wb") as file:
            torch.save(state, file)
    except OSError as error:
        raise InputError(
            f"cannot write the checkpoint {path} ({error.strerror}); free or choose another place"
        ) from error


def load_checkpoint(path: Path) -> dict[str, Any]:
    """The state that `save_checkpoint` wrote, on the CPU. Raises InputError for a file that is missing or damaged."""
    try:
        with zipfile.ZipFile(path) as archive:  # torch does not compare the checksums that it writes
            if archive.testzip() is not None:
                raise zipfile.BadZipFile("wrong checksum")
        state = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # damaged bytes make the unpickler raise nearly anything
        raise InputError(
            f"the checkpoint {path} cannot be read ({type(error).__name__}); start afresh with --resume never"
        ) from error
    if not isinstance(state, dict):
        raise InputError(f"{path} is not a checkpoint of ssmail; start afresh with --resume never")
    return state
