"""Computes cells in this process: trains, stores metrics and checkpoints, and resumes unfinished runs."""

import threading
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from functools import partial
from types import MappingProxyType
from typing import Any, Protocol

import numpy as np
import torch

from ssmail.config.spec import RunSpec
from ssmail.errors import InputError, SsmailError, masked
from ssmail.execution import Resume
from ssmail.execution.cells import Cell, Event, Kind, RunSettings
from ssmail.execution.devices import also_on
from ssmail.execution.planning import Plan, plan_cell
from ssmail.store import RunState, RunWriter, Store
from ssmail.store.checkpoint_files import BEST, LAST, LASTS
from ssmail.store.queue import Claim
from ssmail.store.recorded_checkpoints import load_recorded
from ssmail.training.checkpoint import AFRESH, UnfitState, checkpoint_bytes, save_checkpoint
from ssmail.training.loop import Divergence, TrainingLoop


class Loop(Protocol):
    """The part of TrainingLoop that `run_together` uses. Tests substitute simple loops."""

    epoch: int  # completed epochs
    dataset_hash: str
    improved: bool  # whether the last epoch's model is the best so far
    snapshot: dict[str, np.ndarray]  # the arrays to store for the last epoch

    def run_epoch(self) -> dict[str, float]:
        """Train one epoch and return its metrics. Raises Divergence."""

    @staticmethod
    def run_epochs(loops: Sequence[Any]) -> Sequence[dict[str, float] | Exception]:
        """Train one epoch of each loop, all before the same epoch; return what `run_epoch` would return or raise."""

    def final_evaluation(self) -> tuple[dict[str, float], dict[str, np.ndarray]]:
        """Return the final metrics and arrays."""

    def state_dict(self) -> dict[str, Any]:
        """Return everything needed to resume."""

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore the state that `state_dict` returned."""

    def best_state_dict(self) -> dict[str, Any]:
        """Return the best model so far."""


MakeLoop = Callable[[RunSpec, int, str], Loop]
"""Creates a loop from a spec, a seed and a device."""


def run_together(
    cells: Sequence[Cell],
    store: Store,
    settings: RunSettings,
    on_event: Callable[[Event], None],
    should_stop: Callable[[], bool],
    make_loop: MakeLoop = TrainingLoop,
    claims: Mapping[Cell, Claim] = MappingProxyType({}),
) -> None:
    """Compute seeds of one spec, epoch by epoch, all at once; pass every event to `on_event`, also the final ones.

    claims: the runs to begin or resume; a cell without one is planned and claimed here.

    A seed ends by itself: its divergence or failure does not affect the others. Seeds that were interrupted at
    different epochs catch up first. `should_stop` is called between epochs. Once it returns True, the runs are marked
    interrupted; resuming them gives the same numbers as an uninterrupted run. Exceptions become "failed" events, with
    the traceback in the run's `error`.
    """
    if should_stop():
        for cell in cells:
            on_event(Event("interrupted", cell, None, 0, cell.spec.epochs, message="stopped before it started"))
        return
    runs = []
    for cell in cells:
        started = _start(cell, store, settings, make_loop, claims.get(cell))
        if isinstance(started, Event):
            on_event(started)
        else:
            runs.append(started)
            on_event(started.event("resumed" if started.resumed else "started", message=started.remark))
    with _heartbeats([run.writer for run in runs], settings.heartbeat_seconds):
        _train([run for run in runs if run.attempt(run.begin, on_event)], on_event, should_stop)


def _start(cell: Cell, store: Store, settings: RunSettings, make_loop: MakeLoop, claim: Claim | None) -> "_Run | Event":
    """Start or resume the run of a cell, or return its final event if there is nothing to train."""
    try:
        plan = Plan(row=store.run(claim.run_id)) if claim else plan_cell(store, cell, settings.resume)
        if plan.skipped is not None:
            return plan.skipped
        if settings.device.startswith("cuda") and not torch.cuda.is_available():
            raise InputError("PyTorch finds no CUDA device on this machine; use --device cpu")
        loop = make_loop(cell.spec, cell.seed, settings.device)
        writer, remark = _open_run(cell, store, settings, plan, loop, claim)
        return _Run(cell, loop, writer, resumed=plan.row is not None and plan.row.has_begun, remark=remark)
    except Exception as error:
        bad_input = isinstance(error, InputError)
        return Event("failed", cell, None, 0, cell.spec.epochs, message=_summary(error), bad_input=bad_input)


def _open_run(
    cell: Cell, store: Store, settings: RunSettings, plan: Plan, loop: Loop, claim: Claim | None
) -> tuple[RunWriter, str]:
    """Start a new run, or resume the planned one and load its last checkpoint into `loop`.

    Returns the writer, and what there is to say.
    """
    begun = {"dataset_hash": loop.dataset_hash, "device": settings.device}
    if plan.row is None:
        repeat = settings.resume is Resume.NEVER
        return store.start_run(cell.spec, cell.seed, repeat=repeat, **begun), ""
    if not plan.row.has_begun:
        return store.resume_run(plan.row.id, 0, claim, **begun), ""
    if plan.row.dataset_hash != loop.dataset_hash:
        raise InputError(
            f"the data of run {plan.row.name} has changed since it was interrupted; start a new run with --resume never"
        )
    remark = _load_last(store, plan.row.id, loop)
    device = also_on(plan.row.device, settings.device) if loop.epoch else settings.device
    return store.resume_run(plan.row.id, loop.epoch, claim, device=device), remark


def _load_last(store: Store, run_id: str, loop: Loop) -> str:
    """Load the run's last checkpoint into `loop`; return what there is to say if it recorded one that is missing.

    Raises InputError when it is not as recorded.
    """
    where, state = load_recorded(store, run_id, LAST)
    if state is None:
        recorded = any(row.name == LAST for row in store.artifacts(run_id))
        return "its checkpoint is not here, nor where --artifacts says, so it starts again" if recorded else ""
    try:
        loop.load_state_dict(state)
    except UnfitState as error:
        raise InputError(f"the checkpoint {where} does not fit its run ({error}); {AFRESH}") from error
    return ""


class _Run:
    """A run in progress: a loop and what is stored of it."""

    # Each epoch is written in this order: metrics, arrays, checkpoint, and the checkpoint's record. So a recorded
    # checkpoint is never ahead of the database, and what a killed process stored after it is computed again, to the
    # same bits. Two files take turns: the recorded one stays until the next one has a record. In a place that every
    # machine reaches, files are objects named after their content, and a process on another machine has only the
    # records to go by, so the best model is recorded at once, too.

    def __init__(self, cell: Cell, loop: Loop, writer: RunWriter, *, resumed: bool, remark: str = "") -> None:
        self.cell, self.loop, self.writer, self.resumed, self.remark = cell, loop, writer, resumed, remark
        self.epochs = cell.spec.epochs

    def event(self, kind: Kind, metrics: Mapping[str, float] | None = None, message: str = "") -> Event:
        return Event(kind, self.cell, self.writer.run_id, self.loop.epoch, self.epochs, metrics or {}, message)

    def attempt(self, work: Callable[[], Event | None], on_event: Callable[[Event], None]) -> bool:
        """Do a part of the run's work and report its event; return whether the run goes on."""
        try:
            event = work()
        except Exception as error:
            event = self.fail(error)
        if event is not None:
            on_event(event)
        return event is None or not event.is_final

    def begin(self) -> None:
        """Store what the loop has before its first epoch here."""
        self.record_snapshot()
        if self.loop.epoch and self.writer.storage and not self.writer.objects().keys() >= {BEST, LAST}:
            self._save(best=True)  # the epochs before were computed without it

    def record_snapshot(self) -> None:
        if self.loop.snapshot:
            self.writer.arrays(self.loop.snapshot)

    def record_epoch(self, outcome: Mapping[str, float] | Exception) -> Event:
        """Store an epoch that has been trained, or how it ended the run."""
        if isinstance(outcome, Divergence):
            self._record_checkpoints(self._last_name())
            self.writer.finish(RunState.DIVERGED, str(outcome))
            return self.event("diverged", message=str(outcome))
        if isinstance(outcome, Exception):
            return self.fail(outcome)
        self.writer.epoch(self.loop.epoch, outcome)
        self.record_snapshot()
        self._save(best=self.loop.improved)
        return self.event("epoch", outcome)

    def evaluate(self) -> Event:
        """Store the final evaluation and end the run."""
        metrics, arrays = self.loop.final_evaluation()
        self.writer.final(self.loop.epoch, metrics)
        self.writer.arrays(arrays)
        self._record_checkpoints(LAST)
        self.writer.finish(RunState.FINISHED)
        return self.event("finished", metrics)

    def interrupt(self) -> Event:
        self.writer.finish(RunState.INTERRUPTED, f"stopped after epoch {self.loop.epoch}")
        return self.event("interrupted")

    def fail(self, error: Exception) -> Event:
        with suppress(SsmailError):  # if writing to the store fails too, report the first error
            trace = "".join(traceback.format_exception(error))
            self.writer.finish(RunState.FAILED, f"{_summary(error)}\n\n{masked(trace)}")
        return self.event("failed", message=_summary(error))

    def _save(self, best: bool) -> None:
        """Store and record the checkpoint of this epoch, and before it the best model if there is a new one."""
        states = {BEST: self.loop.best_state_dict()} if best else {}
        states[LAST] = self.loop.state_dict()
        if self.writer.storage is not None:
            self.writer.store_objects({name: checkpoint_bytes(state) for name, state in states.items()})
            return
        files = {BEST: BEST, LAST: self._last_name()}
        for name, state in states.items():
            save_checkpoint(self.writer.folder / files[name], state)
        self.writer.artifact(LAST, files[LAST])

    def _last_name(self) -> str:
        """Return the name of the checkpoint file of this epoch; that of the final one is LAST."""
        return LASTS[(self.epochs - self.loop.epoch) % 2]

    def _record_checkpoints(self, last: str) -> None:
        """Record the checkpoints of a run that ends, and remove what an earlier epoch or a killed process left."""
        folder = self.writer.folder
        kept = {} if self.writer.storage else {BEST: BEST, LAST: last}  # objects are recorded already
        for name, file in kept.items():
            if (folder / file).exists():
                self.writer.artifact(name, file)
        others = (folder / file for file in (BEST, *LASTS) if file not in kept.values())
        for stray in (*folder.glob(".*.partial"), *others):
            stray.unlink(missing_ok=True)


def _train(runs: Sequence[_Run], on_event: Callable[[Event], None], should_stop: Callable[[], bool]) -> None:
    """Train the runs to their end, always those that are the least far."""
    while runs:
        for run in runs:
            run.writer.share(len(runs))
        runs = [run for run in runs if run.loop.epoch < run.epochs or run.attempt(run.evaluate, on_event)]
        if not runs:
            return
        if should_stop():
            for run in runs:
                run.attempt(run.interrupt, on_event)
            return
        epoch = min(run.loop.epoch for run in runs)
        behind = [run for run in runs if run.loop.epoch == epoch]
        ended = [
            run
            for run, outcome in zip(behind, _outcomes([run.loop for run in behind]), strict=True)
            if not run.attempt(partial(run.record_epoch, outcome), on_event)
        ]
        runs = [run for run in runs if run not in ended]


def _outcomes(loops: Sequence[Loop]) -> Sequence[Mapping[str, float] | Exception]:
    """Train each loop for an epoch; return its metrics, or the exception that ended it."""
    try:
        return [loops[0].run_epoch()] if len(loops) == 1 else type(loops[0]).run_epochs(loops)
    except Exception as error:
        return [error] * len(loops)


@contextmanager
def _heartbeats(writers: Sequence[RunWriter], seconds: float) -> Iterator[None]:
    """While the block runs, record heartbeats every `seconds` from another thread, however long an epoch takes."""
    done = threading.Event()

    def beat() -> None:
        while not done.wait(seconds):
            for writer in writers:
                # the run has ended, or the training thread meets the same error at its next write, and reports it
                with suppress(SsmailError):
                    writer.heartbeat()

    thread = threading.Thread(target=beat, name="heartbeat", daemon=True)
    thread.start()
    try:
        yield
    finally:
        done.set()
        thread.join()


def _summary(error: Exception) -> str:
    return masked(str(error) if isinstance(error, SsmailError) else f"{type(error).__name__}: {error}")
