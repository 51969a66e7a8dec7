"""Waiting for processes that a killed command has left behind."""

import time
from collections.abc import Callable, Iterable

from ssmail.execution.cells import Cell
from ssmail.store import HEARTBEAT_SECONDS, STALE_SECONDS, RunRow, Store, is_alive

_POLL_SECONDS = 0.2


def wait_for_others(
    store: Store,
    cells: Iterable[Cell],
    on_wait: Callable[[RunRow], None],
    stale_seconds: float = STALE_SECONDS,
    grace_seconds: float = HEARTBEAT_SECONDS,
) -> None:
    """Return when no process is computing any of the cells, and in any case after `stale_seconds + grace_seconds`.

    The children of a command that was killed stop after their epoch; killed too, they count as alive until they have
    been silent for `stale_seconds`. Whoever is at work after that belongs to another command, which `run_cells` does
    not put up with. `on_wait` is called once, with a run that is waited for.
    """
    waiting = list(cells)
    deadline = time.monotonic() + stale_seconds + grace_seconds
    told = False
    while True:
        rows = {cell: store.find_cell(cell.spec.hash(), cell.seed) for cell in waiting}
        alive = {cell: row for cell, row in rows.items() if row is not None and is_alive(row, stale_seconds)}
        if not alive or time.monotonic() >= deadline:
            return
        if not told:
            on_wait(next(iter(alive.values())))
            told = True
        waiting = list(alive)
        time.sleep(_POLL_SECONDS)
