"""Cells in processes of their own: side by side, crashing, killed, interrupted, orphaned."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pytest

from ssmail.errors import InputError
from ssmail.execution import Resume
from ssmail.execution.cells import Cell, Event, RunSettings
from ssmail.execution.local import run_cells
from ssmail.store import RunState, Store
from tests.execution.fake_loop import Accidents, Chatty, Endless, Patient, Slow, Walk
from tests.execution.fake_worker import fake_worker
from tests.execution.one_cell import run_cell
from tests.execution.recorded import recorded

PARENT = Path(__file__).parent / "parent.py"


def compute(
    store: Store, cells: Sequence[Cell], loop: type, meanwhile: Callable[[Event], None] = lambda _: None, **how: Any
) -> tuple[list[Event], list[Event]]:
    """Final events, and all events but those of processes that are loading."""
    events: list[Event] = []

    def on_event(event: Event) -> None:
        if event.kind != "loading":
            events.append(event)
            meanwhile(event)

    final = run_cells(cells, store_url=store.url, on_event=on_event, worker=fake_worker(loop), **how)
    return final, events


def undisturbed(cell: Cell, folder: Path) -> tuple[Any, ...]:
    """What an uninterrupted run of the cell records."""
    store = Store.open(folder / f"undisturbed_{cell.seed}.db")
    event = run_cell(cell, store, RunSettings(), lambda _: None, lambda: False, Walk)
    assert event.run_id is not None
    result = recorded(store, event.run_id)
    store.close()
    return result


def test_accidents_leave_other_cells_alone_and_can_be_resumed(store: Store, cells: list[Cell], tmp_path: Path) -> None:
    final, events = compute(store, cells, Accidents, jobs=2)
    assert [(event.cell.seed, event.kind, event.epoch, event.message) for event in final] == [
        (0, "finished", 4, ""),
        (1, "failed", 1, "ZeroDivisionError: planted"),
        (2, "failed", 1, "its process was killed by SIGKILL"),
        (3, "failed", 1, "its process ended with exit code 7: out of luck"),
    ]
    rows = {row.id: row for row in store.runs()}
    for cell, last in zip(cells, final, strict=True):
        of_cell = [event for event in events if event.cell == cell]
        assert [event.kind for event in of_cell] == ["started", *["epoch"] * last.epoch, last.kind]
        assert last.run_id is not None
        assert {event.run_id for event in of_cell} == {last.run_id}
        assert rows[last.run_id].state == last.kind
        assert (rows[last.run_id].error or "").startswith(last.message)
    first_end = next(index for index, event in enumerate(events) if event.is_final)
    assert {event.cell.seed for event in events[:first_end]} <= {0, 1}  # at most two at once

    killed = final[2].run_id
    final, events = compute(store, cells[::2], Walk)  # at once, not only when the killed run counts as silent
    assert [event.kind for event in events] == ["skipped", "resumed", "epoch", "epoch", "epoch", "finished"]
    assert final[1].run_id == killed
    assert recorded(store, final[0].run_id) == undisturbed(cells[0], tmp_path)
    assert recorded(store, killed) == undisturbed(cells[2], tmp_path)


def test_a_process_is_loading_until_its_run_begins(store: Store, cells: list[Cell]) -> None:
    events: list[Event] = []
    run_cells(cells[:1], store_url=store.url, on_event=events.append, worker=fake_worker(Walk))
    assert [(event.kind, event.run_id is None) for event in events[:2]] == [("loading", True), ("started", False)]
    events.clear()
    run_cells(cells[:1], store_url=store.url, on_event=events.append, worker=fake_worker(Walk))
    assert [event.kind for event in events] == ["skipped"]  # which needs no process


def test_two_processes_at_once_of_one_thread_each_may_print_what_they_like(
    store: Store, cells: list[Cell], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MEETING_PLACE", str(tmp_path))
    final, events = compute(store, cells[:2], Chatty, jobs=2)
    assert [event.kind for event in final] == ["finished", "finished"]
    epochs = [event for event in events if event.kind == "epoch"]
    assert [event.metrics["threads"] for event in epochs] == [1] * 8
    assert [event.metrics["met"] for event in epochs] == [1] * 8


def test_sigterm_interrupts_and_resuming_equals_an_undisturbed_run(
    store: Store, cells: list[Cell], tmp_path: Path
) -> None:
    def stop(event: Event) -> None:
        if event.kind == "epoch":
            os.kill(os.getpid(), signal.SIGTERM)

    before = signal.getsignal(signal.SIGTERM)
    final, _ = compute(store, cells[:2], Patient, stop, jobs=1)
    assert [event.kind for event in final] == ["interrupted", "interrupted"]
    assert final[0].epoch in (1, 2)  # at the end of an epoch, whichever it was in when it heard of the signal
    assert final[1].run_id is None  # the second cell never began
    (row,) = store.runs()
    assert row.state is RunState.INTERRUPTED
    assert signal.getsignal(signal.SIGTERM) is before
    (resumed,), events = compute(store, cells[:1], Walk)
    assert (events[0].kind, events[0].epoch) == ("resumed", final[0].epoch)
    assert resumed.kind == "finished"
    assert recorded(store, row.id) == undisturbed(cells[0], tmp_path)


def test_a_second_ctrl_c_kills(store: Store, cells: list[Cell]) -> None:
    def stop(event: Event) -> None:
        if event.kind == "started":
            os.kill(os.getpid(), signal.SIGINT)
            os.kill(os.getpid(), signal.SIGINT)

    (event,), _ = compute(store, [cells[0]], Endless, stop)
    assert (event.kind, event.message) == ("interrupted", "its process was killed by SIGKILL")
    assert store.runs()[0].state is RunState.INTERRUPTED


def start_parent(store: Store, loop: str, seeds: int, jobs: int) -> "subprocess.Popen[str]":
    command = [sys.executable, str(PARENT), store.where, loop, str(seeds), str(jobs)]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True)


def read_until(process: "subprocess.Popen[str]", line: str) -> None:
    assert process.stdout is not None
    while (said := process.stdout.readline()) != f"{line}\n":
        assert said, f"the parent ended before saying {line!r}"


def test_ctrl_c_on_the_whole_group_interrupts_every_cell(store: Store, cells: list[Cell]) -> None:
    """A terminal sends SIGINT to every process of the foreground group."""
    parent = start_parent(store, "Patient", seeds=3, jobs=2)
    read_until(parent, "0 epoch 1")
    os.killpg(parent.pid, signal.SIGINT)
    said, complaints = parent.communicate()
    assert said.endswith("returned interrupted interrupted interrupted\n")
    assert (complaints, parent.returncode) == ("", 0)
    assert {row.state for row in store.runs()} == {RunState.INTERRUPTED}


def test_children_of_a_killed_parent_interrupt_themselves(store: Store, cells: list[Cell]) -> None:
    parent = start_parent(store, "Patient", seeds=1, jobs=1)
    read_until(parent, "0 epoch 1")
    os.killpg(parent.pid, signal.SIGKILL)
    parent.communicate()
    deadline = time.monotonic() + 300
    while store.runs()[0].state is RunState.RUNNING and time.monotonic() < deadline:
        time.sleep(0.1)
    (row,) = store.runs()
    assert row.state is RunState.INTERRUPTED
    assert row.error is not None
    assert row.error.startswith("stopped after epoch")  # by itself, not given up as silent


def test_a_new_run_of_a_cell_in_other_hands_is_refused_before_anything_starts(store: Store, cells: list[Cell]) -> None:
    store.start_run(cells[2].spec, 2, dataset_hash=None, device="cpu")
    with pytest.raises(InputError, match="seed 2 of this spec is being computed by another process"):
        compute(store, cells, Walk, resume=Resume.NEVER)
    assert [row.seed for row in store.runs()] == [2]


def test_nothing_to_resume_is_refused_before_anything_starts(store: Store, cells: list[Cell]) -> None:
    with pytest.raises(InputError, match="seed 0 of this spec has no run to resume"):
        compute(store, cells, Walk, resume=Resume.REQUIRE)
    assert store.runs() == []


def test_input_that_no_process_can_begin_with_is_raised(store: Store, cells: list[Cell]) -> None:
    writer = store.start_run(cells[0].spec, 0, dataset_hash="d" * 64, device="cpu")
    writer.finish(RunState.INTERRUPTED)
    checkpoint = store.checkpoint_root / writer.run_id / "last.pt"
    checkpoint.parent.mkdir(parents=True)
    checkpoint.write_bytes(b"nothing")
    with pytest.raises(InputError, match=r"last\.pt cannot be read"):
        compute(store, cells[:2], Walk)
    assert len(store.runs()) == 1


def test_a_run_that_is_deleted_or_whose_database_is_removed_has_not_finished(store: Store, cells: list[Cell]) -> None:
    def disturb(event: Event) -> None:
        if event.kind == "epoch" and event.epoch == 1 and event.cell.seed == 0:
            for path in Path(store.where).parent.glob(f"{Path(store.where).name}*"):
                path.unlink()

    final, events = compute(store, cells[:2], Slow, disturb)
    assert [(event.kind, event.cell.seed) for event in final] == [("failed", 0), ("finished", 1)]
    assert not any(event.kind == "finished" and event.cell.seed == 0 for event in events)
    assert [row.seed for row in Store.open(store.where).runs()] == [1]
