"""The tables of the store; docs/database.md explains each column. Every change here needs an Alembic revision."""

import re
from collections.abc import Iterable, Mapping
from datetime import UTC, datetime
from enum import StrEnum
from typing import Any

import sqlalchemy as sa
from sqlalchemy.ext.compiler import compiles
from sqlalchemy.sql.functions import FunctionElement
from sqlalchemy.types import TypeDecorator

from ssmail.errors import InputError, shortened

REVISIONS = ("0001",)
"""All schema revisions that this version of ssmail knows, oldest first; it reads and writes the last one."""


def is_run_id(value: object) -> bool:
    """Return whether a value is a run id: 32 hexadecimal digits in lower case. Only such an id may become a path."""
    return isinstance(value, str) and re.fullmatch(r"[0-9a-f]{32}", value) is not None


class RunState(StrEnum):
    """The state of a run. Only a RUNNING run can be written to; QUEUED, INTERRUPTED and FAILED runs can be resumed.

    A QUEUED run waits for any process to compute it; see `ssmail.store.queue`.
    """

    QUEUED = "queued"
    RUNNING = "running"
    FINISHED = "finished"
    FAILED = "failed"
    DIVERGED = "diverged"
    INTERRUPTED = "interrupted"

    @property
    def settled(self) -> bool:
        """Whether the run has finished or diverged, so that it is not trained any further."""
        return self in (RunState.FINISHED, RunState.DIVERGED)


class UtcDateTime(TypeDecorator[datetime]):
    """A time in UTC, stored without a time zone but read and written with one."""

    impl = sa.DateTime
    cache_ok = True

    def process_bind_param(self, value: datetime | None, dialect: Any) -> datetime | None:
        """Convert `value`, which must have a time zone, to its stored form."""
        return None if value is None else value.astimezone(UTC).replace(tzinfo=None)

    def process_result_value(self, value: datetime | None, dialect: Any) -> datetime | None:
        """Return the stored time, marked as UTC."""
        return None if value is None else value.replace(tzinfo=UTC)


metadata = sa.MetaData()

run = sa.Table(
    "run",
    metadata,
    sa.Column("id", sa.String(32), primary_key=True),
    sa.Column("method", sa.String(64), nullable=False),
    sa.Column("environment", sa.String(64), nullable=False),
    sa.Column("profile", sa.String(64), nullable=False),
    sa.Column("seed", sa.BigInteger, nullable=False),
    sa.Column("spec_json", sa.Text, nullable=False),
    sa.Column("spec_hash", sa.String(16), nullable=False),
    sa.Column("dataset_hash", sa.String(64)),
    sa.Column("state", sa.String(16), nullable=False),
    sa.Column("error", sa.Text),
    sa.Column("started", UtcDateTime, nullable=False),
    sa.Column("finished", UtcDateTime),
    sa.Column("heartbeat", UtcDateTime, nullable=False),
    sa.Column("owner", sa.String(32), nullable=False),
    sa.Column("resumes", sa.Integer, nullable=False),
    sa.Column("git_commit", sa.String(40)),
    sa.Column("git_dirty", sa.Boolean),
    sa.Column("package_version", sa.String(64), nullable=False),
    sa.Column("torch_version", sa.String(64), nullable=False),
    sa.Column("device", sa.String(64), nullable=False),
    sa.Column("host", sa.String(255), nullable=False),
    sa.Column("wall_seconds", sa.Float, nullable=False),
    sa.Column("cpu_seconds", sa.Float, nullable=False),
    sa.Column("peak_memory_bytes", sa.BigInteger),
    sa.Index("run_cell", "spec_hash", "seed"),
    # Databases made by earlier versions, or by someone else, lack these constraints, so readers check ids too.
    sa.CheckConstraint("typeof(id) = 'text' AND length(CAST(id AS BLOB)) = 32 AND id NOT GLOB '*[^0-9a-f]*'").ddl_if(
        dialect="sqlite"
    ),
    sa.CheckConstraint("id ~ '^[0-9a-f]{32}$'").ddl_if(dialect="postgresql"),
)


def _run_id() -> sa.Column[str]:
    return sa.Column("run_id", sa.String(32), sa.ForeignKey("run.id", ondelete="CASCADE"), primary_key=True)


metric = sa.Table(
    "metric",
    metadata,
    _run_id(),
    sa.Column("name", sa.String(128), primary_key=True),
    sa.Column("step", sa.Integer, primary_key=True, autoincrement=False),
    sa.Column("value", sa.Float(53)),
    sa.Column("kind", sa.String(8), nullable=False),
    sqlite_with_rowid=False,
)

metric_latest = sa.Table(
    "metric_latest",
    metadata,
    _run_id(),
    sa.Column("name", sa.String(128), primary_key=True),
    sa.Column("step", sa.Integer, nullable=False),
    sa.Column("value", sa.Float(53)),
    sa.Column("kind", sa.String(8), nullable=False),
    sqlite_with_rowid=False,
)

array = sa.Table(
    "array",
    metadata,
    _run_id(),
    sa.Column("name", sa.String(128), primary_key=True),
    sa.Column("dtype", sa.String(16), nullable=False),
    sa.Column("shape", sa.String(255), nullable=False),
    sa.Column("data", sa.LargeBinary, nullable=False),
)

artifact = sa.Table(
    "artifact",
    metadata,
    _run_id(),
    sa.Column("name", sa.String(128), primary_key=True),
    sa.Column("path", sa.Text, nullable=False),
    sa.Column("sha256", sa.String(64), nullable=False),
    sa.Column("size_bytes", sa.BigInteger, nullable=False),
)


class in_byte_order(FunctionElement[str]):  # noqa: N801 (a function to its callers)
    """A text column to order by: in the order of its bytes on every database, as in SQLite and Python."""

    inherit_cache = True


@compiles(in_byte_order)
def _plain(element: Any, compiler: Any, **options: Any) -> str:
    return str(compiler.process(element.clauses, **options))


@compiles(in_byte_order, "postgresql")
def _collated(element: Any, compiler: Any, **options: Any) -> str:
    return f'{compiler.process(element.clauses, **options)} COLLATE "C"'


def require_fitting(table: sa.Table, rows: Iterable[Mapping[str, Any]]) -> None:
    """Raise InputError if a text is longer than its column, which SQLite would accept and a server would refuse."""
    for row in rows:
        if fault := length_fault(table, row):
            raise InputError(f"{fault}; give a shorter one")


def length_fault(table: sa.Table, row: Mapping[str, Any]) -> str | None:
    """Return which text of a row is longer than its column, or cannot be stored on a server; None if all fit."""
    for column in table.c:
        value, longest = row.get(column.name), getattr(column.type, "length", None)
        if not isinstance(value, str):
            continue
        if longest is not None and len(value) > longest:
            named = f"{column.name} {shortened(value, 40)!r} has {len(value)} characters"
            return f"the {table.name}'s {named}, of which the database keeps {longest}"
        if "\0" in value:
            return f"the {table.name}'s {column.name} {shortened(value, 40)!r} has a null character"
    return None
