"""What a database holds, in numbers: its file, its schema, its runs, and what takes the space."""

from dataclasses import dataclass
from pathlib import Path

from sqlalchemy import Connection, Table, func, select

from ssmail.store import schema
from ssmail.store.connection import reading
from ssmail.store.maintenance.sqlite_file import existing, opened, revision
from ssmail.store.schema import REVISIONS


@dataclass(frozen=True)
class RunCount:
    """How many runs agree in these four."""

    environment: str
    method: str
    profile: str
    state: str
    runs: int


@dataclass(frozen=True)
class DatabaseInformation:
    """Sizes in bytes. `size_bytes` counts the write-ahead log beside the file too; `free_bytes` of it hold nothing."""

    path: Path
    revision: str | None  # None: no tables yet
    newest_revision: str
    size_bytes: int
    free_bytes: int
    metrics: int  # rows
    arrays: int  # rows
    array_bytes: int  # as compressed
    artifacts: int  # rows
    runs: tuple[RunCount, ...]

    @property
    def array_share(self) -> float:
        """The part of the size that arrays take, 0..1."""
        return self.array_bytes / self.size_bytes if self.size_bytes else 0.0


def inform(where: str | Path) -> DatabaseInformation:
    """The numbers of one consistent state of the database, which is neither upgraded nor changed.

    Raises InputError for a file that is missing, damaged, no database of ssmail's or of a newer ssmail.
    """
    path = existing(where)
    found = revision(path)
    with opened(path) as engine, reading(engine) as connection:
        rows = {"metrics": 0, "arrays": 0, "array_bytes": 0, "artifacts": 0} if found is None else _rows(connection)
        return DatabaseInformation(
            path=path,
            revision=found,
            newest_revision=REVISIONS[-1],
            size_bytes=_size(path),
            free_bytes=_pragma(connection, "freelist_count") * _pragma(connection, "page_size"),
            runs=() if found is None else _runs(connection),
            **rows,
        )


def _rows(connection: Connection) -> dict[str, int]:
    def count(table: Table) -> int:
        return int(connection.execute(select(func.count()).select_from(table)).scalar_one())

    sizes = select(func.coalesce(func.sum(func.length(schema.array.c.data)), 0))
    return {
        "metrics": count(schema.metric),
        "arrays": count(schema.array),
        "array_bytes": int(connection.execute(sizes).scalar_one()),
        "artifacts": count(schema.artifact),
    }


def _runs(connection: Connection) -> tuple[RunCount, ...]:
    run = schema.run
    columns = (run.c.environment, run.c.method, run.c.profile, run.c.state)
    query = select(*columns, func.count()).group_by(*columns).order_by(*columns)
    return tuple(RunCount(*row) for row in connection.execute(query))


def _size(path: Path) -> int:
    log = path.with_name(path.name + "-wal")
    return path.stat().st_size + (log.stat().st_size if log.exists() else 0)


def _pragma(connection: Connection, name: str) -> int:
    return int(connection.exec_driver_sql(f"PRAGMA {name}").scalar_one())
