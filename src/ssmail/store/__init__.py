"""The store of runs: SQLite by default, any SQLAlchemy URL by choice. docs/database.md describes it."""

from ssmail.store.lifecycle import HEARTBEAT_SECONDS, STALE_SECONDS, is_alive
from ssmail.store.queries import ArtifactRow, RunRow
from ssmail.store.run_store import Store
from ssmail.store.schema import RunState
from ssmail.store.writer import RunWriter

__all__ = ["HEARTBEAT_SECONDS", "STALE_SECONDS", "ArtifactRow", "RunRow", "RunState", "RunWriter", "Store", "is_alive"]
