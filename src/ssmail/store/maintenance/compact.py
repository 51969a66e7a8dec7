"""Export of a small database: runs with all columns and last values, but only the curves and arrays that are wanted."""

import sqlite3
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy.typing as npt
from sqlalchemy import Connection, Table, select, update

from ssmail.errors import InputError
from ssmail.store import arrays, queries, schema
from ssmail.store.connection import connect, reading, writing
from ssmail.store.maintenance.run_rows import copy_rows
from ssmail.store.maintenance.whole_databases import existing, new_file, opened, require_current
from ssmail.store.queries import RunRow
from ssmail.store.validation import DamagedRow, shown

Thinning = Callable[[npt.NDArray[Any]], npt.NDArray[Any]]
"""Reduces an array to the part that is wanted."""


@dataclass(frozen=True)
class Wanted:
    """What to keep in addition to the runs and their last values.

    curves: names of the metrics to keep for every epoch. arrays: for each run id, the names of the arrays to keep, with
    a Thinning, or None to keep the array whole.
    """

    curves: Collection[str]
    arrays: Mapping[str, Mapping[str, Thinning | None]]


@dataclass(frozen=True)
class Compact:
    """What was written, and what was left out of the exported runs."""

    path: Path
    size_bytes: int
    runs: int
    metrics: int  # rows
    arrays: int
    thinned: int  # arrays of which only a part was kept
    left_out_metrics: int
    left_out_arrays: int
    left_out_artifacts: int
    damaged: frozenset[DamagedRow]  # rows that were left out too


def settled_cells(runs: Sequence[RunRow]) -> list[RunRow]:
    """Return the newest finished or diverged run of each spec, seed and data; `runs` must be ordered newest last."""
    newest = {run.cell: run for run in runs if run.state.settled}
    return [run for run in runs if newest.get(run.cell) is run]


def export_compact(where: str | Path, target: Path, runs: Sequence[RunRow], wanted: Wanted) -> Compact:
    """Write these runs to the new database `target`, without checkpoints.

    The file is not in WAL mode, so reading it creates no second file. If the process dies at any moment there is no
    `target`. Raises InputError when `target` exists or cannot be written, or when the database is missing, damaged or
    of another schema.
    """
    source = existing(where)
    require_current(source)
    with new_file(target.absolute()) as partial:
        connect(partial).dispose()  # creates the tables
        with opened(source) as theirs, opened(partial) as ours, reading(theirs) as there, writing(ours) as here:
            damaged: set[DamagedRow] = set()
            for run in runs:
                _copy_run(there, here, run, wanted, damaged)
            report = _counts(there, here, runs)
        _shrink(partial)
        size = partial.stat().st_size
    thinned = sum(thin is not None for run in runs for thin in wanted.arrays.get(run.id, {}).values())
    return Compact(path=target, size_bytes=size, runs=len(runs), thinned=thinned, damaged=frozenset(damaged), **report)


def _shrink(path: Path) -> None:
    """Free unused pages and leave WAL mode."""
    with closing(sqlite3.connect(path, isolation_level=None)) as connection:
        connection.execute("PRAGMA journal_mode = DELETE")
        connection.execute("VACUUM")


def _copy_run(there: Connection, here: Connection, run: RunRow, wanted: Wanted, damaged: set[DamagedRow]) -> None:
    metric, latest, array = schema.metric, schema.metric_latest, schema.array
    copy_rows(there, here, schema.run, schema.run.c.id == run.id, damaged=damaged)
    last = select(latest.c.name).where(
        latest.c.run_id == run.id, latest.c.name == metric.c.name, latest.c.step == metric.c.step
    )
    kept = metric.c.name.in_(list(wanted.curves)) | last.exists()
    copy_rows(there, here, metric, metric.c.run_id == run.id, kept, damaged=damaged)
    copy_rows(there, here, latest, latest.c.run_id == run.id, damaged=damaged)
    for name, thin in wanted.arrays.get(run.id, {}).items():
        this = (array.c.run_id == run.id) & (array.c.name == name)
        copy_rows(there, here, array, this, damaged=damaged)
        if thin is not None:
            row = here.execute(select(array.c.dtype, array.c.shape, array.c.data).where(this)).one_or_none()
            if row is None:
                raise InputError(f"run {run.name} has no sound array {shown(name)}")
            here.execute(update(array).where(this).values(**arrays.encode(thin(arrays.decode(*row)))))


def _counts(there: Connection, here: Connection, runs: Sequence[RunRow]) -> dict[str, int]:
    def count(connection: Connection, table: Table) -> int:
        return queries.count_rows(connection, table, table.c.run_id.in_([run.id for run in runs]))

    metrics, kept = count(here, schema.metric), count(here, schema.array)
    return {
        "metrics": metrics,
        "arrays": kept,
        "left_out_metrics": count(there, schema.metric) - metrics,
        "left_out_arrays": count(there, schema.array) - kept,
        "left_out_artifacts": count(there, schema.artifact),
    }
