"""Writes one run: metrics, arrays, artifacts, heartbeats and its final state, in short transactions.

Each transaction first updates the run's row, and continues only if the run is RUNNING and this writer still owns it. So
a finished run cannot change, and a process that was declared dead cannot write into a run that another one resumed.
The transactions of an epoch and of the end of a run recognize what they wrote if the answer to their commit was lost.
"""

import hashlib
import math
import time
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy.typing as npt
from sqlalchemy import Connection, Engine, Table, delete, func, insert, select, update
from sqlalchemy.exc import IntegrityError

from ssmail.errors import SsmailError
from ssmail.store import arrays, queries, run_metadata, schema
from ssmail.store.artifact_storage import ArtifactStorage
from ssmail.store.checkpoint_files import run_folder
from ssmail.store.connection import read, write
from ssmail.store.queries import RunRow
from ssmail.store.queue import left_state
from ssmail.store.schema import RunState, require_fitting


class RunWriter:
    """Records one run. Get a RunWriter from Store.start_run or Store.resume_run.

    folder: for the run's files; it need not exist yet. resumed: the run's row before this process resumed it; the
    resources in it are added to those of this process. storage: where its checkpoints go instead of the folder, if
    the user named a place.
    """

    def __init__(
        self,
        engine: Engine,
        checkpoint_root: Path,
        run_id: str,
        owner: str,
        resumed: RunRow | None = None,
        storage: ArtifactStorage | None = None,
    ) -> None:
        self.run_id, self.storage = run_id, storage
        self._engine, self._root = engine, checkpoint_root
        self.folder = run_folder(checkpoint_root, run_id)
        self._owner = owner
        # wall and CPU time up to a clock reading; what has passed since then is shared among so many runs
        self._used = (resumed.wall_seconds, resumed.cpu_seconds) if resumed else (0.0, 0.0)
        self._since, self._runs = (time.monotonic(), time.process_time()), 1
        self._peak_memory_before = (resumed and resumed.peak_memory_bytes) or 0

    def epoch(self, step: int, metrics: Mapping[str, float]) -> None:
        """Record the metrics of epoch `step` (1-based). Raises SsmailError when the epoch has metrics already."""

        def record(connection: Connection, again: bool) -> None:
            self._touch(connection)
            if again and self._has(connection, step, metrics):
                return
            try:
                _insert(connection, schema.metric, self.run_id, step, metrics)
            except IntegrityError as error:
                raise SsmailError(f"run {self.run_id[:8]} already has metrics for step {step}") from error
            self._replace_latest(connection, step, metrics)

        write(self._engine, record)

    def final(self, step: int, metrics: Mapping[str, float]) -> None:
        """Record the metrics of the final evaluation, replacing those of an interrupted evaluation."""

        def record(connection: Connection, _again: bool) -> None:
            self._touch(connection)
            _delete(connection, schema.metric, self.run_id, list(metrics))
            _insert(connection, schema.metric, self.run_id, step, metrics)
            self._replace_latest(connection, step, metrics)

        write(self._engine, record)

    def share(self, runs: int) -> None:
        """From now on, count time as that of `runs` runs which this process trains at once."""
        self._used, self._since, self._runs = self._seconds(), (time.monotonic(), time.process_time()), runs

    def heartbeat(self) -> None:
        """Record that this run is alive. Safe to call from another thread. Does not wait for a lost server."""
        write(self._engine, lambda connection, _: self._touch(connection), patience=0)

    def arrays(self, values: Mapping[str, npt.NDArray[Any]]) -> None:
        """Store the arrays by name, replacing existing arrays of the same name."""
        rows = [{"run_id": self.run_id, "name": name, **arrays.encode(value)} for name, value in values.items()]
        self._replace(schema.array, rows)

    def artifact(self, name: str, file: str | None = None) -> None:
        """Record a file of the run's folder under `name`, by default the file of that name, with its SHA-256."""
        file = file or name
        content = (self.folder / file).read_bytes()
        row = {"name": name, "path": f"{self.run_id}/{file}", "size_bytes": len(content)}
        self._replace(schema.artifact, [{"run_id": self.run_id, **row, "sha256": hashlib.sha256(content).hexdigest()}])

    def objects(self) -> dict[str, str]:
        """Return the SHA-256 of each object that the run recorded, by its name."""
        rows = read(self._engine, lambda connection: queries.artifacts(connection, self.run_id, self._root))
        return {row.name: row.sha256 for row in rows if row.by_content}

    def store_objects(self, contents: Mapping[str, bytes]) -> None:
        """Put contents into the storage, then record them by name, then remove the objects that they supersede.

        An object that is not recorded, because the process ended or lost the run in between, stays: another process of
        the run may have recorded the same one.
        """
        assert self.storage is not None
        before = self.objects()
        now = before | {name: self.storage.put(self.run_id, content) for name, content in contents.items()}
        rows = [
            {"run_id": self.run_id, "name": name, "path": f"{self.run_id}/{now[name]}", "sha256": now[name]}
            | {"size_bytes": len(content)}
            for name, content in contents.items()
        ]
        self._replace(schema.artifact, rows)
        with suppress(SsmailError):  # a place where nothing may be deleted
            self.storage.remove(self.run_id, set(before.values()) - set(now.values()))

    def finish(self, state: RunState, error: str | None = None) -> None:
        """End the run in `state`, which must not be QUEUED or RUNNING. The writer cannot be used afterwards.

        A run from the queue that is INTERRUPTED waits again.
        """
        if state in (RunState.QUEUED, RunState.RUNNING):
            raise SsmailError(f"a run cannot end in the state {state}")
        if state is RunState.INTERRUPTED:
            state = left_state(self._owner)
        error = error and error.replace("\0", "\\0")  # which a server does not store

        def end(connection: Connection, again: bool) -> None:
            mine = (schema.run.c.id == self.run_id) & (schema.run.c.owner == self._owner)
            stored = connection.execute(select(schema.run.c.state).where(mine)).scalar() if again else None
            if stored != state:
                self._touch(connection, state=state, error=error, finished=queries.clock(connection))

        write(self._engine, end)

    def _touch(self, connection: Connection, **changes: Any) -> None:
        run = schema.run
        mine = (run.c.id == self.run_id) & (run.c.owner == self._owner) & (run.c.state == RunState.RUNNING)
        values = {"heartbeat": queries.clock(connection), **self._resources(), **changes}
        if connection.execute(update(run).where(mine).values(values)).rowcount == 1:
            return
        state = connection.execute(select(run.c.state).where(run.c.id == self.run_id)).scalar()
        if state is None:
            raise SsmailError(f"run {self.run_id[:8]} was deleted while it was being written")
        if state == RunState.RUNNING:
            raise SsmailError(f"run {self.run_id[:8]} was resumed by another process, which now owns it")
        raise SsmailError(f"run {self.run_id[:8]} is {state} and can no longer be written")

    def _seconds(self) -> tuple[float, float]:
        """Return this run's wall and CPU time so far."""
        wall, cpu = time.monotonic() - self._since[0], time.process_time() - self._since[1]
        return self._used[0] + wall / self._runs, self._used[1] + cpu / self._runs

    def _resources(self) -> dict[str, Any]:
        wall, cpu = self._seconds()
        return {
            "wall_seconds": wall,
            "cpu_seconds": cpu,
            "peak_memory_bytes": max(self._peak_memory_before, run_metadata.peak_memory_bytes()),
        }

    def _replace(self, table: Table, rows: list[dict[str, Any]]) -> None:
        require_fitting(table, rows)

        def replace(connection: Connection, _again: bool) -> None:
            self._touch(connection)
            _delete(connection, table, self.run_id, [row["name"] for row in rows])
            if rows:
                connection.execute(insert(table), rows)

        write(self._engine, replace)

    def _has(self, connection: Connection, step: int, metrics: Mapping[str, float]) -> bool:
        """Return whether exactly these values are stored of the step."""
        metric = schema.metric
        query = select(metric.c.name, metric.c.value, metric.c.kind)
        stored = connection.execute(query.where(metric.c.run_id == self.run_id, metric.c.step == step))
        rows = ((name, _value(value)) for name, value in metrics.items())
        return {tuple(row) for row in stored} == {(name, row["value"], row["kind"]) for name, row in rows}

    def _replace_latest(self, connection: Connection, step: int, metrics: Mapping[str, float]) -> None:
        _delete(connection, schema.metric_latest, self.run_id, list(metrics))
        _insert(connection, schema.metric_latest, self.run_id, step, metrics)


def _delete(connection: Connection, table: Table, run_id: str, names: list[str]) -> None:
    connection.execute(delete(table).where(table.c.run_id == run_id, table.c.name.in_(names)))


def _insert(connection: Connection, table: Table, run_id: str, step: int, metrics: Mapping[str, float]) -> None:
    rows = [{"run_id": run_id, "name": name, "step": step, **_value(value)} for name, value in metrics.items()]
    require_fitting(table, rows)
    if rows:
        connection.execute(insert(table), rows)


def _value(value: float) -> dict[str, Any]:
    """Return the columns value and kind. SQLite would store NaN as NULL, and other databases reject infinities."""
    number = float(value)
    if math.isfinite(number):
        return {"value": number, "kind": "finite"}
    return {"value": None, "kind": "nan" if math.isnan(number) else "inf" if number > 0 else "-inf"}


def drop_metrics_after(connection: Connection, row: RunRow, step: int) -> None:
    """Delete the run's metrics after `step` and rebuild metric_latest.

    Raises SsmailError when the run has recorded fewer steps.
    """
    metric, latest = schema.metric, schema.metric_latest
    connection.execute(delete(metric).where(metric.c.run_id == row.id, metric.c.step > step))
    last = queries.last_step(connection, row.id)
    if last < step:
        raise SsmailError(
            f"the checkpoint of run {row.name} is at epoch {step} but the database ends at epoch {last}; "
            "delete the run and train it again"
        )
    connection.execute(delete(latest).where(latest.c.run_id == row.id))
    newest = (
        select(metric.c.name, func.max(metric.c.step).label("step"))
        .where(metric.c.run_id == row.id)
        .group_by(metric.c.name)
        .subquery()
    )
    same = (metric.c.name == newest.c.name) & (metric.c.step == newest.c.step)
    columns = ["run_id", "name", "step", "value", "kind"]
    rows = select(*(metric.c[column] for column in columns)).join(newest, same).where(metric.c.run_id == row.id)
    connection.execute(insert(latest).from_select(columns, rows))
