"""A process of test_contention.py; arguments: database, first seed, runs, epochs, seconds to wait for a lock."""

import sys

import numpy as np

from ssmail.config.experiments import build_spec
from ssmail.store import RunState, Store, connection


def main(where: str, first_seed: int, runs: int, epochs: int, busy_seconds: float) -> None:
    connection.BUSY_SECONDS = busy_seconds
    print("ready", flush=True)
    sys.stdin.readline()
    store, spec = Store.open(where), build_spec("ssail", "yjunction", "smoke")
    for seed in range(first_seed, first_seed + runs):
        writer = store.start_run(spec, seed, dataset_hash=None, device="cpu")
        for epoch in range(1, epochs + 1):
            writer.epoch(epoch, {f"metric/{number}": seed + epoch / 1000 + number for number in range(20)})
            writer.heartbeat()
        writer.arrays({"x": np.full(1000, seed)})
        writer.finish(RunState.FINISHED)


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]), int(sys.argv[3]), int(sys.argv[4]), float(sys.argv[5]))
