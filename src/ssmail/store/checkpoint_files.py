"""The files of checkpoints beside a database: whether they are as recorded, and how they follow their run elsewhere."""

import hashlib
import shutil
import uuid
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path

from ssmail.errors import InputError
from ssmail.store.queries import ArtifactRow

STAGING = ".merge-"
"""How the folder begins that holds copies until they are wanted; a merge that was killed leaves it behind."""
PARTIAL = ".partial"


def root_of(database: Path) -> Path:
    """The folder of checkpoints of an SQLite file."""
    return database.parent / "checkpoints"


def fault(row: ArtifactRow) -> str | None:
    """What is wrong with a recorded file, "missing" or "altered"; None when its content is the recorded one."""
    try:
        if row.path.stat().st_size != row.size_bytes:
            return "altered"
        with row.path.open("rb") as file:
            return None if hashlib.file_digest(file, "sha256").hexdigest() == row.sha256 else "altered"
    except OSError:
        return "missing"


class CheckpointCopies:
    """Folders of checkpoints on their way from one root to another.

    They are first copied aside (`stage`), then named as they shall be (`place`), which can be undone until `settle`.
    Between two databases in one folder there is nothing to copy.
    """

    def __init__(self, source: Path, target: Path) -> None:
        self.source, self.target = source, target
        self.needless = source.resolve() == target.resolve()
        self.staged: set[str] = set()
        self._placed: list[str] = []
        self._staging = target / f"{STAGING}{uuid.uuid4().hex[:8]}"
        self._makes_root = not target.exists()

    def stage(self, run_ids: Iterable[str]) -> None:
        """Copy the folders of these runs aside, those that exist; files that were never completed stay behind."""
        for run_id in run_ids:
            folder = self.source / run_id
            if self.needless or run_id in self.staged or not folder.is_dir():
                continue
            try:
                shutil.copytree(folder, self._staging / run_id, ignore=shutil.ignore_patterns(f"*{PARTIAL}"))
            except (OSError, shutil.Error) as error:
                raise InputError(f"the checkpoints in {folder} cannot be copied to {self.target}: {error}") from error
            self.staged.add(run_id)

    def place(self, run_ids: Iterable[str]) -> None:
        """Give the staged folders of these runs their place; what is there already is kept aside until the end."""
        for run_id in self.staged.intersection(run_ids):
            place = self.target / run_id
            if place.exists():
                place.rename(self._aside(run_id))
            self._placed.append(run_id)
            (self._staging / run_id).rename(place)
            self.staged.discard(run_id)

    def settle(self) -> None:
        """What is placed by now stays."""
        self._placed.clear()

    def undo(self) -> None:
        """Take back what was placed since the last `settle`, and put back what was there."""
        while self._placed:
            run_id = self._placed.pop()
            shutil.rmtree(self.target / run_id, ignore_errors=True)
            if self._aside(run_id).exists():
                self._aside(run_id).rename(self.target / run_id)

    def remove(self, run_ids: Iterable[str]) -> None:
        """Delete the folders of runs that are no longer in the target."""
        for run_id in run_ids:
            shutil.rmtree(self.target / run_id, ignore_errors=True)

    def close(self) -> None:
        """Delete what is still aside, and a folder that was made for nothing."""
        shutil.rmtree(self._staging, ignore_errors=True)
        if self._makes_root:
            with suppress(OSError):
                self.target.rmdir()  # only when it is empty

    def _aside(self, run_id: str) -> Path:
        return self._staging / f"old-{run_id}"
