"""Engines for databases of the current schema, and their read and write transactions.

SQLite runs in WAL mode, so readers never wait. Writers take turns: each write transaction starts with BEGIN IMMEDIATE,
which waits up to BUSY_SECONDS for the write lock, so that no later statement of the transaction meets a lock.
"""

import os
import sqlite3
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

from sqlalchemy import URL, Connection, Engine, create_engine, event, inspect, make_url, select, table, text
from sqlalchemy.exc import ArgumentError, DBAPIError, NoSuchModuleError

from ssmail.config.foreign_files import open_regular
from ssmail.errors import InputError, SsmailError, masked, shortened
from ssmail.store.schema import REVISIONS, metadata

BUSY_SECONDS = 120.0
DRIVER_ERRORS = (DBAPIError, sqlite3.Error, UnicodeDecodeError)
"""What using a database raises; a UnicodeDecodeError about a damaged name in the schema, or SQLite's message on it."""
_JOURNAL = bytes.fromhex("d9d505f920a163d7")  # how a journal ends that names another file (SQLite's file format)
BACKENDS = ("sqlite", "postgresql")
DRIVERS = (
    "sqlite",
    "sqlite+pysqlite",
    "postgresql",
    *(f"postgresql+{name}" for name in ("psycopg", "psycopg2", "pg8000")),
)
_MIGRATIONS = Path(__file__).parent / "migrations"


def connect(where: str | Path) -> Engine:
    """Return an engine for the database at `where` (a path or an SQLAlchemy URL); create or upgrade it if necessary.

    Raises InputError when the database cannot be created or read, is not an ssmail database, or has a newer schema.
    """
    url = as_url(where)
    if url.get_backend_name() == "sqlite":
        folder = Path(str(url.database)).parent
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(
                f"cannot create the folder {folder} for the database ({error.strerror}); choose a writable place"
            ) from error
    try:
        engine = make_engine(url)
    except (NoSuchModuleError, ImportError) as error:
        raise InputError(
            f"no driver for the database URL {name_of(url)} is installed ({error}); install it with pip"
        ) from error
    try:
        with explained_errors(describe(engine)):
            with engine.connect() as connection:
                revision = revision_of(connection, engine)
            if revision != REVISIONS[-1]:
                _upgrade(engine)
    except SsmailError:
        engine.dispose()
        raise
    return engine


@contextmanager
def reading(engine: Engine) -> Iterator[Connection]:
    """Yield a connection that reads one consistent state of the database; never waits for a writer."""
    with explained_errors(describe(engine)), engine.connect() as connection:
        yield connection


@contextmanager
def writing(engine: Engine) -> Iterator[Connection]:
    """Yield a connection in a write transaction. Waits for the write lock and holds it until the block ends."""
    with explained_errors(describe(engine)), engine.connect() as connection:
        connection = connection.execution_options(writes=True)
        with connection.begin():
            yield connection


def describe(engine: Engine) -> str:
    """Return the database's path, or its URL without the password, for messages."""
    return name_of(engine.url)


def as_url(where: str | Path) -> URL:
    """Return the URL for a path or URL, with an absolute path for SQLite.

    Raises InputError when `where` is neither, or is a folder.
    """
    if isinstance(where, Path) or "://" not in where:
        return _file_url(where)
    try:
        url = make_url(where)
    except (ArgumentError, ValueError):
        shown = shortened(masked(where), 100)
        raise InputError(f"{shown} is neither a path nor a database URL such as sqlite:////tmp/ssmail.db") from None
    if url.drivername not in DRIVERS:  # SQLAlchemy would import whatever package calls itself so
        raise InputError(
            f"{shortened(url.drivername, 60)} is no database that ssmail knows; use {' or '.join(BACKENDS)}"
        )
    if url.get_backend_name() != "sqlite":
        return url
    if url.database in (None, "", ":memory:") or str(url.database).startswith("file:"):
        raise InputError(
            f"{shortened(masked(where), 100)} is not a file on disk, which ssmail needs; give the path of a file"
        )
    return _file_url(Path(str(url.database)), home=False)


def make_engine(url: URL) -> Engine:
    """Return an engine with ssmail's settings, without checking or upgrading the database."""
    if url.get_backend_name() != "sqlite":
        return create_engine(url, isolation_level="SERIALIZABLE")
    _refuse_journal(Path(os.path.realpath(str(url.database))))  # SQLite looks beside the file behind a link
    engine = create_engine(url, connect_args={"timeout": BUSY_SECONDS, "check_same_thread": False})

    @event.listens_for(engine, "connect")
    def _configure(dbapi_connection: Any, _record: Any) -> None:
        dbapi_connection.isolation_level = None  # keeps the driver from starting transactions; `_begin` does
        dbapi_connection.execute("PRAGMA foreign_keys = ON")
        dbapi_connection.execute("PRAGMA trusted_schema = OFF")
        dbapi_connection.text_factory = _text

    @event.listens_for(engine, "begin")
    def _begin(connection: Connection) -> None:
        writes = connection.get_execution_options().get("writes", False)
        connection.exec_driver_sql("BEGIN IMMEDIATE" if writes else "BEGIN")

    return engine


def revision_of(connection: Connection, engine: Engine) -> str | None:
    """Return the schema revision, or None for an empty database.

    Raises InputError for a database of another program or of a newer ssmail.
    """
    if engine.dialect.name == "sqlite":
        _refuse_program(connection, describe(engine))
    tables = set(inspect(connection).get_table_names())
    if not tables:
        return None
    version_table = "alembic_version"
    if version_table not in tables or not tables & set(metadata.tables):
        raise InputError(f"{describe(engine)} is a database of another program; give ssmail its own file")
    revision = connection.execute(select(text("version_num")).select_from(table(version_table))).scalar()
    if revision not in REVISIONS:
        raise InputError(
            f"{describe(engine)} was written by a newer ssmail (schema {revision}; this version supports up "
            f"to {REVISIONS[-1]}); upgrade ssmail or use another database"
        )
    if engine.dialect.name == "sqlite":
        _refuse_other_tables(connection, describe(engine))
    return str(revision)


def _refuse_program(connection: Connection, where: str) -> None:
    """Raise InputError if an SQLite file computes anything when it is read or written.

    That is a view or a virtual table in place of a table, a trigger, or a generated column; ssmail makes none of them.
    """
    objects = "SELECT name FROM sqlite_master WHERE type NOT IN ('table', 'index') OR rootpage = 0"
    columns = (
        "SELECT m.name FROM sqlite_master AS m, pragma_table_xinfo(m.name) AS c WHERE m.type = 'table' AND c.hidden"
    )
    found = connection.exec_driver_sql(f"{objects} UNION ALL {columns} LIMIT 1").scalar()
    if found is not None:
        raise InputError(
            f"{where} holds {str(found)!r:.40}, a view, trigger or computed column, which ssmail never makes; do not "
            "use this file"
        )


def _refuse_journal(file: Path) -> None:
    """Raise InputError if a rollback journal names another file, which SQLite may delete when it rolls back.

    It does so in transactions over several databases, of which ssmail has none.
    """
    try:
        with open_regular(file.with_name(f"{file.name}-journal")) as journal:
            journal.seek(-min(len(_JOURNAL), os.fstat(journal.fileno()).st_size), os.SEEK_END)
            names_another = journal.read(len(_JOURNAL)) == _JOURNAL
    except FileNotFoundError:
        return
    except OSError:
        names_another = True
    if names_another:
        raise InputError(f"{file}-journal is not a journal that ssmail leaves behind; do not use these two files")


def _text(content: bytes) -> str:
    """Return a stored text, with surrogates for what is not UTF-8: one such text must not hide all other rows."""
    return content.decode(errors="surrogateescape")


def _refuse_other_tables(connection: Connection, where: str) -> None:
    """Raise InputError unless the tables of an SQLite file have the columns and primary keys of the schema."""
    columns = "SELECT m.name, c.name, c.pk > 0 FROM sqlite_master AS m, pragma_table_info(m.name) AS c"
    found = {tuple(row) for row in connection.exec_driver_sql(f"{columns} WHERE m.type = 'table'")}
    for name, wanted in metadata.tables.items():
        if {row for row in found if row[0] == name} != {(name, item.name, item.primary_key) for item in wanted.columns}:
            raise InputError(
                f"the table {name} of {where} does not have the columns that ssmail gives it; use a backup of the file"
            )


@contextmanager
def explained_errors(where: str) -> Iterator[None]:
    """Turn errors of the database driver into an SsmailError that explains them in one sentence."""
    try:
        yield
    except DRIVER_ERRORS as error:
        raise explained(error, where) from error


def explained(error: Exception, where: str) -> SsmailError:
    """Return the error that says in one sentence what one of DRIVER_ERRORS means for the user."""
    reason = str(error.orig if isinstance(error, DBAPIError) else error)
    if isinstance(error, UnicodeDecodeError):
        reason = "malformed text"
    if "not a database" in reason or "malformed" in reason:
        return InputError(f"{where} is not an SQLite database, or is damaged ({reason}); give another file")
    if "unable to open" in reason or "readonly" in reason:
        return InputError(
            f"cannot write the database {where} ({reason}), as even reading it requires; choose a writable place, or "
            "copy it to one"
        )
    if "locked" in reason:
        return SsmailError(f"another program locked the database {where} for {BUSY_SECONDS:.0f} s; close that program")
    return SsmailError(f"an operation on the database {where} failed: {reason}")


def name_of(url: URL) -> str:
    """Return the path of an SQLite database, or the URL of another without passwords, for messages."""
    if url.get_backend_name() == "sqlite" and url.database:
        return url.database
    return masked(url.render_as_string(hide_password=True))


def _file_url(where: str | Path, home: bool = True) -> URL:
    """Return the URL of a file, whose path may begin with ~ if `home`. Raises InputError for a folder, or no path."""
    try:
        path = (Path(where).expanduser() if home else Path(where)).absolute()
        is_folder = path.is_dir()
    except (OSError, RuntimeError, ValueError) as error:  # too long a name; nobody's home; a null byte
        raise InputError(f"{shortened(str(where), 120)!r} is no path; give that of a database file") from error
    if is_folder:
        raise InputError(f"{path} is a folder; give the path of the database file, such as {path / 'ssmail.db'}")
    if path.exists() and not path.is_file():
        raise InputError(f"{path} is a pipe or a device; give the path of a file")
    return URL.create("sqlite", database=str(path))


def _upgrade(engine: Engine) -> None:
    from alembic import command  # imported late: most databases need no upgrade
    from alembic.config import Config

    if engine.dialect.name == "sqlite":
        _use_wal(engine)
    config = Config()
    config.set_main_option("script_location", str(_MIGRATIONS).replace("%", "%%"))
    with writing(engine) as connection:
        config.attributes["connection"] = connection
        revision = revision_of(connection, engine)
        if revision is None:
            metadata.create_all(connection)
            command.stamp(config, "head")
        elif revision != REVISIONS[-1]:  # another process may have upgraded it meanwhile
            command.upgrade(config, "head")


def _use_wal(engine: Engine) -> None:
    """Switch the file to WAL mode permanently. SQLite does not wait for locks here, hence the loop."""
    deadline = time.monotonic() + BUSY_SECONDS
    with closing(engine.raw_connection()) as connection:
        while True:
            try:
                connection.cursor().execute("PRAGMA journal_mode = WAL")
                return
            except Exception as error:
                if "locked" not in str(error) or time.monotonic() > deadline:
                    raise DBAPIError("PRAGMA journal_mode = WAL", None, error) from error
                time.sleep(0.01)
