"""Checkpoints in a place that every machine reaches: a folder, or anything else that fsspec has a driver for.

An object is RUN_ID/SHA256 below that place. Only these two come from a database; the place comes from the user. An
object whose content does not have the SHA-256 in its name is not used. Runs do not share objects, although runs of one
cell have the same checkpoints, so that a run removes nothing that another one needs.
"""

import hashlib
import os
import re
import uuid
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Protocol

from ssmail.config.foreign_files import IrregularFileError, open_regular, read_whole
from ssmail.data.atomic_file import atomic_write
from ssmail.errors import InputError, SsmailError, masked, shortened
from ssmail.store.checkpoint_files import fault_of, run_folder
from ssmail.store.queries import ArtifactRow

VARIABLE = "SSMAIL_ARTIFACTS"
"""The environment variable that names the place where no option does."""
NOT_GIVEN = "in a place that --artifacts names, which is not given"
"""The fault of a checkpoint that cannot be looked for."""
LARGEST = 2**30  # bytes of an object, as of a checkpoint file that is read
_HASH = re.compile(r"[0-9a-f]{64}")
_PATTERN = re.compile(r"[*?\[]")  # what fsspec gives a meaning in a path


class AlteredObjectError(InputError):
    """An object does not have the content that its name says."""


class _Files(Protocol):
    """What an ArtifactStorage needs of a file system. Missing files and folders raise FileNotFoundError."""

    def size(self, run_id: str, name: str) -> int | None:
        """Return the bytes of a file; None if they are not known before it is read."""

    def read(self, run_id: str, name: str, most: int) -> bytes | None:
        """Return the content of a file; None if it has more than `most` bytes or is no regular file."""

    def write(self, run_id: str, name: str, content: bytes) -> None:
        """Write a file so that it appears under its name as a whole or not at all."""

    def remove(self, run_id: str, name: str) -> None:
        """Delete a file."""


class ArtifactStorage:
    """Objects below a place, which is the path of a folder, made if necessary, or a URL.

    place: the same place for any process of this machine; a URL may hold a password. where: the same for messages.
    Errors of the place are raised as SsmailError, which names it.
    """

    def __init__(self, place: str) -> None:
        """Raises InputError for an empty or unusable place, and where the driver of a URL is not installed."""
        self._files: _Files
        scheme, separator, rest = place.partition("://")
        if scheme in ("file", "local") and separator:
            place = rest
        if not place.strip() or "\0" in place:
            raise InputError("--artifacts takes a folder or a URL, not an empty one")
        if separator and scheme not in ("file", "local"):
            self.place, self.where = place.rstrip("/"), masked(place.rstrip("/"))
            self._files = _Remote(self.place, self.where)
        else:
            folder = Path(place).expanduser().absolute()
            self.place = self.where = str(folder)
            self._files = _Folder(folder)

    def name_of(self, row: ArtifactRow) -> str:
        """Return where the object of a recorded checkpoint would be, for messages."""
        return f"{self.where}/{row.run_id}/{row.sha256}"

    def require_writable(self) -> None:
        """Raise InputError unless an object can be written and deleted; done once, before anything is trained."""
        run_id, name = "0" * 32, f"probe-{uuid.uuid4().hex}"
        try:
            with self._explained("written to"):
                self._files.write(run_id, name, b"ssmail")
                self._files.remove(run_id, name)
        except SsmailError as error:
            raise InputError(f"{error}; choose another place with --artifacts") from error

    def put(self, run_id: str, content: bytes) -> str:
        """Store the content as an object of the run and return its SHA-256. An object that is there is kept."""
        sha256 = hashlib.sha256(content).hexdigest()
        with self._explained("written to"):
            if not self._has(run_id, sha256, len(content)):
                self._files.write(run_id, sha256, content)
        return sha256

    def has(self, row: ArtifactRow) -> bool:
        """Return whether there is an object of the recorded size; `read` checks its content too."""
        with self._explained("read"):
            return _is_named(row) and self._has(row.run_id, row.sha256, row.size_bytes)

    def read(self, row: ArtifactRow) -> bytes | None:
        """Return the content of a recorded checkpoint, or None if its object is missing.

        Raises AlteredObjectError if it is not as recorded, and InputError if it is larger than 1 GiB.
        """
        if not _is_named(row):
            return None
        try:
            with self._explained("read"):
                size = self._files.size(row.run_id, row.sha256)
                if row.size_bytes > LARGEST:
                    raise InputError(f"the checkpoint {self.name_of(row)} is larger than 1 GiB")
                fits = size in (None, row.size_bytes)
                content = self._files.read(row.run_id, row.sha256, row.size_bytes) if fits else None
        except FileNotFoundError:
            return None
        if content is None or hashlib.sha256(content).hexdigest() != row.sha256:
            raise AlteredObjectError(f"the checkpoint {self.name_of(row)} has been altered since it was recorded")
        return content

    def remove(self, run_id: str, names: Iterable[str]) -> None:
        """Delete objects of a run by their SHA-256, as far as there are any."""
        for sha256 in filter(_HASH.fullmatch, names):
            with suppress(FileNotFoundError), self._explained("deleted from"):
                self._files.remove(run_id, sha256)

    def _has(self, run_id: str, sha256: str, size: int) -> bool:
        try:
            return self._files.size(run_id, sha256) in (None, size)
        except FileNotFoundError:
            return False

    @contextmanager
    def _explained(self, what: str) -> Iterator[None]:
        """Turn whatever a driver raises, but FileNotFoundError while reading, into a sentence about the place."""
        try:
            yield
        except SsmailError:
            raise
        except Exception as error:
            if isinstance(error, FileNotFoundError) and what != "written to":
                raise
            text = getattr(error, "strerror", None) or str(error) or type(error).__name__
            reason = shortened(" ".join(masked(str(text)).split()), 160)
            raise SsmailError(f"the artifacts in {self.where} cannot be {what} ({reason})") from error


def _is_named(row: ArtifactRow) -> bool:
    """Return whether the recorded SHA-256 is one; nothing else becomes part of a path."""
    return _HASH.fullmatch(row.sha256) is not None


class _Folder:
    """A folder of this machine, or one that several machines have. Links in it are not followed."""

    def __init__(self, root: Path) -> None:
        self._root = root

    def size(self, run_id: str, name: str) -> int | None:
        return (run_folder(self._root, run_id) / name).lstat().st_size

    def read(self, run_id: str, name: str, most: int) -> bytes | None:
        try:
            with open_regular(run_folder(self._root, run_id) / name, follow=False) as file:
                content = read_whole(file, most)
        except IrregularFileError:
            return None
        return None if content is None else bytes(content)

    def write(self, run_id: str, name: str, content: bytes) -> None:
        with atomic_write(run_folder(self._root, run_id) / name) as partial:
            partial.write_bytes(content)

    def remove(self, run_id: str, name: str) -> None:
        folder = run_folder(self._root, run_id)
        (folder / name).unlink()
        with suppress(OSError):
            folder.rmdir()  # succeeds only if it is empty


class _Remote:
    """What a URL names, through fsspec. Its own settings are fsspec's: `FSSPEC_S3_ENDPOINT_URL` and the like."""

    def __init__(self, url: str, shown: str) -> None:
        if _PATTERN.search(url):
            raise InputError(f"{shown} has one of * ? [, which fsspec reads as a pattern; give a plain URL")
        from fsspec.core import url_to_fs  # late: most commands need no driver

        scheme = url.partition("://")[0]
        try:
            self._fs, root = url_to_fs(url)
        except ImportError as error:
            module = getattr(error.__cause__, "name", None) or error.name
            package = shortened(str(module or f"fsspec[{scheme}]").partition(".")[0], 40)
            raise InputError(f"no driver for the URL {shown} is installed; run `pip install {package}`") from error
        except Exception as error:
            reason = shortened(masked(str(error)), 120)
            raise InputError(
                f"{shown} cannot be used for artifacts ({reason}); check it, or give another URL"
            ) from error
        self._root = str(root).rstrip("/")
        self._made: set[str] = set()

    def _path(self, run_id: str, name: str) -> str:
        return f"{self._root}/{run_id}/{name}"

    def size(self, run_id: str, name: str) -> int | None:
        found: int | None = self._fs.info(self._path(run_id, name)).get("size")
        return found

    def read(self, run_id: str, name: str, most: int) -> bytes | None:
        content: bytes = self._fs.cat_file(self._path(run_id, name), start=0, end=most + 1)
        return content if len(content) <= most else None

    def write(self, run_id: str, name: str, content: bytes) -> None:
        self._make_folders(run_id)
        partial = self._path(run_id, f".{name}.{uuid.uuid4().hex[:8]}.partial")
        try:
            self._fs.pipe_file(partial, content)
            self._fs.mv(partial, self._path(run_id, name))
        except BaseException:
            with suppress(Exception):
                self._fs.rm_file(partial)
            raise

    def remove(self, run_id: str, name: str) -> None:
        self._fs.rm_file(self._path(run_id, name))

    def _make_folders(self, run_id: str) -> None:
        """Make the folders, where there are such, but never a bucket, which would be paid for."""
        if run_id in self._made:
            return
        for folder in (self._root, f"{self._root}/{run_id}"):
            if "/" in folder.strip("/"):
                with suppress(FileExistsError):
                    self._fs.mkdir(folder, create_parents=False)
        self._made.add(run_id)


def storage_of(place: str | None) -> ArtifactStorage | None:
    """Return the storage at a place, by default the one that SSMAIL_ARTIFACTS names; None where neither names any."""
    place = place or os.environ.get(VARIABLE)
    return ArtifactStorage(place) if place else None


def place_of(row: ArtifactRow, storage: ArtifactStorage | None) -> str | None:
    """Return where a recorded checkpoint should be; of an object in a place that is not given, its name there."""
    if row.by_content:
        return storage.name_of(row) if storage is not None else f"{row.run_id}/{row.sha256}"
    return None if row.path is None else str(row.path)


def recorded_fault(row: ArtifactRow, storage: ArtifactStorage | None) -> str | None:
    """Return what is wrong with a recorded checkpoint: None if its object or its file is as recorded.

    Otherwise NOT_GIVEN, or what `checkpoint_files.fault_of` returns of the file.
    """
    try:
        if storage is not None and storage.read(row) is not None:
            return None
    except InputError:
        return "altered"
    fault = fault_of(row)
    return NOT_GIVEN if fault == "missing" and row.by_content and storage is None else fault
