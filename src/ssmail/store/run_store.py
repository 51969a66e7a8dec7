"""The store: one database that holds every run, its metrics and the arrays that the figures draw."""

import shutil
import uuid
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import numpy.typing as npt
from sqlalchemy import Engine

from ssmail.config.spec import RunSpec
from ssmail.store import lifecycle, origin, queries, schema
from ssmail.store.checkpoint_files import root_of
from ssmail.store.connection import connect, describe, reading, writing
from ssmail.store.lifecycle import STALE_SECONDS
from ssmail.store.queries import ArtifactRow, RunRow
from ssmail.store.schema import RunState
from ssmail.store.writer import RunWriter

if TYPE_CHECKING:
    import pandas as pd


class Store:
    """An open store. Many processes may use one database at once; each opens its own Store.

    url: opens the same database again, in any process. where: its path, or its URL without the password, for messages.
    checkpoint_root: the folder with one subfolder of checkpoints for each run id, beside an SQLite file.
    """

    def __init__(self, engine: Engine) -> None:
        self._engine = engine
        self.url = engine.url.render_as_string(hide_password=False)
        self.where = describe(engine)
        on_sqlite = engine.dialect.name == "sqlite"
        file = Path(str(engine.url.database)) if on_sqlite else Path("results/ssmail.db").absolute()
        self.checkpoint_root = root_of(file)

    @classmethod
    def open(cls, where: str | Path) -> Self:
        """The store at `where`, a path or an SQLAlchemy URL; created, or upgraded to the current schema, if need be.

        Raises InputError for a place that cannot be used, a file that is no database of ssmail's, and a newer schema.
        """
        return cls(connect(where))

    def close(self) -> None:
        """Close every connection; the next call opens new ones."""
        self._engine.dispose()

    # -- runs ------------------------------------------------------------------------------------------------------

    def runs(
        self,
        *,
        method: str | None = None,
        environment: str | None = None,
        profile: str | None = None,
        state: RunState | str | None = None,
        ids: Sequence[str] | None = None,
    ) -> list[RunRow]:
        """The runs that meet every condition given, newest last.

        `ids` are ids or their beginnings. Raises InputError for an unknown or ambiguous id.
        """
        run = schema.run
        equal = {run.c.method: method, run.c.environment: environment, run.c.profile: profile, run.c.state: state}
        conditions = [column == value for column, value in equal.items() if value is not None]
        with reading(self._engine) as connection:
            if ids is not None:
                conditions.append(run.c.id.in_(queries.resolve(connection, ids)))
            return queries.runs(connection, *conditions)

    def find_cell(self, spec_hash: str, seed: int) -> RunRow | None:
        """The newest run of the cell, or None."""
        with reading(self._engine) as connection:
            return queries.newest_of_cell(connection, spec_hash, seed)

    def start_run(
        self,
        spec: RunSpec,
        seed: int,
        *,
        dataset_hash: str | None,
        device: str,
        replace: bool = False,
        stale_seconds: float = STALE_SECONDS,
    ) -> RunWriter:
        """Begin a new run of the cell, in the state RUNNING, and return the hand that writes it.

        Of several processes that try at once one succeeds. Raises InputError when another process is computing the
        cell, or when it is finished or diverged already; `replace` begins a new run beside such an old one.
        """
        owner = uuid.uuid4().hex
        values = {"dataset_hash": dataset_hash, "device": device, "owner": owner, **origin.columns()}
        with writing(self._engine) as connection:
            run_id = lifecycle.begin(connection, spec, seed, values, replace, stale_seconds)
        used = {"wall_seconds": 0.0, "cpu_seconds": 0.0, "peak_memory_bytes": None}
        return RunWriter(self._engine, self.checkpoint_root, run_id, owner, used)

    def resume_run(self, run_id: str, from_step: int, *, stale_seconds: float = STALE_SECONDS) -> RunWriter:
        """Continue an unfinished run after epoch `from_step`; what it recorded later is dropped.

        Of several processes that try at once one succeeds. Raises InputError when another process is computing it or
        there is no such run, SsmailError when it is finished or diverged or has recorded fewer epochs than `from_step`.
        """
        values = {"owner": uuid.uuid4().hex, **origin.columns()}
        with writing(self._engine) as connection:
            row = lifecycle.resume(connection, run_id, from_step, values, stale_seconds)
        used = {name: getattr(row, name) for name in ("wall_seconds", "cpu_seconds", "peak_memory_bytes")}
        return RunWriter(self._engine, self.checkpoint_root, run_id, values["owner"], used)

    def mark_stale(self, older_than_seconds: float = STALE_SECONDS) -> list[RunRow]:
        """Mark the RUNNING runs without a heartbeat for so long as INTERRUPTED, and return them as they were found."""
        with writing(self._engine) as connection:
            found = lifecycle.stale(connection, older_than_seconds)
            for row in found:
                lifecycle.interrupt(connection, row)
        return found

    def end_dead_run(self, run_id: str, state: RunState, error: str) -> None:
        """Put a RUNNING run whose process is known to be gone into `state`; a run in any other state stays as it is."""
        with writing(self._engine) as connection:
            lifecycle.end(connection, run_id, state, error)

    def delete(self, run_ids: Sequence[str], *, stale_seconds: float = STALE_SECONDS) -> None:
        """Delete the runs (ids or their beginnings), all they recorded, and their checkpoint files.

        Raises InputError, and deletes nothing, when an id is unknown or ambiguous or a run is being computed.
        """
        with writing(self._engine) as connection:
            full = queries.resolve(connection, run_ids)
            lifecycle.remove(connection, full, stale_seconds)
        for run_id in full:
            shutil.rmtree(self.checkpoint_root / run_id, ignore_errors=True)

    # -- what runs recorded ----------------------------------------------------------------------------------------

    def metrics(self, run_ids: Sequence[str], names: Sequence[str] | None = None) -> "pd.DataFrame":
        """Every value of the runs (full ids): columns run_id, seed, name, step, value; one row for each value."""
        with reading(self._engine) as connection:
            return queries.metrics(connection, run_ids, names)

    def latest_metrics(self, run_ids: Sequence[str], names: Sequence[str] | None = None) -> "pd.DataFrame":
        """The last value of each metric of the runs (full ids): columns run_id, name, step, value."""
        with reading(self._engine) as connection:
            return queries.latest_metrics(connection, run_ids, names)

    def array(self, run_id: str, name: str) -> npt.NDArray[Any]:
        """The run's array of that name. Raises InputError, naming those there are, when it has none."""
        with reading(self._engine) as connection:
            return queries.array(connection, run_id, name)

    def array_names(self, run_id: str) -> list[str]:
        """The names of the run's arrays, sorted."""
        with reading(self._engine) as connection:
            return queries.array_names(connection, run_id)

    def artifacts(self, run_id: str) -> list[ArtifactRow]:
        """The files that the run left behind, by name."""
        with reading(self._engine) as connection:
            return queries.artifacts(connection, run_id, self.checkpoint_root)
