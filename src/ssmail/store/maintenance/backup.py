"""Backups of databases that may be in use, and upgrades that make a backup first."""

import sqlite3
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from ssmail.errors import InputError
from ssmail.store.connection import BUSY_SECONDS, connect, explained
from ssmail.store.maintenance.sqlite_file import existing, new_file, revision
from ssmail.store.schema import REVISIONS


@dataclass(frozen=True)
class Upgrade:
    """What an upgrade did. `backup` is a copy of the old state; None if there was nothing to upgrade or keep."""

    path: Path
    before: str | None
    after: str
    backup: Path | None


def back_up(where: str | Path, target: Path) -> int:
    """Copy the database to the new file `target` and return its size in bytes.

    The copy is one consistent state of the database, even while runs are written, and makes no writer wait. Checkpoint
    files are not copied. Raises InputError when `target` exists or cannot be written, or when `where` is damaged or not
    an ssmail database.
    """
    path = existing(where)
    revision(path)
    with new_file(target.absolute()) as partial:
        try:
            _copy(path, partial)
        except sqlite3.Error as error:
            raise explained(error, str(path)) from error
    return target.stat().st_size


def upgrade(where: str | Path) -> Upgrade:
    """Back up the database beside the file, then upgrade it to the newest schema in one transaction.

    Raises InputError, and changes nothing, when ssmail cannot use the file.
    """
    path = existing(where)
    before = revision(path)
    backup = None
    if before is not None and before != REVISIONS[-1]:
        backup = path.with_name(f"{path.stem}-schema-{before}-{datetime.now(UTC):%Y%m%dT%H%M%SZ}{path.suffix}")
        back_up(path, backup)
    connect(path).dispose()
    return Upgrade(path, before, REVISIONS[-1], backup)


def _copy(path: Path, partial: Path) -> None:
    """Copy all pages in one read transaction, and check that the copy is intact."""
    source = sqlite3.connect(path, timeout=BUSY_SECONDS)
    copy = sqlite3.connect(partial)
    try:
        source.backup(copy, pages=-1)
        damage = copy.execute("PRAGMA quick_check(1)").fetchone()[0]
        copy.execute("PRAGMA wal_checkpoint(TRUNCATE)")
    finally:
        copy.close()
        source.close()
    if damage != "ok":
        raise InputError(f"{path} is damaged ({damage}) and was not copied; run `ssmail db check` for details")
