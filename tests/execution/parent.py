"""A program that computes cells, to be sent signals: python parent.py DATABASE LOOP SEEDS JOBS; prints its events."""

import sys

from ssmail.config.experiments import build_spec
from ssmail.execution.local import Cell, Event, run_cells


def tell(event: Event) -> None:
    print(event.cell.seed, event.kind, event.epoch, flush=True)


if __name__ == "__main__":
    where, loop, seeds, jobs = sys.argv[1:]
    spec = build_spec("ssail", "yjunction", "smoke", ["training.epochs=4"])
    cells = [Cell(spec, seed) for seed in range(int(seeds))]
    events = run_cells(
        cells, store_url=where, on_event=tell, jobs=int(jobs), loop_factory=f"tests.execution.fake_loop:{loop}"
    )
    print("returned", *(event.kind for event in events), flush=True)
