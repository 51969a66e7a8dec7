"""Whole databases: find and open them without upgrading, describe, back up and upgrade them; write new SQLite files.

What only a server has is in `postgres`.
"""

import sqlite3
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from sqlalchemy import URL, Connection, Engine, func, select

from ssmail.data.atomic_file import atomic_write
from ssmail.errors import InputError, command_line
from ssmail.store import schema
from ssmail.store.checkpoint_files import checkpoint_root
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
from ssmail.store.maintenance.postgres import dump, size_of
from ssmail.store.queries import count_rows
from ssmail.store.schema import REVISIONS
from ssmail.store.server import missing_driver

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
    """What a database holds, with sizes in bytes. `size_bytes` includes the write-ahead log and `free_bytes`.

    path: of an SQLite file; of a server its URL, without the password. free_bytes: None for a server.
    """

    path: Path | str
    revision: str | None  # None: no tables yet
    newest_revision: str
    size_bytes: int
    free_bytes: int | None
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

    path: Path | str
    before: str | None
    after: str
    backup: Path | None


def existing(where: str | Path) -> URL:
    """Return the URL of a database, given its path or URL; whether a server has it shows when it is opened.

    Raises InputError for a folder, or a file that does not exist.
    """
    url = as_url(where)
    if is_missing(url):
        raise InputError(
            f"there is no database {name_of(url)}; check the path, or create a database with `ssmail train`"
        )
    return url


def is_missing(url: URL) -> bool:
    """Return whether it is the URL of an SQLite file that does not exist."""
    return url.get_backend_name() == "sqlite" and not Path(str(url.database)).exists()


def place_of(url: URL) -> Path | str:
    """Return the path of an SQLite file, or the URL of a server's database without the password."""
    return Path(str(url.database)) if url.get_backend_name() == "sqlite" else name_of(url)


@contextmanager
def opened(where: URL | Path) -> Iterator[Engine]:
    """Yield an engine for a database or file, whatever its schema is; close all its connections afterwards."""
    url = where if isinstance(where, URL) else URL.create("sqlite", database=str(where))
    try:
        engine = make_engine(url)
    except ImportError as error:
        raise missing_driver(name_of(url)) from error
    try:
        yield engine
    finally:
        engine.dispose()


def revision(where: URL | Path) -> str | None:
    """Return the schema revision of a database; None when it has no tables.

    Raises InputError when it is damaged, is not an ssmail database, or is from a newer ssmail.
    """
    with opened(where) as engine, reading(engine, patience=0) as connection:
        return revision_of(connection, engine)


def require_current(where: URL) -> None:
    """Raise InputError unless the database has the schema that this ssmail writes."""
    found = revision(where)
    if found != REVISIONS[-1]:
        state = "has no tables yet" if found is None else f"has schema {found}, but this ssmail reads {REVISIONS[-1]}"
        command = command_line("ssmail", "db", "upgrade", "--db", name_of(where))
        raise InputError(f"{name_of(where)} {state}; upgrade it first with `{command}`")


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

    Raises InputError when it is missing or damaged, is not an ssmail database, or is from a newer ssmail.
    """
    url = existing(where)
    found, run = revision(url), schema.run
    array_sizes = select(func.coalesce(func.sum(func.length(schema.array.c.data)), 0))
    columns = (run.c.environment, run.c.method, run.c.profile, run.c.state)
    runs = select(*columns, func.count()).group_by(*columns)
    with opened(url) as engine, reading(engine) as connection:
        size, free = _sizes(url, connection)
        if found is None:
            return DatabaseInformation(place_of(url), found, REVISIONS[-1], size, free)
        return DatabaseInformation(
            place_of(url),
            found,
            REVISIONS[-1],
            size,
            free,
            metrics=count_rows(connection, schema.metric),
            arrays=count_rows(connection, schema.array),
            array_bytes=int(connection.execute(array_sizes).scalar_one()),
            artifacts=count_rows(connection, schema.artifact),
            runs=tuple(RunCount(*row) for row in sorted(map(tuple, connection.execute(runs)), key=str)),
        )


def _sizes(url: URL, connection: Connection) -> tuple[int, int | None]:
    """Return the size of the database, and how much of it is free, in bytes."""
    if url.get_backend_name() != "sqlite":
        return size_of(connection), None
    path = Path(str(url.database))
    log = path.with_name(path.name + "-wal")
    free_pages = "SELECT freelist_count * page_size FROM pragma_freelist_count, pragma_page_size"
    size = path.stat().st_size + (log.stat().st_size if log.exists() else 0)
    return size, int(connection.exec_driver_sql(free_pages).scalar_one())


def back_up(where: str | Path, target: Path) -> int:
    """Copy the database to the new file `target` and return its size in bytes; a server's is in pg_dump's format.

    The copy is one consistent state of the database, even while runs are written, and makes no writer wait. Checkpoint
    files are not copied. Raises InputError when `target` exists or cannot be written, or when `where` is damaged or not
    an ssmail database.
    """
    url = existing(where)
    revision(url)
    with new_file(target.absolute()) as partial, explained_errors(name_of(url)):
        if url.get_backend_name() == "sqlite":
            _copy_pages(Path(str(url.database)), partial)
        else:
            dump(url, partial)
    return target.stat().st_size


def upgrade(where: str | Path) -> Upgrade:
    """Back up the database, then upgrade it to the newest schema in one transaction.

    The backup is beside the file; that of a server is beside its checkpoints. Raises InputError, and changes nothing,
    when ssmail cannot use the database.
    """
    url = existing(where)
    before = revision(url)
    backup = None
    if before is not None and before != REVISIONS[-1]:
        on_server = url.get_backend_name() != "sqlite"
        file = checkpoint_root(url).with_name("ssmail.dump") if on_server else Path(str(url.database))
        backup = file.with_name(f"{file.stem}-schema-{before}-{datetime.now(UTC):%Y%m%dT%H%M%SZ}{file.suffix}")
        back_up(where, backup)
    connect(where).dispose()
    return Upgrade(place_of(url), before, REVISIONS[-1], backup)


def _copy_pages(path: Path, partial: Path) -> None:
    """Copy all pages in one read transaction, and check that the copy is intact."""
    with closing(sqlite3.connect(path, timeout=BUSY_SECONDS)) as source, closing(sqlite3.connect(partial)) as copy:
        source.backup(copy, pages=-1)
        damage = copy.execute("PRAGMA quick_check(1)").fetchone()[0]
        copy.execute("PRAGMA wal_checkpoint(TRUNCATE)")
    if damage != "ok":
        raise InputError(f"{path} is damaged ({damage}) and was not copied; run `ssmail db check` for details")
