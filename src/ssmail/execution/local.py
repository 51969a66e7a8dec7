"""Computes cells on this machine in worker processes of one thread each, several at a time.

Seeds of one spec whose method can train them together share a process, which takes a fraction of the time.
"""

import os
import selectors
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from itertools import chain
from typing import Any

from ssmail.errors import InputError, SsmailError, masked
from ssmail.execution import Resume
from ssmail.execution.cells import NO_LONGER_STORED, Cell, Event, Job, Kind, RunSettings
from ssmail.execution.planning import check_labels, plan_cell, shares
from ssmail.store import HEARTBEAT_SECONDS, RunRow, RunState, Store

WORKER = (sys.executable, "-P", "-m", "ssmail.execution.worker")
"""The command that starts a worker process. Tests replace it to compute cells with a training loop of their own."""
_POLL_SECONDS = 0.2
_ONE_THREAD = {"OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
# By default glibc returns large freed blocks to the system, which has to provide and clear them again at the next step;
# for dnri on mocap that takes a fifth of the time. These settings make glibc keep them.
_KEEP_MEMORY = {"MALLOC_MMAP_MAX_": "0", "MALLOC_TRIM_THRESHOLD_": str(2**32)}


def run_cells(
    cells: Sequence[Cell],
    *,
    store_url: str,
    on_event: Callable[[Event], None],
    jobs: int = 1,
    device: str = "cpu",
    resume: Resume = Resume.AUTO,
    worker: Sequence[str] = WORKER,
) -> list[Event]:
    """Compute every cell in at most `jobs` processes, and return the final event of each, in the order of `cells`.

    Seeds of a spec share a process where their method can train several at once (`planning.shares`). `on_event` is
    called in this process with every event, including final ones. A failing cell does not affect the others; a process
    that dies ends all its cells, which can be resumed. After SIGINT or SIGTERM to this process, every running cell
    finishes its epoch and is marked interrupted; a second signal kills the workers, which loses only their current
    epoch. Raises InputError, and computes nothing, when another process is computing one of the cells, when `resume` is
    REQUIRE and there is nothing to resume, when a label function is broken, or when the first cell cannot start because
    of its input.
    """
    check_labels(cells)
    store = Store.open(store_url)
    try:
        plans = [plan_cell(store, cell, resume) for cell in cells]
        pool = _Pool(store, RunSettings(device, resume), jobs, on_event, worker)
        waiting = []
        for cell, plan in zip(cells, plans, strict=True):
            if plan.skipped is not None:
                pool.emit(plan.skipped)
            else:
                waiting.append(cell)
        pool.waiting = shares(waiting, jobs)
        with _counted_signals(pool):
            pool.run()
        return [pool.results[cell] for cell in cells]
    finally:
        store.close()


def wait_for_others(
    store: Store, cells: Iterable[Cell], on_wait: Callable[[RunRow], None], grace_seconds: float = HEARTBEAT_SECONDS
) -> None:
    """Wait until no process is computing any of the cells, for at most `store.stale_seconds + grace_seconds`.

    The workers of a command that was killed stop after their epoch. If they were killed too, they count as alive until
    they have been silent for `store.stale_seconds`. A process that is still at work after that belongs to another
    command, which `run_cells` reports as an error. `on_wait` is called once, with a run that is waited for.
    """
    waiting = list(cells)
    deadline = time.monotonic() + store.stale_seconds + grace_seconds
    reported = False
    while True:
        rows = {cell: store.find_cell(cell.spec.hash(), cell.seed) for cell in waiting}
        alive = {cell: row for cell, row in rows.items() if row is not None and store.is_alive(row)}
        if not alive or time.monotonic() >= deadline:
            return
        if not reported:
            on_wait(next(iter(alive.values())))
            reported = True
        waiting = list(alive)
        time.sleep(_POLL_SECONDS)


class _Worker:
    """A worker process and the last event of each of its cells."""

    def __init__(self, job: Job, command: Sequence[str]) -> None:
        self.spec = job.spec
        self.last = {cell: Event("started", cell, None, 0, job.spec.epochs) for cell in job.cells}
        self._stderr = tempfile.TemporaryFile()  # noqa: SIM115 (closed in `wait`)
        self._buffer = b""
        self.process = subprocess.Popen(
            command,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._stderr,
            env={**os.environ, **_ONE_THREAD, **_KEEP_MEMORY},
            start_new_session=True,  # Ctrl-C reaches only this process, which asks its workers to stop
        )
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        self._stdin, self.stdout = self.process.stdin, self.process.stdout
        with suppress(BrokenPipeError):  # it died immediately, which `read` reports
            self._stdin.write(job.as_line().encode() + b"\n")
            self._stdin.flush()

    def read(self) -> list[Event] | None:
        """Return the events that have arrived; None once the process has closed its output."""
        data = os.read(self.stdout.fileno(), 65536)
        *lines, self._buffer = (self._buffer + data).split(b"\n")
        events = [Event.from_line(line, self.spec) for line in lines]
        self.last |= {event.cell: event for event in events}
        return events if data else None

    def ask_to_stop(self) -> None:
        with suppress(BrokenPipeError):
            self._stdin.close()

    def wait(self) -> str:
        """Wait for the process to end and return a description of how it ended."""
        code = self.process.wait()
        self.ask_to_stop()
        self.stdout.close()
        with self._stderr:
            self._stderr.seek(0)
            messages = self._stderr.read().decode(errors="replace").strip().splitlines()
        how = f"was killed by {signal.Signals(-code).name}" if code < 0 else f"ended with exit code {code}"
        return f"its process {how}" + (f": {masked(messages[-1])}" if messages else "")


class _Pool:
    """Up to `jobs` workers at a time."""

    def __init__(
        self,
        store: Store,
        settings: RunSettings,
        jobs: int,
        on_event: Callable[[Event], None],
        command: Sequence[str],
    ) -> None:
        self.waiting: list[list[Cell]] = []
        self.results: dict[Cell, Event] = {}
        self.stop_signals = 0
        self._store, self._settings, self._jobs, self._on_event = store, settings, jobs, on_event
        self._command = command
        self._workers: list[_Worker] = []
        self._selector = selectors.DefaultSelector()
        self._any_started = False

    def emit(self, event: Event) -> None:
        """Pass an event to `on_event`, and keep it if it is final."""
        if event.is_final:
            self.results[event.cell] = event
        self._any_started = self._any_started or event.kind in ("started", "resumed")
        self._on_event(event)

    def run(self) -> None:
        """Compute all waiting cells. Never leaves a worker behind, even after an exception."""
        try:
            while self.waiting or self._workers:
                self._start_workers()
                for key, _ in self._selector.select(_POLL_SECONDS):
                    self._receive(key.data)
                self._handle_signals()
        finally:
            for worker in self._workers:
                worker.ask_to_stop()
            for worker in self._workers:
                worker.wait()
            self._selector.close()

    def _start_workers(self) -> None:
        while self.waiting and len(self._workers) < self._jobs and not self.stop_signals:
            cells = self.waiting.pop(0)
            seeds = tuple(cell.seed for cell in cells)
            worker = _Worker(Job(cells[0].spec, seeds, self._store.url, self._settings), self._command)
            self._workers.append(worker)
            self._selector.register(worker.stdout, selectors.EVENT_READ, worker)
            for cell in cells:
                self._on_event(Event("loading", cell, None, 0, cell.spec.epochs))

    def _receive(self, worker: _Worker) -> None:
        events = worker.read()
        for event in events or ():
            if event.bad_input and not self._any_started:
                raise InputError(event.message)
            if event.kind in ("finished", "diverged") and not self._store.still_stored([str(event.run_id)]):
                event = replace(event, kind="failed", message=NO_LONGER_STORED)
            self.emit(event)
        if events is None:
            self._selector.unregister(worker.stdout)
            self._workers.remove(worker)
            ended = worker.wait()
            for last in worker.last.values():
                if not last.is_final:
                    self._report_dead_run(last, ended)

    def _report_dead_run(self, last: Event, ended: str) -> None:
        stopped = self.stop_signals > 0
        if last.run_id is not None:
            with suppress(SsmailError):  # the database may be gone, too
                self._store.end_dead_run(last.run_id, RunState.INTERRUPTED if stopped else RunState.FAILED, ended)
        kind: Kind = "interrupted" if stopped else "failed"
        self.emit(Event(kind, last.cell, last.run_id, last.epoch, last.epochs, message=ended))

    def _handle_signals(self) -> None:
        if not self.stop_signals:
            return
        for cell in chain.from_iterable(self.waiting):
            epochs = cell.spec.epochs
            self.emit(Event("interrupted", cell, None, 0, epochs, message="stopped before it started"))
        self.waiting.clear()
        for worker in self._workers:
            worker.ask_to_stop()
            if self.stop_signals > 1:
                worker.process.kill()


@contextmanager
def _counted_signals(pool: _Pool) -> Iterator[None]:
    """While the block runs, count SIGINT and SIGTERM instead of being ended by them (only in the main thread)."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def count(*_: Any) -> None:
        pool.stop_signals += 1

    handlers = {number: signal.signal(number, count) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)
