"""Find and read the files of a subject, anywhere below a folder or inside a zip file.

Members of a zip file are read into memory, up to a limit, and never unpacked (see foreign_files).
"""

import os
import re
import zipfile
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO

from ssmail.config.foreign_files import ARCHIVE_ERRORS, IrregularFileError, is_plain, open_regular, read_whole
from ssmail.errors import InputError

LARGEST = {".asf": 2**20, ".amc": 32 * 2**20}  # bytes; the files of subject 35 have 7 kB and 0.5 MB
LONGEST_SHOWN = 120  # characters of a name in a message


@dataclass(frozen=True)
class _Folder:
    path: Path

    def names(self) -> Iterator[str]:
        def refuse(error: OSError) -> None:
            raise InputError(f"{shown(error.filename)} cannot be read: {error.strerror}; choose another --source")

        try:
            for folder, _, files in os.walk(self.path, onerror=refuse):
                below = Path(folder).relative_to(self.path)
                yield from ((below / file).as_posix() for file in files)
        except RecursionError:
            raise InputError(f"the folders in {self.path} are nested too deeply; choose another --source") from None

    def read(self, name: str) -> bytes:
        label = shown(str(self.path / name))
        try:
            with open_regular(self.path / name) as file:
                return _whole(file, name, label)
        except (IrregularFileError, FileNotFoundError):
            raise InputError(f"{label} is not a file; put the file there") from None
        except OSError as error:
            raise InputError(f"{label} cannot be read: {error.strerror}; check its permissions") from None


@dataclass(frozen=True)
class _Archive:
    path: Path
    archive: zipfile.ZipFile

    def names(self) -> Iterator[str]:
        return (name for name in self.archive.namelist() if not name.endswith("/"))

    def read(self, name: str) -> bytes:
        label = shown(f"{shown(name)} in {self.path}")
        member = self.archive.getinfo(name)
        if not is_plain(member):
            raise InputError(f"{label} is encrypted or packed in an unusual way; pack it plainly")
        try:
            with self.archive.open(member) as file:
                return _whole(file, name, label)
        except NotImplementedError:
            raise InputError(f"{label} is encrypted or packed in an unusual way; pack it plainly") from None
        except ARCHIVE_ERRORS:
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
    with ExitStack() as stack:
        source: Source
        try:
            if path.is_dir():
                source = _Folder(path)
            else:
                source = _Archive(path, stack.enter_context(zipfile.ZipFile(stack.enter_context(open_regular(path)))))
        except FileNotFoundError:
            remedy = "--source takes a folder or a zip file with the .asf and .amc files"
            raise InputError(f"there is no {path}; {remedy}") from None
        except ARCHIVE_ERRORS:
            remedy = "--source takes one of them"
            raise InputError(f"{path} is neither a folder nor a readable zip file; {remedy}") from None
        yield source


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
    """Format a name for a message, on one line and not too long."""
    name = name if name.isprintable() else repr(name)
    return name if len(name) <= LONGEST_SHOWN else f"{name[: LONGEST_SHOWN // 2]}...{name[3 - LONGEST_SHOWN // 2 :]}"


def _whole(file: IO[bytes], name: str, label: str) -> bytes:
    """Read a file whole. Raises InputError if it is larger than LARGEST for its kind; `label` names it there."""
    largest = LARGEST[name[-4:].lower()]
    contents = read_whole(file, largest)
    if contents is None:
        raise InputError(f"{label} is larger than {largest >> 20} MB, so it is no file of the database; remove it")
    return bytes(contents)
