"""Computes cells on this machine in worker processes of one thread each, several at a time.

Seeds of one spec whose method can train them together share a process, which takes a fraction of the time.
"""

import logging
import os
import selectors
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from typing import Any, Protocol

from ssmail.errors import InputError, SsmailError, masked
from ssmail.execution import Resume
from ssmail.execution.cells import AUTO, NO_LONGER_STORED, Cell, Event, Job, Kind, RunSettings
from ssmail.execution.devices import least_used, places
from ssmail.execution.planning import check_labels, plan_cell
from ssmail.execution.sources import QueueSource, Source, SweepSource
from ssmail.store import HEARTBEAT_SECONDS, RunRow, RunState, Store
from ssmail.store.queue import Claim

WORKER = (sys.executable, "-P", "-m", "ssmail.execution.worker")
"""The command that starts a worker process. Tests replace it to compute cells with a training loop of their own."""
_LOG = logging.getLogger(__name__)
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
    per_device: int = 1,
    resume: Resume = Resume.AUTO,
    artifacts: str | None = None,
    worker: Sequence[str] = WORKER,
) -> list[Event]:
    """Compute every cell in at most `jobs` processes, and return the final event of each, in the order of `cells`.

    Seeds of a spec share a process where their method can train several at once (`planning.shares`). `on_event` is
    called in this process with every event, including final ones. Any number of processes may be given the same cells:
    each is computed once, by the process that claims it first, and is skipped in the others once it has ended; a cell
    whose process stops or dies is taken over. A failing cell does not affect the others; a process that dies ends all
    its cells, which can be resumed. After SIGINT or SIGTERM to this process, every running cell finishes its epoch and
    is marked interrupted; a second signal kills the workers, which loses only their current epoch.

    device: see `devices.places`; of the processes at most `per_device` use a GPU at the same time, so there may be
    fewer than `jobs`. artifacts: a folder or URL for checkpoints (see `Store.open`).

    Raises InputError, and computes nothing, when `artifacts` cannot be written to, when `resume` is NEVER and another
    process is computing one of the cells, when it is REQUIRE and there is nothing to resume, when a label function is
    broken, or when the first cell cannot start because of its input.
    """
    check_labels(cells)
    store = Store.open(store_url, artifacts=artifacts)
    free = places(device, per_device)
    jobs = _bounded(jobs, free)
    try:
        settings = _settings(store, device, resume)
        plans = {cell: plan_cell(store, cell, resume) for cell in cells}
        source = SweepSource(store, {cell: plan for cell, plan in plans.items() if not plan.skipped}, jobs, resume)
        pool = _Pool(store, source, settings, jobs, on_event, worker, free)
        for plan in plans.values():
            if plan.skipped is not None:
                pool.emit(plan.skipped)
        with counted_signals(pool):
            pool.run()
        return [pool.results[cell] for cell in cells]
    finally:
        store.close()


def run_waiting(
    source: QueueSource,
    *,
    store: Store,
    on_event: Callable[[Event], None],
    jobs: int = 1,
    device: str = "cpu",
    per_device: int = 1,
    worker: Sequence[str] = WORKER,
) -> tuple[list[Event], bool]:
    """Compute cells that wait in the database, in at most `jobs` processes, until the source ends.

    `device` and `per_device` are as for `run_cells`. Returns the final event of each, in the order in which they ended,
    and whether a signal stopped them. A cell that is stopped, by a signal or because the time of the source is over,
    waits again.
    """
    free = places(device, per_device)
    settings = _settings(store, device, Resume.AUTO)
    pool = _Pool(store, source, settings, _bounded(jobs, free), on_event, worker, free)
    pool.raises_bad_input = False
    with counted_signals(pool):
        pool.run()
    return list(pool.results.values()), pool.stop_signals > 0


def _bounded(jobs: int, free: Sequence[str]) -> int:
    """Return how many processes to run at once; say so if these are fewer than wanted."""
    if not free or jobs <= len(free):
        return jobs
    gpus = len(set(free))
    _LOG.warning("%d runs at once on %d GPU%s; --per-device allows more", len(free), gpus, "s" if gpus > 1 else "")
    return len(free)


def _settings(store: Store, device: str, resume: Resume) -> RunSettings:
    place = None
    if store.storage is not None:
        store.storage.require_writable()
        place = store.storage.place
    device = "cpu" if device == AUTO else device  # where there are GPUs, each process is given one of them
    return RunSettings(device, resume, min(HEARTBEAT_SECONDS, store.stale_seconds / 4), place)


class _Worker:
    """A worker process, its device, its claims, and the last event of each of its cells."""

    def __init__(self, job: Job, command: Sequence[str]) -> None:
        self.device = job.settings.device
        self.spec, self.claims = job.spec, dict(zip(job.cells, job.claims, strict=True))
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

    def not_begun(self) -> list[Claim]:
        """Return the claims of cells whose runs the process has neither begun nor given up."""
        return [self.claims[cell] for cell, last in self.last.items() if last.run_id is None and not last.is_final]

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
    """Up to `jobs` workers at a time, each on one of the `places` (see `devices`) if there are any."""

    def __init__(
        self,
        store: Store,
        source: Source,
        settings: RunSettings,
        jobs: int,
        on_event: Callable[[Event], None],
        command: Sequence[str],
        places: Sequence[str] = (),
    ) -> None:
        self.raises_bad_input = True  # of the first cell
        self.results: dict[Cell, Event] = {}
        self.stop_signals = 0
        self._store, self._source, self._settings, self._jobs = store, source, settings, jobs
        self._on_event, self._next_heartbeat = on_event, 0.0
        self._command, self._places = command, places
        self._workers: list[_Worker] = []
        self._selector = selectors.DefaultSelector()

    def emit(self, event: Event) -> None:
        """Pass an event to `on_event`, and keep it if it is final."""
        if event.is_final:
            self.results[event.cell] = event
        if event.kind in ("started", "resumed"):
            self.raises_bad_input = False
        self._on_event(event)

    def run(self) -> None:
        """Compute what the source has. Never leaves a worker or a claim behind, even after an exception."""
        try:
            while self._workers or not self._source.ended:
                self._start_workers()
                for key, _ in self._selector.select(_POLL_SECONDS):
                    self._receive(key.data)
                self._keep_claims()
                self._handle_signals()
        finally:
            for worker in self._workers:
                worker.ask_to_stop()
            for worker in self._workers:
                worker.wait()
                for claim in worker.claims.values():
                    self._release(claim)  # if its run was not begun
            self._selector.close()

    def _start_workers(self) -> None:
        while not self.stop_signals:
            claims, news = self._source.take(self._jobs - len(self._workers))
            for event in news:
                self.emit(event)
            if not claims:
                return
            cells = list(claims)
            seeds = tuple(cell.seed for cell in cells)
            settings = self._settings
            if self._places:
                device = least_used(self._places, [worker.device for worker in self._workers])
                settings = replace(settings, device=device)
            job = Job(cells[0].spec, seeds, self._store.url, settings, tuple(claims.values()))
            worker = _Worker(job, self._command)
            self._workers.append(worker)
            self._selector.register(worker.stdout, selectors.EVENT_READ, worker)
            for cell in cells:
                self._on_event(Event("loading", cell, None, 0, cell.spec.epochs))

    def _keep_claims(self) -> None:
        """Send the heartbeats of runs whose processes are still loading."""
        loading = [claim for worker in self._workers for claim in worker.not_begun()]
        if loading and time.monotonic() >= self._next_heartbeat:
            with suppress(SsmailError):  # the process meets the same error, and reports it
                self._store.queue.heartbeat(loading)
            self._next_heartbeat = time.monotonic() + self._settings.heartbeat_seconds

    def _release(self, claim: Claim, error: str | None = None) -> bool:
        with suppress(SsmailError):  # the database may be gone
            return self._store.queue.release(claim, error)
        return False

    def _receive(self, worker: _Worker) -> None:
        events = worker.read()
        for event in events or ():
            if event.is_final and event.run_id is None:
                self._release(worker.claims[event.cell], event.message if event.kind == "failed" else None)
            if event.bad_input and self.raises_bad_input:
                raise InputError(event.message)
            if event.kind == "failed" and (row := self._now_of_another(worker.claims[event.cell])):
                event = self._source.lost(event.cell, row)
            if event.kind in ("finished", "diverged") and not self._store.still_stored([str(event.run_id)]):
                event = replace(event, kind="failed", message=NO_LONGER_STORED)
            self.emit(event)
        if events is None:
            self._selector.unregister(worker.stdout)
            self._workers.remove(worker)
            ended = worker.wait()
            for cell, last in worker.last.items():
                if not last.is_final:
                    self._report_dead_run(last, worker.claims[cell], ended)

    def _now_of_another(self, claim: Claim) -> RunRow | None:
        """Return the row of the claimed run if another process has taken it over and is computing it."""
        with suppress(SsmailError):
            row = self._store.run(claim.run_id)
            if row.owner != claim.owner and self._store.is_alive(row):
                return row
        return None

    def _report_dead_run(self, last: Event, claim: Claim, ended: str) -> None:
        stopped = self.stop_signals > 0 or self._source.out_of_time
        if last.run_id is not None or not self._release(claim, None if stopped else ended):
            state = RunState.INTERRUPTED if stopped else RunState.FAILED
            with suppress(SsmailError):  # the database may be gone, too
                self._store.end_dead_run(claim.run_id, state, ended, claim.owner)
        kind: Kind = "interrupted" if stopped else "failed"
        self.emit(Event(kind, last.cell, last.run_id, last.epoch, last.epochs, message=ended))

    def _handle_signals(self) -> None:
        if not self.stop_signals and not self._source.out_of_time:
            return
        for event in self._source.stop():
            self.emit(event)
        for worker in self._workers:
            worker.ask_to_stop()
            if self.stop_signals > 1:
                worker.process.kill()


class Stoppable(Protocol):
    """What stops its work once it has seen `stop_signals`."""

    stop_signals: int


@contextmanager
def counted_signals(work: Stoppable) -> Iterator[None]:
    """While the block runs, count SIGINT and SIGTERM instead of being ended by them (only in the main thread)."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def count(*_: Any) -> None:
        work.stop_signals += 1

    handlers = {number: signal.signal(number, count) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)
