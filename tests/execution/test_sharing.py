"""One sweep in several processes: each cell once, and what a process leaves is taken over."""

import os
import re
import signal
import subprocess
import sys
from collections import Counter
from datetime import timedelta
from pathlib import Path
from typing import Any

import pytest

from ssmail.execution.cells import Cell, Event, RunSettings
from ssmail.execution.local import run_cells
from ssmail.store import RunState, Store, queries
from tests.cli.test_cli_killed import children_of
from tests.execution.fake_loop import Unsteady, Walk
from tests.execution.fake_worker import fake_worker
from tests.execution.one_cell import run_cell
from tests.execution.recorded import recorded

PARENT = Path(__file__).parent / "parent.py"
TEN_MINUTES = timedelta(minutes=10)
Parent = subprocess.Popen[str]


def start(store: Store, loop: str, seeds: int, jobs: int = 1, stale_seconds: float = 30) -> Parent:
    return subprocess.Popen(
        [sys.executable, str(PARENT), store.where, loop, str(seeds), str(jobs)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        env={**os.environ, "SSMAIL_STALE_SECONDS": str(stale_seconds)},
    )


def read_until(process: Parent, pattern: str) -> None:
    assert process.stdout is not None
    while not re.fullmatch(pattern, (said := process.stdout.readline()).strip()):
        assert said, f"the process ended before saying {pattern!r}"


def outcome(process: Parent) -> list[str]:
    """What it said, after it has ended well."""
    said, complaints = process.communicate(timeout=300)
    assert (process.returncode, complaints) == (0, "")
    return said.splitlines()


def kill_with_children(process: Parent) -> None:
    for pid in (process.pid, *children_of(process.pid)):
        os.kill(pid, signal.SIGKILL)
    process.communicate()


def results(store: Store) -> dict[int, Any]:
    rows = store.runs()
    assert len({row.seed for row in rows}) == len(rows)
    return {row.seed: recorded(store, row.id) for row in rows}


@pytest.fixture
def alone(cells: list[Cell], tmp_path: Path) -> dict[int, Any]:
    """What a single process records of the cells."""
    store = Store.open(tmp_path / "alone.db")
    for cell in cells:
        run_cell(cell, store, RunSettings(), lambda _: None, lambda: False, Walk)
    found = results(store)
    store.close()
    return found


def test_three_processes_compute_each_cell_once_and_all_end_when_all_cells_have(
    store: Store, alone: dict[int, Any]
) -> None:
    processes = [start(store, "Walk", seeds=4) for _ in range(3)]
    said = [outcome(process) for process in processes]
    began = Counter(line for lines in said for line in lines if "started" in line)
    assert began == {f"{seed} started 0": 1 for seed in range(4)}
    for lines in said:
        assert set(lines[-1].split()[1:]) <= {"finished", "skipped"}
    for seed in range(4):  # computed by one of them, skipped by two
        assert sorted(lines[-1].split()[1 + seed] for lines in said) == ["finished", "skipped", "skipped"]
    assert {row.resumes for row in store.runs()} == {0}
    assert results(store) == alone
    assert alone[0] != alone[1]


def test_the_cell_of_a_killed_process_is_taken_over_from_its_checkpoint(
    store: Store, cells: list[Cell], alone: dict[int, Any]
) -> None:
    first = start(store, "Stuck", seeds=1, stale_seconds=5)
    read_until(first, "0 epoch 1")
    second = start(store, "Walk", seeds=4, stale_seconds=5)
    read_until(second, "0 elsewhere 0")
    kill_with_children(first)
    said = outcome(second)
    assert "0 resumed 1" in said
    assert said[-1] == "returned finished finished finished finished"
    assert {row.seed: row.resumes for row in store.runs()} == {0: 1, 1: 0, 2: 0, 3: 0}
    assert results(store) == alone


def test_what_ctrl_c_leaves_is_continued_by_the_other_process_at_once(store: Store, alone: dict[int, Any]) -> None:
    first = start(store, "Patient", seeds=4)
    read_until(first, "0 epoch 1")
    second = start(store, "Walk", seeds=4, stale_seconds=3600)  # it does not wait for silence
    read_until(second, "0 elsewhere 0")
    os.kill(first.pid, signal.SIGINT)
    assert "interrupted" in outcome(first)[-1]
    assert outcome(second)[-1] == "returned finished finished finished finished"
    assert results(store) == alone


def test_a_failure_is_not_repeated_by_those_who_saw_the_cell_begin_elsewhere(store: Store, cells: list[Cell]) -> None:
    writer = store.start_run(cells[1].spec, 1, dataset_hash="d" * 64, device="cpu")
    events: list[Event] = []

    def on_event(event: Event) -> None:
        events.append(event)
        if event.kind == "elsewhere":
            writer.finish(RunState.FAILED, "ZeroDivisionError: planted\n\nTraceback")

    (final,) = run_cells(cells[1:2], store_url=store.url, on_event=on_event, worker=fake_worker(Walk))
    assert [event.kind for event in events] == ["elsewhere", "failed"]
    assert final.message.endswith(f"as run {writer.run_id[:8]}: ZeroDivisionError: planted")
    (final,) = run_cells(cells[1:2], store_url=store.url, on_event=on_event, worker=fake_worker(Walk))
    assert (final.kind, final.run_id) == ("finished", writer.run_id)  # a failure from before is tried again


def test_a_cell_that_cannot_begin_leaves_nothing(store: Store, cells: list[Cell]) -> None:
    with pytest.raises(Exception, match="planted: no such data"):
        run_cells(cells, store_url=store.url, on_event=lambda _: None, jobs=2, worker=fake_worker(Unsteady))
    assert store.runs() == []
    writer = store.start_run(cells[0].spec, 0, dataset_hash="d" * 64, device="cpu")
    writer.finish(RunState.INTERRUPTED, "before")
    with pytest.raises(Exception, match="planted: no such data"):
        run_cells(cells[:1], store_url=store.url, on_event=lambda _: None, worker=fake_worker(Unsteady))
    (row,) = store.runs()
    assert (row.state, row.error, row.resumes) == (RunState.INTERRUPTED, "before", 0)


def test_silence_is_judged_by_the_clock_of_the_database(
    store: Store, cells: list[Cell], monkeypatch: pytest.MonkeyPatch
) -> None:
    """As on a server whose clock is ten minutes ahead of this machine's."""
    real = queries.clock
    with monkeypatch.context() as patch:
        patch.setattr(queries, "clock", lambda connection: real(connection) + TEN_MINUTES)
        store.start_run(cells[0].spec, 0, dataset_hash=None, device="cpu")
        (row,) = store.runs()
        assert store.is_alive(row)
        assert store.mark_stale() == []
        assert store.queue.claim([(cells[0].spec, 0)], lambda _: True) == [row]
    assert not store.is_alive(row)  # by this machine's


@pytest.mark.slow
def test_six_terminals_of_which_three_are_killed(store: Store, tmp_path: Path) -> None:
    """The command itself, with real training; the others compute everything, as one undisturbed command does."""
    command = [sys.executable, "-m", "ssmail_cli", "train", "bc", "ssail", "--profile", "smoke", "--seeds", "0-4"]
    environment = {**os.environ, "SSMAIL_STALE_SECONDS": "20", "OMP_NUM_THREADS": "1"}

    def terminal(database: str, name: str) -> "subprocess.Popen[bytes]":
        with (tmp_path / f"{name}.log").open("wb") as log:
            words = [*command, "--device", "cpu", "--db", database]
            return subprocess.Popen(words, env=environment, cwd=tmp_path, stdout=log, stderr=log)

    calm = Store.open(tmp_path / "calm.db")
    assert terminal(calm.where, "calm").wait() == 0, (tmp_path / "calm.log").read_text()
    terminals = [terminal(store.where, f"terminal {number}") for number in range(6)]
    killed = 0
    while killed < 3:
        for process in terminals[:3]:
            log = tmp_path / f"terminal {terminals.index(process)}.log"
            if process.poll() is None and "started" in log.read_text():
                kill_all(process)
                killed += 1
            assert process.poll() in (None, -signal.SIGKILL), "it ended before it could be killed"
    for number, process in enumerate(terminals[3:], start=3):
        assert process.wait() == 0, (tmp_path / f"terminal {number}.log").read_text()
    by_cell = [{(row.method, row.seed): recorded(one, row.id) for row in one.runs()} for one in (store, calm)]
    assert len(store.runs()) == len(calm.runs()) == 10
    assert by_cell[0] == by_cell[1]
    assert any(row.resumes for row in store.runs())  # the kills hit something


def kill_all(process: "subprocess.Popen[bytes]") -> None:
    for pid in (process.pid, *children_of(process.pid)):
        os.kill(pid, signal.SIGKILL)
    process.wait()
