"""Checkpoint files beside a database: checking them against their record, and copying them in a merge."""

import hashlib
import shutil
import uuid
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path

from ssmail.errors import InputError
from ssmail.store.queries import ArtifactRow

STAGING = ".merge-"
"""Prefix of the folder that holds copies until a merge needs them; a merge that is killed leaves it behind."""


def checkpoint_root_of(database: Path) -> Path:
    """Return the checkpoint folder of an SQLite file."""
    return database.parent / "checkpoints"


def fault_of(row: ArtifactRow) -> str | None:
    """Return "missing" or "altered" for a file that is not as recorded, else None."""
    try:
        if row.path.stat().st_size != row.size_bytes:
            return "altered"
        with row.path.open("rb") as file:
            return None if hashlib.file_digest(file, "sha256").hexdigest() == row.sha256 else "altered"
    except OSError:
        return "missing"


class CheckpointCopies:
    """Copies of run folders from one checkpoint root to another.

    `stage` copies folders into a staging folder and `place` moves them to their final path. `undo` reverts what was
    placed since the last `commit`. Two databases in one folder share their checkpoints, so nothing is copied.
    """

    def __init__(self, source: Path, target: Path) -> None:
        self.source, self.target = source, target
        self.shared = source.resolve() == target.resolve()
        self.staged: set[str] = set()
        self._placed: list[str] = []
        self._staging = target / f"{STAGING}{uuid.uuid4().hex[:8]}"
        self._creates_root = not target.exists()

    def stage(self, run_ids: Iterable[str]) -> None:
        """Copy the existing folders of these runs to the staging folder, without partially written files."""
        for run_id in run_ids:
            folder = self.source / run_id
            if self.shared or run_id in self.staged or not folder.is_dir():
                continue
            try:
                shutil.copytree(folder, self._staging / run_id, ignore=shutil.ignore_patterns("*.partial"))
            except (OSError, shutil.Error) as error:
                raise InputError(f"the checkpoints in {folder} cannot be copied to {self.target}: {error}") from error
            self.staged.add(run_id)

    def place(self, run_ids: Iterable[str]) -> None:
        """Move the staged folders of these runs to their final path; existing folders are kept until `close`."""
        for run_id in self.staged.intersection(run_ids):
            place = self.target / run_id
            if place.exists():
                place.rename(self._replaced(run_id))
            self._placed.append(run_id)
            (self._staging / run_id).rename(place)
            self.staged.discard(run_id)

    def commit(self) -> None:
        """Make what has been placed so far permanent."""
        self._placed.clear()

    def undo(self) -> None:
        """Remove the folders placed since the last `commit` and restore those that they replaced."""
        while self._placed:
            run_id = self._placed.pop()
            shutil.rmtree(self.target / run_id, ignore_errors=True)
            if self._replaced(run_id).exists():
                self._replaced(run_id).rename(self.target / run_id)

    def remove(self, run_ids: Iterable[str]) -> None:
        """Delete the folders of runs that are no longer in the target database."""
        for run_id in run_ids:
            shutil.rmtree(self.target / run_id, ignore_errors=True)

    def close(self) -> None:
        """Delete the staging folder, and the checkpoint root if it was created for nothing."""
        shutil.rmtree(self._staging, ignore_errors=True)
        if self._creates_root:
            with suppress(OSError):
                self.target.rmdir()  # succeeds only if the folder is empty

    def _replaced(self, run_id: str) -> Path:
        return self._staging / f"old-{run_id}"
