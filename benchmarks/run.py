"""`make bench`: time the command line, an epoch of training, the store, its queue, the training steps of nri and dnri,
and how training grows with the number of agents.

Training uses one thread.
"""

import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import claiming
import cost_by_agents
import torch
from message_passing import compare
from training_step import report

from ssmail.config.experiments import build_spec
from ssmail.store import Store
from ssmail.training.loop import TrainingLoop


def seconds(work: Callable[[], object], times: int) -> float:
    """Return the median wall-clock seconds of several calls."""
    taken = []
    for _ in range(times):
        begin = time.perf_counter()
        work()
        taken.append(time.perf_counter() - begin)
    return statistics.median(taken)


def help_text() -> float:
    """Time `ssmail --help` in a new process."""
    return cpu_seconds(["--help"], {})


def completion() -> float:
    """Time the completion of keys after --set in a new process, as bash asks for it."""
    words = {"COMP_WORDS": "ssmail train --set sac.", "COMP_CWORD": "3"}
    return cpu_seconds([], {"_SSMAIL_COMPLETE": "complete_bash", **words})


def cpu_seconds(arguments: list[str], environment: dict[str, str]) -> float:
    """Return the median CPU time of `ssmail` in a new process."""
    taken = []
    for _ in range(9):
        before = os.times()
        subprocess.run(
            [sys.executable, "-m", "ssmail_cli", *arguments],
            env={**os.environ, **environment},
            capture_output=True,
            check=True,
        )
        after = os.times()
        taken.append(after.children_user + after.children_system - before.children_user - before.children_system)
    return statistics.median(taken)


def epoch() -> float:
    """Time an epoch of the profile quick, evaluation included. The first epoch does not count."""
    loop = TrainingLoop(build_spec("ssail", "yjunction", "quick"), seed=0)
    loop.run_epoch()
    return seconds(loop.run_epoch, 5)


def stored_epoch() -> float:
    """Time writing the 25 metrics of an epoch to SQLite."""
    with tempfile.TemporaryDirectory() as folder:
        store = Store.open(Path(folder) / "ssmail.db")
        writer = store.start_run(build_spec("ssail", "yjunction", "quick"), 0, dataset_hash=None, device="cpu")
        steps = iter(range(1, 1000))
        metrics = {f"metric/{number}": float(number) for number in range(25)}
        return seconds(lambda: writer.epoch(next(steps), metrics), 200)


if __name__ == "__main__":
    torch.set_num_threads(1)
    for name, measure in (
        ("ssmail --help", help_text),
        ("completion", completion),
        ("epoch (quick)", epoch),
        ("stored epoch", stored_epoch),
    ):
        print(f"{name:<16}{measure():9.4f} s", flush=True)
    claiming.report()
    compare()
    report(["authors", "quick"])
    cost_by_agents.report(Path("build"))
