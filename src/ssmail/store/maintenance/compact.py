"""A small database with what figures need of some runs: every column and every last value, some curves, some arrays."""

import sqlite3
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy.typing as npt
from sqlalchemy import Connection, Table, func, insert, select

from ssmail.store import arrays, schema
from ssmail.store.connection import connect, reading, writing
from ssmail.store.maintenance.sqlite_file import existing, new_file, opened, require_current
from ssmail.store.queries import RunRow

Thinning = Callable[[npt.NDArray[Any]], npt.NDArray[Any]]
"""Makes of an array the part that is wanted of it."""
_ROWS = 500  # at a time


@dataclass(frozen=True)
class Wanted:
    """What to keep beside the runs and their last values.

    curves: names of metrics that keep every epoch; any other keeps its last value alone. arrays: by run id the names of
    arrays, each with what thins it, or None to keep it whole.
    """

    curves: Collection[str]
    arrays: Mapping[str, Mapping[str, Thinning | None]]


@dataclass(frozen=True)
class Compact:
    """What was written, and what was left out of the chosen runs."""

    path: Path
    size_bytes: int
    runs: int
    metrics: int  # rows
    arrays: int
    thinned: int  # arrays of which a part was kept
    left_out_metrics: int
    left_out_arrays: int
    left_out_artifacts: int


def settled_cells(runs: Sequence[RunRow]) -> list[RunRow]:
    """The newest finished or diverged run of each spec, seed and data, in the given order (newest last)."""
    newest = {(run.spec_hash, run.seed, run.dataset_hash): run for run in runs if run.state.settled}
    return [run for run in runs if newest.get((run.spec_hash, run.seed, run.dataset_hash)) is run]


def export_compact(where: str | Path, target: Path, runs: Sequence[RunRow], wanted: Wanted) -> Compact:
    """Write these runs to the new database `target`, without checkpoints; one that needs no second file to be read.

    A death at any moment leaves no `target`. Raises InputError when it exists or cannot be written, and for a database
    that is missing, damaged or of another schema.
    """
    source = existing(where)
    require_current(source)
    with new_file(target.absolute()) as partial:
        engine = connect(partial)
        try:
            with opened(source) as theirs, reading(theirs) as there, writing(engine) as here:
                for run in runs:
                    _carry(there, here, run, wanted)
                report = _counts(there, here, runs)
        finally:
            engine.dispose()
        _shrink(partial)
        size = partial.stat().st_size
    thinned = sum(thin is not None for run in runs for thin in wanted.arrays.get(run.id, {}).values())
    return Compact(path=target, size_bytes=size, runs=len(runs), thinned=thinned, **report)


def _shrink(path: Path) -> None:
    """Give back unused pages, and leave WAL mode: one file, which reading does not touch."""
    connection = sqlite3.connect(path, isolation_level=None)
    try:
        connection.execute("PRAGMA journal_mode = DELETE")
        connection.execute("VACUUM")
    finally:
        connection.close()


def _carry(there: Connection, here: Connection, run: RunRow, wanted: Wanted) -> None:
    columns = there.execute(select(schema.run).where(schema.run.c.id == run.id)).mappings().one()
    here.execute(insert(schema.run), dict(columns))
    for table in (schema.metric, schema.metric_latest):
        for rows in _metrics(there, run.id, table, wanted.curves):
            here.execute(insert(table), rows)
    for name, thin in wanted.arrays.get(run.id, {}).items():
        table = schema.array
        query = select(table).where(table.c.run_id == run.id, table.c.name == name)
        row = dict(there.execute(query).mappings().one())
        if thin is not None:
            row |= arrays.encode(thin(arrays.decode(row["dtype"], row["shape"], row["data"])))
        here.execute(insert(table), row)


def _metrics(
    connection: Connection, run_id: str, table: Table, curves: Collection[str]
) -> Iterator[list[dict[str, Any]]]:
    """Rows of the table, some at a time: of `metric` those of the curves, and of the others the last one."""
    query = select(table).where(table.c.run_id == run_id)
    if table is schema.metric:
        latest = schema.metric_latest
        last = select(latest.c.name).where(latest.c.run_id == run_id, latest.c.name == table.c.name)
        query = query.where(table.c.name.in_(list(curves)) | last.where(latest.c.step == table.c.step).exists())
    for part in connection.execute(query).mappings().partitions(_ROWS):
        yield [dict(row) for row in part]


def _counts(there: Connection, here: Connection, runs: Sequence[RunRow]) -> dict[str, int]:
    ids = [run.id for run in runs]

    def count(connection: Connection, table: Table) -> int:
        query = select(func.count()).select_from(table).where(table.c.run_id.in_(ids))
        return int(connection.execute(query).scalar_one())

    metrics, kept = count(here, schema.metric), count(here, schema.array)
    return {
        "metrics": metrics,
        "arrays": kept,
        "left_out_metrics": count(there, schema.metric) - metrics,
        "left_out_arrays": count(there, schema.array) - kept,
        "left_out_artifacts": count(there, schema.artifact),
    }
