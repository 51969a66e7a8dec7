"""Waiting for the processes of a command that was killed."""

import threading
import time

from ssmail.execution.cells import Cell
from ssmail.execution.local import wait_for_others
from ssmail.store import RunRow, RunState, Store


def test_it_waits_until_a_run_ends_or_falls_silent_and_not_for_ever(store: Store, cells: list[Cell]) -> None:
    told: list[RunRow] = []

    def waited(stale_seconds: float, **limits: float) -> float:
        store.stale_seconds = stale_seconds
        told.clear()
        began = time.monotonic()
        wait_for_others(store, cells[:2], told.append, **limits)
        return time.monotonic() - began

    waited(stale_seconds=60)
    assert told == []
    writer = store.start_run(cells[1].spec, 1, dataset_hash="d" * 64, device="cpu")
    assert waited(stale_seconds=0.5, grace_seconds=60) >= 0.4  # silent
    assert [run.id for run in told] == [writer.run_id]
    assert waited(stale_seconds=60, grace_seconds=-59.5) >= 0.5  # at work: given up
    assert len(told) == 1
    timer = threading.Timer(0.5, writer.finish, (RunState.INTERRUPTED,))
    timer.start()
    waited(stale_seconds=60)
    timer.join()
    assert store.runs()[0].state is RunState.INTERRUPTED
    assert len(told) == 1
