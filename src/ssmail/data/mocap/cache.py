"""The folder that downloaded files stay in: what is whole, what may be resumed, and the checksums of both visits.

A file under its own name is whole and recorded in `downloads.json` with its size and SHA-256; what is still arriving
is called NAME.part. The record is written before the file gets its name, and both atomically, so that a process killed
at any moment leaves nothing half-written that could be taken for whole.
"""

import hashlib
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from pathlib import Path

from pydantic import Field, ValidationError

from ssmail.config.sections import Frozen
from ssmail.data.atomic_file import atomic_write
from ssmail.errors import InputError, SsmailError

RECORD = "downloads.json"


class Whole(Frozen):
    """A file that arrived whole: from where, when (ISO 8601, UTC), its size in bytes and its checksum."""

    url: str
    fetched: str
    size: int = Field(ge=1)
    sha256: str = Field(pattern="^[0-9a-f]{64}$")


class Partial(Frozen):
    """A file that is arriving: its size in bytes, if told, and what tells this version of it from another.

    validator: a strong ETag or a Last-Modified date, fit for If-Range; None where the server gives neither, and then
    the file is never resumed.
    """

    url: str
    size: int | None = Field(ge=0)
    validator: str | None


class Record(Frozen):
    """What `downloads.json` holds, by file name."""

    whole: dict[str, Whole] = Field(default_factory=dict)
    partial: dict[str, Partial] = Field(default_factory=dict)


class Cache:
    """One subject's folder. OSError of the disk is left to `open_cache`, which words it."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._record = _read(folder / RECORD)

    def holds(self, name: str) -> bool:
        """Whether the file is there, whole and unchanged. Raises InputError if it was changed or never recorded."""
        path, recorded = self.folder / name, self._record.whole.get(name)
        if not path.exists():
            return False
        if recorded is None:
            raise InputError(
                f"{RECORD} does not record {path} as a download; move it away, or read the folder with --source"
            )
        contents = path.read_bytes()
        if len(contents) != recorded.size or _digest(contents) != recorded.sha256:
            raise InputError(
                f"{path} was changed after it was downloaded on {recorded.fetched[:10]} (its checksum differs); "
                "delete it to download it again, or read the folder with --source"
            )
        return True

    def part(self, name: str) -> Path:
        """Where the file arrives."""
        return self.folder / f"{name}.part"

    def arrived(self, name: str) -> int:
        """How many bytes of the file lie in its part."""
        return self.part(name).stat().st_size if self.part(name).exists() else 0

    def resumable(self, name: str, url: str) -> Partial | None:
        """What is known of the file whose beginning came from `url`; None if there is nothing to go on from."""
        partial = self._record.partial.get(name)
        return partial if partial and partial.url == url and partial.validator and self.arrived(name) else None

    def begin(self, name: str, partial: Partial) -> None:
        """Empty the part and record what is going to arrive in it."""
        self.discard(name)  # first: the bytes of one version must never stand under the validator of another
        self._save(self._record.whole, {**self._record.partial, name: partial})

    def discard(self, name: str) -> None:
        """Forget the beginning of a file."""
        self.part(name).unlink(missing_ok=True)

    def finish(self, name: str, url: str) -> None:
        """Give the whole file its name, after its record. Raises SsmailError if it differs from an earlier visit's."""
        contents = self.part(name).read_bytes()
        digest, before = _digest(contents), self._record.whole.get(name)
        if before and digest != before.sha256:
            self.discard(name)
            raise SsmailError(
                f"{url} is another file than on {before.fetched[:10]} (SHA-256 {digest[:12]} instead of "
                f"{before.sha256[:12]}, {len(contents)} bytes instead of {before.size}); if you trust the new one, "
                "download everything into an empty --cache"
            )
        whole = before or Whole(url=url, fetched=_now(), size=len(contents), sha256=digest)
        others = {key: value for key, value in self._record.partial.items() if key != name}
        self._save({**self._record.whole, name: whole}, others)
        self.part(name).replace(self.folder / name)

    def _save(self, whole: dict[str, Whole], partial: dict[str, Partial]) -> None:
        self._record = Record(whole=whole, partial=partial)
        with atomic_write(self.folder / RECORD) as path:
            path.write_text(self._record.model_dump_json(indent=2) + "\n", encoding="utf-8")


@contextmanager
def open_cache(folder: Path) -> Iterator[Cache]:
    """The cache in this folder, made if need be, for one process at a time.

    Raises InputError when another process uses it, its record cannot be read, or the disk refuses (also later, within
    the block: network errors must not leave it as OSError).
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with _alone(folder):
            yield Cache(folder)
    except OSError as error:
        raise InputError(f"cannot use the cache {folder}: {error.strerror}; choose another --cache") from error


@contextmanager
def _alone(folder: Path) -> Iterator[None]:
    """Hold the folder's lock, which the system takes back when the process ends however it ends."""
    try:
        import fcntl
    except ImportError:  # Windows has no such lock
        yield
        return
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        with suppress(OSError):  # nor have some network disks
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                raise InputError(f"another ssmail is downloading into {folder}; wait until it has ended") from None
        yield
    finally:
        os.close(descriptor)


def _read(path: Path) -> Record:
    if not path.exists():
        return Record()
    try:
        return Record.model_validate_json(path.read_bytes())
    except ValidationError:
        raise InputError(
            f"{path} is damaged, so the files beside it cannot be checked; choose another --cache, or delete "
            f"{path.parent} to download them again"
        ) from None


def _digest(contents: bytes) -> str:
    return hashlib.sha256(contents).hexdigest()


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="seconds")
