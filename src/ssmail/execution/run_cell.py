"""Computes one cell in this process: trains, stores metrics and checkpoints, and resumes an unfinished run."""

import os
import threading
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Any, Protocol

import numpy as np
import torch

from ssmail.config.spec import RunSpec
from ssmail.errors import InputError, SsmailError, masked
from ssmail.execution import Resume
from ssmail.execution.cells import Cell, Event, RunSettings
from ssmail.execution.planning import BEST, LAST, LASTS, Plan, plan_cell
from ssmail.store import RunState, RunWriter, Store
from ssmail.store.checkpoint_files import run_folder
from ssmail.training.checkpoint import AFRESH, UnfitState, load_checkpoint, save_checkpoint
from ssmail.training.loop import Divergence, TrainingLoop


class Loop(Protocol):
    """The part of TrainingLoop that `run_cell` uses. Tests substitute simple loops."""

    epoch: int  # completed epochs
    dataset_hash: str
    improved: bool  # whether the last epoch's model is the best so far
    snapshot: dict[str, np.ndarray]  # the arrays to store for the last epoch

    def run_epoch(self) -> dict[str, float]:
        """Train one epoch and return its metrics. Raises Divergence."""

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


def run_cell(
    cell: Cell,
    store: Store,
    settings: RunSettings,
    on_event: Callable[[Event], None],
    should_stop: Callable[[], bool],
    make_loop: MakeLoop = TrainingLoop,
) -> Event:
    """Compute the cell and return its final event; pass all earlier events to `on_event`.

    `should_stop` is called between epochs. Once it returns True, the run is marked interrupted; resuming it gives the
    same numbers as an uninterrupted run. Exceptions become a "failed" event, with the traceback in the run's `error`.
    """
    epochs = cell.spec.epochs
    if should_stop():
        return Event("interrupted", cell, None, 0, epochs, message="stopped before it started")
    try:
        plan = plan_cell(store, cell, settings.resume)
        if plan.skipped is not None:
            return plan.skipped
        if settings.device.startswith("cuda") and not torch.cuda.is_available():
            raise InputError("PyTorch finds no CUDA device on this machine; use --device cpu")
        loop = make_loop(cell.spec, cell.seed, settings.device)
        writer = _open_run(cell, store, settings, plan, loop)
    except Exception as error:
        bad_input = isinstance(error, InputError)
        return Event("failed", cell, None, 0, epochs, message=_summary(error), bad_input=bad_input)
    on_event(Event("resumed" if plan.row else "started", cell, writer.run_id, loop.epoch, epochs))
    with _heartbeats(writer, settings.heartbeat_seconds):
        try:
            return _train(cell, loop, writer, on_event, should_stop)
        except Exception as error:
            with suppress(SsmailError):  # if writing to the store fails too, report the first error
                writer.finish(RunState.FAILED, f"{_summary(error)}\n\n{masked(traceback.format_exc())}")
            return Event("failed", cell, writer.run_id, loop.epoch, epochs, message=_summary(error))


def _open_run(cell: Cell, store: Store, settings: RunSettings, plan: Plan, loop: Loop) -> RunWriter:
    """Start a new run, or resume the planned one and load its last checkpoint into `loop`."""
    if plan.row is None:
        repeat = settings.resume is Resume.NEVER
        return store.start_run(
            cell.spec, cell.seed, dataset_hash=loop.dataset_hash, device=settings.device, repeat=repeat
        )
    if plan.row.dataset_hash != loop.dataset_hash:
        raise InputError(
            f"the data of run {plan.row.name} has changed since it was interrupted; start a new run with --resume never"
        )
    _load_last(store, plan.row.id, loop)
    return store.resume_run(plan.row.id, loop.epoch)


def _load_last(store: Store, run_id: str, loop: Loop) -> None:
    """Load the run's last checkpoint, if it has one, into `loop`. Raises InputError when it is not as recorded."""
    folder = run_folder(store.checkpoint_root, run_id)
    recorded = [row for row in store.artifacts(run_id) if row.name == LAST]
    sha256 = recorded[0].sha256 if recorded else None  # runs of older versions record it at their end only
    last = recorded[0].path if recorded else folder / LAST
    if last is None or last.name not in LASTS:
        raise InputError(f"run {run_id[:8]} has its checkpoint recorded in another folder; {AFRESH}")
    if not os.path.lexists(last):
        return
    try:
        loop.load_state_dict(load_checkpoint(last, sha256))
    except UnfitState as error:
        raise InputError(f"the checkpoint {last} does not fit its run ({error}); {AFRESH}") from error


def _train(
    cell: Cell,
    loop: Loop,
    writer: RunWriter,
    on_event: Callable[[Event], None],
    should_stop: Callable[[], bool],
) -> Event:
    # Each epoch is written in this order: metrics, arrays, checkpoint, and the checkpoint's record. So a recorded
    # checkpoint is never ahead of the database, and what a killed process stored after it is computed again, to the
    # same bits. Two files take turns: the recorded one stays until the next one has a record.
    epochs = cell.spec.epochs
    if loop.snapshot:
        writer.arrays(loop.snapshot)
    while loop.epoch < epochs:
        if should_stop():
            writer.finish(RunState.INTERRUPTED, f"stopped after epoch {loop.epoch}")
            return Event("interrupted", cell, writer.run_id, loop.epoch, epochs)
        try:
            metrics = loop.run_epoch()
        except Divergence as error:
            _record_checkpoints(writer, _last_name(epochs, loop.epoch))
            writer.finish(RunState.DIVERGED, str(error))
            return Event("diverged", cell, writer.run_id, loop.epoch, epochs, message=str(error))
        writer.epoch(loop.epoch, metrics)
        if loop.snapshot:
            writer.arrays(loop.snapshot)
        if loop.improved:
            save_checkpoint(writer.folder / BEST, loop.best_state_dict())
        last = _last_name(epochs, loop.epoch)
        save_checkpoint(writer.folder / last, loop.state_dict())
        writer.artifact(LAST, last)
        on_event(Event("epoch", cell, writer.run_id, loop.epoch, epochs, metrics))
    metrics, arrays = loop.final_evaluation()
    writer.final(loop.epoch, metrics)
    writer.arrays(arrays)
    _record_checkpoints(writer, LAST)
    writer.finish(RunState.FINISHED)
    return Event("finished", cell, writer.run_id, loop.epoch, epochs, metrics)


def _last_name(epochs: int, epoch: int) -> str:
    """Return the name of the checkpoint file of an epoch; that of the final one is LAST."""
    return LASTS[(epochs - epoch) % 2]


def _record_checkpoints(writer: RunWriter, last: str) -> None:
    """Record the checkpoints of a run that ends, and remove what an earlier epoch or a killed process left there."""
    for name, file in ((BEST, BEST), (LAST, last)):
        if (writer.folder / file).exists():
            writer.artifact(name, file)
    for stray in (*writer.folder.glob(".*.partial"), *(writer.folder / name for name in LASTS if name != last)):
        stray.unlink(missing_ok=True)


@contextmanager
def _heartbeats(writer: RunWriter, seconds: float) -> Iterator[None]:
    """While the block runs, record a heartbeat every `seconds` from another thread, however long an epoch takes."""
    done = threading.Event()

    def beat() -> None:
        while not done.wait(seconds):
            with suppress(SsmailError):  # the training thread meets the same error at its next write, and reports it
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
