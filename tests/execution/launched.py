"""The command line in a process of its own, and the numbers of a sweep, for the tests of launchers."""

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

from ssmail.store import Store
from tests.cli.command_line import Outcome
from tests.execution.recorded import recorded

SWEEP = ("train", "bc", "ssail", "--profile", "smoke", "--seeds", "0-1")
LONG = ("train", "bc", "--profile", "smoke", "--seeds", "0-2", "--set", "training.epochs=120")
SLURM = ("--launcher", "slurm", "--launcher-set", "partition=main,time=120")
Numbers = dict[tuple[str, int], Any]


class FrontEnd:
    """A command in a process of its own, whose folder is that of its database."""

    def __init__(self, folder: Path, *words: str, **environment: str) -> None:
        folder.mkdir(exist_ok=True)
        self._log = folder / "stderr.log"
        with self._log.open("wb") as log:
            self.process = subprocess.Popen(
                [sys.executable, "-m", "ssmail_cli", *words, "--device", "cpu"],
                env={**os.environ, "SSMAIL_STALE_SECONDS": "10", **environment},
                cwd=folder,
                stdout=subprocess.PIPE,
                stderr=log,
                text=True,
            )

    def wait_for(self, text: str) -> None:
        while text not in self._log.read_text():
            assert self.process.poll() is None, f"ended before it said {text!r}: {self._log.read_text()}"

    def end(self) -> Outcome:
        said, _ = self.process.communicate(timeout=400)
        return Outcome(self.process.returncode, said, self._log.read_text())


def numbers(folder: Path, database: str | None = None) -> Numbers:
    """What the runs recorded, by method and seed; each cell has one."""
    store = Store.open(database or folder / "results" / "ssmail.db")
    rows = store.runs()
    assert len(rows) == len({(row.method, row.seed) for row in rows})
    found = {(row.method, row.seed): recorded(store, row.id) for row in rows}
    store.close()
    return found


def computed_locally(folder: Path, sweep: tuple[str, ...]) -> Numbers:
    outcome = FrontEnd(folder, *sweep, "--jobs", "2").end()
    assert outcome.code == 0, outcome.err
    found = numbers(folder)
    assert found["bc", 0] != found["bc", 1]
    return found
