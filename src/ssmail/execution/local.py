"""Compute cells on this machine, each in a process of its own with one thread, some of them at once."""

import os
import selectors
import signal
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from typing import Any

from ssmail.errors import InputError
from ssmail.execution.cells import Cell, Event, Job, Kind, Resume, Settings, check_labels, plan_cell
from ssmail.store import HEARTBEAT_SECONDS, STALE_SECONDS, RunState, Store

__all__ = ["Cell", "Event", "Resume", "run_cells"]

_POLL_SECONDS = 0.2
_ONE_THREAD = {"OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
# glibc gives large blocks back to the system when they are freed, only to fetch and clear them again at the next step:
# a fifth of the time of dnri on mocap. These keep them.
_KEEP_MEMORY = {"MALLOC_MMAP_MAX_": "0", "MALLOC_TRIM_THRESHOLD_": str(2**32)}


def run_cells(
    cells: Sequence[Cell],
    *,
    store_url: str,
    on_event: Callable[[Event], None],
    jobs: int = 1,
    device: str = "cpu",
    resume: Resume = Resume.AUTO,
    heartbeat_seconds: float = HEARTBEAT_SECONDS,
    stale_seconds: float = STALE_SECONDS,
    loop_factory: str = Settings.loop_factory,
) -> list[Event]:
    """Compute every cell, at most `jobs` at once, and return the final event of each, in the order of `cells`.

    `on_event` is called in this process with every event, final ones included. A cell that fails leaves the others
    alone. SIGINT or SIGTERM to this process lets every running cell finish its epoch and marks it interrupted; a second
    one kills them (their epoch is lost, nothing else). Raises InputError, and computes nothing, when another process is
    computing one of the cells, when there is nothing to resume and `resume` is REQUIRE, when a label function is
    broken, or when the first cell cannot begin because of its input.
    """
    check_labels(cells)
    settings = Settings(device, resume, heartbeat_seconds, stale_seconds, loop_factory)
    store = Store.open(store_url)
    try:
        plans = [plan_cell(store, cell, settings) for cell in cells]
        pool = _Pool(store, settings, jobs, on_event)
        for index, (cell, plan) in enumerate(zip(cells, plans, strict=True)):
            if plan.skipped is not None:
                pool.tell(index, plan.skipped)
            else:
                pool.waiting.append((index, cell))
        with _signals(pool):
            pool.run()
        return [pool.results[index] for index in range(len(cells))]
    finally:
        store.close()


class _Child:
    """A worker process and what it said last."""

    def __init__(self, index: int, job: Job) -> None:
        self.index, self.cell = index, job.cell
        self.last = Event("started", job.cell, None, 0, job.cell.spec.epochs)
        self._stderr = tempfile.TemporaryFile()  # noqa: SIM115 (closed in `wait`)
        self._buffer = b""
        self.process = subprocess.Popen(
            [sys.executable, "-P", "-m", "ssmail.execution.worker"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._stderr,
            env={**os.environ, **_ONE_THREAD, **_KEEP_MEMORY},
            start_new_session=True,  # Ctrl-C reaches only the parent, which asks its children to stop
        )
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        self._stdin, self.stdout = self.process.stdin, self.process.stdout
        with suppress(BrokenPipeError):  # it died at once: `read` will tell
            self._stdin.write(job.as_line().encode() + b"\n")
            self._stdin.flush()

    def read(self) -> list[Event] | None:
        """The events that have arrived; None once the process has closed its output."""
        data = os.read(self.stdout.fileno(), 65536)
        *lines, self._buffer = (self._buffer + data).split(b"\n")
        events = [Event.from_line(line, self.cell) for line in lines]
        self.last = events[-1] if events else self.last
        return events if data else None

    def ask_to_stop(self) -> None:
        with suppress(BrokenPipeError):
            self._stdin.close()

    def wait(self) -> str:
        """Wait for the end of the process; how it ended, in words."""
        code = self.process.wait()
        self.ask_to_stop()
        self.stdout.close()
        with self._stderr:
            self._stderr.seek(0)
            said = self._stderr.read().decode(errors="replace").strip().splitlines()
        how = f"was killed by {signal.Signals(-code).name}" if code < 0 else f"ended with exit code {code}"
        return f"its process {how}" + (f": {said[-1]}" if said else "")


class _Pool:
    """Up to `jobs` children at a time."""

    def __init__(self, store: Store, settings: Settings, jobs: int, on_event: Callable[[Event], None]) -> None:
        self.waiting: list[tuple[int, Cell]] = []
        self.results: dict[int, Event] = {}
        self.stop_signals = 0
        self._store, self._settings, self._jobs, self._on_event = store, settings, jobs, on_event
        self._children: list[_Child] = []
        self._selector = selectors.DefaultSelector()
        self._began = False

    def tell(self, index: int, event: Event) -> None:
        """Pass an event on, and keep it when it is final."""
        if event.is_final:
            self.results[index] = event
        self._began = self._began or event.kind in ("started", "resumed")
        self._on_event(event)

    def run(self) -> None:
        """Compute all that waits. Whatever happens, no child is left behind."""
        try:
            while self.waiting or self._children:
                self._start_some()
                for key, _ in self._selector.select(_POLL_SECONDS):
                    self._listen(key.data)
                self._obey_signals()
        finally:
            for child in self._children:
                child.ask_to_stop()
            for child in self._children:
                child.wait()
            self._selector.close()

    def _start_some(self) -> None:
        while self.waiting and len(self._children) < self._jobs and not self.stop_signals:
            index, cell = self.waiting.pop(0)
            child = _Child(index, Job(cell, self._store.url, self._settings))
            self._children.append(child)
            self._selector.register(child.stdout, selectors.EVENT_READ, child)

    def _listen(self, child: _Child) -> None:
        events = child.read()
        for event in events or ():
            if event.bad_input and not self._began:
                raise InputError(event.message)
            self.tell(child.index, event)
        if events is None:
            self._selector.unregister(child.stdout)
            self._children.remove(child)
            ended = child.wait()
            if not child.last.is_final:
                self._tell_of_death(child, ended)

    def _tell_of_death(self, child: _Child, ended: str) -> None:
        last, stopped = child.last, self.stop_signals > 0
        if last.run_id is not None:
            self._store.end_dead_run(last.run_id, RunState.INTERRUPTED if stopped else RunState.FAILED, ended)
        kind: Kind = "interrupted" if stopped else "failed"
        self.tell(child.index, Event(kind, child.cell, last.run_id, last.epoch, last.epochs, message=ended))

    def _obey_signals(self) -> None:
        if not self.stop_signals:
            return
        for index, cell in self.waiting:
            epochs = cell.spec.epochs
            self.tell(index, Event("interrupted", cell, None, 0, epochs, message="stopped before it began"))
        self.waiting.clear()
        for child in self._children:
            child.ask_to_stop()
            if self.stop_signals > 1:
                child.process.kill()


@contextmanager
def _signals(pool: _Pool) -> Iterator[None]:
    """While the block runs, count SIGINT and SIGTERM instead of dying of them (possible in the main thread only)."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def count(*_: Any) -> None:
        pool.stop_signals += 1

    before = {number: signal.signal(number, count) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
