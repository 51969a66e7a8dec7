"""A reproduction that is killed again and again ends as one that nobody disturbed."""

import os
import random
import re
import signal
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pytest

from ssmail.execution.cells import Cell, Event, RunSettings
from ssmail.store import Store
from ssmail.store.maintenance.checks import check
from ssmail_cli.progress import Report
from tests.cli.command_line import CommandLine
from tests.cli.test_cli_reproduce import needs
from tests.execution.fake_loop import Driver
from tests.execution.one_cell import run_cell

ROOT = Path(__file__).parents[2]
DRAW = random.Random(6)
NAMES = ("disturbed", "calm")


def figures(folder: Path, db: Path | str) -> Mapping[str, str]:
    """The CSV of each figure, with the spec and seed of each run in place of its id."""
    runs = {run.id: f"{run.spec_hash} {run.seed}" for run in Store.open(db).runs()}
    tables = {path.name: path.read_text() for path in folder.glob("*.csv")}
    return {name: re.sub(r"\b[0-9a-f]{32}\b", lambda found: runs[found[0]], text) for name, text in tables.items()}


def compare(disturbed: Mapping[str, str], calm: Mapping[str, str], count: int) -> None:
    assert len(calm) == count
    assert all(text.count("\n") > 3 for text in calm.values())
    assert disturbed == calm


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs os.fork")
def test_killed_ten_times_with_training_that_takes_no_time(
    cli: CommandLine, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def run_cells(cells: Sequence[Cell], *, store_url: str, on_event: Report, device: str, **_: Any) -> list[Event]:
        store, settings = Store.open(store_url, stale_seconds=0), RunSettings(device)
        return [run_cell(cell, store, settings, on_event, lambda: False, Driver) for cell in cells]

    monkeypatch.chdir(tmp_path)
    needs(monkeypatch, tmp_path, fig4=["ssail", "gail", "wail"])
    monkeypatch.setattr("ssmail.execution.local.run_cells", run_cells)

    def reproduce(folder: str) -> int:
        out = tmp_path / folder
        arguments = ("--profile", "smoke", "--device", "cpu", "--seeds", "0-3", "--out", out / "figures")
        return cli("reproduce", *arguments, "--db", out / "ssmail.db").code

    began = time.monotonic()
    assert reproduce("calm") == 0
    whole = time.monotonic() - began
    killed = 0
    for _ in range(10):
        child = os.fork()
        if child == 0:
            try:
                reproduce("disturbed")
            finally:
                os._exit(0)
        time.sleep(DRAW.uniform(0, 0.3 * whole))
        os.kill(child, signal.SIGKILL)
        killed += os.WIFSIGNALED(os.waitpid(child, 0)[1])
    assert killed > 1
    assert reproduce("disturbed") == 0
    compare(*(figures(tmp_path / name / "figures", tmp_path / name / "ssmail.db") for name in NAMES), count=1)
    assert check(tmp_path / "disturbed" / "ssmail.db") == []
    assert (tmp_path / "disturbed" / "report.html").exists()


@pytest.mark.slow
def test_a_smoke_killed_ten_times(tmp_path: Path) -> None:
    walking = Path(os.environ.get("SSMAIL_CMU_DIR", ""))
    environment = {**os.environ, "PYTHONPATH": f"{ROOT / 'src'}:{ROOT / 'cli'}", "OMP_NUM_THREADS": "1"}
    environment.pop("SSMAIL_DB", None)
    command = [sys.executable, "-m", "ssmail_cli", "reproduce", "--profile", "smoke", "--seeds", "0"]
    nine = "SSMAIL_CMU_DIR" in os.environ and walking.is_dir()

    def start(folder: str) -> "subprocess.Popen[bytes]":
        (tmp_path / folder).mkdir(exist_ok=True)
        with (tmp_path / f"{folder}.log").open("ab") as log:
            return subprocess.Popen(command, cwd=tmp_path / folder, env=environment, stdout=log, stderr=log)

    began = time.monotonic()
    assert start("calm").wait() == (0 if nine else 3), (tmp_path / "calm.log").read_text()
    whole = time.monotonic() - began
    for kill in range(10):
        process = start("disturbed")
        time.sleep(DRAW.uniform(0, whole / 7))  # the tenth comes before it has ended
        assert process.poll() is None, (tmp_path / "disturbed.log").read_text()
        children = children_of(process.pid) if kill % 3 == 0 else []  # else they find out and end by themselves
        for pid in (process.pid, *children):
            os.kill(pid, signal.SIGKILL)
        process.wait()
    assert start("disturbed").wait() == (0 if nine else 3), (tmp_path / "disturbed.log").read_text()
    found = [figures(tmp_path / name / "results/figures", tmp_path / name / "results/ssmail.db") for name in NAMES]
    compare(*found, count=9 if nine else 7)
    assert check(tmp_path / "disturbed/results/ssmail.db") == []
    assert (tmp_path / "disturbed/results/report.html").exists()


def children_of(parent: int) -> list[int]:
    """The processes that a process has started and that still run."""
    return [int(pid) for pid in Path(f"/proc/{parent}/task/{parent}/children").read_text().split()]
