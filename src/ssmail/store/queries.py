"""Queries on an open connection: runs, metrics as data frames, arrays, artifacts."""

import json
from collections.abc import Sequence
from dataclasses import dataclass, fields
from datetime import UTC, datetime, timedelta
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy.typing as npt
from sqlalchemy import ColumnElement, Connection, Table, func, select

from ssmail.config.spec import with_added_keys
from ssmail.errors import InputError
from ssmail.store import arrays, schema
from ssmail.store.schema import RunState

if TYPE_CHECKING:
    import pandas as pd


HEARTBEAT_SECONDS = 5.0
"""Interval at which a running run records a heartbeat."""
STALE_SECONDS = 30.0
"""A running run without a heartbeat for this long counts as dead."""


@dataclass(frozen=True)
class RunRow:
    """One row of the table `run`; docs/database.md explains each column. Times are in UTC."""

    id: str
    method: str
    environment: str
    profile: str
    seed: int
    spec_json: str
    spec_hash: str
    dataset_hash: str | None
    state: RunState
    error: str | None
    started: datetime
    finished: datetime | None
    heartbeat: datetime
    owner: str
    resumes: int
    git_commit: str | None
    git_dirty: bool | None
    package_version: str
    torch_version: str
    device: str
    host: str
    wall_seconds: float
    cpu_seconds: float
    peak_memory_bytes: int | None

    @property
    def name(self) -> str:
        """The first eight digits of the id, for messages and tables."""
        return self.id[:8]

    @property
    def code(self) -> str:
        """The code that computed the run: "0.1.0+COMMIT", with "-dirty" where the tree was changed."""
        commit = f"+{self.git_commit}" if self.git_commit else ""
        return f"{self.package_version}{commit}{'-dirty' if self.git_dirty else ''}"

    @cached_property
    def spec(self) -> dict[str, Any]:
        """The spec as nested plain values, completed with the keys that were added after the run was stored."""
        return with_added_keys(json.loads(self.spec_json))

    @property
    def silent_seconds(self) -> float:
        """Seconds since the last heartbeat."""
        return (datetime.now(UTC) - self.heartbeat).total_seconds()

    def is_alive(self, stale_seconds: float = STALE_SECONDS) -> bool:
        """Return whether the run is RUNNING and its last heartbeat is younger than `stale_seconds`."""
        return self.state is RunState.RUNNING and self.silent_seconds < stale_seconds


@dataclass(frozen=True)
class ArtifactRow:
    """A file that a run recorded. `path` is absolute; the file may have been deleted since."""

    run_id: str
    name: str
    path: Path
    sha256: str
    size_bytes: int


def runs(connection: Connection, *conditions: Any) -> list[RunRow]:
    """Return the runs that meet all conditions, newest last."""
    query = select(schema.run).where(*conditions).order_by(schema.run.c.started, schema.run.c.id)
    return [_run_row(row) for row in connection.execute(query).mappings()]


def one_run(connection: Connection, run_id: str) -> RunRow:
    """Return the run with that full id. Raises InputError when there is none."""
    found = runs(connection, schema.run.c.id == run_id)
    if not found:
        raise InputError(f"there is no run {run_id[:8]} in the database; `ssmail runs list` shows the stored runs")
    return found[0]


def silent_runs(connection: Connection, stale_seconds: float = STALE_SECONDS) -> list[RunRow]:
    """Return the RUNNING runs whose last heartbeat is older than `stale_seconds`."""
    limit = datetime.now(UTC) - timedelta(seconds=stale_seconds)
    return runs(connection, schema.run.c.state == RunState.RUNNING, schema.run.c.heartbeat < limit)


def newest_of_cell(connection: Connection, spec_hash: str, seed: int) -> RunRow | None:
    """Return the newest run of the cell, or None."""
    found = runs(connection, schema.run.c.spec_hash == spec_hash, schema.run.c.seed == seed)
    return found[-1] if found else None


def resolve(connection: Connection, prefixes: Sequence[str]) -> list[str]:
    """Return the full id for each id or prefix of one. Raises InputError for an unknown or ambiguous prefix."""
    return [_resolve_one(connection, prefix.strip().lower()) for prefix in prefixes]


def count_rows(connection: Connection, table: Table, *conditions: ColumnElement[bool]) -> int:
    """Return the number of rows of the table that meet the conditions."""
    return int(connection.execute(select(func.count()).select_from(table).where(*conditions)).scalar_one())


def metrics(
    connection: Connection, run_ids: Sequence[str], names: Sequence[str] | None, *, latest: bool = False
) -> "pd.DataFrame":
    """Return all recorded values, or the latest of each metric: columns run_id, seed, name, step, value.

    The rows are ordered by the start of the run, name and step.
    """
    import pandas as pd  # imported late so that listing runs does not wait for it

    table, run = schema.metric_latest if latest else schema.metric, schema.run
    query = select(table.c.run_id, run.c.seed, table.c.name, table.c.step, table.c.value, table.c.kind)
    query = query.join(run, run.c.id == table.c.run_id).where(table.c.run_id.in_(list(run_ids)))
    if names is not None:
        query = query.where(table.c.name.in_(list(names)))
    query = query.order_by(run.c.started, run.c.id, table.c.name, table.c.step)
    columns = ["run_id", "seed", "name", "step", "value"]
    frame = pd.DataFrame(connection.execute(query).all(), columns=[*columns, "kind"])
    value = frame["value"].astype(float).to_numpy(copy=True)
    for kind in ("nan", "inf", "-inf"):
        value[(frame["kind"] == kind).to_numpy()] = float(kind)
    return frame.assign(value=value).astype({"seed": "int64", "step": "int64"})[columns]


def array(connection: Connection, run_id: str, name: str) -> npt.NDArray[Any]:
    """Return the run's array of that name. Raises InputError, listing the run's arrays, when there is none."""
    table = schema.array
    query = select(table.c.dtype, table.c.shape, table.c.data).where(table.c.run_id == run_id, table.c.name == name)
    row = connection.execute(query).one_or_none()
    if row is None:
        existing = ", ".join(array_names(connection, run_id)) or "none"
        raise InputError(f"run {run_id[:8]} has no array {name!r}; its arrays: {existing}")
    return arrays.decode(row.dtype, row.shape, row.data)


def array_names(connection: Connection, run_id: str) -> list[str]:
    """Return the names of the run's arrays, sorted."""
    table = schema.array
    query = select(table.c.name).where(table.c.run_id == run_id).order_by(table.c.name)
    return list(connection.execute(query).scalars())


def artifacts(connection: Connection, run_id: str, root: Path) -> list[ArtifactRow]:
    """Return the run's files, by name; relative paths are resolved against `root`."""
    table = schema.artifact
    query = select(table).where(table.c.run_id == run_id).order_by(table.c.name)
    return [
        ArtifactRow(row["run_id"], row["name"], root / row["path"], row["sha256"], row["size_bytes"])
        for row in connection.execute(query).mappings()
    ]


def _run_row(row: Any) -> RunRow:
    values = {item.name: row[item.name] for item in fields(RunRow)}
    return RunRow(**{**values, "state": RunState(values["state"])})


def _resolve_one(connection: Connection, prefix: str) -> str:
    run = schema.run
    query = select(run.c.id).where(run.c.id.startswith(prefix, autoescape=True)).limit(2)
    found = list(connection.execute(query).scalars()) if prefix else []
    if not found:
        raise InputError(f"no run id starts with {prefix!r}; `ssmail runs list` shows the stored runs")
    if len(found) > 1:
        raise InputError(f"several run ids start with {prefix!r}; give more digits")
    return str(found[0])
