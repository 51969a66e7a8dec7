"""Checkpoint files beside a database: checking them against their record, and copying them in a merge."""

import errno
import hashlib
import os
import shutil
import stat
import uuid
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path

from sqlalchemy import URL

from ssmail.config.foreign_files import IrregularFileError, open_regular
from ssmail.errors import InputError
from ssmail.store.queries import ArtifactRow
from ssmail.store.schema import is_run_id

LAST, BEST = "last.pt", "best.pt"
"""Names of the checkpoints of a run."""
LASTS = (LAST, "last.2.pt")
"""Names of the two files in checkpoint_root/<run id>/ that hold LAST in turn while the run is trained."""
STAGING = ".merge-"
"""Prefix of the folder that holds copies until a merge needs them; a merge that is killed leaves it behind."""
LARGEST = 8 * 2**30  # bytes of a checkpoint; those of the paper's sizes have a thousandth of it
MOST_FILES = 16  # of a run; ssmail writes two


def checkpoint_root_of(database: Path) -> Path:
    """Return the checkpoint folder of an SQLite file."""
    return database.parent / "checkpoints"


def checkpoint_root(url: URL) -> Path:
    """Return the checkpoint folder of a database: beside an SQLite file; below the current folder for a server."""
    on_sqlite = url.get_backend_name() == "sqlite"
    return checkpoint_root_of(Path(str(url.database)) if on_sqlite else Path("results/ssmail.db").absolute())


def run_folder(root: Path, run_id: str) -> Path:
    """Return the folder of a run's checkpoints. Every folder that is written, copied or deleted by id comes from here.

    Raises InputError for an id that is not 32 hexadecimal digits, and for a folder that is a link: what lies behind it
    may be anything.
    """
    if not is_run_id(run_id):
        raise InputError(f"{run_id!r:.40} is no run id, so it has no checkpoints; `ssmail db check` names such runs")
    folder = root / run_id
    if folder.is_symlink():
        raise InputError(f"{folder} is a link, which ssmail does not follow; put the folder itself in its place")
    return folder


def remove_run_folder(root: Path, run_id: str) -> None:
    """Delete the folder of a run's checkpoints; links in it are deleted, not followed. Raises as `run_folder` does."""
    shutil.rmtree(run_folder(root, run_id), ignore_errors=True)


def fault_of(row: ArtifactRow) -> str | None:
    """Return "missing", "altered" or "recorded in another folder" for a file that is not as recorded, else None.

    Links are not followed, and pipes and devices not opened.
    """
    if row.path is None:
        return "recorded in another folder"
    try:
        with open_regular(row.path, follow=False) as file:
            size = os.fstat(file.fileno()).st_size
            if row.path.parent.is_symlink() or size != row.size_bytes or size > LARGEST:
                return "altered"
            return None if hashlib.file_digest(file, "sha256").hexdigest() == row.sha256 else "altered"
    except IrregularFileError:
        return "altered"
    except OSError as error:
        return "altered" if error.errno == errno.ELOOP else "missing"


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
        """Copy the existing files of these runs to the staging folder.

        Only regular files are copied: no links, pipes, folders, partially written files, and none above LARGEST. Raises
        InputError when a file cannot be copied.
        """
        for run_id in run_ids:
            folder = run_folder(self.source, run_id)
            if self.shared or run_id in self.staged or not folder.is_dir():
                continue
            copies = run_folder(self._staging, run_id)
            try:
                copies.mkdir(parents=True)
                for file in sorted(folder.iterdir(), key=lambda file: (file.suffix != ".pt", file.name))[:MOST_FILES]:
                    _copy(file, copies / file.name)
            except OSError as error:
                reason = error.strerror or error
                raise InputError(f"the checkpoints in {folder} cannot be copied to {self.target}: {reason}") from error
            self.staged.add(run_id)

    def place(self, run_ids: Iterable[str]) -> None:
        """Move the staged folders of these runs to their final path; existing folders are kept until `close`."""
        for run_id in self.staged.intersection(run_ids):
            place = run_folder(self.target, run_id)
            if place.exists():
                place.rename(self._replaced(run_id))
            self._placed.append(run_id)
            run_folder(self._staging, run_id).rename(place)
            self.staged.discard(run_id)

    def commit(self) -> None:
        """Make what has been placed so far permanent."""
        self._placed.clear()

    def undo(self) -> None:
        """Remove the folders placed since the last `commit` and restore those that they replaced."""
        while self._placed:
            run_id = self._placed.pop()
            remove_run_folder(self.target, run_id)
            if self._replaced(run_id).exists():
                self._replaced(run_id).rename(self.target / run_id)

    def remove(self, run_ids: Iterable[str]) -> None:
        """Delete the folders of runs that are no longer in the target database."""
        for run_id in run_ids:
            remove_run_folder(self.target, run_id)

    def close(self) -> None:
        """Delete the staging folder, and the checkpoint root if it was created for nothing."""
        shutil.rmtree(self._staging, ignore_errors=True)
        if self._creates_root:
            with suppress(OSError):
                self.target.rmdir()  # succeeds only if the folder is empty

    def _replaced(self, run_id: str) -> Path:
        return self._staging / f"old-{run_id}"


def _copy(file: Path, target: Path) -> None:
    """Copy a regular file that is not partially written; leave out anything else."""
    if file.name.endswith(".partial") or not stat.S_ISREG(file.lstat().st_mode):
        return
    with open_regular(file, follow=False) as source, target.open("xb") as copy:
        if os.fstat(source.fileno()).st_size <= LARGEST:
            shutil.copyfileobj(source, copy)
