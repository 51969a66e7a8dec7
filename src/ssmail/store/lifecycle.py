"""How a run begins, is resumed, is given up for dead and is deleted. Functions of an open write transaction."""

import uuid
from collections.abc import Sequence
from datetime import UTC, datetime, timedelta
from typing import Any

from sqlalchemy import Connection, delete, func, insert, select, update

from ssmail.config.spec import RunSpec
from ssmail.errors import InputError, SsmailError
from ssmail.store import queries, schema
from ssmail.store.queries import RunRow
from ssmail.store.schema import RunState

HEARTBEAT_SECONDS = 5.0
"""How often a running run says that it is alive."""
STALE_SECONDS = 30.0
"""A running run that has been silent for so long is taken for dead."""

RESUMABLE = (RunState.QUEUED, RunState.INTERRUPTED, RunState.FAILED)


def begin(
    connection: Connection, spec: RunSpec, seed: int, values: dict[str, Any], replace: bool, stale_seconds: float
) -> str:
    """Insert a new RUNNING run of the cell and return its id; `values` holds the columns that are not set here."""
    newest = queries.newest_of_cell(connection, spec.hash(), seed)
    if newest is not None:
        _refuse_if_alive(newest, stale_seconds)
        if newest.state.settled and not replace:
            raise InputError(
                f"seed {seed} of this spec is {newest.state} already, as run {newest.name}; delete it first"
            )
        if newest.state is RunState.RUNNING:
            interrupt(connection, newest)
    run_id, now = uuid.uuid4().hex, datetime.now(UTC)
    row = {
        "id": run_id,
        "method": spec.method,
        "environment": spec.environment,
        "profile": spec.profile,
        "seed": seed,
        "spec_json": spec.as_json(),
        "spec_hash": spec.hash(),
        "state": RunState.RUNNING,
        "started": now,
        "heartbeat": now,
        "resumes": 0,
        "wall_seconds": 0.0,
        "cpu_seconds": 0.0,
        **values,
    }
    connection.execute(insert(schema.run), row)
    return run_id


def resume(connection: Connection, run_id: str, from_step: int, values: dict[str, Any], stale_seconds: float) -> RunRow:
    """Make the run RUNNING again, without what it recorded after `from_step`; return the row as it was.

    `values` holds the new owner and where the run is computed now.
    """
    row = one(connection, run_id)
    _refuse_if_alive(row, stale_seconds)
    if row.state not in (*RESUMABLE, RunState.RUNNING):
        raise SsmailError(f"run {row.name} is {row.state} and cannot be resumed")
    _drop_after(connection, run_id, from_step)
    reached = connection.execute(
        select(func.max(schema.metric.c.step)).where(schema.metric.c.run_id == run_id)
    ).scalar()
    if from_step > (reached or 0):
        raise SsmailError(
            f"the checkpoint of run {row.name} is at epoch {from_step} but the database ends at {reached or 0}; "
            "delete the run and train it again"
        )
    now = datetime.now(UTC)
    changes = {"state": RunState.RUNNING, "error": None, "finished": None, "heartbeat": now}
    columns = {**changes, **values, "resumes": row.resumes + 1}
    connection.execute(update(schema.run).where(schema.run.c.id == run_id).values(columns))
    return row


def stale(connection: Connection, older_than_seconds: float) -> list[RunRow]:
    """The RUNNING runs whose last heartbeat is older than that."""
    limit = datetime.now(UTC) - timedelta(seconds=older_than_seconds)
    return queries.runs(connection, schema.run.c.state == RunState.RUNNING, schema.run.c.heartbeat < limit)


def interrupt(connection: Connection, row: RunRow) -> None:
    """Mark a run whose process fell silent as INTERRUPTED."""
    end(
        connection, row.id, RunState.INTERRUPTED, f"its process fell silent after {row.heartbeat:%Y-%m-%d %H:%M:%S} UTC"
    )


def end(connection: Connection, run_id: str, state: RunState, error: str) -> None:
    """Put a RUNNING run whose process is gone into `state`; a run in any other state stays as it is."""
    gone = (schema.run.c.id == run_id) & (schema.run.c.state == RunState.RUNNING)
    values = {"state": state, "error": error, "finished": datetime.now(UTC)}
    connection.execute(update(schema.run).where(gone).values(values))


def remove(connection: Connection, run_ids: Sequence[str], stale_seconds: float) -> None:
    """Delete the runs with everything they recorded. Raises InputError when one of them is being computed."""
    for run_id in run_ids:
        _refuse_if_alive(one(connection, run_id), stale_seconds)
    connection.execute(delete(schema.run).where(schema.run.c.id.in_(list(run_ids))))


def one(connection: Connection, run_id: str) -> RunRow:
    """The run of that full id. Raises InputError when there is none."""
    found = queries.runs(connection, schema.run.c.id == run_id)
    if not found:
        raise InputError(f"there is no run {run_id[:8]} in the database; `ssmail runs list` shows those there are")
    return found[0]


def is_alive(row: RunRow, stale_seconds: float) -> bool:
    """Whether the run is RUNNING and its process gave a sign of life lately."""
    silent = (datetime.now(UTC) - row.heartbeat).total_seconds()
    return row.state is RunState.RUNNING and silent < stale_seconds


def refusal(row: RunRow, stale_seconds: float) -> str:
    """The sentence for who wants to work on a run that is alive."""
    silent = max(0.0, (datetime.now(UTC) - row.heartbeat).total_seconds())
    return (
        f"seed {row.seed} of this spec is being computed by another process on {row.host} (run {row.name}, last sign "
        f"of life {silent:.0f} s ago); wait for it, or if it was killed try again in {stale_seconds - silent + 1:.0f} s"
    )


def _refuse_if_alive(row: RunRow, stale_seconds: float) -> None:
    if is_alive(row, stale_seconds):
        raise InputError(refusal(row, stale_seconds))


def _drop_after(connection: Connection, run_id: str, step: int) -> None:
    """Delete the metrics of later steps, and make metric_latest true again."""
    metric, latest = schema.metric, schema.metric_latest
    connection.execute(delete(metric).where(metric.c.run_id == run_id, metric.c.step > step))
    connection.execute(delete(latest).where(latest.c.run_id == run_id))
    newest = (
        select(metric.c.name, func.max(metric.c.step).label("step"))
        .where(metric.c.run_id == run_id)
        .group_by(metric.c.name)
        .subquery()
    )
    same = (metric.c.name == newest.c.name) & (metric.c.step == newest.c.step)
    columns = ["run_id", "name", "step", "value", "kind"]
    rows = select(*(metric.c[column] for column in columns)).join(newest, same).where(metric.c.run_id == run_id)
    connection.execute(insert(latest).from_select(columns, rows))
