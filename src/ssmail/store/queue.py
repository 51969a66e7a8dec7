"""Which process computes which cell: cells that wait, and claims, each decided in one write transaction.

A claim makes the newest run of a cell RUNNING, or inserts one, for a process that will begin it. A run that was taken
from the queue has an owner that begins with QUEUE; when its process stops or dies, it waits again, for anyone.
"""

import uuid
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from enum import StrEnum
from typing import Any, NamedTuple

from sqlalchemy import Connection, Engine, delete, insert, select, text, update

from ssmail.config.spec import RunSpec
from ssmail.store import queries, run_metadata, schema, server
from ssmail.store.connection import read, write
from ssmail.store.queries import RunRow
from ssmail.store.schema import RunState, require_fitting

QUEUE = "queue"
_NOBODY = QUEUE.ljust(32, "-")
_INDEXES = (
    "CREATE INDEX IF NOT EXISTS run_waiting ON run (state, started, id)",
    "CREATE INDEX IF NOT EXISTS run_waiting_of_spec ON run (state, spec_hash, started, id)",
)
"""Made with the first queue: a database of an earlier ssmail needs no upgrade, and an earlier ssmail still opens it."""


class Enqueued(StrEnum):
    """What became of a cell that was put into the queue."""

    QUEUED = "queued"
    WAITING = "waiting"  # it was in the queue already
    RUNNING = "running"  # a process is computing it
    STORED = "stored"  # it has finished or diverged


@dataclass(frozen=True)
class Claim:
    """A run that this process may begin, and its row from before the claim, which is None for a new one."""

    run_id: str
    owner: str
    previous: RunRow | None = None


class Queue:
    """The cells of a database as processes share them. Get it from `Store.queue`."""

    def __init__(self, engine: Engine, stale_seconds: float) -> None:
        self._engine, self._stale_seconds = engine, stale_seconds

    def add(self, cells: Sequence[tuple[RunSpec, int]]) -> list[Enqueued]:
        """Let the cells (spec and seed) wait, and return what became of each. An unfinished run waits to be resumed."""
        of_spec: dict[RunSpec, list[int]] = {}  # places among the cells
        for place, (spec, _) in enumerate(cells):
            of_spec.setdefault(spec, []).append(place)

        def add(connection: Connection, _again: bool) -> list[Enqueued]:
            server.lock_cells(connection)
            for index in _INDEXES:
                connection.execute(text(index))
            now, became = queries.clock(connection), [Enqueued.WAITING] * len(cells)
            for spec, places in of_spec.items():
                for first in range(0, len(places), queries.MOST_AT_ONCE):
                    part = places[first : first + queries.MOST_AT_ONCE]
                    seeds = {cells[place][1]: place for place in reversed(part)}  # the first place of each
                    for seed, what in self._add(connection, spec, seeds, now).items():
                        became[seeds[seed]] = what
            return became

        return write(self._engine, add)

    def _add(
        self, connection: Connection, spec: RunSpec, places: Mapping[int, int], now: datetime
    ) -> dict[int, Enqueued]:
        """Let seeds of a spec wait, by place, a microsecond apart so that they are taken in this order."""
        blank = new_row(spec, 0, RunState.QUEUED, _NOBODY)
        newest = queries.newest_of_cells(connection, blank["spec_hash"], list(places))
        new = []
        for seed, place in places.items():
            if seed not in newest:
                time = now + timedelta(microseconds=place)
                new.append({**blank, "id": uuid.uuid4().hex, "seed": seed, "started": time, "heartbeat": time})
        if new:
            connection.execute(insert(schema.run), new)
        known = {seed: self._add_again(connection, row, now) for seed, row in newest.items()}
        return dict.fromkeys(places, Enqueued.QUEUED) | known

    def _add_again(self, connection: Connection, newest: RunRow, now: datetime) -> Enqueued:
        """Let the newest run of a cell wait unless it is being computed or has ended."""
        if newest.state.settled:
            return Enqueued.STORED
        if newest.state is RunState.QUEUED:
            return Enqueued.WAITING
        if newest.is_alive(self._stale_seconds, now):
            return Enqueued.RUNNING
        changes = {"state": RunState.QUEUED, "owner": _NOBODY, "finished": None}
        connection.execute(update(schema.run).where(_unchanged(newest)).values(changes))
        return Enqueued.QUEUED

    def claim(
        self, cells: Sequence[tuple[RunSpec, int]], may_take: Callable[[RunRow], bool], *, repeat: bool = False
    ) -> list[Claim | RunRow]:
        """Claim those of the cells (spec and seed) that nobody computes and that have not ended.

        Returns a claim for each, or the newest run of a cell that was not claimed: it has ended, another process is
        computing it, or `may_take` is False for it. repeat: claim a new run beside one that has ended or stopped.
        """

        def claim(connection: Connection, _again: bool) -> list[Claim | RunRow]:
            server.lock_cells(connection)
            now = queries.clock(connection)
            return [self._claim(connection, spec, seed, now, may_take, repeat) for spec, seed in cells]

        return write(self._engine, claim)

    def _claim(
        self,
        connection: Connection,
        spec: RunSpec,
        seed: int,
        now: datetime,
        may_take: Callable[[RunRow], bool],
        repeat: bool,
    ) -> Claim | RunRow:
        newest = queries.newest_of_cell(connection, spec.hash(), seed)
        if newest is not None and newest.is_alive(self._stale_seconds, now):
            return newest
        if newest is not None and not repeat:
            if newest.state.settled:
                _forget_waiting(connection, newest)
                return newest
            return _take(connection, newest, now) if may_take(newest) else newest
        if newest is not None and newest.state is RunState.RUNNING:
            interrupt(connection, newest)
        row = new_row(spec, seed, RunState.RUNNING, uuid.uuid4().hex)
        insert_row(connection, row, now)
        return Claim(row["id"], row["owner"])

    def claim_waiting(self, most: Callable[[RunRow, int], int], without: set[str]) -> list[Claim]:
        """Claim the run that has waited longest, and others of its spec if `most` allows several; none if none waits.

        `most` says how many to claim of a spec, given its first run and how many of its runs wait (1000 stands for
        any more). The hashes of specs of which it says 0, and the ids of damaged runs, are added to `without`, whose
        runs are left alone. Runs that were taken from the queue by a process that has died wait again. The time that
        this takes does not depend on how many wait.
        """

        def claim(connection: Connection, _again: bool) -> list[Claim]:
            now = queries.clock(connection)
            for row in queries.silent_runs(connection, self._stale_seconds, skip_locked=True):
                if row.owner.startswith(QUEUE):
                    interrupt(connection, row)
            while (run_id := connection.execute(queries.longest_waiting(without)).scalar()) is not None:
                first = next(iter(queries.runs(connection, schema.run.c.id == run_id)), None)
                if first is None:  # damaged
                    without.add(run_id)
                    continue
                wanted = most(first, queries.count_waiting(connection, first.spec_hash))
                if wanted == 0:
                    without.add(first.spec_hash)
                    continue
                others = queries.others_waiting(connection, first, wanted - 1, without)
                if claims := _take_waiting(connection, [first, *others], now):
                    return claims
            return []

        return write(self._engine, claim)

    def heartbeat(self, claims: Sequence[Claim]) -> None:
        """Record that the process which made these claims is alive."""
        run = schema.run
        mine = run.c.id.in_([item.run_id for item in claims]) & run.c.owner.in_([item.owner for item in claims])
        alive = update(run).where(mine, run.c.state == RunState.RUNNING)

        def record(connection: Connection, _again: bool) -> None:
            connection.execute(alive.values(heartbeat=queries.clock(connection)))

        write(self._engine, record)

    def release(self, claim: Claim, error: str | None = None) -> bool:
        """Undo a claim unless its run was begun or is no longer ours; return whether it was undone.

        A run from the queue that could not begin has failed, by `error`.
        """
        run, before = schema.run, claim.previous
        mine = (run.c.id == claim.run_id) & (run.c.owner == claim.owner) & (run.c.state == RunState.RUNNING)
        mine &= (
            run.c.dataset_hash.is_(None) if before is None or not before.has_begun else run.c.resumes == before.resumes
        )

        def undo(connection: Connection, _again: bool) -> bool:
            if before is None:
                return connection.execute(delete(run).where(mine)).rowcount == 1
            names = ("state", "error", "finished", "started", "owner", "heartbeat")
            values = {name: getattr(before, name) for name in names}
            if error is not None and before.state is RunState.QUEUED:
                values |= {"state": RunState.FAILED, "error": error, "finished": queries.clock(connection)}
            return connection.execute(update(run).where(mine).values(values)).rowcount == 1

        return write(self._engine, undo)

    def contents(self, limit: int | None = None) -> "Contents":
        """Return how many runs wait or are running, and the first `limit` of them."""
        run = schema.run

        def look(connection: Connection) -> Contents:
            now = queries.clock(connection)
            running, waiting = run.c.state == RunState.RUNNING, run.c.state == RunState.QUEUED
            dead = queries.count_rows(connection, run, running, queries.is_silent(now, self._stale_seconds))
            alive = queries.count_rows(connection, run, running) - dead
            rows = queries.runs(connection, running, limit=limit)
            rows += queries.runs(connection, waiting, limit=None if limit is None else limit - len(rows))
            return Contents(rows, queries.count_rows(connection, run, waiting), alive, dead, now)

        return read(self._engine, look)


class Contents(NamedTuple):
    """How many runs of a database wait, are running or have a process that died; and the first of them.

    rows: those that are running or dead, then those that wait, in the order in which they are taken. now: the time of
    the database's clock.
    """

    rows: list[RunRow]
    waiting: int
    running: int
    dead: int
    now: datetime


def _take_waiting(connection: Connection, rows: Sequence[RunRow], now: datetime) -> list[Claim]:
    """Claim those of the waiting runs of a spec whose cells have no newer run, after a merge or --resume never."""
    claims = []
    for row in rows:
        newest = queries.newest_of_cell(connection, row.spec_hash, row.seed)
        if newest is not None and newest.id != row.id:
            _leave_to(connection, row, newest)
        elif isinstance(taken := _take(connection, row, now), Claim):
            claims.append(taken)
    return claims


def new_row(spec: RunSpec, seed: int, state: RunState, owner: str) -> dict[str, Any]:
    """Return the columns, without times, of a new run of the cell, which has not read its data yet.

    Raises InputError if one is too long for its column.
    """
    row = {
        "id": uuid.uuid4().hex,
        "method": spec.method,
        "environment": spec.environment,
        "profile": spec.profile,
        "seed": seed,
        "spec_json": spec.as_json(),
        "spec_hash": spec.hash(),
        "dataset_hash": None,
        "state": state,
        "owner": owner,
        "resumes": 0,
        "device": "cpu",
        "wall_seconds": 0.0,
        "cpu_seconds": 0.0,
        **run_metadata.columns(),
    }
    require_fitting(schema.run, [row])
    return row


def insert_row(connection: Connection, row: dict[str, Any], now: datetime) -> None:
    """Insert a new run that begins, or begins to wait, at `now`."""
    connection.execute(insert(schema.run), {**row, "started": now, "heartbeat": now})


def interrupt(connection: Connection, row: RunRow) -> None:
    """Mark a run whose process is silent as INTERRUPTED; one from the queue waits again."""
    last = f"{row.heartbeat:%Y-%m-%d %H:%M:%S} UTC"
    ahead = row.silent_seconds(queries.clock(connection)) < 0
    error = (
        f"its last heartbeat, of {last}, was ahead of the clock" if ahead else f"its process fell silent after {last}"
    )
    end(connection, row.id, RunState.INTERRUPTED, error, row.owner)  # unless another process took it meanwhile


def end(connection: Connection, run_id: str, state: RunState, error: str, owner: str | None = None) -> None:
    """End a RUNNING run, of that owner if one is given; one from the queue that is INTERRUPTED waits again."""
    run = schema.run
    running = (run.c.id == run_id) & (run.c.state == RunState.RUNNING)
    if owner is not None:
        running &= run.c.owner == owner
    if state is RunState.INTERRUPTED:
        state = left_state(str(connection.execute(select(run.c.owner).where(running)).scalar()))
    values = {"state": state, "error": error, "finished": queries.clock(connection)}
    connection.execute(update(run).where(running).values(values))


def left_state(owner: str) -> RunState:
    """Return the state of a run that its owner leaves before its end."""
    return RunState.QUEUED if owner.startswith(QUEUE) else RunState.INTERRUPTED


def _take(connection: Connection, row: RunRow, now: datetime) -> Claim | RunRow:
    """Claim an existing run; return its row if another process was faster, which only a server allows."""
    token = uuid.uuid4().hex
    from_queue = row.state is RunState.QUEUED or row.owner.startswith(QUEUE)
    owner = QUEUE + token[len(QUEUE) :] if from_queue else token
    changes = {"state": RunState.RUNNING, "owner": owner, "heartbeat": now, "finished": None}
    if not row.has_begun:
        changes["started"] = now
    taken = connection.execute(update(schema.run).where(_unchanged(row)).values(changes)).rowcount == 1
    return Claim(row.id, owner, row) if taken else row


def _unchanged(row: RunRow) -> Any:
    run = schema.run
    return (run.c.id == row.id) & (run.c.owner == row.owner) & (run.c.state == row.state)


def _forget_waiting(connection: Connection, newest: RunRow) -> None:
    """Delete the runs of a settled cell that only wait, and hold nothing."""
    run = schema.run
    same = (run.c.spec_hash == newest.spec_hash) & (run.c.seed == newest.seed)
    connection.execute(delete(run).where(same, run.c.state == RunState.QUEUED, run.c.dataset_hash.is_(None)))


def _leave_to(connection: Connection, row: RunRow, newest: RunRow) -> None:
    """Take a run out of the queue whose cell has a newer one; it is deleted only if it never began."""
    if row.has_begun:
        left = {"state": RunState.INTERRUPTED, "error": f"its cell has a newer run, {newest.name}"}
        connection.execute(update(schema.run).where(_unchanged(row)).values(left))
    else:
        connection.execute(delete(schema.run).where(_unchanged(row)))
