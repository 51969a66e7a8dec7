"""A hundred SIGKILLs at random moments: every command, started again, ends as one that nobody disturbed.

Most commands run in a child of this process, with training in it as well, which costs no start; some run as they are,
with workers. SSMAIL_CRASH_SEED repeats a session, as far as the machine is as fast.
"""

import os
import random
import re
import secrets
import shutil
import signal
import subprocess
import sys
import time
import traceback
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from ssmail.config.names import METHODS
from ssmail.execution.cells import Cell, Event, RunSettings
from ssmail.store import Store
from ssmail.store.checkpoint_files import STAGING
from ssmail.store.maintenance.checks import check
from ssmail_cli.main import run
from ssmail_cli.progress import Report
from tests.cli.test_cli_killed import ROOT, children_of
from tests.cli.test_cli_reproduce import needs
from tests.data.mocap.handmade import write_set, write_subject
from tests.execution.one_cell import run_cell
from tests.execution.recorded import recorded
from tests.hostile import harness

pytestmark = pytest.mark.skipif(not hasattr(os, "fork"), reason="needs os.fork")

SEED = int(os.environ.get("SSMAIL_CRASH_SEED", secrets.randbelow(2**32)))
ENVIRONMENTS = ("yjunction", "letters", "mocap")
UNTRAINED = ("constant-velocity", "copy-last")
SMOKE = ("--profile", "smoke", "--device", "cpu")
SHORT = ("--set", "training.epochs=3", "--set", "training.updates=1")
PATIENCE = 90  # seconds for a killed command's workers to end or to count as dead


@dataclass(frozen=True)
class Scenario:
    """A command to kill so many times, in a folder of its own.

    at_once: how often the same command is killed before it may end. prepared: the files of the shelf to copy first.
    made: the file that the command refuses to write again.
    """

    arguments: tuple[Any, ...]
    kills: int
    at_once: int = 1
    prepared: tuple[str, ...] = ()
    made: str | None = None


def training(method: str, environment: str) -> Scenario:
    if environment == "mocap":
        data = ("data.path=../shelf/mocap.npz", "forecast.observed=6", "forecast.predicted=10")
        settings = tuple(part for value in data for part in ("--set", value))
    else:
        settings = ()
    short = () if method in UNTRAINED else SHORT
    command = ("train", "--method", method, "--env", environment, *SMOKE, *short, *settings, "--db", "ssmail.db")
    return Scenario(command, kills=2, at_once=2)


SCENARIOS = {f"train {method} on {where}": training(method, where) for method in METHODS for where in ENVIRONMENTS} | {
    "reproduce": Scenario(
        ("reproduce", *SMOKE, "--seeds", "0-1", "--out", "figures", "--db", "ssmail.db"), kills=10, at_once=5
    ),
    "ablate": Scenario(
        ("ablate", "beta", "--values", "0,0.5", "--seeds", "0", *SMOKE, *SHORT, "--db", "ssmail.db"), kills=6, at_once=3
    ),
    "db merge": Scenario(("db", "merge", "other/ssmail.db", "--db", "ssmail.db"), kills=7, prepared=("other",)),
    "db export": Scenario(
        ("db", "export", "small.db", "--compact", "--db", "other/ssmail.db"), 6, prepared=("other",), made="small.db"
    ),
    "db upgrade": Scenario(("db", "upgrade", "--db", "empty.db"), kills=3, prepared=("empty.db",)),
    "prep-mocap": Scenario(
        ("prep-mocap", "--source", "subject", "--out", "m.npz", "--train", "1-2", "--val", "3", "--test", "4"),
        kills=5,
        prepared=("subject",),
        made="m.npz",
    ),
    "plot": Scenario(
        ("plot", "fig4", "--format", "png", "--format", "svg", "--out", "figures", "--db", "other/ssmail.db"),
        kills=5,
        prepared=("other",),
    ),
    "runs export": Scenario(
        ("runs", "export", "--out", "runs.csv", "--db", "other/ssmail.db"), kills=4, prepared=("other",)
    ),
}
IN_PROCESSES = {False: 5, True: 1}  # kills, by whether the workers are killed as well


def test_there_are_a_hundred_kills() -> None:
    assert sum(scenario.kills for scenario in SCENARIOS.values()) + sum(IN_PROCESSES.values()) == 100


def train_here(cells: Sequence[Cell], *, store_url: str, on_event: Report, device: str, **_: Any) -> list[Event]:
    """Instead of run_cells: compute the cells in this process, where a killed process counts as dead at once."""
    store, settings, events = Store.open(store_url, stale_seconds=0), RunSettings(device), []
    for cell in cells:
        events.append(run_cell(cell, store, settings, on_event, lambda: False))
        on_event(events[-1])
    return events


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder to work in, where figure 4 needs the runs of two methods, the only figure."""
    monkeypatch.chdir(tmp_path)
    needs(monkeypatch, tmp_path, fig4=["bc", "gail"])
    monkeypatch.delenv("SSMAIL_CMU_DIR", raising=False)
    (tmp_path / "shelf").mkdir()
    write_set(tmp_path / "shelf" / "mocap.npz")
    write_subject(tmp_path / "shelf" / "subject", {1: 101, 2: 151, 3: 60, 4: 110})
    (tmp_path / "shelf" / "empty.db").touch()
    monkeypatch.setattr("ssmail.execution.local.run_cells", train_here)
    return tmp_path


def child(folder: Path, arguments: Sequence[Any]) -> int:
    """Begin the command in a child of this process, in the folder; return its id."""
    pid = os.fork()
    if pid:
        return pid
    code = 99
    try:
        os.chdir(folder)
        log = os.open(folder.with_suffix(".log"), os.O_WRONLY | os.O_CREAT | os.O_APPEND)
        os.dup2(log, 1)
        os.dup2(log, 2)
        sys.stdout, sys.stderr = os.fdopen(1, "w", closefd=False), os.fdopen(2, "w", closefd=False)
        code = run([str(argument) for argument in arguments])
    except BaseException:
        traceback.print_exc()
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)


def finish(folder: Path, arguments: Sequence[Any]) -> None:
    """Let the command end, which it must do well."""
    code = os.waitstatus_to_exitcode(os.waitpid(child(folder, arguments), 0)[1])
    assert code == 0, (SEED, code, folder.with_suffix(".log").read_text()[-3000:])


def made_ready(place: Path, name: str, scenario: Scenario) -> Path:
    """A new folder with what the command needs."""
    folder = place / name
    folder.mkdir()
    for item in scenario.prepared:
        if item == "other" and not (place / "shelf" / "other").exists():
            (place / "shelf" / "other").mkdir()
            finish(place / "shelf" / "other", SCENARIOS["reproduce"].arguments)
        source = place / "shelf" / item
        (shutil.copytree if source.is_dir() else shutil.copy)(source, folder / item)
    return folder


def numbers(folder: Path) -> dict[str, Any]:
    """All that a command has left: the files, the text of the CSVs, and what the databases record of each cell."""
    found: dict[str, Any] = {}
    ids: dict[str, str] = {}
    for staging in folder.rglob(f"{STAGING}*"):  # a killed merge leaves it, and `db check` says to remove it so
        shutil.rmtree(staging)
    for path in sorted(folder.rglob("*.db")):
        assert check(path) == [], (SEED, check(path))
        store = Store.open(path)
        rows = store.runs()
        assert len({(row.spec_hash, row.seed) for row in rows}) == len(rows)
        ids |= {row.id: f"{row.spec_hash} {row.seed}" for row in rows}
        name = path.relative_to(folder).as_posix()
        found[name] = {ids[row.id]: (row.state, *recorded(store, row.id)) for row in rows}
        store.close()
    known = re.compile("|".join(ids) or "$^")
    for path in sorted(folder.rglob("*.csv")):
        text = known.sub(lambda run_id: ids[run_id[0]], path.read_text())
        found[path.relative_to(folder).as_posix()] = sorted(re.sub(r",seconds,.*", "", text).splitlines())
    files = (path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file())
    kept = (file for file in files if not file.endswith(("-wal", "-shm")))
    found["files"] = sorted(known.sub(lambda run_id: ids[run_id[0]], file) for file in kept)
    return found


@pytest.mark.crash
@pytest.mark.parametrize("name", SCENARIOS)
def test_killed_and_started_again_it_ends_as_undisturbed(place: Path, name: str) -> None:
    scenario, draw = SCENARIOS[name], random.Random(f"{SEED} {name}")
    print(f"SSMAIL_CRASH_SEED={SEED}")
    calm = made_ready(place, "calm", scenario)
    began = time.monotonic()
    finish(calm, scenario.arguments)
    whole, expected = time.monotonic() - began, numbers(calm)
    hits = 0
    for attempt in range(10 * scenario.kills):
        if hits == scenario.kills:
            break
        folder = made_ready(place, f"disturbed{attempt}", scenario)
        for _ in range(min(scenario.at_once, scenario.kills - hits)):
            process = child(folder, scenario.arguments)
            time.sleep(draw.uniform(0, whole))
            os.kill(process, signal.SIGKILL)
            hits += os.WIFSIGNALED(os.waitpid(process, 0)[1])
        if scenario.made is None or not (folder / scenario.made).exists():
            finish(folder, scenario.arguments)
        assert numbers(folder) == expected, SEED
    assert hits == scenario.kills, SEED
    harness.killed += hits


@pytest.mark.crash
@pytest.mark.parametrize("all_of_them", IN_PROCESSES)
def test_so_does_training_in_processes_of_its_own(place: Path, all_of_them: bool) -> None:
    draw = random.Random(f"{SEED} {all_of_them}")
    print(f"SSMAIL_CRASH_SEED={SEED}")
    arguments = ("train", "--method", "ssail", *SMOKE, "--seeds", "0-1", "--jobs", "2", "--db", "ssmail.db")
    command = [sys.executable, "-m", "ssmail_cli", *arguments]
    path = os.pathsep.join(str(ROOT / part) for part in ("src", "cli"))
    environment = {**os.environ, "PYTHONPATH": path, "OMP_NUM_THREADS": "1"}

    def start(folder: Path) -> "subprocess.Popen[bytes]":
        folder.mkdir(exist_ok=True)
        with folder.with_suffix(".log").open("ab") as log:
            return subprocess.Popen(command, cwd=folder, env=environment, stdout=log, stderr=log)

    began = time.monotonic()
    assert start(place / "calm").wait() == 0, (place / "calm.log").read_text()
    whole, hits = time.monotonic() - began, 0
    while hits < IN_PROCESSES[all_of_them]:
        process = start(place / "disturbed")
        time.sleep(draw.uniform(0.2, 0.8) * whole)
        if process.poll() is None:
            for pid in (process.pid, *(children_of(process.pid) if all_of_them else [])):
                os.kill(pid, signal.SIGKILL)
            hits += 1
        process.wait()
        deadline = time.monotonic() + PATIENCE
        while start(place / "disturbed").wait() != 0 and time.monotonic() < deadline:
            time.sleep(1)  # "is being computed by another process"
        assert numbers(place / "disturbed") == numbers(place / "calm"), (SEED, (place / "disturbed.log").read_text())
        shutil.rmtree(place / "disturbed")
    harness.killed += hits
