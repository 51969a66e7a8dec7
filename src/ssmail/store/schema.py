"""The tables of the store; docs/database.md explains each column. Every change here needs an Alembic revision."""

from datetime import UTC, datetime
from enum import StrEnum
from typing import Any

from sqlalchemy import (
    BigInteger,
    Boolean,
    Column,
    DateTime,
    Float,
    ForeignKey,
    Index,
    Integer,
    LargeBinary,
    MetaData,
    String,
    Table,
    Text,
)
from sqlalchemy.types import TypeDecorator

REVISIONS = ("0001",)
"""All schema revisions that this version of ssmail knows, oldest first; it reads and writes the last one."""


class RunState(StrEnum):
    """The state of a run. Only a RUNNING run can be written to; INTERRUPTED and FAILED runs can be resumed.

    Nothing sets QUEUED yet: it is part of the schema for the planned work queues, and such a run can be resumed.
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

    impl = DateTime
    cache_ok = True

    def process_bind_param(self, value: datetime | None, dialect: Any) -> datetime | None:
        """Convert `value`, which must have a time zone, to its stored form."""
        return None if value is None else value.astimezone(UTC).replace(tzinfo=None)

    def process_result_value(self, value: datetime | None, dialect: Any) -> datetime | None:
        """Return the stored time, marked as UTC."""
        return None if value is None else value.replace(tzinfo=UTC)


metadata = MetaData()

run = Table(
    "run",
    metadata,
    Column("id", String(32), primary_key=True),
    Column("method", String(64), nullable=False),
    Column("environment", String(64), nullable=False),
    Column("profile", String(64), nullable=False),
    Column("seed", BigInteger, nullable=False),
    Column("spec_json", Text, nullable=False),
    Column("spec_hash", String(16), nullable=False),
    Column("dataset_hash", String(64)),
    Column("state", String(16), nullable=False),
    Column("error", Text),
    Column("started", UtcDateTime, nullable=False),
    Column("finished", UtcDateTime),
    Column("heartbeat", UtcDateTime, nullable=False),
    Column("owner", String(32), nullable=False),
    Column("resumes", Integer, nullable=False),
    Column("git_commit", String(40)),
    Column("git_dirty", Boolean),
    Column("package_version", String(64), nullable=False),
    Column("torch_version", String(64), nullable=False),
    Column("device", String(64), nullable=False),
    Column("host", String(255), nullable=False),
    Column("wall_seconds", Float, nullable=False),
    Column("cpu_seconds", Float, nullable=False),
    Column("peak_memory_bytes", BigInteger),
    Index("run_cell", "spec_hash", "seed"),
)


def _run_id() -> Column[str]:
    return Column("run_id", String(32), ForeignKey("run.id", ondelete="CASCADE"), primary_key=True)


metric = Table(
    "metric",
    metadata,
    _run_id(),
    Column("name", String(128), primary_key=True),
    Column("step", Integer, primary_key=True, autoincrement=False),
    Column("value", Float(53)),
    Column("kind", String(8), nullable=False),
    sqlite_with_rowid=False,
)

metric_latest = Table(
    "metric_latest",
    metadata,
    _run_id(),
    Column("name", String(128), primary_key=True),
    Column("step", Integer, nullable=False),
    Column("value", Float(53)),
    Column("kind", String(8), nullable=False),
    sqlite_with_rowid=False,
)

array = Table(
    "array",
    metadata,
    _run_id(),
    Column("name", String(128), primary_key=True),
    Column("dtype", String(16), nullable=False),
    Column("shape", String(255), nullable=False),
    Column("data", LargeBinary, nullable=False),
)

artifact = Table(
    "artifact",
    metadata,
    _run_id(),
    Column("name", String(128), primary_key=True),
    Column("path", Text, nullable=False),
    Column("sha256", String(64), nullable=False),
    Column("size_bytes", BigInteger, nullable=False),
)
