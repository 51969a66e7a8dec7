"""The Store: one database that holds every run, its metrics and the arrays that the figures draw."""

import uuid
from collections.abc import Iterable, Sequence
from copy import copy
from datetime import datetime
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import numpy.typing as npt
from sqlalchemy import Connection, Engine, Table, delete, select, update

from ssmail.config.spec import RunSpec
from ssmail.errors import InputError, SsmailError, shortened
from ssmail.store import arrays, queries, run_metadata, schema, server
from ssmail.store.artifact_storage import ArtifactStorage, storage_of
from ssmail.store.checkpoint_files import checkpoint_root, remove_run_folder
from ssmail.store.connection import connect, describe, read, reading, write
from ssmail.store.queries import STALE_SECONDS, ArtifactRow, RunRow
from ssmail.store.queue import Claim, Queue, end, insert_row, interrupt, new_row
from ssmail.store.schema import RunState, in_byte_order
from ssmail.store.validation import DamagedRow, is_name, metric_fault, raw
from ssmail.store.writer import RunWriter, drop_metrics_after

if TYPE_CHECKING:
    import pandas as pd


class Store:
    """An open database of runs. Many processes may use the same database at once; each opens its own Store.

    url: opens the same database again, in any process. where: its path, or its URL without the password, for messages.
    checkpoint_root: the folder with one subfolder of checkpoints per run id, beside an SQLite file. stale_seconds: a
    running run whose last heartbeat is further from now than this counts as dead. damaged: the damaged rows that were
    met so far, and left out.
    """

    def __init__(self, engine: Engine, stale_seconds: float = STALE_SECONDS, artifacts: str | None = None) -> None:
        self._engine, self._artifacts = engine, artifacts
        self.url = engine.url.render_as_string(hide_password=False)
        self.where = describe(engine)
        self.stale_seconds = stale_seconds
        self.checkpoint_root = checkpoint_root(engine.url)
        self.damaged: set[DamagedRow] = set()
        self._only: frozenset[str] | None = None  # ids of the runs that `runs` returns; None: of any

    @classmethod
    def open(
        cls,
        where: str | Path,
        *,
        stale_seconds: float | None = None,
        patience: float = 0.0,
        artifacts: str | None = None,
    ) -> Self:
        """Open the database at `where`, a path or an SQLAlchemy URL; create it or upgrade its schema if necessary.

        patience: how many seconds to wait for a server that cannot be reached. artifacts: a folder or URL for
        checkpoints, by default that of SSMAIL_ARTIFACTS.
        Raises InputError when a place cannot be used, the file is not an ssmail database, or its schema is newer.
        """
        stale = queries.chosen_stale_seconds() if stale_seconds is None else stale_seconds
        return cls(connect(where, patience), stale, artifacts)

    @cached_property
    def storage(self) -> ArtifactStorage | None:  # made late: most commands read no checkpoint, and need no driver
        """Where checkpoints are instead of the folder. Raises InputError for a place that cannot be used."""
        return storage_of(self._artifacts)

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
        """Return the runs that meet all given conditions, newest last.

        `ids` are full ids or prefixes. Raises InputError for an id that is unknown, ambiguous, or of a damaged row.
        """
        run = schema.run
        equal = {run.c.method: method, run.c.environment: environment, run.c.profile: profile, run.c.state: state}
        conditions = [column == value for column, value in equal.items() if value is not None]
        damaged: set[DamagedRow] = set()

        def find(connection: Connection) -> list[RunRow]:
            wanted = () if ids is None else (run.c.id.in_(queries.resolve(connection, ids)),)
            return queries.runs(connection, *conditions, *wanted, damaged=damaged)

        found = read(self._engine, find)
        if ids is not None:
            queries.refuse(damaged)
        self.damaged |= damaged
        return found if self._only is None else [row for row in found if row.id in self._only]

    def run(self, run_id: str) -> RunRow:
        """Return the run with that full id. Raises InputError when there is none, or its row is damaged."""
        with reading(self._engine) as connection:
            return queries.one_run(connection, run_id)

    def full_ids(self, ids: Sequence[str]) -> list[str]:
        """Return the full id for each id or prefix, also of a damaged row.

        Raises InputError for one that is unknown or ambiguous.
        """
        return list(dict.fromkeys(read(self._engine, lambda connection: queries.resolve(connection, ids))))

    def only(self, run_ids: Iterable[str]) -> Self:
        """Return the same store, except that its `runs` are among these (full ids); both use the same connections."""
        other = copy(self)
        other._only = frozenset(run_ids)
        return other

    def still_stored(self, run_ids: Iterable[str]) -> list[RunRow]:
        """Return those of the runs (full ids) that are in the database which has this name now, newest last.

        There are none when it has been removed, or replaced by what is no database of ssmail.
        """
        self.close()  # open connections would still read a file that has been removed
        if self._engine.dialect.name == "sqlite" and not Path(self.where).exists():
            return []
        try:
            return read(self._engine, lambda connection: queries.runs_of(connection, run_ids))
        except SsmailError:
            return []

    def find_cell(self, spec_hash: str, seed: int) -> RunRow | None:
        """Return the newest run of the cell, or None."""
        return read(self._engine, lambda connection: queries.newest_of_cell(connection, spec_hash, seed))

    def is_alive(self, row: RunRow) -> bool:
        """Return whether a process is computing the run: it is RUNNING and has sent a heartbeat recently."""
        return row.state is RunState.RUNNING and row.is_alive(self.stale_seconds, self._now())

    def _now(self) -> datetime:
        with reading(self._engine) as connection:
            return queries.clock(connection)

    @property
    def queue(self) -> Queue:
        """The cells that wait, and who computes which."""
        return Queue(self._engine, self.stale_seconds)

    def require_idle(self, row: RunRow) -> None:
        """Raise InputError when another process is computing the run."""
        if row.state is RunState.RUNNING and row.is_alive(self.stale_seconds, now := self._now()):
            silent = row.silent_seconds(now)
            when = f"{silent:.0f} s ago" if silent >= 0 else f"{-silent:.0f} s ahead of this clock"
            raise InputError(
                f"seed {row.seed} of this spec is being computed by another process on {row.host} (run {row.name}, "
                f"last heartbeat {when}); wait for it to end, or, if it was killed, try again in "
                f"{self.stale_seconds - silent + 1:.0f} s"
            )

    def start_run(
        self, spec: RunSpec, seed: int, *, dataset_hash: str | None, device: str, repeat: bool = False
    ) -> RunWriter:
        """Insert a new run of the cell in state RUNNING and return a RunWriter for it.

        If several processes try at once, only one succeeds. Raises InputError when another process is computing the
        cell, or when the cell has finished or diverged already, unless `repeat` allows a new run beside the old one.
        """
        row = new_row(spec, seed, RunState.RUNNING, uuid.uuid4().hex)
        row |= {"dataset_hash": dataset_hash, "device": device}

        def start(connection: Connection, again: bool) -> None:
            server.lock_cells(connection)
            newest = queries.newest_of_cell(connection, spec.hash(), seed, for_update=True)
            if newest is not None:
                if again and newest.id == row["id"]:
                    return
                self.require_idle(newest)
                if newest.state.settled and not repeat:
                    raise InputError(
                        f"seed {seed} of this spec has {newest.state} already, as run {newest.name}; delete it first"
                    )
                if newest.state is RunState.RUNNING:
                    interrupt(connection, newest)
            insert_row(connection, row, queries.clock(connection))

        write(self._engine, start)
        return RunWriter(self._engine, self.checkpoint_root, row["id"], row["owner"], storage=self.storage)

    def resume_run(self, run_id: str, from_step: int, claim: Claim | None = None, **begun: str | None) -> RunWriter:
        """Continue an unfinished run after epoch `from_step`, dropping the metrics of later epochs.

        From step 0, the records of checkpoints are dropped too: they would be ahead of the metrics.
        With a claim of the run, only who made it may do so. begun: its columns dataset_hash and device, if they change.
        If several processes try at once, only one succeeds. Raises InputError when another process is computing the run
        or there is no such run, SsmailError when it has finished or diverged, or has recorded fewer epochs than
        `from_step`.
        """
        owner = claim.owner if claim else uuid.uuid4().hex
        met: list[RunRow] = []  # the row by attempt; the first may have been committed, if only the answer was lost

        def resume(connection: Connection, again: bool) -> RunRow:
            row = queries.one_run(connection, run_id, for_update=True)
            if again and claim is None and row.owner == owner:
                return row
            if claim is None or row.owner != owner:
                self.require_idle(row)
            if row.state.settled:
                raise SsmailError(f"run {row.name} has {row.state} and cannot be resumed")
            drop_metrics_after(connection, row, from_step)
            if from_step == 0:
                connection.execute(delete(schema.artifact).where(schema.artifact.c.run_id == run_id))
            met.append(row)
            before = met[0] if claim else row
            changes = {
                "state": RunState.RUNNING,
                "error": None,
                "finished": None,
                "heartbeat": queries.clock(connection),
                "owner": owner,
                "resumes": before.resumes + (claim is None or before.has_begun),
                **run_metadata.columns(),
                **begun,
            }
            connection.execute(update(schema.run).where(schema.run.c.id == run_id).values(changes))
            return row

        row = write(self._engine, resume)
        return RunWriter(self._engine, self.checkpoint_root, run_id, owner, resumed=row, storage=self.storage)

    def mark_stale(self) -> list[RunRow]:
        """Mark the RUNNING runs without a recent heartbeat as INTERRUPTED; return their rows from before the change."""

        def mark(connection: Connection, _again: bool) -> list[RunRow]:
            found = queries.silent_runs(connection, self.stale_seconds, for_update=True)
            for row in found:
                interrupt(connection, row)
            return found

        return write(self._engine, mark)

    def end_dead_run(self, run_id: str, state: RunState, error: str, owner: str | None = None) -> None:
        """Set the state of a RUNNING run, of that owner if one is given, whose process is known to be dead."""
        write(self._engine, lambda connection, _: end(connection, run_id, state, error, owner))

    def delete(self, run_ids: Sequence[str]) -> None:
        """Delete the runs (full ids or prefixes), everything they recorded, and their checkpoint files.

        In the storage, those objects are deleted that they recorded. Raises InputError, and deletes nothing, when an id
        is unknown or ambiguous or a run is being computed. A damaged run is deleted too, whatever it says of its
        process.
        """
        full: list[str] = []
        objects: dict[str, list[str]] = {}

        def delete_idle(connection: Connection, again: bool) -> None:
            full[:] = full if again and full else queries.resolve(connection, run_ids)
            for row in queries.runs(connection, schema.run.c.id.in_(full), for_update=True):
                self.require_idle(row)
            for run_id in full:
                found = queries.artifacts(connection, run_id, self.checkpoint_root)
                objects[run_id] = [row.sha256 for row in found] or objects.get(run_id, [])
            connection.execute(delete(schema.run).where(schema.run.c.id.in_(full)))

        write(self._engine, delete_idle)
        for run_id in filter(schema.is_run_id, full):
            remove_run_folder(self.checkpoint_root, run_id)
            if self.storage is not None:
                self.storage.remove(run_id, objects[run_id])

    # -- what runs recorded ----------------------------------------------------------------------------------------

    def metrics(
        self, run_ids: Sequence[str], names: Sequence[str] | None = None, *, after: int | None = None
    ) -> "pd.DataFrame":
        """Return every metric value of the runs (full ids): columns run_id, seed, name, step, value.

        The rows are ordered by the start of the run, name and step. after: only of later epochs than this one.
        """
        return self._metrics(schema.metric, run_ids, names, after)

    def latest_metrics(self, run_ids: Sequence[str], names: Sequence[str] | None = None) -> "pd.DataFrame":
        """Return the last value of each metric of the runs (full ids): columns run_id, name, step, value."""
        return self._metrics(schema.metric_latest, run_ids, names).drop(columns="seed")

    def _metrics(
        self, table: Table, run_ids: Sequence[str], names: Sequence[str] | None, after: int | None = None
    ) -> "pd.DataFrame":
        import pandas as pd  # imported late so that listing runs does not wait for it

        run = schema.run
        row = {column.name: column for column in raw(table)}
        query = select(row["run_id"], run.c.seed, row["name"], row["step"], row["value"], row["kind"])
        query = query.join(run, run.c.id == table.c.run_id).where(table.c.run_id.in_(list(run_ids)))
        if names is not None:
            query = query.where(table.c.name.in_(list(names)))
        if after is not None:
            query = query.where(table.c.step > after)
        query = query.order_by(run.c.started, run.c.id, in_byte_order(table.c.name), table.c.step)
        columns = ["run_id", "seed", "name", "step", "value"]
        with reading(self._engine) as connection:
            rows = [row for row in connection.execute(query) if self._is_sound(table, *row)]
        frame = pd.DataFrame(rows, columns=[*columns, "kind"])
        value = frame["value"].astype(float).to_numpy(copy=True)
        for kind in ("nan", "inf", "-inf"):
            value[(frame["kind"] == kind).to_numpy()] = float(kind)
        return frame.assign(value=value).astype({"seed": "int64", "step": "int64"})[columns]

    def _is_sound(self, table: Table, run_id: str, _seed: int, name: Any, step: Any, value: Any, kind: Any) -> bool:
        fault = metric_fault(name, step, value, kind)
        if fault is not None:
            self.damaged.add(DamagedRow(table.name, run_id, fault, name))
        return fault is None

    def array(self, run_id: str, name: str) -> npt.NDArray[Any]:
        """Return the run's array of that name.

        Raises InputError when there is none, listing the run's arrays, and when it cannot be read.
        """
        table = schema.array
        row_of = {column.name: column for column in raw(table)}
        query = select(row_of["dtype"], row_of["shape"], row_of["data"])
        query = query.where(table.c.run_id == run_id, table.c.name == name)
        with reading(self._engine) as connection:
            row = connection.execute(query).first()
        if row is None:
            existing = ", ".join(self.array_names(run_id)) or "none"
            raise InputError(f"run {run_id[:8]} has no array {name!r}; its arrays: {existing}")
        try:
            return arrays.decode(*row)
        except arrays.UnreadableArrayError as error:
            raise InputError(
                f"the array {shortened(name, 60)} of run {run_id[:8]} cannot be read: {error}; "
                "`ssmail db check` shows what to do"
            ) from None

    def array_names(self, run_id: str) -> list[str]:
        """Return the names of the run's arrays, sorted."""
        table = schema.array
        query = select(table.c.name).where(table.c.run_id == run_id).order_by(in_byte_order(table.c.name))
        with reading(self._engine) as connection:
            names = list(connection.execute(query).scalars())
        wrong = {DamagedRow(table.name, run_id, "its name is none", name) for name in names if not is_name(name)}
        self.damaged |= wrong
        return [name for name in names if is_name(name)]

    def artifacts(self, run_id: str) -> list[ArtifactRow]:
        """Return the files that the run recorded, by name."""
        root = self.checkpoint_root
        return read(self._engine, lambda connection: queries.artifacts(connection, run_id, root, self.damaged))

    def is_compact(self, run: RunRow) -> bool:
        """Return whether a run that ended has no checkpoint: a compact database keeps only what figures read of it."""
        return run.state.settled and not self.artifacts(run.id)
