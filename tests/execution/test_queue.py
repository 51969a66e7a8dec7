"""Cells that wait in the store, and workers that compute them."""

import os
import re
import signal
import threading
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import text

from ssmail.config.experiments import build_spec
from ssmail.execution.cells import Cell, Event, RunSettings
from ssmail.execution.local import run_waiting
from ssmail.execution.sources import QueueSource
from ssmail.store import RunState, Store, queries
from ssmail.store.connection import reading, writing
from ssmail.store.queries import longest_waiting
from ssmail.store.queue import Enqueued
from ssmail.store.validation import sound
from tests.execution.fake_loop import Crashes, Patient, Unsteady, Walk
from tests.execution.fake_worker import fake_worker
from tests.execution.one_cell import run_cell
from tests.execution.recorded import recorded


def add(store: Store, cells: list[Cell]) -> list[Enqueued]:
    return store.queue.add([(cell.spec, cell.seed) for cell in cells])


def work(store: Store, loop: type = Walk, on_event: Any = lambda _: None, **limits: Any) -> tuple[list[Event], bool]:
    source = QueueSource(store, **{"idle_exit": 0, **limits})
    return run_waiting(source, store=store, on_event=on_event, worker=fake_worker(loop))


def states(store: Store) -> dict[int, str]:
    return {row.seed: str(row.state) for row in store.runs()}


def test_what_waits_is_computed_as_train_does(store: Store, cells: list[Cell], tmp_path: Path) -> None:
    assert add(store, cells) == [Enqueued.QUEUED] * 4
    assert add(store, cells) == [Enqueued.WAITING] * 4
    assert {(row.state, row.has_begun) for row in store.runs()} == {(RunState.QUEUED, False)}
    events, stopped = work(store, max_cells=3)
    assert [(event.cell.seed, event.kind) for event in events] == [(0, "finished"), (1, "finished"), (2, "finished")]
    assert not stopped
    assert states(store) == {0: "finished", 1: "finished", 2: "finished", 3: "queued"}
    assert [event.cell.seed for event in work(store)[0]] == [3]
    assert work(store) == ([], False)
    assert add(store, cells) == [Enqueued.STORED] * 4
    other = Store.open(tmp_path / "other.db")
    for cell in cells:
        run_cell(cell, other, RunSettings(), lambda _: None, lambda: False, Walk)
    both = [{row.seed: recorded(one, row.id) for row in one.runs()} for one in (store, other)]
    assert both[0] == both[1]
    assert {row.resumes for row in store.runs()} == {0}
    other.close()


def test_ctrl_c_gives_the_cell_back_and_resuming_it_equals_no_interruption(
    store: Store, cells: list[Cell], tmp_path: Path
) -> None:
    def stop(event: Event) -> None:
        if event.kind == "epoch":
            os.kill(os.getpid(), signal.SIGINT)

    add(store, cells[:2])
    ((event,), stopped) = work(store, Patient, stop)
    assert (event.kind, stopped) == ("interrupted", True)
    assert states(store) == {0: "queued", 1: "queued"}
    seen: list[Event] = []
    work(store, Walk, seen.append)
    assert [event.kind for event in seen if event.kind in ("started", "resumed")] == ["started", "resumed"]
    other = Store.open(tmp_path / "other.db")
    run_cell(cells[0], other, RunSettings(), lambda _: None, lambda: False, Walk)
    assert recorded(store, store.runs()[0].id) == recorded(other, other.runs()[0].id)
    other.close()


def test_when_its_time_is_over_a_worker_gives_its_cell_back(store: Store, cells: list[Cell]) -> None:
    add(store, cells[:1])
    ((event,), stopped) = work(store, Patient, max_hours=8 / 3600, idle_exit=None)
    assert (event.kind, stopped) == ("interrupted", False)
    assert states(store) == {0: "queued"}


def test_what_a_dead_worker_had_waits_again_and_what_a_dead_sweep_had_does_not(store: Store, cells: list[Cell]) -> None:
    add(store, cells[:1])
    (claim,) = store.queue.claim_waiting(lambda *_: 1, set())
    store.start_run(cells[1].spec, 1, dataset_hash=None, device="cpu")
    assert store.queue.claim_waiting(lambda *_: 1, set()) == []  # both are alive
    store.stale_seconds = 0
    (again,) = store.queue.claim_waiting(lambda *_: 1, set())
    assert (again.run_id, again.owner == claim.owner) == (claim.run_id, False)
    assert states(store) == {0: "running", 1: "running"}
    store.mark_stale()
    assert states(store) == {0: "queued", 1: "interrupted"}


def test_a_failure_is_not_tried_again_by_workers(store: Store, cells: list[Cell]) -> None:
    add(store, cells[:2])
    assert [event.kind for event in work(store, Crashes)[0]] == ["finished", "failed"]
    assert work(store, Walk)[0] == []
    assert add(store, cells[:2]) == [Enqueued.STORED, Enqueued.QUEUED]  # but it is on request
    assert [event.kind for event in work(store, Walk)[0]] == ["finished"]


def test_a_cell_that_cannot_begin_fails_by_its_reason(store: Store, cells: list[Cell]) -> None:
    add(store, cells[:2])
    assert [event.kind for event in work(store, Unsteady)[0]] == ["failed", "failed"]
    assert states(store) == {0: "failed", 1: "failed"}
    assert {row.error for row in store.runs()} == {"planted: no such data"}


def test_many_at_once_claim_each_cell_once(store: Store) -> None:
    spec = build_spec("bc", "yjunction", "smoke", [])
    store.queue.add([(spec, seed) for seed in range(40)])
    taken: list[str] = []

    def claim() -> None:
        own = Store.open(store.where)
        while claims := own.queue.claim_waiting(lambda *_: 2, set()):
            taken.extend(item.run_id for item in claims)
        own.close()

    threads = [threading.Thread(target=claim) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert sorted(taken) == sorted(row.id for row in store.runs())
    assert len(taken) == 40


def test_seeds_that_train_together_are_taken_together_but_not_all_by_one(store: Store) -> None:
    spec = build_spec("ssail", "yjunction", "smoke", [])
    store.queue.add([(spec, seed) for seed in range(20)])
    source = QueueSource(store)
    assert [len(source.take(free=4)[0]) for _ in range(3)] == [5, 4, 3]
    assert len(QueueSource(store, max_cells=2).take(free=1)[0]) == 2
    store.queue.add([(spec, seed) for seed in range(20, 40)])
    assert len(source.take(free=1)[0]) == 8


def plan(store: Store, without: set[str]) -> str:
    query = longest_waiting(without).compile(store._engine, compile_kwargs={"literal_binds": True})
    with reading(store._engine) as connection:
        return " ".join(row[3] for row in connection.execute(text(f"EXPLAIN QUERY PLAN {query}")))


def test_a_claim_reads_one_entry_of_an_index_however_many_wait(store: Store, cells: list[Cell]) -> None:
    add(store, cells)
    for without in (set(), {"a" * 32}):
        assert re.fullmatch(r"SEARCH run USING (COVERING )?INDEX run_waiting \(state=\?\)", plan(store, without))
    with writing(store._engine) as connection:
        connection.execute(text("DROP INDEX run_waiting"))
    store.close()  # and what it has prepared
    assert "USE TEMP B-TREE FOR ORDER BY" in plan(store, set())  # negative control: all that wait are sorted


def rows_read(monkeypatch: pytest.MonkeyPatch, work: Any) -> int:
    """How many rows are read and checked while `work` is done."""
    read: list[object] = []
    with monkeypatch.context() as patch:
        patch.setattr(queries, "sound", lambda table, row: read.append(row) or sound(table, row))
        work()
    return len(read)


def test_neither_a_claim_nor_the_end_of_a_run_reads_all_that_wait(
    store: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    spec = build_spec("bc", "yjunction", "smoke", [])
    store.queue.add([(spec, seed) for seed in range(300)])
    for most in (1, 8):
        assert rows_read(monkeypatch, lambda most=most: store.queue.claim_waiting(lambda *_: most, set())) == 2 * most
    one = store.runs()[0].id
    assert rows_read(monkeypatch, lambda: store.still_stored([one])) == 1
    assert rows_read(monkeypatch, lambda: store.queue.contents(limit=5)) == 5
    assert rows_read(monkeypatch, store.queue.contents) == 300  # negative control


def test_many_cells_are_added_in_parts_and_taken_in_their_order(
    store: Store, cells: list[Cell], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(queries, "MOST_AT_ONCE", 2)
    other = build_spec("copy-last", "yjunction", "smoke", [])
    store.start_run(cells[1].spec, 1, dataset_hash=None, device="cpu")
    store.start_run(other, 0, dataset_hash=None, device="cpu").finish(RunState.FINISHED)
    pairs = [(cell.spec, cell.seed) for cell in cells]
    mixed = [pairs[3], (other, 1), pairs[0], (other, 0), pairs[1], pairs[3], pairs[2]]
    waits, runs, ended, anew = Enqueued.WAITING, Enqueued.RUNNING, Enqueued.STORED, Enqueued.QUEUED
    assert store.queue.add(mixed) == [anew, anew, anew, ended, runs, waits, anew]
    assert store.queue.add(mixed) == [waits, waits, waits, ended, runs, waits, waits]
    taken = [store.queue.claim_waiting(lambda *_: 1, set())[0].previous for _ in range(4)]
    assert [(row.method, row.seed) for row in taken if row] == [("bc", 3), ("copy-last", 1), ("bc", 0), ("bc", 2)]


def test_seeds_that_were_computed_otherwise_are_not_taken_with_the_first(store: Store, cells: list[Cell]) -> None:
    add(store, cells[:3])
    store.start_run(cells[1].spec, 1, dataset_hash="d" * 64, device="cpu", repeat=True).finish(RunState.FINISHED)
    claims = store.queue.claim_waiting(lambda *_: 3, set())
    assert [claim.previous.seed for claim in claims if claim.previous] == [0, 2]
    assert sorted(states(store).items()) == [(0, "running"), (1, "finished"), (2, "running")]
    assert len(store.runs()) == 3


def test_a_spec_that_is_left_alone_is_asked_about_once(store: Store, cells: list[Cell]) -> None:
    add(store, cells)
    asked: list[int] = []
    without: set[str] = set()
    for _ in range(2):
        assert store.queue.claim_waiting(lambda row, waiting: asked.append(waiting) or 0, without) == []
    assert (asked, without) == ([4], {cells[0].spec.hash()})


def test_the_contents_of_the_queue_are_what_runs_and_what_comes_next(store: Store, cells: list[Cell]) -> None:
    add(store, cells)
    store.queue.claim_waiting(lambda *_: 2, set())
    found = store.queue.contents(limit=3)
    assert (found.waiting, found.running, found.dead) == (2, 2, 0)
    rows = [(row.seed, str(row.state)) for row in found.rows]
    assert (sorted(rows[:2]), rows[2:]) == ([(0, "running"), (1, "running")], [(2, "queued")])  # claimed at one time
    store.stale_seconds = 1e-6
    found = store.queue.contents(limit=1)
    assert (found.waiting, found.running, found.dead, len(found.rows)) == (2, 0, 2, 1)


def change(store: Store, **columns: object) -> None:
    with writing(store._engine) as connection:
        for name, value in columns.items():
            connection.execute(text(f"UPDATE run SET {name} = :value WHERE seed = 0"), {"value": value})


def test_a_spec_that_does_not_fit_its_hash_is_left_alone(
    store: Store, cells: list[Cell], caplog: pytest.LogCaptureFixture
) -> None:
    add(store, cells[:2])
    change(store, spec_hash="0" * 16)
    assert [event.cell.seed for event in work(store)[0]] == [1]
    assert "its spec is not valid, or does not fit its hash" in caplog.text
    assert states(store) == {0: "queued", 1: "finished"}


def test_a_damaged_row_holds_nobody_up(store: Store, cells: list[Cell]) -> None:
    add(store, cells[:2])
    change(store, spec_json="{}")
    assert [event.cell.seed for event in work(store)[0]] == [1]


def test_code_and_files_of_a_database_need_consent(
    store: Store, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    inside, outside = tmp_path / "inside", tmp_path / "outside.npz"
    inside.mkdir()
    monkeypatch.chdir(inside)
    monkeypatch.delenv("SSMAIL_EXPERIMENTS", raising=False)
    (inside / "mine.py").write_text("def label(alpha):\n    return alpha\n")
    code = build_spec("ssail", "yjunction", "smoke", ["self_supervision.label=mine:label"])
    elsewhere = build_spec("bc", "yjunction", "smoke", [f"data.path={outside}"])
    here = build_spec("bc", "yjunction", "smoke", ["data.path=data.npz"])
    store.queue.add([(code, 0), (elsewhere, 0), (here, 0)])
    assert [event.cell.spec for event in work(store)[0]] == [here]
    assert "names the Python function mine:label@" in caplog.text
    assert "is not in this folder; give --data" in caplog.text
    assert [event.cell.spec for event in work(store, own_files=[outside])[0]] == [elsewhere]
    monkeypatch.setenv("SSMAIL_EXPERIMENTS", str(Path(__file__).parents[2] / "experiments.yaml"))
    assert [event.cell.spec for event in work(store)[0]] == [code]


def test_a_cell_that_waits_counts_only_until_it_has_a_result(store: Store, cells: list[Cell]) -> None:
    """As after a merge: another run of the cell is stored beside the one that waits."""
    add(store, cells[:1])
    writer = store.start_run(cells[0].spec, 0, dataset_hash="d" * 64, device="cpu", repeat=True)
    writer.finish(RunState.FINISHED)
    newest = store.find_cell(cells[0].spec.hash(), 0)
    assert newest is not None
    assert newest.id == writer.run_id
    assert work(store)[0] == []
    assert [row.id for row in store.runs()] == [writer.run_id]
