"""What is wrong with a database and the checkpoints beside it, each problem with its remedy. Nothing is changed."""

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from sqlalchemy import Connection, func, select
from sqlalchemy.exc import DBAPIError

from ssmail.config.spec import spec_hash
from ssmail.errors import InputError
from ssmail.store import arrays, lifecycle, queries, schema
from ssmail.store.checkpoint_files import STAGING, fault, root_of
from ssmail.store.connection import revision_of
from ssmail.store.lifecycle import STALE_SECONDS
from ssmail.store.maintenance.sqlite_file import existing, opened
from ssmail.store.queries import RunRow
from ssmail.store.schema import REVISIONS, RunState

FINAL = "test"
"""How the names of final metrics begin."""
_MOST = 20  # problems of one kind that SQLite itself is asked for
_DATABASE = b"SQLite format 3\x00"


@dataclass(frozen=True)
class Problem:
    """`check` names the kind, `subject` what it is about (a run's id, a table, a folder); the others are for people."""

    check: str
    subject: str
    problem: str
    remedy: str


def check(where: str | Path, *, stale_seconds: float = STALE_SECONDS) -> list[Problem]:
    """Every problem of an SQLite database, none when it is sound; safe while runs are being computed.

    Raises InputError for a file that is missing, no SQLite database, another program's or of a newer ssmail.
    """
    path = existing(where)
    folders = _checkpoint_folders(path)  # before the runs are read: a run has its row before its folder
    try:
        with opened(path) as engine, engine.connect() as connection:
            return list(_problems(path, connection, revision_of(connection, engine), folders, stale_seconds))
    except DBAPIError as error:
        if "not a database" in str(error.orig):
            raise InputError(f"{path} is not an SQLite database ({error.orig}); give another file") from error
        return [_damage(path, str(error.orig))]


def _problems(
    path: Path, connection: Connection, revision: str | None, folders: Sequence[Path], stale_seconds: float
) -> Iterator[Problem]:
    damage = connection.exec_driver_sql(f"PRAGMA integrity_check({_MOST})").scalars().all()
    if damage != ["ok"]:
        yield from (_damage(path, str(line)) for line in damage)
        return
    if revision != REVISIONS[-1]:
        found = (
            "it has no tables yet" if revision is None else f"its schema is {revision}, and {REVISIONS[-1]} is current"
        )
        yield Problem("schema", path.name, found, f"run `ssmail db upgrade --db {path}`, then check again")
        return
    yield from _orphans(path, connection)
    runs = queries.runs(connection)
    for examine in (_spec, _final_metrics, _unreadable_arrays, _stale_latest):
        yield from (problem for run in runs for problem in examine(connection, run))
    yield from _silent(connection, stale_seconds)
    yield from _checkpoints(path, connection, runs)
    yield from _stray_folders(path, folders, {run.id for run in runs})


def _damage(path: Path, reason: str) -> Problem:
    remedy = f"restore a backup, or save what can be read with `sqlite3 {path} .recover | sqlite3 NEW.db`"
    return Problem("integrity", path.name, f"the file is damaged: {' '.join(reason.split())}", remedy)


def _orphans(path: Path, connection: Connection) -> Iterator[Problem]:
    """Rows that belong to no run, counted by table."""
    rows = connection.exec_driver_sql("PRAGMA foreign_key_check").all()
    tables = [row[0] for row in rows]
    for name in sorted(set(tables)):
        count = tables.count(name)
        delete = f"DELETE FROM {name} WHERE run_id NOT IN (SELECT id FROM run)"
        found = f"{count} row{'s belong' if count > 1 else ' belongs'} to no run"
        yield Problem("orphans", name, f"{found} in the table {name}", f'run `sqlite3 {path} "{delete}"`')


def _spec(_connection: Connection, run: RunRow) -> Iterator[Problem]:
    """The hash must be that of the spec."""
    try:
        found = spec_hash(run.spec)
    except (ValueError, TypeError, AttributeError):  # no JSON, or not that of a spec
        found = None
    if found != run.spec_hash:
        yield Problem("spec", run.id, f"the spec of run {run.name} does not have the hash {run.spec_hash}", _again(run))


def _final_metrics(connection: Connection, run: RunRow) -> Iterator[Problem]:
    """A finished run has been evaluated."""
    latest = schema.metric_latest
    query = select(func.count()).where(latest.c.run_id == run.id, latest.c.name.startswith(FINAL))
    if run.state is RunState.FINISHED and connection.execute(query).scalar_one() == 0:
        yield Problem("final metrics", run.id, f"run {run.name} is finished without final metrics", _again(run))


def _unreadable_arrays(connection: Connection, run: RunRow) -> Iterator[Problem]:
    table = schema.array
    query = select(table.c.name, table.c.dtype, table.c.shape, table.c.data).where(table.c.run_id == run.id)
    for name, *columns in connection.execute(query):
        try:
            arrays.decode(*columns)
        except Exception as error:  # of zlib, JSON or NumPy
            found = f"the array {name} of run {run.name} cannot be read ({error})"
            yield Problem("arrays", run.id, found, _again(run))


def _stale_latest(connection: Connection, run: RunRow) -> Iterator[Problem]:
    """metric_latest must repeat the last row of each metric."""
    columns = ("name", "step", "value", "kind")
    metric, latest = schema.metric, schema.metric_latest
    query = select(*(metric.c[key] for key in columns)).where(metric.c.run_id == run.id).order_by(metric.c.step)
    last = {row.name: tuple(row) for row in connection.execute(query)}
    query = select(*(latest.c[key] for key in columns)).where(latest.c.run_id == run.id)
    shown = {row.name: tuple(row) for row in connection.execute(query)}
    wrong = sorted(name for name in last.keys() | shown.keys() if last.get(name) != shown.get(name))
    if wrong:
        found = f"the last value of {wrong[0]} of run {run.name} is not what the table metric_latest says"
        yield Problem("latest metrics", run.id, found, _again(run))


def _silent(connection: Connection, stale_seconds: float) -> Iterator[Problem]:
    for run in lifecycle.stale(connection, stale_seconds):
        found = f"run {run.name} is running but gave its last sign of life at {run.heartbeat:%Y-%m-%d %H:%M:%S} UTC"
        remedy = "train it again to continue it, or list the runs (`ssmail runs list`) to mark it interrupted"
        yield Problem("stale", run.id, found, remedy)


def _checkpoints(path: Path, connection: Connection, runs: Sequence[RunRow]) -> Iterator[Problem]:
    """The recorded files must be there, with the recorded content."""
    for run in runs:
        for row in queries.artifacts(connection, run.id, root_of(path)):
            if wrong := fault(row):
                remedy = f"copy it from a backup to {row.path}, or {_again(run)}"
                yield Problem("checkpoints", run.id, f"the checkpoint {row.name} of run {run.name} is {wrong}", remedy)


def _stray_folders(path: Path, folders: Sequence[Path], here: set[str]) -> Iterator[Problem]:
    """Folders of checkpoints that belong to no run, of this database or another one in the same folder."""
    strays = [folder for folder in folders if folder.name not in here]
    known = set().union(*map(_run_ids, _neighbours(path))) if strays else set()
    for folder in strays:
        if folder.name.startswith(STAGING):
            found = f"{folder} is left over from a merge that was killed, or of one at work"
        elif folder.name not in known:
            found = f"the checkpoints in {folder} belong to no run"
        else:
            continue
        yield Problem("folders", folder.name, found, f"delete the folder: `rm -r {folder}`")


def _checkpoint_folders(path: Path) -> list[Path]:
    """Those named after a run, and those that a merge works in."""
    root = root_of(path)
    named = re.compile(rf"[0-9a-f]{{32}}|{re.escape(STAGING)}.*")
    return sorted(folder for folder in root.iterdir() if named.fullmatch(folder.name)) if root.is_dir() else []


def _neighbours(path: Path) -> list[Path]:
    """The other SQLite files in the folder: they have the same folder of checkpoints."""

    def begins_as_one(file: Path) -> bool:
        try:
            with file.open("rb") as content:
                return content.read(len(_DATABASE)) == _DATABASE
        except OSError:
            return False

    return [file for file in path.parent.iterdir() if file != path and file.is_file() and begins_as_one(file)]


def _run_ids(path: Path) -> set[str]:
    """The ids of its runs; none when it is no database of ssmail's."""
    try:
        with opened(path) as engine, engine.connect() as connection:
            return set(connection.execute(select(schema.run.c.id)).scalars())
    except DBAPIError:
        return set()


def _again(run: RunRow) -> str:
    return f"delete the run (`ssmail runs delete {run.name}`) and train it again"
