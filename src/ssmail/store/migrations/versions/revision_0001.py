"""The first schema: run, metric, metric_latest, array, artifact."""

import sqlalchemy as sa
from alembic import op

from ssmail.store.schema import hexadecimal

revision = "0001"
down_revision = None


def upgrade() -> None:
    _create_run()
    _create_children()


def _create_run() -> None:
    op.create_table(
        "run",
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
        sa.Column("started", sa.DateTime, nullable=False),
        sa.Column("finished", sa.DateTime),
        sa.Column("heartbeat", sa.DateTime, nullable=False),
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
        *hexadecimal("id"),
    )
    op.create_index("run_cell", "run", ["spec_hash", "seed"])


def _create_children() -> None:
    op.create_table(
        "metric",
        _run_id(),
        sa.Column("name", sa.String(128), primary_key=True),
        sa.Column("step", sa.Integer, primary_key=True, autoincrement=False),
        sa.Column("value", sa.Float(53)),
        sa.Column("kind", sa.String(8), nullable=False),
        sqlite_with_rowid=False,
    )
    op.create_table(
        "metric_latest",
        _run_id(),
        sa.Column("name", sa.String(128), primary_key=True),
        sa.Column("step", sa.Integer, nullable=False),
        sa.Column("value", sa.Float(53)),
        sa.Column("kind", sa.String(8), nullable=False),
        sqlite_with_rowid=False,
    )
    op.create_table(
        "array",
        _run_id(),
        sa.Column("name", sa.String(128), primary_key=True),
        sa.Column("dtype", sa.String(16), nullable=False),
        sa.Column("shape", sa.String(255), nullable=False),
        sa.Column("data", sa.LargeBinary, nullable=False),
    )
    op.create_table(
        "artifact",
        _run_id(),
        sa.Column("name", sa.String(128), primary_key=True),
        sa.Column("path", sa.Text, nullable=False),
        sa.Column("sha256", sa.String(64), nullable=False),
        sa.Column("size_bytes", sa.BigInteger, nullable=False),
    )


def _run_id() -> sa.Column[str]:
    return sa.Column("run_id", sa.String(32), sa.ForeignKey("run.id", ondelete="CASCADE"), primary_key=True)
