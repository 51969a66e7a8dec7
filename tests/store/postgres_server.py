"""A small PostgreSQL server for tests, in a folder of its own and at a Unix socket only."""

import os
import pwd
import shutil
import signal
import subprocess
import tempfile
import time
import uuid
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

if TYPE_CHECKING:
    import psycopg

PASSWORD = "SECRET-of-the-tests"
_SETTINGS = ("listen_addresses=", "fsync=off", "shared_buffers=16MB", "max_connections=50")
_SECONDS = 60.0  # to start in


class Server:
    """A running server; `kill` and `start` it at will."""

    def __init__(self) -> None:
        self._programs = _programs()
        self._owner = _owner()
        self.folder = Path(tempfile.mkdtemp(prefix="ssmail-pg-", dir="/tmp"))  # short: a socket's path has a limit
        self.folder.chmod(0o755)
        password = self.folder / "password"
        password.write_text(PASSWORD)
        if self._owner:
            shutil.chown(self.folder, self._owner["user"])
        options = ("--auth=scram-sha-256", "--username=ssmail", f"--pwfile={password}", "--no-sync", "--encoding=UTF8")
        command = [self._programs / "initdb", f"--pgdata={self.folder / 'data'}", *options, "--locale=C.UTF-8"]
        subprocess.run(command, check=True, capture_output=True, cwd="/", **self._owner)
        self.start()

    def start(self) -> None:
        """Start the server and wait until it takes connections; after a kill it may have to try several times."""
        from psycopg import OperationalError

        settings = [word for setting in _SETTINGS for word in ("-c", setting)]
        command = [self._programs / "postgres", "-D", self.folder / "data", "-k", self.folder, *settings]
        deadline = time.monotonic() + _SECONDS
        with (self.folder / "log").open("ab") as log:
            self.process = subprocess.Popen(command, stdout=log, stderr=log, cwd="/", **self._owner)
            while time.monotonic() < deadline:
                if self.process.poll() is not None:  # what is left of the killed one still holds the shared memory
                    self.process = subprocess.Popen(command, stdout=log, stderr=log, cwd="/", **self._owner)
                try:
                    self.connect().close()
                    return
                except OperationalError:
                    time.sleep(0.1)
        raise TimeoutError((self.folder / "log").read_text()[-2000:])

    def kill(self) -> None:
        """Kill the server as a power failure would; its other processes end when they notice."""
        self.process.send_signal(signal.SIGKILL)
        self.process.wait()

    def close(self) -> None:
        """Stop the server and delete its folder."""
        self.process.send_signal(signal.SIGQUIT)
        self.process.wait()
        shutil.rmtree(self.folder, ignore_errors=True)

    def connect(self, database: str = "postgres") -> "psycopg.Connection[Any]":
        """A connection past ssmail, without transactions."""
        import psycopg

        return psycopg.connect(
            host=str(self.folder), dbname=database, user="ssmail", password=PASSWORD, autocommit=True
        )

    def new_database(self) -> str:
        """The name of a new, empty database, which by itself sorts "a" before "B"."""
        name = f"ssmail_{uuid.uuid4().hex[:8]}"
        with self.connect() as connection:
            connection.execute(f"CREATE DATABASE {name} TEMPLATE template0 LOCALE_PROVIDER icu ICU_LOCALE 'en'")
        return name

    def url(self, database: str, password: str | None = PASSWORD) -> str:
        """The URL of a database on this server."""
        secret = "" if password is None else f":{password}"
        return f"postgresql://ssmail{secret}@/{database}?host={self.folder}"


def _programs() -> Path:
    """The folder with initdb and postgres, the newest that Debian has; skips the test if there is none."""
    pytest.importorskip("psycopg", reason="psycopg, of the extra postgres, is not installed")
    newest = sorted(Path("/usr/lib/postgresql").glob("*/bin"), key=lambda path: int(path.parent.name))
    found = shutil.which("postgres")
    folders = [*([Path(found).parent] if found else []), *reversed(newest)]
    for folder in folders:
        if (folder / "initdb").exists() and (folder / "postgres").exists():
            return folder
    pytest.skip("no PostgreSQL server is installed (Debian: apt-get install postgresql)")


def _owner() -> dict[str, Any]:
    """For subprocess: the user that runs the server, which refuses to be run by root."""
    if os.getuid() != 0:
        return {}
    names = {entry.pw_name for entry in pwd.getpwall()}
    user = pwd.getpwnam("postgres" if "postgres" in names else "nobody")
    return {"user": user.pw_name, "group": user.pw_gid, "extra_groups": []}
