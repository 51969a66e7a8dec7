"""Where a pool of processes takes its cells from: the cells of a sweep, or those that wait in the database.

Both are shared with any number of other processes. A cell is claimed in the database when a process is free for it.
"""

import logging
import math
import os
import time
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from pathlib import Path
from typing import Protocol

from pydantic import ValidationError

from ssmail.config.experiments_file import ENVIRONMENT_VARIABLE
from ssmail.config.names import FUNCTION, flatten
from ssmail.config.spec import RunSpec
from ssmail.execution import Resume
from ssmail.execution.cells import Cell, Event
from ssmail.execution.planning import Plan, shares, trains_together
from ssmail.store import RunRow, RunState, Store
from ssmail.store.queue import Claim

LOOK_SECONDS = 1.0
"""Seconds between two looks at the runs of other processes, or at the queue."""
_MOST_TOGETHER = 8  # seeds that a worker takes at once, so that something is left for others
_LOG = logging.getLogger(__name__)
Claims = dict[Cell, Claim]


class Source(Protocol):
    """What a pool asks for work."""

    @property
    def ended(self) -> bool:
        """Whether nothing is left to take."""

    @property
    def out_of_time(self) -> bool:
        """Whether what is being computed has to stop, too."""

    def take(self, free: int) -> tuple[Claims, list[Event]]:
        """Claim what one of `free` processes computes, cells of one spec; and say what is new of other cells.

        The claims are empty if there is nothing to compute now.
        """

    def lost(self, cell: Cell, row: RunRow) -> Event:
        """Return the event of a cell that another process has taken over, because this one was silent."""

    def stop(self) -> list[Event]:
        """Return the final events of the cells that have not been taken, which are not going to be."""


class SweepSource:
    """Given cells. Those that another process computes are watched until they end, or can be claimed after all."""

    def __init__(self, store: Store, plans: dict[Cell, Plan], jobs: int, resume: Resume) -> None:
        self._store, self._jobs, self._repeat = store, jobs, resume is Resume.NEVER
        self._groups = shares([cell for cell, plan in plans.items() if not plan.elsewhere], jobs)
        self._elsewhere: dict[Cell, RunRow] = {}
        self._news: list[Event] = []
        self._failed = {cell: attempt(plan.row) for cell, plan in plans.items() if plan.row is not None}
        self._next_look = time.monotonic() + LOOK_SECONDS
        for cell, plan in plans.items():
            if plan.elsewhere and plan.row is not None:
                self._news.append(self.lost(cell, plan.row))

    @property
    def out_of_time(self) -> bool:
        """A sweep may take any time."""
        return False

    @property
    def ended(self) -> bool:
        """Whether no cell is left."""
        return not self._groups and not self._elsewhere and not self._news

    def take(self, free: int) -> tuple[Claims, list[Event]]:
        """Claim the next cells, and check at intervals whether the runs of other processes have ended."""
        news, self._news = self._news, []
        if time.monotonic() >= self._next_look:
            news += self._look()
        claims: Claims = {}
        while self._groups and free and not claims:
            group = self._groups.pop(0)
            wanted = [(cell.spec, cell.seed) for cell in group]
            taken = self._claim(wanted, partial(self._may_take, group[0].spec))
            for cell, found in zip(group, taken, strict=True):
                if isinstance(found, Claim):
                    claims[cell] = found
                else:
                    news.append(self._result(cell, found) or self.lost(cell, found))
        return claims, news

    def lost(self, cell: Cell, row: RunRow) -> Event:
        """Watch a cell that another process computes from now on."""
        self._elsewhere[cell] = row
        return elsewhere(cell, row)

    def stop(self) -> list[Event]:
        """Leave all cells that have not been taken to others."""
        waiting = [cell for group in self._groups for cell in group]
        events = [stopped(cell) for cell in waiting]
        events += [stopped(cell, row) for cell, row in self._elsewhere.items()]
        self._groups, self._elsewhere, self._news = [], {}, []
        return events

    def _claim(self, wanted: Sequence[tuple[RunSpec, int]], may_take: Callable[[RunRow], bool]) -> list[Claim | RunRow]:
        """Claim cells in the database of this name, which is made anew if it has been removed meanwhile."""
        store = Store.open(self._store.url, stale_seconds=self._store.stale_seconds)
        try:
            return store.queue.claim(wanted, may_take, repeat=self._repeat)
        finally:
            store.close()

    def _may_take(self, spec: RunSpec, row: RunRow) -> bool:
        """Whether to compute an unfinished run: not if it failed in another process since this one began."""
        return row.state is not RunState.FAILED or attempt(row) == self._failed.get(Cell(spec, row.seed))

    def _look(self) -> list[Event]:
        """Return the final events of cells that others have ended; what others have given up waits here again."""
        began = time.monotonic()
        events, given_up = [], []
        for cell in list(self._elsewhere):
            row = self._store.find_cell(cell.spec.hash(), cell.seed)
            if row is not None and self._store.is_alive(row):
                continue
            del self._elsewhere[cell]
            if row is not None and (event := self._result(cell, row)):
                events.append(event)
            else:
                given_up.append(cell)
        self._groups += shares(given_up, self._jobs)
        now = time.monotonic()
        self._next_look = now + max(LOOK_SECONDS, 10 * (now - began))
        return events

    def _result(self, cell: Cell, row: RunRow) -> Event | None:
        return ended_elsewhere(cell, row, self._failed.get(cell))


class QueueSource:
    """The cells that wait in the database, whoever put them there.

    max_cells: take so many at most. max_hours: then stop, as after Ctrl-C. idle_exit: end when nothing has waited for
    so many seconds; None: go on looking. own_files: data files that specs in the database may name, beside those in
    the current folder.
    """

    def __init__(
        self,
        store: Store,
        max_cells: int | None = None,
        max_hours: float | None = None,
        idle_exit: float | None = None,
        own_files: Iterable[Path] = (),
    ) -> None:
        self._store, self._left, self._idle_exit = store, max_cells, idle_exit
        self._own_files = [path.resolve() for path in own_files]
        now = time.monotonic()
        self._deadline = None if max_hours is None else now + 3600 * max_hours
        self._busy, self._next_look = now, now
        self._without: set[str] = set()
        self._specs: dict[tuple[str, str], RunSpec | None] = {}  # by their JSON and hash
        self._free = 1

    @property
    def out_of_time(self) -> bool:
        """Whether max_hours are over."""
        return self._deadline is not None and time.monotonic() >= self._deadline

    @property
    def ended(self) -> bool:
        """Whether as many cells were taken as wanted, or nothing has waited for long enough."""
        is_idle = self._idle_exit is not None and self._next_look - self._busy > self._idle_exit
        return self.out_of_time or self._left == 0 or is_idle

    def take(self, free: int) -> tuple[Claims, list[Event]]:
        """Claim what has waited longest: a cell, or several seeds of a spec that can be trained together."""
        now = time.monotonic()
        if not free or now < self._next_look or self.ended:
            return {}, []
        self._free = free
        claims = self._store.queue.claim_waiting(self._most, self._without)
        if not claims:
            self._next_look = now + LOOK_SECONDS
            if self._idle_exit is not None:
                self._next_look = min(self._next_look, max(now, self._busy + self._idle_exit) + 0.001)
            return {}, []
        self._busy = self._next_look = time.monotonic()
        if self._left is not None:
            self._left -= len(claims)
        found: Claims = {}
        for claim in claims:
            assert claim.previous is not None
            spec = self._specs[_key(claim.previous)]
            assert spec is not None
            found[Cell(spec, claim.previous.seed)] = claim
        return found, []

    def lost(self, cell: Cell, row: RunRow) -> Event:
        """Leave the cell to the other process."""
        message = f"taken over by another process on {row.host}, as run {row.name}"
        return Event("skipped", cell, row.id, 0, cell.spec.epochs, message=message)

    def stop(self) -> list[Event]:
        """Take no more cells."""
        self._left = 0
        return []

    def _most(self, row: RunRow, waiting: int) -> int:
        """Return how many seeds of the run's spec to take; 0 if the spec is not to be computed here, which is noted."""
        key = _key(row)
        if key not in self._specs:
            spec = _valid_spec(row)
            reason = "its spec is not valid, or does not fit its hash" if spec is None else self._objection(spec)
            self._specs[key] = None if reason else spec
            if reason:
                _LOG.warning("run %s is left in the queue: %s", row.name, reason)
        spec = self._specs[key]
        if spec is None:
            return 0
        together = min(math.ceil(waiting / self._free), _MOST_TOGETHER) if trains_together(spec) else 1
        return together if self._left is None else min(together, self._left)

    def _objection(self, spec: RunSpec) -> str | None:
        """Return why a spec of the database needs the user's consent, if it does: it names code, or a file elsewhere.

        A database may be someone else's. Code is allowed as in experiments.yaml: by SSMAIL_EXPERIMENTS.
        """
        for value in flatten(spec.model_dump()).values():
            if isinstance(value, str) and FUNCTION.fullmatch(value) and ENVIRONMENT_VARIABLE not in os.environ:
                return f"its spec names the Python function {value}; set {ENVIRONMENT_VARIABLE} to allow that"
        path = spec.data.path
        if path is not None:
            full = Path(path).resolve()
            if not full.is_relative_to(Path.cwd().resolve()) and full not in self._own_files:
                return f"its data {path} is not in this folder; give --data {path} to allow that"
        return None


def _key(row: RunRow) -> tuple[str, str]:
    return row.spec_json, row.spec_hash


def _valid_spec(row: RunRow) -> RunSpec | None:
    """Return the run's spec, or None unless it is valid and has the stored hash."""
    try:
        spec = RunSpec.model_validate_json(row.spec_json)
    except ValidationError:
        return None
    return spec if spec.hash() == row.spec_hash else None


def attempt(row: RunRow | None) -> Sequence[object]:
    """Return what tells a failure of a run from a later one."""
    return () if row is None else (row.id, row.resumes, row.finished)


def elsewhere(cell: Cell, row: RunRow) -> Event:
    """Return the event of a cell that another process computes."""
    message = f"computed by another process on {row.host}, as run {row.name}"
    return Event("elsewhere", cell, row.id, 0, cell.spec.epochs, message=message)


def ended_elsewhere(cell: Cell, row: RunRow, failed: Sequence[object] | None) -> Event | None:
    """Return the final event of a cell that another process has ended; None for one that it has not.

    failed: the `attempt` that had failed before.
    """
    epochs = cell.spec.epochs
    by = f"by another process on {row.host}, as run {row.name}"
    if row.state.settled:
        epoch = epochs if row.state is RunState.FINISHED else 0
        return Event("skipped", cell, row.id, epoch, epochs, message=f"{row.state} {by}")
    if row.state is RunState.FAILED and attempt(row) != failed:
        reason = (row.error or "no reason is stored").splitlines()[0]
        return Event("failed", cell, row.id, 0, epochs, message=f"computed {by}: {reason}")
    return None


def stopped(cell: Cell, row: RunRow | None = None) -> Event:
    """Return the final event of a cell that is not computed because of a signal, or is left to the process of `row`."""
    message = f"left to another process on {row.host}" if row else "stopped before it started"
    return Event("interrupted", cell, None, 0, cell.spec.epochs, message=message)
