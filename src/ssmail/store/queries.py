"""Rows of runs and artifacts, and the queries on an open connection that the Store shares with maintenance."""

import json
import os
import re
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from functools import cached_property
from pathlib import Path
from typing import Any

from sqlalchemy import BigInteger, ColumnElement, Connection, Select, Table, cast, func, literal_column, select

from ssmail.config.changes import changes, with_changes
from ssmail.config.spec import with_added_keys
from ssmail.errors import InputError, shortened
from ssmail.store import schema
from ssmail.store.schema import RunState, in_byte_order
from ssmail.store.validation import DamagedRow, UnsoundError, raw, sound

HEARTBEAT_SECONDS = 5.0
"""Interval at which a running run records a heartbeat."""
STALE_SECONDS = 30.0
"""A running run without a heartbeat for this long counts as dead."""
MOST_AT_ONCE = 500
"""Rows that a statement names or inserts."""
MOST_COUNTED = 1000
"""Waiting runs of a spec: more make no difference to how many of them a process takes."""


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
    def cell(self) -> tuple[str, int, str | None]:
        """What the run computes: the hash of its spec, its seed and the hash of its data."""
        return self.spec_hash, self.seed, self.dataset_hash

    @property
    def deterministic(self) -> bool:
        """Whether the same code on the same machine computes the same numbers: on a CPU alone, not on a GPU."""
        return self.device == "cpu"

    @property
    def code(self) -> str:
        """The code that computed the run: "0.1.0+COMMIT", with "-dirty" where the tree was changed."""
        commit = f"+{self.git_commit}" if self.git_commit else ""
        return f"{self.package_version}{commit}{'-dirty' if self.git_dirty else ''}"

    @cached_property
    def spec(self) -> dict[str, Any]:
        """The spec as nested plain values, completed with the keys that were added after the run was stored."""
        return with_added_keys(json.loads(self.spec_json))

    @cached_property
    def changes(self) -> dict[str, Any]:
        """The dotted keys in which the spec differs from its profile, with its values (see `ssmail.config.changes`)."""
        return changes(self.spec)

    @property
    def settings(self) -> str:
        """The profile, with the changes to it: "quick + training.epochs=12"."""
        return with_changes(self.profile, self.changes)

    @property
    def has_begun(self) -> bool:
        """Whether the run has read its data; until then, it holds nothing."""
        return self.dataset_hash is not None

    def silent_seconds(self, now: datetime | None = None) -> float:
        """Return the seconds from the last heartbeat to `now`; negative if the clock was set back since.

        `now` is the time of the database's clock (`clock`), by default that of this machine.
        """
        return ((now or datetime.now(UTC)) - self.heartbeat).total_seconds()

    def is_alive(self, stale_seconds: float = STALE_SECONDS, now: datetime | None = None) -> bool:
        """Return whether the run is RUNNING and its last heartbeat is less than `stale_seconds` away from now.

        One further in the future was sent before the clock was set back: a process at work would have sent others.
        """
        return self.state is RunState.RUNNING and abs(self.silent_seconds(now)) < stale_seconds


@dataclass(frozen=True)
class ArtifactRow:
    """A file that a run recorded. `path` is absolute; the file may have been deleted since.

    It is None if what is stored is not the path of a file in the run's own folder: no other file is ever touched. With
    --artifacts, runs record objects instead: those have their SHA-256 as the name of the file (`by_content`).
    """

    run_id: str
    name: str
    path: Path | None
    sha256: str
    size_bytes: int

    @property
    def by_content(self) -> bool:
        """Whether it was stored as an object, in a place that the user names (see `artifact_storage`)."""
        return self.path is not None and self.path.name == self.sha256


def runs(
    connection: Connection,
    *conditions: Any,
    damaged: set[DamagedRow] | None = None,
    for_update: bool = False,
    skip_locked: bool = False,
    limit: int | None = None,
) -> list[RunRow]:
    """Return the runs that meet all conditions, newest last, without damaged rows, which are added to `damaged`.

    for_update: on a server, nobody else changes the rows until the transaction ends; in SQLite it is so anyway.
    skip_locked: the same, without rows that somebody else is about to change. limit: read so many rows, the oldest.
    """
    query = select(*raw(schema.run)).where(*conditions).order_by(schema.run.c.started, schema.run.c.id)
    if limit is not None:
        query = query.limit(_number(limit))
    if for_update or skip_locked:
        query = query.with_for_update(skip_locked=skip_locked)
    return [RunRow(**values) for values in sound_rows(connection, schema.run, query, damaged)]


def sound_rows(
    connection: Connection, table: Table, query: Select[Any], damaged: set[DamagedRow] | None = None
) -> Iterator[dict[str, Any]]:
    """Yield the rows of a query for the raw columns of `table`; add those that are damaged to `damaged` instead."""
    for row in connection.execute(query).mappings():
        try:
            yield sound(table, row)
        except UnsoundError as error:
            if damaged is not None:
                named = "id" if table is schema.run else "run_id"
                damaged.add(DamagedRow(table.name, row[named], str(error), row.get("name")))


def rows_of(
    connection: Connection, table: Table, run_id: str, damaged: set[DamagedRow] | None = None
) -> Iterator[dict[str, Any]]:
    """Yield what the run recorded in a table, by name; add damaged rows to `damaged` instead."""
    query = select(*raw(table)).where(table.c.run_id == run_id).order_by(in_byte_order(table.c.name))
    yield from sound_rows(connection, table, query, damaged)


def one_run(connection: Connection, run_id: str, *, for_update: bool = False) -> RunRow:
    """Return the run with that full id. Raises InputError when there is none."""
    damaged: set[DamagedRow] = set()
    found = runs(connection, schema.run.c.id == run_id, damaged=damaged, for_update=for_update)
    refuse(damaged)
    if not found:
        raise InputError(f"there is no run {run_id[:8]} in the database; `ssmail runs list` shows the stored runs")
    return found[0]


def refuse(damaged: Iterable[DamagedRow]) -> None:
    """Raise InputError if there is a damaged row."""
    for row in damaged:
        raise InputError(f"run {row.run} is damaged ({row.place}{row.reason}); `ssmail db check` shows what to do")


def clock(connection: Connection) -> datetime:
    """Return the time of the database's clock, by which heartbeats are written and judged.

    SQLite is used by the processes of one machine; those of several machines, whose clocks differ, ask the server.
    """
    if connection.dialect.name == "sqlite":
        return datetime.now(UTC)
    now: datetime = connection.execute(select(func.clock_timestamp())).scalar_one()
    return now.astimezone(UTC)


def runs_of(connection: Connection, run_ids: Iterable[str]) -> list[RunRow]:
    """Return the runs with these full ids, newest last."""
    wanted = list(dict.fromkeys(run_ids))
    parts = (wanted[first : first + MOST_AT_ONCE] for first in range(0, len(wanted), MOST_AT_ONCE))
    found = [row for part in parts for row in runs(connection, schema.run.c.id.in_(part))]
    return sorted(found, key=lambda row: (row.started, row.id))


def silent_runs(
    connection: Connection,
    stale_seconds: float = STALE_SECONDS,
    *,
    for_update: bool = False,
    skip_locked: bool = False,
) -> list[RunRow]:
    """Return the RUNNING runs that are not alive (see RunRow.is_alive)."""
    silent = is_silent(clock(connection), stale_seconds)
    running = schema.run.c.state == RunState.RUNNING
    return runs(connection, running, silent, for_update=for_update, skip_locked=skip_locked)


def is_silent(now: datetime, stale_seconds: float) -> ColumnElement[bool]:
    """Return the condition that a RUNNING run is not alive."""
    heartbeat, stale = schema.run.c.heartbeat, timedelta(seconds=stale_seconds)
    return (heartbeat < now - stale) | (heartbeat > now + stale)


def newest_of_cell(connection: Connection, spec_hash: str, seed: int, *, for_update: bool = False) -> RunRow | None:
    """Return the newest run of the cell, or None. One that waits or stopped before it began counts as the oldest."""
    return newest_of_cells(connection, spec_hash, [seed], for_update=for_update).get(seed)


def newest_of_cells(
    connection: Connection, spec_hash: str, seeds: Sequence[int], *, for_update: bool = False
) -> dict[int, RunRow]:
    """Return the newest run (see newest_of_cell) of those of the seeds that have one; MOST_AT_ONCE seeds at most."""
    seed = schema.run.c.seed
    # With the bounds, a server that expects few runs of the spec does not read all of them instead.
    cells = (schema.run.c.spec_hash == spec_hash, seed.in_(seeds), seed >= min(seeds), seed <= max(seeds))
    newest: dict[int, RunRow] = {}
    for row in runs(connection, *cells, for_update=for_update):
        if _counts(row) or row.seed not in newest or not _counts(newest[row.seed]):
            newest[row.seed] = row
    return newest


def _counts(row: RunRow) -> bool:
    """Whether a run has begun, is about to, or has ended."""
    return row.has_begun or row.state.settled or row.state is RunState.RUNNING


def longest_waiting(without: set[str]) -> Select[Any]:
    """Return the query for the id of the run that has waited longest, but those; it reads one entry of the index."""
    query = select(schema.run.c.id).where(schema.run.c.state == RunState.QUEUED, *_not_among(without))
    return query.order_by(schema.run.c.started, schema.run.c.id).limit(_number(1)).with_for_update(skip_locked=True)


def _not_among(without: set[str]) -> list[ColumnElement[bool]]:
    """Return the conditions that leave out ids of runs, and hashes of specs, which are shorter."""
    return [schema.run.c.id.not_in(without), schema.run.c.spec_hash.not_in(without)] if without else []


def count_waiting(connection: Connection, spec_hash: str) -> int:
    """Return how many runs of a spec wait; MOST_COUNTED if there are more."""
    waiting = (
        select(schema.run.c.id)
        .where(schema.run.c.spec_hash == spec_hash, schema.run.c.state == RunState.QUEUED)
        .limit(_number(MOST_COUNTED))
    )
    return int(connection.execute(select(func.count()).select_from(waiting.subquery())).scalar_one())


def others_waiting(connection: Connection, first: RunRow, count: int, without: set[str]) -> list[RunRow]:
    """Return up to `count` other waiting runs of the spec, without those that another process is about to take."""
    if count == 0:
        return []
    same = (
        schema.run.c.spec_hash == first.spec_hash,
        schema.run.c.state == RunState.QUEUED,
        schema.run.c.id != first.id,
    )
    return runs(connection, *same, *_not_among(without), limit=count, skip_locked=True)


def _number(value: int) -> ColumnElement[int]:
    """Return a number that is part of the statement: a server that plans for any limit would sort all that waits."""
    return literal_column(str(int(value)))


def resolve(connection: Connection, prefixes: Sequence[str]) -> list[str]:
    """Return the full id for each id or prefix of one. Raises InputError for an unknown or ambiguous prefix."""
    ids = schema.run.c.id
    full = []
    for prefix in (prefix.strip().lower() for prefix in prefixes):
        query = select(ids).where(ids.startswith(prefix, autoescape=True))
        plain = re.fullmatch(r"[0-9a-f]{1,32}", prefix)
        found = list(filter(schema.is_run_id, connection.execute(query).scalars())) if plain else []
        if not found:
            raise InputError(f"no run id starts with {prefix!r}; `ssmail runs list` shows the stored runs")
        if len(found) > 1:
            raise InputError(f"several run ids start with {prefix!r}; give more digits")
        full += found
    return full


def last_step(connection: Connection, run_id: str) -> int:
    """Return the last step of which the run has a metric; 0 if there is none."""
    step = func.coalesce(func.max(cast(schema.metric.c.step, BigInteger)), 0)  # a step may be of any type in SQLite
    return int(connection.execute(select(step).where(schema.metric.c.run_id == run_id)).scalar_one())


def count_rows(connection: Connection, table: Table, *conditions: ColumnElement[bool]) -> int:
    """Return the number of rows of the table that meet the conditions."""
    return int(connection.execute(select(func.count()).select_from(table).where(*conditions)).scalar_one())


def artifacts(
    connection: Connection, run_id: str, root: Path, damaged: set[DamagedRow] | None = None
) -> list[ArtifactRow]:
    """Return the run's files, by name; `root` is the checkpoint root."""
    rows = rows_of(connection, schema.artifact, run_id, damaged)
    return [ArtifactRow(**{**row, "path": _file_of_run(root, run_id, row["path"])}) for row in rows]


def _file_of_run(root: Path, run_id: str, stored: object) -> Path | None:
    """Return the path of a recorded file, "RUN_ID/NAME" below the checkpoint root; None for anything else."""
    folder, _, name = str(stored).partition("/")
    plain = schema.is_run_id(run_id) and folder == run_id and re.fullmatch(r"[A-Za-z0-9_][A-Za-z0-9_.-]{0,99}", name)
    return root / run_id / name if plain else None


def chosen_stale_seconds() -> float:
    """Return the value of SSMAIL_STALE_SECONDS, by default STALE_SECONDS. Raises InputError if it is no such number."""
    text = os.environ.get("SSMAIL_STALE_SECONDS")
    with suppress(ValueError):
        if text is None or 0 < float(text) < 1e6:
            return STALE_SECONDS if text is None else float(text)
    raise InputError(f"SSMAIL_STALE_SECONDS is {shortened(str(text), 40)!r}; give a number of seconds above 0")
