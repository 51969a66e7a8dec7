"""SQLite database files: find and open them without upgrading, describe, back up, upgrade and write them."""

import sqlite3
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from sqlalchemy import URL, Engine, func, select

from ssmail.data.atomic_file import atomic_write
from ssmail.errors import InputError, command_line
from ssmail.store import schema
from ssmail.store.connection import (
    BUSY_SECONDS,
    as_url,
    connect,
    explained_errors,
    make_engine,
    name_of,
    reading,
    revision_of,
)
from ssmail.store.queries import count_rows
from ssmail.store.schema import REVISIONS

SIDE_FILES = ("-wal", "-shm", "-journal")
"""Suffixes of the files that SQLite may keep beside a database."""


@dataclass(frozen=True)
class RunCount:
    """How many runs have this environment, method, profile and state."""

    environment: str
    method: str
    profile: str
    state: str
    runs: int


@dataclass(frozen=True)
class DatabaseInformation:
    """What a database holds, with sizes in bytes. `size_bytes` includes the write-ahead log and `free_bytes`."""

    path: Path
    revision: str | None  # None: no tables yet
    newest_revision: str
    size_bytes: int
    free_bytes: int
    metrics: int = 0  # rows
    arrays: int = 0  # rows
    array_bytes: int = 0  # as compressed
    artifacts: int = 0  # rows
    runs: tuple[RunCount, ...] = ()

    @property
    def array_share(self) -> float:
        """The fraction of the size that arrays take, in [0, 1]."""
        return self.array_bytes / self.size_bytes if self.size_bytes else 0.0


@dataclass(frozen=True)
class Upgrade:
    """What an upgrade did. `backup` is a copy of the old state; None if there was nothing to upgrade or keep."""

    path: Path
    before: str | None
    after: str
    backup: Path | None


def existing(where: str | Path) -> Path:
    """Return the file of an SQLite database, given its path or URL.

    Raises InputError for a server database, a folder, or a file that does not exist.
    """
    path = file_of(where)
    if not path.exists():
        raise InputError(f"there is no database {path}; check the path, or create a database with `ssmail train`")
    return path


def file_of(where: str | Path) -> Path:
    """Return the absolute path of an SQLite database, which may not exist. Raises InputError for a server database."""
    url = as_url(where)
    if url.get_backend_name() != "sqlite":
        raise InputError(
            f"{name_of(url)} is a server database, but `ssmail db` is for SQLite files "
            "only; use the server's own tools (any other command upgrades its tables when it opens it)"
        )
    return Path(str(url.database))


@contextmanager
def opened(path: Path) -> Iterator[Engine]:
    """Yield an engine for the file, whatever its schema is; close all its connections afterwards."""
    engine = make_engine(URL.create("sqlite", database=str(path)))
    try:
        yield engine
    finally:
        engine.dispose()


def revision(path: Path) -> str | None:
    """Return the schema revision of the file; None when it has no tables.

    Raises InputError when the file is damaged, is not an ssmail database, or is from a newer ssmail.
    """
    with opened(path) as engine, reading(engine) as connection:
        return revision_of(connection, engine)


def require_current(path: Path) -> None:
    """Raise InputError unless the file has the schema that this ssmail writes."""
    found = revision(path)
    if found != REVISIONS[-1]:
        state = "has no tables yet" if found is None else f"has schema {found}, but this ssmail reads {REVISIONS[-1]}"
        command = command_line("ssmail", "db", "upgrade", "--db", path)
        raise InputError(f"{path} {state}; upgrade it first with `{command}`")


@contextmanager
def new_file(target: Path) -> Iterator[Path]:
    """Yield a path to write a new database to; rename the file to `target` when the block succeeds, else delete it.

    A process that dies at any moment leaves no `target`, only a hidden file that ends in .partial. Raises InputError
    when `target` exists (it stays as it is) or when its folder cannot be written.
    """
    _refuse_existing(target)
    try:
        with explained_errors(str(target)), atomic_write(target, overwrite=False) as partial:
            try:
                yield partial
            finally:
                for ending in SIDE_FILES:
                    partial.with_name(partial.name + ending).unlink(missing_ok=True)
    except OSError as error:
        _refuse_existing(target)  # another process may have written it meanwhile
        raise InputError(f"{target} cannot be written: {error.strerror or error}; choose another place") from error


def _refuse_existing(target: Path) -> None:
    if target.exists() or target.is_symlink():
        raise InputError(f"{target} exists already and is not overwritten; give the name of a new file")


def describe_contents(where: str | Path) -> DatabaseInformation:
    """Describe one consistent state of the database, without upgrading or changing it.

    Raises InputError when the file is missing or damaged, is not an ssmail database, or is from a newer ssmail.
    """
    path = existing(where)
    found = revision(path)
    log, run = path.with_name(path.name + "-wal"), schema.run
    size = path.stat().st_size + (log.stat().st_size if log.exists() else 0)
    free_pages = "SELECT freelist_count * page_size FROM pragma_freelist_count, pragma_page_size"
    array_sizes = select(func.coalesce(func.sum(func.length(schema.array.c.data)), 0))
    columns = (run.c.environment, run.c.method, run.c.profile, run.c.state)
    runs = select(*columns, func.count()).group_by(*columns).order_by(*columns)
    with opened(path) as engine, reading(engine) as connection:
        free = int(connection.exec_driver_sql(free_pages).scalar_one())
        if found is None:
            return DatabaseInformation(path, found, REVISIONS[-1], size, free)
        return DatabaseInformation(
            path,
            found,
            REVISIONS[-1],
            size,
            free,
            metrics=count_rows(connection, schema.metric),
            arrays=count_rows(connection, schema.array),
            array_bytes=int(connection.execute(array_sizes).scalar_one()),
            artifacts=count_rows(connection, schema.artifact),
            runs=tuple(RunCount(*row) for row in connection.execute(runs)),
        )


def back_up(where: str | Path, target: Path) -> int:
    """Copy the database to the new file `target` and return its size in bytes.

    The copy is one consistent state of the database, even while runs are written, and makes no writer wait. Checkpoint
    files are not copied. Raises InputError when `target` exists or cannot be written, or when `where` is damaged or not
    an ssmail database.
    """
    path = existing(where)
    revision(path)
    with new_file(target.absolute()) as partial, explained_errors(str(path)):
        _copy_pages(path, partial)
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


def _copy_pages(path: Path, partial: Path) -> None:
    """Copy all pages in one read transaction, and check that the copy is intact."""
    with closing(sqlite3.connect(path, timeout=BUSY_SECONDS)) as source, closing(sqlite3.connect(partial)) as copy:
        source.backup(copy, pages=-1)
        damage = copy.execute("PRAGMA quick_check(1)").fetchone()[0]
        copy.execute("PRAGMA wal_checkpoint(TRUNCATE)")
    if damage != "ok":
        raise InputError(f"{path} is damaged ({damage}) and was not copied; run `ssmail db check` for details")
