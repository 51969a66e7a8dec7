"""An SQLite database as a file: found, never made; opened, never upgraded; written whole or not at all."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from sqlalchemy import URL, Engine
from sqlalchemy.exc import DBAPIError

from ssmail.data.atomic_file import atomic_write
from ssmail.errors import InputError
from ssmail.store.connection import as_url, explained, make_engine, reading, revision_of
from ssmail.store.schema import REVISIONS

SIDE_FILES = ("-wal", "-shm", "-journal")
"""Suffixes of the files that SQLite may keep beside a database."""


def existing(where: str | Path) -> Path:
    """The file of an SQLite database, given by its path or URL.

    Raises InputError for a server database, which is no file, and for a file that is not there.
    """
    path = file_of(where)
    if path.is_dir():
        raise InputError(f"{path} is a folder; give the path of the database file, such as {path / 'ssmail.db'}")
    if not path.exists():
        raise InputError(f"there is no database {path}; check the path, `ssmail train` makes a new one")
    return path


def file_of(where: str | Path) -> Path:
    """The absolute path that an SQLite database has, or would have. Raises InputError for a server database."""
    url = as_url(where)
    if url.get_backend_name() != "sqlite":
        raise InputError(
            f"{url.render_as_string(hide_password=True)} is a server database, and `ssmail db` is for SQLite files "
            "only; use the server's own tools (its tables are upgraded by any other command that opens it)"
        )
    return Path(str(url.database))


@contextmanager
def opened(path: Path) -> Iterator[Engine]:
    """An engine on the file as it is, whatever its schema; all connections are closed in the end."""
    engine = make_engine(URL.create("sqlite", database=str(path)))
    try:
        yield engine
    finally:
        engine.dispose()


def revision(path: Path) -> str | None:
    """The revision of the schema in the file; None when it holds no table.

    Raises InputError for a file that is no database of ssmail's, is damaged, or is of a newer ssmail.
    """
    with opened(path) as engine, reading(engine) as connection:
        return revision_of(connection, engine)


def require_current(path: Path) -> None:
    """Raise InputError, naming the remedy, unless the schema in the file is the one that this ssmail writes."""
    found = revision(path)
    if found != REVISIONS[-1]:
        state = "has no tables yet" if found is None else f"has schema {found}, and this ssmail reads {REVISIONS[-1]}"
        raise InputError(f"{path} {state}; upgrade it first with `ssmail db upgrade --db {path}`")


@contextmanager
def new_file(target: Path) -> Iterator[Path]:
    """Yield a path to write a new database to; rename the file to `target` when the block succeeds, else delete it.

    A process that dies at any moment leaves no `target`, only a hidden file that ends in .partial. Raises InputError
    when `target` exists (it stays as it is) or when its folder cannot be written.
    """
    _refuse_existing(target)
    try:
        with atomic_write(target, overwrite=False) as partial:
            try:
                yield partial
            finally:
                for ending in SIDE_FILES:
                    partial.with_name(partial.name + ending).unlink(missing_ok=True)
    except OSError as error:
        _refuse_existing(target)  # another process may have written it meanwhile
        raise InputError(f"{target} cannot be written: {error.strerror or error}; choose another place") from error
    except DBAPIError as error:
        raise explained(error.orig, str(target)) from error


def _refuse_existing(target: Path) -> None:
    if target.exists() or target.is_symlink():
        raise InputError(f"{target} exists already and is not overwritten; give the name of a new file")
