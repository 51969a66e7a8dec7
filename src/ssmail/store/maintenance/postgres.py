"""Databases on a PostgreSQL server: their size, and a backup through pg_dump."""

import os
import shutil
import subprocess
from pathlib import Path

from sqlalchemy import URL, Connection, text

from ssmail.errors import InputError, shortened
from ssmail.store.connection import name_of

_URL_ONLY = ("password", "sslpassword")  # must not be among the words of a process, which all users see


def size_of(connection: Connection) -> int:
    """Return the size of the database in bytes."""
    return int(connection.execute(text("SELECT pg_database_size(current_database())")).scalar_one())


def dump(url: URL, target: Path) -> None:
    """Write the database to `target` in the format that pg_restore reads.

    Raises InputError if pg_dump is missing or fails, for example because the server is newer.
    """
    program = shutil.which("pg_dump")
    if program is None:
        raise InputError("pg_dump is not installed; install PostgreSQL's client, in Debian `postgresql-client`")
    parts = {"host": url.host, "port": url.port, "user": url.username, "dbname": url.database, "password": url.password}
    given = {name: value if isinstance(value, str) else ",".join(value) for name, value in url.query.items()}
    given |= {name: str(value) for name, value in parts.items() if value is not None}
    words = " ".join(f"{name}={_quoted(value)}" for name, value in given.items() if name not in _URL_ONLY)
    secret = {"PGPASSWORD": given["password"]} if "password" in given else {}
    command = [program, "--format=custom", "--no-owner", "--no-password", f"--file={target}", f"--dbname={words}"]
    done = subprocess.run(command, env={**os.environ, **secret}, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        reason = shortened(" ".join(done.stderr.split()), 160)
        raise InputError(f"pg_dump could not copy {name_of(url)} ({reason}); use the pg_dump of the server's version")


def _quoted(value: str) -> str:
    """Return a value as libpq reads it after "name="."""
    escaped = value.replace("\\", "\\\\").replace("'", "\\'")
    return f"'{escaped}'"
