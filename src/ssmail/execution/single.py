"""Compute one cell in this process: train, store, checkpoint; resume where it stopped."""

import importlib
import threading
import traceback
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ssmail.errors import InputError, SsmailError
from ssmail.execution.cells import BEST, LAST, Cell, Event, Plan, Resume, Settings, plan_cell
from ssmail.store import RunState, RunWriter, Store
from ssmail.training.loop import Divergence, load_checkpoint, save_checkpoint


def run_cell(
    cell: Cell, store: Store, settings: Settings, on_event: Callable[[Event], None], should_stop: Callable[[], bool]
) -> Event:
    """Bring the cell to its end and return the final event; `on_event` is given those before it.

    `should_stop` is asked between epochs; once true, the run is marked interrupted and can be resumed to the same
    numbers. No exception leaves this function: a failure is an event, and the run's `error` holds the traceback.
    """
    epochs = cell.spec.epochs
    if should_stop():
        return Event("interrupted", cell, None, 0, epochs, message="stopped before it began")
    try:
        plan = plan_cell(store, cell, settings)
        if plan.skipped is not None:
            return plan.skipped
        loop = _make_loop(cell, settings)
        writer = _claim(cell, store, settings, plan, loop)
    except Exception as error:
        bad = isinstance(error, InputError)
        return Event("failed", cell, None, 0, epochs, message=_summary(error), bad_input=bad)
    on_event(Event("resumed" if plan.row else "started", cell, writer.run_id, loop.epoch, epochs))
    with _beating(writer, settings.heartbeat_seconds):
        try:
            return _train(cell, loop, writer, store.checkpoint_root / writer.run_id, on_event, should_stop)
        except Exception as error:
            with suppress(SsmailError):  # when the store is the obstacle, the first error is the one to tell
                writer.finish(RunState.FAILED, f"{_summary(error)}\n\n{traceback.format_exc()}")
            return Event("failed", cell, writer.run_id, loop.epoch, epochs, message=_summary(error))


def _make_loop(cell: Cell, settings: Settings) -> Any:
    if settings.device.startswith("cuda") and not torch.cuda.is_available():
        raise InputError("this machine offers PyTorch no CUDA device; use --device cpu")
    module, name = settings.loop_factory.split(":")
    return getattr(importlib.import_module(module), name)(cell.spec, cell.seed, settings.device)


def _claim(cell: Cell, store: Store, settings: Settings, plan: Plan, loop: Any) -> RunWriter:
    """Make the run ours, with `loop` in the state of its last checkpoint."""
    stale = settings.stale_seconds
    if plan.row is None:
        return store.start_run(
            cell.spec,
            cell.seed,
            dataset_hash=loop.dataset_hash,
            device=settings.device,
            replace=settings.resume is Resume.NEVER,
            stale_seconds=stale,
        )
    if plan.row.dataset_hash != loop.dataset_hash:
        raise InputError(
            f"the data of run {plan.row.name} has changed since it was interrupted; start afresh with --resume never"
        )
    last = store.checkpoint_root / plan.row.id / LAST
    if last.exists():
        loop.load_state_dict(load_checkpoint(last))
    return store.resume_run(plan.row.id, loop.epoch, stale_seconds=stale)


def _train(
    cell: Cell,
    loop: Any,
    writer: RunWriter,
    folder: Path,
    on_event: Callable[[Event], None],
    should_stop: Callable[[], bool],
) -> Event:
    epochs = cell.spec.epochs
    _keep(writer, loop.snapshot)
    while loop.epoch < epochs:
        if should_stop():
            writer.finish(RunState.INTERRUPTED, f"stopped after epoch {loop.epoch}")
            return Event("interrupted", cell, writer.run_id, loop.epoch, epochs)
        try:
            metrics = loop.run_epoch()
        except Divergence as error:
            _record_checkpoints(writer, folder)
            writer.finish(RunState.DIVERGED, str(error))
            return Event("diverged", cell, writer.run_id, loop.epoch, epochs, message=str(error))
        writer.epoch(loop.epoch, metrics)
        _keep(writer, loop.snapshot)
        if loop.improved:
            save_checkpoint(folder / BEST, loop.best_state_dict())
        save_checkpoint(folder / LAST, loop.state_dict())  # last: a checkpoint never runs ahead of the metrics
        on_event(Event("epoch", cell, writer.run_id, loop.epoch, epochs, metrics))
    metrics, arrays = loop.final_evaluation()
    writer.final(loop.epoch, metrics)
    writer.arrays(arrays)
    _record_checkpoints(writer, folder)
    writer.finish(RunState.FINISHED)
    return Event("finished", cell, writer.run_id, loop.epoch, epochs, metrics)


def _keep(writer: RunWriter, snapshot: Mapping[str, np.ndarray]) -> None:
    """Store the arrays of an epoch, before its checkpoint: after a kill they are computed again, to the same bits."""
    if snapshot:
        writer.arrays(snapshot)


def _record_checkpoints(writer: RunWriter, folder: Path) -> None:
    for name in (BEST, LAST):
        if (folder / name).exists():
            writer.artifact(name, folder / name)


@contextmanager
def _beating(writer: RunWriter, seconds: float) -> Iterator[None]:
    """Send heartbeats from another thread while the block runs, however long one epoch takes."""
    done = threading.Event()

    def beat() -> None:
        while not done.wait(seconds):
            with suppress(SsmailError):  # the training thread meets the same obstacle when it writes, and reports it
                writer.heartbeat()

    thread = threading.Thread(target=beat, name="heartbeat", daemon=True)
    thread.start()
    try:
        yield
    finally:
        done.set()
        thread.join()


def _summary(error: Exception) -> str:
    return str(error) if isinstance(error, SsmailError) else f"{type(error).__name__}: {error}"
