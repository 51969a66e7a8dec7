"""A copy of a database that may be in use, through SQLite's own backup; and an upgrade with such a copy made first."""

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
    """What an upgrade did. `backup` is the copy of the old state; None when there was nothing to upgrade or to keep."""

    path: Path
    before: str | None
    after: str
    backup: Path | None


def back_up(where: str | Path, target: Path) -> int:
    """Copy the database to the new file `target` and return its size in bytes.

    Safe at any time: the copy is the database as it is at one moment, whatever writers do; no one waits. Checkpoints,
    which are files beside the database, are not copied. Raises InputError when `target` exists, cannot be written, or
    when `where` is damaged or no database of ssmail's.
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
    """Bring the tables of the database to the newest schema, in one transaction, with a backup beside it first.

    Raises InputError for a file that ssmail cannot use; then nothing has changed.
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
    """All pages in one step, which is one read transaction; then a look at whether the copy is sound."""
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
        raise InputError(f"{path} is damaged ({damage}) and was not copied; `ssmail db check` tells more")
