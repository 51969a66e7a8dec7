"""Engines for databases of the current schema, and their read and write transactions.

SQLite runs in WAL mode, so readers never wait. Writers take turns: each write transaction starts with BEGIN IMMEDIATE,
which waits up to BUSY_SECONDS for the write lock, so that no later statement of the transaction meets a lock. On a
server (see `server`), `read` and `write` do their work again after a conflict or a lost connection.
"""

import os
import sqlite3
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any, TypeVar

from sqlalchemy import URL, Connection, Engine, create_engine, event, inspect, make_url, select, table, text
from sqlalchemy.exc import ArgumentError, DBAPIError, NoSuchModuleError

from ssmail.errors import InputError, SsmailError, masked, shortened
from ssmail.store import server
from ssmail.store.foreign_sqlite import refuse_journal, refuse_other_tables, refuse_program
from ssmail.store.schema import REVISIONS, metadata

BUSY_SECONDS = 120.0
DRIVER_ERRORS = (DBAPIError, sqlite3.Error, UnicodeDecodeError)
"""What using a database raises; a UnicodeDecodeError about a damaged name in the schema, or SQLite's message on it."""
BACKENDS = ("sqlite", "postgresql")
DRIVERS = ("sqlite", "sqlite+pysqlite", "postgresql", "postgres", f"postgresql+{server.DRIVER}")
_MIGRATIONS = Path(__file__).parent / "migrations"
_READS: dict[str, Any] = {"isolation_level": "REPEATABLE READ", "postgresql_readonly": True}
T = TypeVar("T")


def connect(where: str | Path, patience: float = 0.0) -> Engine:
    """Return an engine for the database at `where` (a path or an SQLAlchemy URL); create or upgrade it if necessary.

    patience: how many seconds to wait for a server that cannot be reached; one that is starting is always waited for.
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
        raise server.missing_driver(name_of(url)) from error
    try:
        passes = server.passes if patience else server.is_coming
        revision = _attempts(engine, lambda _: _revision(engine), patience or BUSY_SECONDS, passes)
        if revision != REVISIONS[-1]:
            with explained_errors(describe(engine)):
                _upgrade(engine)
    except SsmailError:
        engine.dispose()
        raise
    return engine


@contextmanager
def reading(engine: Engine, patience: float | None = None) -> Iterator[Connection]:
    """Yield a connection that reads one consistent state of the database; never waits for a writer.

    Waits `patience` seconds, by default BUSY_SECONDS, for a server that cannot be reached, but raises SsmailError if it
    is lost during the block; `read` does not.
    """
    with explained_errors(describe(engine)), _connected(engine, patience) as connection:
        yield connection


@contextmanager
def writing(engine: Engine) -> Iterator[Connection]:
    """Yield a connection in a write transaction. Waits for the write lock and holds it until the block ends.

    The block is left with an SsmailError after a conflict, or if a server is lost; `write` does its work again.
    """
    with explained_errors(describe(engine)), _transaction(engine) as connection:
        yield connection


def read(engine: Engine, work: Callable[[Connection], T]) -> T:
    """Return what `work` reads from one consistent state; on a server, from a new one if the connection is lost."""

    def attempt(_again: bool) -> T:
        with _connection(engine, reads=True) as connection:
            return work(connection)

    return _attempts(engine, attempt, BUSY_SECONDS)


def write(engine: Engine, work: Callable[[Connection, bool], T], patience: float | None = None) -> T:
    """Return what `work` returns, after committing what it wrote in a write transaction of its own.

    On a server, `work` is done again after a conflict with another transaction or a lost connection, for `patience`
    seconds, by default BUSY_SECONDS. Its second argument is then True: the attempt before may have been committed, if
    only the answer was lost, so `work` must recognize what it wrote.
    """

    def attempt(again: bool) -> T:
        with _transaction(engine) as connection:
            return work(connection, again)

    return _attempts(engine, attempt, BUSY_SECONDS if patience is None else patience)


def _attempts(
    engine: Engine,
    attempt: Callable[[bool], T],
    patience: float,
    passes: Callable[[DBAPIError], bool] = server.passes,
) -> T:
    """Return what `attempt(False)` returns, or on a server `attempt(True)` after an error that passes."""
    with explained_errors(describe(engine)):
        pauses, again = server.delays(patience), False
        while True:
            try:
                return attempt(again)
            except DBAPIError as error:
                if engine.dialect.name == "sqlite" or not passes(error) or next(pauses, None) is None:
                    raise
            again = True


def _connected(engine: Engine, patience: float | None) -> Connection:
    """Return a connection to read from, as soon as the server can be reached."""
    seconds = BUSY_SECONDS if patience is None else patience
    return _attempts(engine, lambda _: _connection(engine, reads=True), seconds)


def _connection(engine: Engine, reads: bool = False) -> Connection:
    connection = engine.connect()  # asks a server whether it is still there, and connects again if not
    return connection.execution_options(**_READS) if reads and engine.dialect.name != "sqlite" else connection


@contextmanager
def _transaction(engine: Engine) -> Iterator[Connection]:
    with _connection(engine).execution_options(writes=True) as connection, connection.begin():
        yield connection


def _revision(engine: Engine) -> str | None:
    with _connection(engine) as connection:
        return revision_of(connection, engine)


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
    if url.drivername.startswith("postgresql+") and url.drivername not in DRIVERS:
        raise InputError(
            f"{shortened(url.drivername, 60)} is no driver that ssmail uses; write postgresql://, for psycopg 3"
        )
    if url.drivername not in DRIVERS:  # SQLAlchemy would import whatever package calls itself so
        raise InputError(
            f"{shortened(url.drivername, 60)} is no database that ssmail knows; use {' or '.join(BACKENDS)}"
        )
    if url.get_backend_name() != "sqlite":
        return server.with_driver(url)
    if url.database in (None, "", ":memory:") or str(url.database).startswith("file:"):
        raise InputError(
            f"{shortened(masked(where), 100)} is not a file on disk, which ssmail needs; give the path of a file"
        )
    return _file_url(Path(str(url.database)), home=False)


def make_engine(url: URL) -> Engine:
    """Return an engine with ssmail's settings, without checking or upgrading the database."""
    if url.get_backend_name() != "sqlite":
        found = server.arguments(url, BUSY_SECONDS)
        return create_engine(url, isolation_level="READ COMMITTED", pool_pre_ping=True, connect_args=found)
    refuse_journal(Path(os.path.realpath(str(url.database))))  # SQLite looks beside the file behind a link
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
        refuse_program(connection, describe(engine))
    tables = set(inspect(connection).get_table_names())
    if not tables:
        return None
    version_table = "alembic_version"
    if version_table not in tables or not tables & set(metadata.tables):
        raise InputError(f"{describe(engine)} is a database of another program; give ssmail its own database")
    revision = connection.execute(select(text("version_num")).select_from(table(version_table))).scalar()
    if revision not in REVISIONS:
        raise InputError(
            f"{describe(engine)} was written by a newer ssmail (schema {revision}; this version supports up "
            f"to {REVISIONS[-1]}); upgrade ssmail or use another database"
        )
    if engine.dialect.name == "sqlite":
        refuse_other_tables(connection, describe(engine))
    return str(revision)


def _text(content: bytes) -> str:
    """Return a stored text, with surrogates for what is not UTF-8: one such text must not hide all other rows."""
    return content.decode(errors="surrogateescape")


@contextmanager
def explained_errors(where: str) -> Iterator[None]:
    """Turn errors of the database driver into an SsmailError that explains them in one sentence."""
    try:
        yield
    except DRIVER_ERRORS as error:
        raise explained(error, where) from error


def explained(error: Exception, where: str) -> SsmailError:
    """Return the error that says in one sentence what one of DRIVER_ERRORS means for the user."""
    orig = error.orig if isinstance(error, DBAPIError) else error
    if isinstance(error, DBAPIError) and not isinstance(orig, sqlite3.Error):
        return server.explained(error, where)
    reason = str(orig)
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
    if url.drivername == f"postgresql+{server.DRIVER}":
        url = url.set(drivername="postgresql")
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
        server.lock_schema(connection)
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
