"""Find and read the files of a subject, anywhere below a folder or inside a zip file.

Members of a zip file are read into memory, up to a limit, and never unpacked: no member can write outside its folder or
grow without bounds.
"""

import os
import re
import zipfile
import zlib
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO

from ssmail.errors import InputError

LARGEST = {".asf": 2**20, ".amc": 32 * 2**20}  # bytes; the files of subject 35 have 7 kB and 0.5 MB


@dataclass(frozen=True)
class _Folder:
    path: Path

    def names(self) -> Iterator[str]:
        def refuse(error: OSError) -> None:
            raise InputError(f"{error.filename} cannot be read: {error.strerror}; choose another --source")

        for folder, _, files in os.walk(self.path, onerror=refuse):
            below = Path(folder).relative_to(self.path)
            yield from ((below / file).as_posix() for file in files)

    def read(self, name: str) -> bytes:
        path = self.path / name
        try:
            if not path.is_file():  # a pipe would block
                raise InputError(f"{shown(str(path))} is not a file; put the file there")
            with path.open("rb") as file:
                return _whole(file, name, shown(str(path)))
        except OSError as error:
            raise InputError(f"{shown(str(path))} cannot be read: {error.strerror}; check its permissions") from None


@dataclass(frozen=True)
class _Archive:
    path: Path
    archive: zipfile.ZipFile

    def names(self) -> Iterator[str]:
        return (member.filename for member in self.archive.infolist() if not member.is_dir())

    def read(self, name: str) -> bytes:
        label = f"{shown(name)} in {self.path}"
        try:
            with self.archive.open(name) as file:
                return _whole(file, name, label)
        except RuntimeError:  # zipfile's word for a password; NotImplementedError, for an exotic method, is one too
            raise InputError(f"{label} is encrypted or packed in an unusual way; pack it plainly") from None
        except (zipfile.BadZipFile, zlib.error, OSError, EOFError, ValueError):
            raise InputError(f"{label} is damaged; get the zip file again") from None


Source = _Folder | _Archive  # `path`, the `names` of all files relative to it, and `read`, a file by its name


@dataclass(frozen=True)
class Subject:
    """The files of one subject, as names in a source."""

    skeleton: str
    trials: dict[int, str]


@contextmanager
def open_source(path: Path) -> Iterator[Source]:
    """Open the folder or zip file at `path`. Raises InputError if it is neither, or cannot be read."""
    if path.is_dir():
        yield _Folder(path)
        return
    if not path.exists():
        raise InputError(f"there is no {path}; --source takes a folder or a zip file with the .asf and .amc files")
    try:
        if not path.is_file():  # a pipe would block
            raise zipfile.BadZipFile
        archive = zipfile.ZipFile(path)
    except (zipfile.BadZipFile, OSError, ValueError, NotImplementedError):
        raise InputError(f"{path} is neither a folder nor a readable zip file; --source takes one of them") from None
    with archive:
        yield _Archive(path, archive)


def find_subject(source: Source, subject: int, trials: Iterable[int]) -> Subject:
    """Find the skeleton of a subject and those of its trials that exist.

    Files are named SUBJECT.asf and SUBJECT_TRIAL.amc, in upper or lower case, with or without leading zeros. Raises
    InputError if there is no skeleton, or if one of these files is there twice.
    """
    wanted: dict[int | None, list[str]] = {trial: [] for trial in (None, *trials)}
    for name in source.names():
        found = re.fullmatch(
            r"0*(\d{1,6})(?:\.asf|_0*(\d{1,6})\.amc)", name.rpartition("/")[2], re.IGNORECASE | re.ASCII
        )
        if found and int(found[1]) == subject:
            wanted.get(int(found[2]) if found[2] else None, []).append(name)
    for trial, names in wanted.items():
        if len(names) > 1:
            what = "the skeleton" if trial is None else f"trial {trial:02d}"
            first, second = (shown(name) for name in sorted(names)[:2])
            both = f"{first} and {second}" if first != second else f"{first}, twice"
            raise InputError(f"{source.path} holds {what} of subject {subject} in {both}; leave one of them")
    if not wanted[None]:
        raise InputError(f"{source.path} holds no {subject:02d}.asf, the skeleton of subject {subject}; add it")
    return Subject(wanted[None][0], {trial: names[0] for trial, names in wanted.items() if trial is not None and names})


def shown(name: str) -> str:
    """Format a name for a message, on one line."""
    return name if name.isprintable() else repr(name)


def _whole(file: IO[bytes], name: str, label: str) -> bytes:
    """Read a file whole. Raises InputError if it is larger than LARGEST for its kind; `label` names it there."""
    largest = LARGEST[name[-4:].lower()]
    contents = file.read(largest + 1)
    if len(contents) > largest:
        raise InputError(f"{label} is larger than {largest >> 20} MB, so it is no file of the database; remove it")
    return contents
