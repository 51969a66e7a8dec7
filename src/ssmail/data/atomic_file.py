"""Files that are written whole or not at all."""

import os
import uuid
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path


@contextmanager
def atomic_write(target: Path, *, overwrite: bool = True) -> Iterator[Path]:
    """Yield a temporary path beside `target` to write to; rename it to `target` when the block succeeds.

    Creates the folder if necessary. If the process dies at any moment, or the power fails, `target` is either the old
    file or the complete new one, and at most a hidden file that ends in .partial is left over. When the block raises,
    the temporary file is deleted. Raises OSError when the file cannot be written, FileExistsError when `overwrite` is
    off and there is a `target` by then.
    """
    target.parent.mkdir(parents=True, exist_ok=True)
    partial = target.with_name(f".{target.name}.{uuid.uuid4().hex[:8]}.partial")
    try:
        yield partial
        with partial.open("rb+") as file:
            os.fsync(file.fileno())
        if overwrite:
            partial.replace(target)
        else:
            _rename_to_new(partial, target)
        _sync_folder(target.parent)
    finally:
        with suppress(OSError):
            partial.unlink()


def _rename_to_new(partial: Path, target: Path) -> None:
    """Rename without overwriting: when two processes write a file of the same name, only one succeeds."""
    try:
        os.link(partial, target)
    except FileExistsError:
        raise
    except OSError:  # the file system has no hard links
        if target.exists() or target.is_symlink():
            raise FileExistsError(f"{target} exists") from None
        partial.rename(target)


def _sync_folder(folder: Path) -> None:
    """Make a rename in `folder` survive a power failure."""
    if os.name == "nt":  # Windows cannot open a folder, and does not need this step
        return
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
