"""Files that may come from anyone: only regular ones are opened, and zip archives are read within bounds.

Members of an archive are read into memory and never extracted, so none can write to the disk. Only stored and deflated
members are read, in pieces, so the memory needed is what the caller allows, whatever the archive declares.
"""

import io
import os
import stat
import struct
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

PIECE = 2**20  # bytes that are read at once
DIRECTORY = 4 * 2**20  # bytes of the largest list of members; the whole CMU database needs a twentieth
COMPRESSIONS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
ENCRYPTED = 0x1  # a flag of a member

ARCHIVE_ERRORS = (
    *(OSError, EOFError, ValueError, OverflowError, RuntimeError, LookupError),
    *(struct.error, zlib.error, zipfile.BadZipFile),
)
"""What zipfile raises for archives that are damaged, or crafted."""


class IrregularFileError(OSError):
    """A folder, pipe or device stands where a file is expected."""

    def __init__(self) -> None:
        super().__init__("it is not a regular file")
        self.strerror = str(self)


class _BoundedFile(io.BufferedReader):
    """A file that refuses to read more at once than DIRECTORY bytes, whatever size zipfile takes from an archive."""

    def read(self, size: int | None = -1, /) -> bytes:
        contents = super().read(DIRECTORY + 1 if size is None or not 0 <= size <= DIRECTORY else size)
        if len(contents) > DIRECTORY:
            raise zipfile.BadZipFile("the list of members is too long")
        return contents


@contextmanager
def open_regular(path: Path, *, follow: bool = True) -> Iterator[io.BufferedReader]:
    """Open a file for reading; a link is followed unless `follow` is off. Never waits for a pipe or device.

    Raises OSError if it cannot be opened, IrregularFileError if it is not a regular file. An unusable name, with a zero
    byte in it, counts as absent.
    """
    extra = getattr(os, "O_NONBLOCK", 0) | (0 if follow else getattr(os, "O_NOFOLLOW", 0))
    try:
        raw = io.FileIO(path, opener=lambda name, flags: os.open(name, flags | extra))
    except IsADirectoryError:
        raise IrregularFileError from None
    except ValueError:
        raise FileNotFoundError(f"no file can be called {path!r}") from None
    with _BoundedFile(raw) as file:
        if not stat.S_ISREG(os.fstat(raw.fileno()).st_mode):
            raise IrregularFileError
        yield file


def is_plain(member: zipfile.ZipInfo) -> bool:
    """Return whether a member can be read: neither encrypted nor compressed in an unusual way."""
    return member.compress_type in COMPRESSIONS and not member.flag_bits & ENCRYPTED


def read_whole(file: IO[bytes], most: int) -> bytearray | None:
    """Read a file to its end, in pieces; None if it has more than `most` bytes."""
    contents = bytearray()
    while piece := file.read(min(PIECE, most + 1 - len(contents))):
        contents += piece
        if len(contents) > most:
            return None
    return contents
