"""A program that computes cells, to be sent signals: python parent.py DATABASE LOOP SEEDS JOBS; prints its events."""

import sys

from ssmail.config.experiments import build_spec
from ssmail.execution.cells import Cell, Event
from ssmail.execution.local import run_cells
from tests.execution import fake_loop
from tests.execution.fake_worker import fake_worker


def tell(event: Event) -> None:
    print(event.cell.seed, event.kind, event.epoch, flush=True)


if __name__ == "__main__":
    where, loop, seeds, jobs = sys.argv[1:]
    spec = build_spec("bc", "yjunction", "smoke", ["training.epochs=4"])  # each seed has a process of its own
    cells = [Cell(spec, seed) for seed in range(int(seeds))]
    worker = fake_worker(getattr(fake_loop, loop))
    events = run_cells(cells, store_url=where, on_event=tell, jobs=int(jobs), worker=worker)
    print("returned", *(event.kind for event in events), flush=True)
