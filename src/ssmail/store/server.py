"""What is particular to databases on a PostgreSQL server: the driver, locks, and errors after which to try again.

Reading transactions see one state (REPEATABLE READ). Writing ones lock the rows of `run` that they decide about (READ
COMMITTED): the owner of a run by updating its row first, all others by `for_update` or one of the locks below.
"""

import random
import time
from collections.abc import Iterator
from typing import Any

from sqlalchemy import URL, Connection, text
from sqlalchemy.exc import DBAPIError, OperationalError

from ssmail.errors import InputError, SsmailError, shortened

DRIVER = "psycopg"
_SCHEMA_LOCK, _CELL_LOCK = 0x55314A11_0001, 0x55314A11_0002  # of ssmail; a server has 2**64 for all programs
_CONFLICTS = ("40001", "40P01")  # serialization failure, deadlock
_GONE = ("57P01", "57P02", "57P03")  # shut down by an administrator, crashed, starting or stopping
_COMING = ("starting up", "shutting down", "recovery mode", "too many clients", "remaining connection slots")
_JITTER = random.SystemRandom()  # of no use for results, which are from seeded generators only


def with_driver(url: URL) -> URL:
    """Return the URL of a database on a server with psycopg 3 as the driver, also if it names none."""
    return url.set(drivername=f"postgresql+{DRIVER}")


def missing_driver(where: str) -> InputError:
    """Return the error about a driver that is not installed."""
    return InputError(f"no driver for the database URL {where} is installed; run `pip install 'ssmail[postgres]'`")


def arguments(url: URL, lock_seconds: float) -> dict[str, Any]:
    """Return the connection's parameters that the URL leaves open: how soon a dead server or a held lock shows."""
    wanted = {
        "connect_timeout": 10,
        "keepalives_idle": 30,
        "keepalives_interval": 10,
        "keepalives_count": 3,
        "application_name": "ssmail",
        "options": f"-c lock_timeout={lock_seconds:.0f}s",
    }
    return {name: value for name, value in wanted.items() if name not in url.query}


def lock_schema(connection: Connection) -> None:
    """Wait for the right to create or upgrade tables, which is held until the transaction ends."""
    _lock(connection, f"SELECT pg_advisory_xact_lock({_SCHEMA_LOCK})")


def lock_cells(connection: Connection) -> None:
    """Wait for the right to add a run of a cell, which is held until the transaction ends."""
    _lock(connection, f"SELECT pg_advisory_xact_lock({_CELL_LOCK})")


def lock_runs(connection: Connection) -> None:
    """Keep all others from writing until the transaction ends; they can read."""
    _lock(connection, "LOCK TABLE run IN SHARE ROW EXCLUSIVE MODE")


def _lock(connection: Connection, statement: str) -> None:
    if connection.dialect.name == "postgresql":  # a write transaction of SQLite has the whole file
        connection.execute(text(statement))


def passes(error: DBAPIError) -> bool:
    """Return whether the same transaction may succeed later: a conflict, or a server that cannot be reached now."""
    return _state(error) in _CONFLICTS or is_lost(error)


def is_lost(error: DBAPIError) -> bool:
    """Return whether the connection to the server broke or could not be made."""
    state = _state(error)
    return error.connection_invalidated or state.startswith("08") or state in _GONE or _cannot_connect(error)


def is_coming(error: DBAPIError) -> bool:
    """Return whether the server answers, but takes no more connections at the moment."""
    return is_lost(error) and any(words in str(error.orig) for words in _COMING)


def delays(seconds: float) -> Iterator[float]:
    """Sleep longer and longer, by random times, and yield how long; end before `seconds` are over."""
    deadline, longest = time.monotonic() + seconds, 0.02
    while True:
        delay = _JITTER.uniform(longest / 2, longest)
        if time.monotonic() + delay > deadline:
            return
        time.sleep(delay)
        yield delay
        longest = min(2 * longest, 2.0)


def explained(error: DBAPIError, where: str) -> SsmailError:
    """Return the error that says in one sentence what an error of the server means for the user."""
    reason = shortened(" ".join(str(error.orig).split()), 200)
    if _state(error) == "55P03":
        return SsmailError(f"another program holds a lock in the database {where}; close that program")
    if _cannot_connect(error):
        return InputError(
            f"cannot connect to the database {where} ({reason}); check its URL and its password, and that the server "
            "runs and has this database"
        )
    if is_lost(error):
        return SsmailError(f"the connection to the database {where} broke ({reason}); give the command again")
    return SsmailError(f"an operation on the database {where} failed: {reason}")


def _cannot_connect(error: DBAPIError) -> bool:
    made = error.connection_invalidated or error.statement is not None or _state(error)
    return isinstance(error, OperationalError) and not made


def _state(error: DBAPIError) -> str:
    """Return the SQLSTATE of five characters; empty if there is none."""
    found = getattr(error.orig, "sqlstate", None)
    return found if isinstance(found, str) else ""
