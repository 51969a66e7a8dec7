"""Checkpoints on disk: written whole or not at all, and read without running any code they hold."""

import os
import zipfile
from pathlib import Path
from typing import Any

import torch

from ssmail.errors import InputError


def save_checkpoint(path: Path, state: dict[str, Any]) -> None:
    """Write `state` (nested dicts and lists of tensors and plain data) to `path`, making its folder if need be.

    A process that dies at any moment leaves the old file or the new one, and so does a power cut. Raises InputError
    when the file cannot be written.
    """
    partial = path.with_name(path.name + ".partial")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with partial.open("wb") as file:
            torch.save(state, file)
            file.flush()
            os.fsync(file.fileno())
        partial.replace(path)
        _sync_folder(path.parent)
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


def _sync_folder(folder: Path) -> None:
    """Make a rename in `folder` outlast a power cut."""
    if os.name == "nt":  # Windows cannot open a folder, and needs no such step
        return
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
