"""The database of runs: SQLite by default, or any SQLAlchemy URL. docs/database.md describes it."""

from ssmail.store.queries import HEARTBEAT_SECONDS, STALE_SECONDS, ArtifactRow, RunRow
from ssmail.store.run_store import Store
from ssmail.store.schema import RunState
from ssmail.store.writer import RunWriter

__all__ = ["HEARTBEAT_SECONDS", "STALE_SECONDS", "ArtifactRow", "RunRow", "RunState", "RunWriter", "Store"]
