"""Checks of a database and its checkpoints. Every problem comes with a remedy; nothing is changed."""

import re
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from sqlalchemy import URL, Connection, select

from ssmail.config.spec import spec_hash
from ssmail.errors import InputError, command_line, shortened
from ssmail.store import queries, schema
from ssmail.store.artifact_storage import NOT_GIVEN, ArtifactStorage, place_of, recorded_fault, storage_of
from ssmail.store.checkpoint_files import STAGING, checkpoint_root
from ssmail.store.connection import DRIVER_ERRORS, explained, name_of, reading, revision_of
from ssmail.store.maintenance.whole_databases import existing, opened
from ssmail.store.queries import RunRow
from ssmail.store.schema import REVISIONS, RunState
from ssmail.store.validation import DamagedRow, raw

FINAL = "test"
"""Prefix of the names of final metrics."""
_NO_ID = "typeof(id) <> 'text' OR length(id) <> 32 OR id GLOB '*[^0-9a-f]*'"
_CHILDREN = {
    schema.metric: "metrics",
    schema.metric_latest: "latest metrics",
    schema.array: "arrays",
    schema.artifact: "checkpoints",
}
_MOST = 20  # problems reported by SQLite's integrity check


@dataclass(frozen=True)
class Problem:
    """A problem of the kind `check` with `subject` (a run id, a table or a folder), and two sentences for the user."""

    check: str
    subject: str
    problem: str
    remedy: str


def check(where: str | Path, artifacts: str | None = None) -> list[Problem]:
    """Return all problems of a database. Safe while runs are being computed.

    artifacts: where its checkpoints are, if not beside it (see `Store.open`). Raises InputError when the database is
    missing, is not one of ssmail's, or is from a newer ssmail.
    """
    url, storage = existing(where), storage_of(artifacts)
    folders = _checkpoint_folders(url)  # read before the runs, because a run has its row before its folder
    if url.get_backend_name() != "sqlite":
        with opened(url) as engine, reading(engine, patience=0) as connection:
            return list(_problems(url, connection, revision_of(connection, engine), folders, storage))
    path = Path(str(url.database))
    try:
        with opened(url) as engine, engine.connect() as connection:
            revision = revision_of(connection, engine)
            connection.exec_driver_sql("PRAGMA ignore_check_constraints = ON")  # an id that is none: a damaged row
            damage = connection.exec_driver_sql(f"PRAGMA integrity_check({_MOST})").scalars().all()
            if damage != ["ok"]:
                return [_damage(path, str(line)) for line in damage]
            orphans = list(_orphans(path, connection)) if revision == REVISIONS[-1] else []
            return [*orphans, *_problems(url, connection, revision, folders, storage)]
    except DRIVER_ERRORS as error:
        reason = str(getattr(error, "orig", error))
        if "not a database" in reason:
            raise InputError(f"{path} is not an SQLite database ({reason}); give another file") from error
        if any(words in reason for words in ("unable to open", "readonly", "locked")):
            raise explained(error, str(path)) from error
        return [_damage(path, reason)]


def _problems(
    url: URL,
    connection: Connection,
    revision: str | None,
    folders: Sequence[Path],
    storage: ArtifactStorage | None,
) -> Iterator[Problem]:
    """Find what any database may have; damaged pages, and rows without a run, are for SQLite files only."""
    place = name_of(url)
    if revision != REVISIONS[-1]:
        command = command_line("ssmail", "db", "upgrade", "--db", place)
        if revision is None:
            found = "it has no tables yet; the process that created it was stopped before it made them"
            remedy = f"use it as it is, for the next command that opens it makes them, such as `{command}`"
        else:
            found = f"its schema is {revision}, but {REVISIONS[-1]} is current"
            remedy = f"run `{command}`, then check again"
        yield Problem("schema", Path(str(url.database)).name, found, remedy)
        return
    damaged: set[DamagedRow] = set()
    runs = queries.runs(connection, damaged=damaged)
    yield from (damaged_run(url, row) for row in sorted(damaged, key=repr))
    for run in runs:
        yield from faults_of(connection, run)
    yield from _silent(connection)
    yield from _checkpoints(url, connection, runs, storage)
    yield from _stray_folders(url, folders, {run.id for run in runs} | {row.run_id for row in damaged})


def _damage(path: Path, reason: str) -> Problem:
    command = f"{command_line('sqlite3', path, '.recover')} | sqlite3 NEW.db"
    remedy = f"restore a backup, or save what can be read with `{command}`"
    return Problem("integrity", path.name, f"the file is damaged: {' '.join(reason.split())}", remedy)


def _orphans(path: Path, connection: Connection) -> Iterator[Problem]:
    """Find rows that belong to no run, counted by table."""
    rows = connection.exec_driver_sql("PRAGMA foreign_key_check").all()
    tables = [row[0] for row in rows]
    for name in sorted(set(tables)):
        count = tables.count(name)
        command = command_line("sqlite3", path, f"DELETE FROM {name} WHERE run_id NOT IN (SELECT id FROM run)")
        remedy = f"run `{command}`" if name in schema.metadata.tables else "give ssmail a database of its own"
        found = f"{count} row{'s belong' if count > 1 else ' belongs'} to no run"
        yield Problem("orphans", name, f"{found} in the table {name}", remedy)


def damaged_run(url: URL, row: DamagedRow) -> Problem:
    """Return the problem of a row of the table `run` that no command uses."""
    kind = "spec" if row.reason.startswith("its spec") else "rows"
    found = f"run {row.run} is damaged: {row.reason}"
    if schema.is_run_id(row.run_id):
        return Problem(kind, row.run_id, found, _again(row.run))
    statement = f"PRAGMA foreign_keys = ON; DELETE FROM run WHERE {_NO_ID}"
    remedy = f"run `{command_line('sqlite3', str(url.database), statement)}`, which deletes all such runs"
    return Problem(kind, row.run, found, remedy)


def faults_of(connection: Connection, run: RunRow) -> Iterator[Problem]:
    """Yield what is wrong with the rows of a run, files apart."""
    for examine in (_spec, damaged_rows, _final_metrics, _stale_latest):
        yield from examine(connection, run)


def _spec(_connection: Connection, run: RunRow) -> Iterator[Problem]:
    """Check that the stored hash is that of the spec."""
    if spec_hash(run.spec) != run.spec_hash:
        found = f"the spec of run {run.name} does not have the hash {shortened(run.spec_hash, 40)}"
        yield Problem("spec", run.id, found, _again(run.name))


def damaged_rows(connection: Connection, run: RunRow) -> Iterator[Problem]:
    """Find rows of the run that no command uses; the values of metrics are counted."""
    for table, kind in _CHILDREN.items():
        damaged: set[DamagedRow] = set()
        deque(queries.rows_of(connection, table, run.id, damaged), maxlen=0)
        rows = sorted(damaged, key=repr)
        if table is schema.array:
            texts = [f"the array {row.name} of run {run.name} cannot be read ({row.reason})" for row in rows]
        elif table is schema.artifact:
            texts = [f"the checkpoint {row.name} of run {run.name} is damaged ({row.reason})" for row in rows]
        else:
            count = f"{len(rows)} of the rows of run {run.name} in the table {table.name}"
            texts = [f"{count} cannot be read, such as {row.name} ({row.reason})" for row in rows[:1]]
        yield from (Problem(kind, run.id, text, _again(run.name)) for text in texts)


def _final_metrics(connection: Connection, run: RunRow) -> Iterator[Problem]:
    """Check that a finished run has final metrics."""
    latest = schema.metric_latest
    final = latest.c.name.startswith(FINAL)
    if run.state is RunState.FINISHED and not queries.count_rows(connection, latest, latest.c.run_id == run.id, final):
        yield Problem("final metrics", run.id, f"run {run.name} is finished without final metrics", _again(run.name))


def _stale_latest(connection: Connection, run: RunRow) -> Iterator[Problem]:
    """Check that metric_latest holds the last value of each metric."""
    metric = schema.metric
    query = select(*raw(metric)).where(metric.c.run_id == run.id).order_by(metric.c.step)
    last = {row["name"]: row for row in queries.sound_rows(connection, metric, query)}
    shown = {row["name"]: row for row in queries.rows_of(connection, schema.metric_latest, run.id)}
    wrong = sorted(name for name in last.keys() | shown.keys() if last.get(name) != shown.get(name))
    if wrong:
        found = f"the last value of {wrong[0]} of run {run.name} differs from the one in the table metric_latest"
        yield Problem("latest metrics", run.id, found, _again(run.name))


def _silent(connection: Connection) -> Iterator[Problem]:
    for run in queries.silent_runs(connection):
        found = f"run {run.name} is running, but its last heartbeat was at {run.heartbeat:%Y-%m-%d %H:%M:%S} UTC"
        remedy = "train it again to resume it, or run `ssmail runs list`, which marks it as interrupted"
        yield Problem("stale", run.id, found, remedy)


def _checkpoints(
    url: URL, connection: Connection, runs: Sequence[RunRow], storage: ArtifactStorage | None
) -> Iterator[Problem]:
    """Check that the recorded files and objects are as recorded; those of a run at work change meanwhile."""
    now = queries.clock(connection)
    for run in runs:
        if run.is_alive(now=now):
            continue
        for row in queries.artifacts(connection, run.id, checkpoint_root(url)):
            if wrong := recorded_fault(row, storage):
                again = _again(run.name)
                place = place_of(row, storage)
                remedy = f"copy it from a backup to {place}, or {again}" if place else again
                remedy = "give that place with --artifacts" if wrong is NOT_GIVEN else remedy
                yield Problem("checkpoints", run.id, f"the checkpoint {row.name} of run {run.name} is {wrong}", remedy)


def _stray_folders(url: URL, folders: Sequence[Path], here: set[str]) -> Iterator[Problem]:
    """Find checkpoint folders that belong to no run of this database or of files beside them.

    Those of databases on servers are not known here: the remedy says so.
    """
    strays = [folder for folder in folders if folder.name not in here]
    beside = checkpoint_root(url).parent
    own = url.database if url.get_backend_name() == "sqlite" else None
    neighbours = [file for file in beside.iterdir() if str(file) != own and file.is_file()] if strays else []
    known = set().union(*map(_run_ids, neighbours)) if strays else set()
    for folder in strays:
        if folder.name.startswith(STAGING):
            found, unless = f"{folder} belongs to a merge that is running or was killed", ""
        elif folder.name not in known:
            found = f"the checkpoints in {folder} belong to no run"
            unless = "unless a database on a server has this run, "
        else:
            continue
        yield Problem("folders", folder.name, found, f"{unless}delete the folder: `{command_line('rm', '-r', folder)}`")


def _checkpoint_folders(url: URL) -> list[Path]:
    """Return the folders named after a run id, and the staging folders of merges."""
    root = checkpoint_root(url)
    named = re.compile(rf"[0-9a-f]{{32}}|{re.escape(STAGING)}.*")
    return sorted(folder for folder in root.iterdir() if named.fullmatch(folder.name)) if root.is_dir() else []


def _run_ids(path: Path) -> set[str]:
    """Return the ids of the runs in the file; empty if it is not an ssmail database."""
    try:
        with opened(path) as engine, engine.connect() as connection:
            if revision_of(connection, engine) is None:
                return set()
            return set(connection.execute(select(schema.run.c.id)).scalars())
    except (*DRIVER_ERRORS, InputError):
        return set()


def _again(name: str) -> str:
    return f"delete the run (`{command_line('ssmail', 'runs', 'delete', name)}`) and train it again"
