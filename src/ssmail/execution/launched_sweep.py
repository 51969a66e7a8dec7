"""Computes cells in the jobs of a cluster: submits them, and follows their runs in the database."""

import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

from ssmail.errors import InputError, SsmailError, missing_package
from ssmail.execution import LauncherName, Resume
from ssmail.execution.cells import Cell, Event
from ssmail.execution.launchers import Ended, Launcher, Unended, events_of, job_text, whole
from ssmail.execution.local import counted_signals
from ssmail.execution.planning import Plan, check_labels, plan_cell
from ssmail.execution.sources import LOOK_SECONDS, attempt, elsewhere, ended_elsewhere, stopped
from ssmail.store import RunRow, RunState, Store
from ssmail.store.connection import BUSY_SECONDS

_MOST_SECONDS = 5.0  # between two looks, however long a look takes
CELLS = "cells"
"""The setting that every launcher has: how many cells a job computes."""


class Grouping(NamedTuple):
    """How cells are divided: so many in a job, of which so many are computed at once."""

    cells: int = 1
    processes: int = 1


SINGLE = Grouping()


def check_settings(name: LauncherName, settings: Mapping[str, str]) -> None:
    """Raise InputError for a wrong setting of the launcher, or without its package."""
    _divided(settings, 1)
    if name is LauncherName.SLURM:
        _slurm().parameters(_own(settings))
    else:
        _ray().options(_own(settings))


def open_launcher(
    name: LauncherName, settings: Mapping[str, str], store: Store, jobs: int
) -> tuple[Launcher, Grouping]:
    """Return the launcher with these settings, and how to group cells for it.

    Raises InputError as `check_settings` does, and without its cluster.
    """
    grouping = _divided(settings, jobs)
    if name is LauncherName.SLURM:
        folder = store.checkpoint_root.parent / "slurm"
        return _slurm().SlurmLauncher(_own(settings), folder, grouping.processes), grouping
    return _ray().RayLauncher(_own(settings), grouping.processes), grouping


def _divided(settings: Mapping[str, str], jobs: int) -> Grouping:
    cells = whole(settings, CELLS, 1)
    return Grouping(cells, min(jobs, cells))


def _own(settings: Mapping[str, str]) -> dict[str, str]:
    return {key: value for key, value in settings.items() if key != CELLS}


def _slurm() -> Any:
    try:
        from ssmail.execution import slurm_launcher
    except ImportError as error:
        raise missing_package(error, "slurm") from None
    return slurm_launcher


def _ray() -> Any:
    try:
        from ssmail.execution import ray_launcher
    except ImportError as error:
        raise missing_package(error, "ray") from None
    return ray_launcher


def launch_cells(
    cells: Sequence[Cell],
    *,
    store_url: str,
    launcher: Launcher,
    on_event: Callable[[Event], None],
    grouping: Grouping = SINGLE,
    artifacts: str | None = None,
    device: str = "cpu",
    per_device: int = 1,
    resume: Resume = Resume.AUTO,
) -> list[Event]:
    """Compute every cell in jobs of the launcher, and return the final event of each, in the order of `cells`.

    Jobs share cells with any other process as those of `local.run_cells` do. `on_event` is called in this process with
    every event, as far as the database tells them. After SIGINT or SIGTERM to this process, the jobs are cancelled:
    their runs are interrupted at the end of their epoch, if the cluster lets them; after a second one, this returns at
    once. The cells of a job that was cancelled by anybody else are interrupted. Raises InputError as `local.run_cells`
    does, when the cluster refuses the jobs, and when `resume` is NEVER.
    """
    if resume is Resume.NEVER:
        raise InputError("a launcher is for --resume auto or require, not never: a job that is requeued resumes")
    check_labels(cells)
    store = Store.open(store_url, patience=BUSY_SECONDS, artifacts=artifacts)
    try:
        plans = {cell: plan_cell(store, cell, resume) for cell in cells}
        sweep = _Sweep(store, launcher, grouping, (device, per_device), on_event)
        with counted_signals(sweep):
            sweep.run(plans)
        return [sweep.results[cell] for cell in cells]
    finally:
        store.close()


@dataclass(frozen=True)
class _Left:
    """A cell that no job of ours computes: another process does (None), or its job has ended without a result."""

    kind: Unended | None = None
    message: str = ""


@dataclass
class _Seen:
    """How far a run was when it was last looked at."""

    run_id: str
    owner: str
    resumes: int
    epoch: int


class _Sweep:
    """The cells of a sweep, the jobs that compute them, and what is known of their runs."""

    def __init__(
        self,
        store: Store,
        launcher: Launcher,
        grouping: Grouping,
        device: tuple[str, int],
        on_event: Callable[[Event], None],
    ) -> None:
        self.results: dict[Cell, Event] = {}
        self.stop_signals = 0
        self._store, self._launcher, self._grouping, self._device = store, launcher, grouping, device
        self._on_event, self._has_started, self._is_cancelled = on_event, False, False
        self._jobs: dict[str, list[Cell]] = {}
        self._left: dict[Cell, _Left] = {}
        self._seen: dict[Cell, _Seen] = {}
        self._loading: dict[Cell, str] = {}
        self._failed: dict[Cell, Sequence[object]] = {}
        self._keys: dict[tuple[str, int], Cell] = {}

    def emit(self, event: Event) -> None:
        """Pass an event to `on_event`, and keep it if it is final."""
        if event.is_final:
            self.results[event.cell] = event
        self._on_event(event)

    def run(self, plans: Mapping[Cell, Plan]) -> None:
        """Submit the cells, but for those that others compute, and look at intervals until all have ended.

        Leaves no job behind, even after an exception.
        """
        self._keys = {(cell.spec.hash(), cell.seed): cell for cell in plans}
        self._failed = {cell: attempt(plan.row) for cell, plan in plans.items()}
        wanted = []
        for cell, plan in plans.items():
            if plan.skipped is not None:
                self.emit(plan.skipped)
            elif plan.elsewhere and plan.row is not None:
                self._left[cell] = _Left()
                self.emit(elsewhere(cell, plan.row))
            else:
                wanted.append(cell)
        try:
            self._submit(wanted)
            while self._jobs or self._left:
                began = time.monotonic()
                self._look()
                if self._jobs or self._left:
                    self._pause(min(max(LOOK_SECONDS, 10 * (time.monotonic() - began)), _MOST_SECONDS))
        finally:
            if self._jobs and not self._is_cancelled:
                self._launcher.cancel()

    def _submit(self, cells: Sequence[Cell]) -> None:
        size, processes = self._grouping
        groups = [list(cells[first : first + size]) for first in range(0, len(cells), size)]
        texts = [job_text(group, self._store, *self._device, processes) for group in groups]
        if texts:
            self._jobs |= dict(zip(self._launcher.submit(texts), groups, strict=True))

    def _pause(self, seconds: float) -> None:
        """Wait, but not longer than until the next signal."""
        end, signals = time.monotonic() + seconds, self.stop_signals
        while self.stop_signals == signals and (left := end - time.monotonic()) > 0:
            time.sleep(min(left, 0.1))

    def _look(self) -> None:
        """Report what is new."""
        if self.stop_signals and not self._is_cancelled:
            self._launcher.cancel()
            self._is_cancelled = True
        self._follow_running()
        for ended in self._launcher.poll():
            self._end(ended)
        if self.stop_signals:
            self._stop()
        given_up = [cell for cell in list(self._left) if self._is_given_up(cell)]
        for cell in given_up:
            del self._left[cell]
        self._submit(given_up)

    def _follow_running(self) -> None:
        ours = {cell for group in self._jobs.values() for cell in group}
        for row in self._store.runs(state=RunState.RUNNING):
            cell = self._keys.get((row.spec_hash, row.seed))
            if cell in ours and cell not in self.results:
                self._follow(cell, row)

    def _follow(self, cell: Cell, row: RunRow) -> None:
        """Report that a run has begun or was resumed, and its epochs since the last look."""
        seen = self._seen.get(cell)
        if not row.has_begun:
            if self._loading.get(cell) != row.owner:
                self._loading[cell] = row.owner
                self._on_event(Event("loading", cell, None, 0, cell.spec.epochs))
            return
        if seen is None or (seen.run_id, seen.owner, seen.resumes) != (row.id, row.owner, row.resumes):
            same_run = seen is not None and seen.run_id == row.id
            before = seen.epoch if seen and same_run else self._last_epoch(row) if row.resumes else 0
            self._seen[cell] = _Seen(row.id, row.owner, row.resumes, before)
            self._has_started = True
            kind: Literal["started", "resumed"] = "resumed" if row.resumes else "started"
            self.emit(Event(kind, cell, row.id, before, cell.spec.epochs))
        self._report_epochs(cell)

    def _last_epoch(self, row: RunRow) -> int:
        steps = self._store.latest_metrics([row.id])["step"]
        return int(steps.max()) if len(steps) else 0

    def _report_epochs(self, cell: Cell) -> None:
        """Report the epochs that were stored since the last look; the metrics of the final evaluation are no epoch."""
        seen, epochs = self._seen[cell], cell.spec.epochs
        found = self._store.metrics([seen.run_id], after=seen.epoch)
        for step, rows in found.groupby("step"):
            metrics = dict(zip(rows["name"], rows["value"], strict=True))
            seen.epoch = int(str(step))
            self._on_event(Event("epoch", cell, seen.run_id, seen.epoch, epochs, metrics))

    def _end(self, ended: Ended) -> None:
        """Report how the cells of a job have ended; what became of them without a result, the database has to tell."""
        cells = self._jobs.pop(ended.job, [])  # none after a signal, if its cells have ended before it
        try:
            events = events_of(ended.result, cells) if cells and ended.result is not None else []
        except (ValueError, TypeError, KeyError):
            events = []
        for event in events:
            if event.bad_input and not self._has_started:
                raise InputError(event.message)
        for event in events:
            row = self._store.find_cell(event.cell.spec.hash(), event.cell.seed)
            if row is not None and row.id == event.run_id and event.kind != "skipped":
                self._follow(event.cell, row)  # it may have done much since the last look
            self.emit(event)
        for cell in cells:
            if cell not in self.results:
                self._left[cell] = _Left(ended.kind, ended.message)

    def _is_given_up(self, cell: Cell) -> bool:
        """Report how a cell has ended that no job of ours computes; return whether its other process has given it up.

        The process of a job that died may still be alive for what the database knows; then it has to fall silent first.
        """
        row, left = self._store.find_cell(cell.spec.hash(), cell.seed), self._left[cell]
        if row is not None and self._store.is_alive(row):
            return False
        event = self._ended(cell, row) if row is not None else None
        if event is None:
            if left.kind is None:
                return True
            if row is not None and row.state is RunState.RUNNING:
                state = RunState.FAILED if left.kind == "failed" else RunState.INTERRUPTED
                with suppress(SsmailError):
                    self._store.end_dead_run(row.id, state, left.message, row.owner)
            epoch = self._seen[cell].epoch if cell in self._seen else 0
            event = Event(left.kind, cell, row.id if row else None, epoch, cell.spec.epochs, message=left.message)
        del self._left[cell]
        self.emit(event)
        return False

    def _stop(self) -> None:
        """After a signal, end the cells that nobody computes any more; after a second one, all."""
        for cell, left in list(self._left.items()):
            if left.kind is None:
                del self._left[cell]
                self.emit(stopped(cell, self._store.find_cell(cell.spec.hash(), cell.seed)))
            elif self.stop_signals > 1:
                del self._left[cell]
                self.emit(self._last_event(cell))
        for job, group in list(self._jobs.items()):
            unfinished = [cell for cell in group if not self._has_stopped(cell)]
            if not unfinished or self.stop_signals > 1:
                del self._jobs[job]
                for cell in group:
                    self.emit(self._last_event(cell))

    def _has_stopped(self, cell: Cell) -> bool:
        row = self._store.find_cell(cell.spec.hash(), cell.seed)
        return row is None or row.state is not RunState.RUNNING or not self._store.is_alive(row)

    def _last_event(self, cell: Cell) -> Event:
        row, seen = self._store.find_cell(cell.spec.hash(), cell.seed), self._seen.get(cell)
        if row is None or seen is None:
            return stopped(cell)
        return self._ended(cell, row) or Event("interrupted", cell, row.id, seen.epoch, cell.spec.epochs)

    def _ended(self, cell: Cell, row: RunRow) -> Event | None:
        """Return the final event of a cell from its row: of a run that was followed here, or of another process."""
        seen = self._seen.get(cell)
        if seen is None or seen.run_id != row.id or not row.state.settled:
            return ended_elsewhere(cell, row, self._failed.get(cell))
        self._report_epochs(cell)
        kind: Literal["finished", "diverged"] = "finished" if row.state is RunState.FINISHED else "diverged"
        return Event(kind, cell, row.id, seen.epoch, cell.spec.epochs, message=row.error or "")
