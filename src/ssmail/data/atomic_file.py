"""Files that are written whole or not at all.

A file is written under a temporary name, .NAME.PLACE-PROCESS-TOKEN.partial, that says which process writes it. What a
killed process left behind is deleted by the next one that writes into the same folder.
"""

import errno
import hashlib
import os
import platform
import re
import time
import uuid
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path

PATIENCE = 24 * 3600  # seconds after which a temporary file of another machine, or of an older ssmail, is left over
TEMPORARY = re.compile(
    r"\..+\.(?:(?P<place>[0-9a-f]{8})-(?P<process>[0-9]{1,9})-)?[0-9a-f]{8}\.partial(?:-wal|-shm|-journal)?"
    r"|\..+\.npz\.[0-9]+\.npz"  # those of the first release
)
_writing: set[str] = set()
"""The names of the temporary files that this process is writing."""


@contextmanager
def atomic_write(target: Path, *, overwrite: bool = True) -> Iterator[Path]:
    """Yield a temporary path beside `target` to write to; rename it to `target` when the block succeeds.

    Creates the folder if necessary. If the process dies at any moment, or the power fails, `target` is either the old
    file or the complete new one, and at most a hidden file that ends in .partial is left over until the next call for
    the same folder. When the block raises, the temporary file is deleted. Raises OSError when the file cannot be
    written or when a folder, pipe or device has its name; FileExistsError when `overwrite` is off and there is a
    `target` by then.
    """
    target.parent.mkdir(parents=True, exist_ok=True)
    if overwrite and target.exists() and not target.is_file():
        raise OSError(errno.EEXIST, "a folder, pipe or device has this name", str(target))
    _delete_leftovers(target.parent)
    partial = target.with_name(f".{target.name}.{_place()}-{os.getpid()}-{uuid.uuid4().hex[:8]}.partial")
    _writing.add(partial.name)
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
        _writing.discard(partial.name)


def _delete_leftovers(folder: Path) -> None:
    """Delete the temporary files in `folder` that nobody writes any more."""
    with suppress(OSError):
        for path in folder.iterdir():
            found = TEMPORARY.fullmatch(path.name)
            with suppress(OSError):  # another process may be faster
                if found and not _is_written(path, found["place"], found["process"]):
                    path.unlink()


def _is_written(path: Path, place: str | None, process: str | None) -> bool:
    """Return whether the process that named this temporary file may still write it."""
    if place != _place() or process is None or os.name == "nt":  # Windows has no harmless way to ask for a process
        return time.time() - path.lstat().st_mtime < PATIENCE
    if int(process) == os.getpid():
        return any(path.name.startswith(name) for name in _writing)
    try:
        os.kill(int(process), 0)
    except ProcessLookupError:
        return False
    except OSError:  # of another user
        return True
    return True


@cache
def _place() -> str:
    """Name where process ids mean what they mean here: this machine since it started, or this container."""
    try:
        place = Path("/proc/sys/kernel/random/boot_id").read_text("ascii") + str(Path("/proc/self/ns/pid").readlink())
    except OSError:
        place = platform.node()
    return hashlib.sha256(place.encode()).hexdigest()[:8]


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
