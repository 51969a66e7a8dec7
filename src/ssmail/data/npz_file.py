"""The arrays of an .npz file from anyone: checked before they are read, and never unpickled."""

import json
import math
import re
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any, Self

import numpy as np

from ssmail.config.foreign_files import is_plain, read_whole
from ssmail.errors import InputError

LARGEST_FILE, MOST_ARRAYS = 2**31, 64  # bytes; members
LONGEST_TEXT, LONGEST_HEADER = 2**22, 2**10  # bytes of a text, and of what .npy declares about an array
MAGIC = b"\x93NUMPY\x01\x00"  # of the only version that such arrays need; the header's length follows in two bytes
HEADER = re.compile(
    rb"\{'descr': '(<f[248]|<i[248]|<U[1-9]\d{0,6})', 'fortran_order': (True|False), "
    rb"'shape': \(((?:\d{1,12}, ?)*(?:\d{1,12})?)\), \} *\n"
)


def broken(what: str, command: str) -> InputError:
    """Return the error to raise for a file that `command` makes."""
    return InputError(f"{what}; {again(command)}")


def again(command: str) -> str:
    """Return the remedy for a file that `command` makes."""
    return f"make it again with `{command} --force`"


@dataclass(frozen=True)
class Header:
    """What a .npy file, or a member of an archive, declares about its array, and where the data begin."""

    dtype: np.dtype[Any]
    shape: tuple[int, ...]
    fortran: bool
    begin: int  # bytes before the data

    @property
    def count(self) -> int:
        """How many elements the array has."""
        return math.prod(self.shape)

    @property
    def size(self) -> int:
        """How many bytes the file has."""
        return self.begin + self.count * self.dtype.itemsize

    @classmethod
    def read(cls, file: IO[bytes]) -> Self | None:
        """Read the header, which numpy would evaluate as Python; None if it is not of numbers or text."""
        start = file.read(len(MAGIC) + 2)
        length = int.from_bytes(start[len(MAGIC) :], "little")
        found = HEADER.fullmatch(file.read(min(length, LONGEST_HEADER)))
        if not start.startswith(MAGIC) or not found:
            return None
        dtype, fortran, sizes = (group.decode() for group in found.groups())
        shape = tuple(int(size) for size in sizes.split(",") if size.strip())
        return cls(np.dtype(dtype), shape, fortran == "True", len(MAGIC) + 2 + length)

    def values(self, file: IO[bytes]) -> Any:
        """Read the array from a file that is open where its data begin. Raises ValueError if data are missing."""
        data = read_whole(file, self.count * self.dtype.itemsize) or bytearray()
        if self.dtype.kind == "U":
            data.decode("utf-32-le")  # raises UnicodeDecodeError for what is no text; numpy trusts it
        array = np.frombuffer(data, self.dtype)
        return array.reshape(self.shape[::-1]).T if self.fortran else array.reshape(self.shape)


class NpzFile:
    """The arrays of an open .npz file, and what makes a good one.

    Raises InputError, as do all methods, or one of ARCHIVE_ERRORS if a member or an array is not as it should be.
    """

    def __init__(self, path: Path, remedy: str, archive: zipfile.ZipFile, size: int, *, packed: bool = False) -> None:
        """Check the members, and read their headers. size: of the file, in bytes. packed: whether they may be deflated,
        up to LARGEST_FILE altogether.
        """
        self.path, self.remedy, self.archive = path, remedy, archive
        self.headers: dict[str, Header] = {}
        self.members: dict[str, zipfile.ZipInfo] = {}
        members = archive.infolist()
        if size > LARGEST_FILE or len(members) > MOST_ARRAYS:
            raise self.fault(f"{path} is larger than any expert set of ssmail")
        for member in members:
            if not is_plain(member) or not (packed or member.compress_type == zipfile.ZIP_STORED):
                raise self.fault(
                    f"{member.filename!r:.40} in {path} is compressed or encrypted, which ssmail never does"
                )
        most = LARGEST_FILE if packed else size
        if sum(member.file_size for member in members) > most:  # as members that lie on one another do
            raise self.fault(f"{path} declares more than it holds")
        for member in members:
            key = member.filename.removesuffix(".npy")
            if key in self.headers:
                raise self.fault(f"{path} holds the array {key!r:.40} twice")
            self.headers[key] = self._header(key, member)

    def _header(self, key: str, member: zipfile.ZipInfo) -> Header:
        with self.archive.open(member) as file:
            header = Header.read(file)
        if header is None:
            raise self.fault(f"{key!r:.40} in {self.path} is no array of numbers or text")
        if header.size != member.file_size:
            raise self.fault(f"{key!r:.40} in {self.path} is not as large as its shape says")
        self.members[key] = member
        return header

    def fault(self, what: str) -> InputError:
        """Return the error to raise; the remedy is always the same."""
        return InputError(f"{what}; {self.remedy}")

    def header(self, key: str) -> Header:
        """Return what is declared of an array."""
        if key not in self.headers:
            raise self.fault(f"{self.path} holds no array {key!r}, so it is not an expert set of ssmail")
        return self.headers[key]

    def only_or(self, key: str) -> str | None:
        """Return `key` if there is such an array, otherwise the name of the only one; None if there are several."""
        if key in self.headers:
            return key
        return next(iter(self.headers)) if len(self.headers) == 1 else None

    def require_exactly(self, *keys: str) -> None:
        """Raise InputError if an array is missing, or if there are others."""
        for key in keys:
            self.header(key)
        for key in self.headers:
            if key not in keys:
                raise self.fault(f"{self.path} holds {key!r:.40}, which is no array of such an expert set")

    def values(self, key: str) -> Any:
        """Return an array with whatever shape and values it has."""
        header = self.header(key)
        with self.archive.open(self.members[key]) as file:
            file.read(header.begin)
            return header.values(file)

    def array(self, key: str, shape: tuple[int, ...], kind: type[np.generic]) -> Any:
        """Return an array, checked to have this shape and this kind of values, all finite."""
        header = self.header(key)
        if header.shape != shape:
            raise self.fault(f"{key} in {self.path} has shape {header.shape!s:.40} instead of {shape!s:.40}")
        if not np.issubdtype(header.dtype, kind):
            raise self.fault(f"{key} in {self.path} holds {header.dtype} values")
        array = self.values(key)
        if kind is np.float64 and not np.isfinite(array).all():
            raise self.fault(f"{key} in {self.path} holds NaN or infinite values")
        return array

    def whole_numbers(self, key: str, count: int, below: int) -> Any:
        """Return an array (count,) of numbers from 0 on, all less than `below`."""
        array = self.array(key, (count,), np.int64)
        if array.min() < 0 or array.max() >= below:
            raise self.fault(f"{key} in {self.path} holds a number that it cannot hold")
        return array

    def motion(self, split: str, shape: tuple[int, ...]) -> tuple[Any, Any]:
        """Return positions and velocities of this shape (B, T, N, P) of a split."""
        positions, velocities = (
            self.array(f"{split}/{name}", shape, np.float64) for name in ("positions", "velocities")
        )
        return positions, velocities

    def text(self, key: str) -> str:
        """Return an array that is a single text."""
        if self.header(key).size > LONGEST_TEXT:
            raise self.fault(f"{key} in {self.path} is longer than in any expert set of ssmail")
        return str(self.array(key, (), np.str_)[()])

    def json(self, key: str) -> dict[str, Any]:
        """Return a text that is a JSON object; an empty one for other JSON."""
        try:
            value = json.loads(self.text(key))
        except (ValueError, RecursionError):
            raise self.fault(f"the parameters inside {self.path} cannot be read") from None
        return value if isinstance(value, dict) else {}
