"""One cell in this process: what is stored, and that a death at any moment changes no number."""

import errno
import os
import sqlite3
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch

from ssmail.config.experiments import build_spec
from ssmail.data.expert_sets import save
from ssmail.data.yjunction import generate
from ssmail.execution import Resume
from ssmail.execution import run_together as module
from ssmail.execution.cells import Cell, Event, Job, RunSettings
from ssmail.execution.run_together import MakeLoop
from ssmail.store import RunState, RunWriter, Store
from ssmail.training.checkpoint import load_checkpoint, save_checkpoint
from ssmail.training.loop import TrainingLoop
from tests.execution.fake_loop import Crashes, Diverges, OtherData, Walk
from tests.execution.one_cell import run_cell
from tests.execution.recorded import recorded


class Death(BaseException):
    """Stands for SIGKILL: nothing catches it, so nothing is tidied up."""


def run(
    cell: Cell,
    store: Store,
    settings: RunSettings = RunSettings(),  # noqa: B008 - immutable
    stop_after: int | None = None,
    loop: MakeLoop = Walk,
) -> list[Event]:
    """All events of the cell; asks it to stop after that many epochs."""
    events: list[Event] = []

    def should_stop() -> bool:
        return stop_after is not None and bool(events) and events[-1].epoch >= stop_after

    final = run_cell(cell, store, settings, events.append, should_stop, loop)
    return [*events, final]


@pytest.fixture
def undisturbed(tmp_path: Path, cells: list[Cell]) -> tuple[Any, ...]:
    """What an uninterrupted run of the first cell records."""
    store = Store.open(tmp_path / "undisturbed" / "ssmail.db")
    event = run_cell(cells[0], store, RunSettings(), lambda _: None, lambda: False, Walk)
    assert event.run_id is not None
    result = recorded(store, event.run_id)
    store.close()
    return result


def kinds(events: list[Event]) -> list[tuple[str, int]]:
    return [(event.kind, event.epoch) for event in events]


def test_a_cell_is_trained_and_stored(store: Store, cells: list[Cell]) -> None:
    events = run(cells[0], store)
    assert kinds(events) == [("started", 0), ("epoch", 1), ("epoch", 2), ("epoch", 3), ("epoch", 4), ("finished", 4)]
    assert {event.run_id for event in events} == {events[0].run_id}
    assert {event.epochs for event in events} == {4}
    (row,) = store.runs()
    assert (row.state, row.dataset_hash, row.device) == (RunState.FINISHED, "d" * 64, "cpu")
    metrics, arrays, artifacts = recorded(store, row.id)
    for event in events[1:-1]:
        assert {name: metrics[name, event.epoch] for name in event.metrics} == {
            name: repr(value) for name, value in event.metrics.items()
        }
    assert metrics["test/mode_mse", 4] == repr(events[-1].metrics["test/mode_mse"])
    assert arrays.keys() == {"test/rollouts"}
    assert artifacts.keys() == {"best.pt", "last.pt"}


def test_two_seeds_differ_and_one_seed_repeats(store: Store, cells: list[Cell], undisturbed: tuple[Any, ...]) -> None:
    for cell in cells[:2]:
        run(cell, store)
    first, second = (recorded(store, row.id) for row in store.runs())
    assert first == undisturbed
    assert second[0] != undisturbed[0]


MOMENTS: dict[str, tuple[Any, str, int]] = {
    # where the process dies: before the n-th call of this method
    "before the first epoch": (Walk, "run_epoch", 1),
    "before an epoch's metrics": (RunWriter, "epoch", 3),
    "after the metrics, before the best checkpoint": (module, "save_checkpoint", 1),
    "after the metrics, before the last checkpoint": (Walk, "state_dict", 3),
    "between epochs": (Walk, "run_epoch", 4),
    "before the final evaluation": (Walk, "final_evaluation", 1),
    "before the final metrics": (RunWriter, "final", 1),
    "before the arrays": (RunWriter, "arrays", 1),
    "after the last checkpoint, before its record": (RunWriter, "artifact", 3),
    "before the first record": (RunWriter, "artifact", 1),
    "before the artifacts": (RunWriter, "artifact", 5),
    "before the end": (RunWriter, "finish", 1),
}


def die_before(monkeypatch: pytest.MonkeyPatch, owner: Any, name: str, call: int) -> None:
    original: Callable[..., Any] = getattr(owner, name)
    calls = 0

    def counted(*arguments: Any, **named: Any) -> Any:
        nonlocal calls
        calls += 1
        if calls == call:
            raise Death
        return original(*arguments, **named)

    monkeypatch.setattr(owner, name, counted)


@pytest.mark.parametrize("moment", MOMENTS.values(), ids=MOMENTS)
def test_a_death_at_any_moment_changes_no_number(
    store: Store,
    cells: list[Cell],
    undisturbed: tuple[Any, ...],
    monkeypatch: pytest.MonkeyPatch,
    moment: tuple[Any, str, int],
) -> None:
    with monkeypatch.context() as patch:
        die_before(patch, *moment)
        with pytest.raises(Death):
            run(cells[0], store)
    (row,) = store.runs()
    assert row.state is RunState.RUNNING  # the store cannot know yet
    refused = run(cells[0], store)[-1]
    assert (refused.kind, refused.bad_input) == ("failed", True)
    assert "is being computed by another process" in refused.message
    store.stale_seconds = 0
    events = run(cells[0], store)
    assert (events[0].kind, events[-1].kind) == ("resumed", "finished")
    (row,) = store.runs()
    assert (row.state, row.resumes) == (RunState.FINISHED, 1)
    assert recorded(store, row.id) == undisturbed


def test_a_resumed_run_without_its_generator_would_differ(
    store: Store, cells: list[Cell], undisturbed: tuple[Any, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Negative control: the comparison above sees a state that was not restored."""
    run(cells[0], store, stop_after=2)
    load = Walk.load_state_dict

    def forgetful(loop: Walk, state: dict[str, Any]) -> None:
        load(loop, {**state, "generator": loop.generator.get_state()})

    monkeypatch.setattr(Walk, "load_state_dict", forgetful)
    assert run(cells[0], store)[-1].kind == "finished"
    assert recorded(store, store.runs()[0].id)[0] != undisturbed[0]


def test_stopping_interrupts_and_resuming_continues(
    store: Store, cells: list[Cell], undisturbed: tuple[Any, ...]
) -> None:
    events = run(cells[0], store, stop_after=2)
    assert kinds(events) == [("started", 0), ("epoch", 1), ("epoch", 2), ("interrupted", 2)]
    assert store.runs()[0].state is RunState.INTERRUPTED
    events = run(cells[0], store)
    assert kinds(events) == [("resumed", 2), ("epoch", 3), ("epoch", 4), ("finished", 4)]
    assert recorded(store, store.runs()[0].id) == undisturbed


def test_asked_to_stop_at_once_it_leaves_no_run(store: Store, cells: list[Cell]) -> None:
    event = run_cell(cells[0], store, RunSettings(), lambda _: None, lambda: True, Walk)
    assert (event.kind, event.run_id) == ("interrupted", None)
    assert store.runs() == []


def test_a_crash_is_kept_with_its_traceback_and_can_be_resumed(store: Store, cells: list[Cell]) -> None:
    event = run(cells[1], store, loop=Crashes)[-1]
    assert (event.kind, event.epoch, event.message) == ("failed", 1, "ZeroDivisionError: planted")
    assert not event.bad_input
    (row,) = store.runs()
    assert row.state is RunState.FAILED
    assert row.error is not None
    assert row.error.startswith("ZeroDivisionError: planted\n\nTraceback")
    assert "fake_loop.py" in row.error
    assert run(cells[1], store)[0].kind == "resumed"  # once the cause is gone
    (row,) = store.runs()
    assert (row.state, row.error) == (RunState.FINISHED, None)


def test_a_stored_error_shows_no_password(store: Store, cells: list[Cell], monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: Any) -> None:
        raise ConnectionError("postgresql://me:secret@host/name is gone")

    monkeypatch.setattr(Walk, "run_epoch", fail)
    event = run(cells[0], store)[-1]
    (row,) = store.runs()
    assert event.message == "ConnectionError: postgresql://me:***@host/name is gone"
    assert "me:***@host" in str(row.error)
    assert "secret" not in str(row.error)


def test_divergence_ends_a_run_without_final_evaluation(store: Store, cells: list[Cell]) -> None:
    event = run(cells[0], store, loop=Diverges)[-1]
    assert (event.kind, event.epoch, event.message) == ("diverged", 2, "weights became NaN or infinite in epoch 3")
    (row,) = store.runs()
    assert (row.state, row.error) == (RunState.DIVERGED, event.message)
    metrics, arrays, artifacts = recorded(store, row.id)
    assert {step for _, step in metrics} == {1, 2}
    assert arrays == {}
    assert "last.pt" in artifacts
    (again,) = run(cells[0], store, loop=Diverges)
    assert (again.kind, again.message) == ("skipped", f"diverged already, as run {row.name}")


def test_a_finished_cell_is_skipped_unless_begun_afresh(store: Store, cells: list[Cell]) -> None:
    run(cells[0], store)
    (first,) = store.runs()
    for resume in (Resume.AUTO, Resume.REQUIRE):
        (event,) = run(cells[0], store, RunSettings(resume=resume))
        assert (event.kind, event.run_id, event.message) == (
            "skipped",
            first.id,
            f"finished already, as run {first.name}",
        )
    assert run(cells[0], store, RunSettings(resume=Resume.NEVER))[0].kind == "started"
    assert [row.state for row in store.runs()] == [RunState.FINISHED] * 2
    assert store.runs()[0] == first


def test_never_begins_afresh_and_keeps_the_old_run(store: Store, cells: list[Cell]) -> None:
    run(cells[0], store, stop_after=2)
    events = run(cells[0], store, RunSettings(resume=Resume.NEVER))
    assert kinds(events)[0] == ("started", 0)
    assert [row.state for row in store.runs()] == [RunState.INTERRUPTED, RunState.FINISHED]


def test_require_refuses_to_begin(store: Store, cells: list[Cell]) -> None:
    require = RunSettings(resume=Resume.REQUIRE)
    (event,) = run(cells[0], store, require)
    assert (event.kind, event.bad_input) == ("failed", True)
    assert event.message == f"seed 0 of this spec has no run to resume in {store.where}; use --resume auto"
    assert store.runs() == []
    run(cells[0], store, stop_after=1)
    assert kinds(run(cells[0], store, require))[0] == ("resumed", 1)


def test_require_refuses_a_run_without_checkpoint(store: Store, cells: list[Cell]) -> None:
    run(cells[0], store, stop_after=0)
    assert store.runs()[0].state is RunState.INTERRUPTED
    (event,) = run(cells[0], store, RunSettings(resume=Resume.REQUIRE))
    assert (event.kind, event.bad_input) == ("failed", True)
    assert kinds(run(cells[0], store))[0] == ("resumed", 0)


def test_other_data_is_not_mixed_into_a_run(store: Store, cells: list[Cell]) -> None:
    run(cells[0], store, stop_after=1)
    (event,) = run(cells[0], store, loop=OtherData)
    assert event.bad_input
    assert "has changed since it was interrupted; start a new run with --resume never" in event.message
    assert store.runs()[0].state is RunState.INTERRUPTED


def test_a_damaged_checkpoint_is_bad_input_and_leaves_the_run_alone(store: Store, cells: list[Cell]) -> None:
    run(cells[0], store, stop_after=1)
    (before,) = store.runs()
    (recorded,) = store.artifacts(before.id)
    recorded.path.write_bytes(b"nothing")
    (event,) = run(cells[0], store)
    assert event.bad_input
    assert f"{recorded.path} has been altered since it was recorded" in event.message
    assert store.runs() == [before]


def test_a_checkpoint_that_does_not_fit_is_bad_input_and_leaves_the_run_alone(store: Store, tmp_path: Path) -> None:
    cell = Cell(build_spec("bc", "yjunction", "smoke", ["training.epochs=3", "training.updates=1"]), 0)
    run(cell, store, stop_after=1, loop=TrainingLoop)
    (before,) = store.runs()
    (recorded,) = store.artifacts(before.id)
    state = load_checkpoint(recorded.path)
    state["learner"]["optimizer"]["state"][0]["exp_avg"] = torch.zeros(3)
    save_checkpoint(recorded.path, state)
    altered = run(cell, store, loop=TrainingLoop)[-1]
    assert "has been altered since it was recorded" in altered.message
    connection = sqlite3.connect(store.where)  # as one that recorded nothing, or something else
    with connection:
        connection.execute("DELETE FROM artifact")
    connection.close()
    recorded.path.rename(recorded.path.with_name("last.pt"))
    (event,) = run(cell, store, loop=TrainingLoop)
    assert event.bad_input
    assert "last.pt does not fit its run (learner.optimizer.0.exp_avg has another shape or type); sta" in event.message
    assert store.runs() == [before]


def test_the_record_of_a_checkpoint_names_no_file_elsewhere(store: Store, cells: list[Cell], tmp_path: Path) -> None:
    run(cells[0], store, stop_after=1)
    connection = sqlite3.connect(store.where)
    with connection:
        connection.execute("UPDATE artifact SET path = ?", (str(tmp_path / "elsewhere" / "secret.pt"),))
    connection.close()
    save_checkpoint(tmp_path / "elsewhere" / "secret.pt", {})
    (event,) = run(cells[0], store)
    assert event.bad_input
    assert "has its checkpoint recorded in another folder; start afresh" in event.message


def test_a_run_that_has_ended_leaves_only_what_it_recorded(store: Store, cells: list[Cell]) -> None:
    run(cells[0], store, stop_after=2)
    (row,) = store.runs()
    folder = store.checkpoint_root / row.id
    (folder / ".last.pt.1234.partial").write_bytes(b"of a process that was killed")
    run(cells[0], store)
    assert {path.name for path in folder.iterdir()} == {"best.pt", "last.pt"}


def test_a_full_disk_fails_in_a_sentence_and_the_run_can_be_resumed(
    store: Store, cells: list[Cell], undisturbed: tuple[Any, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: Any) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as patch:
        patch.setattr("pathlib.Path.write_bytes", full)
        event = run(cells[0], store)[-1]
    assert event.kind == "failed"
    assert event.message.startswith("cannot write the checkpoint ")
    assert event.message.endswith("(No space left on device); free or choose another place")
    (row,) = store.runs()
    assert row.state is RunState.FAILED
    assert run(cells[0], store)[-1].kind == "finished"
    assert recorded(store, row.id) == undisturbed


def test_a_run_taken_over_stops_without_harm(store: Store, cells: list[Cell], monkeypatch: pytest.MonkeyPatch) -> None:
    step, taken = Walk.run_epoch, []

    def overtaken(loop: Walk) -> dict[str, float]:
        if loop.epoch == 2 and not taken:  # as if this process had slept while another resumed its run
            taken.append(Store.open(store.url, stale_seconds=0).resume_run(store.runs()[0].id, 2))
        return step(loop)

    monkeypatch.setattr(Walk, "run_epoch", overtaken)
    event = run(cells[0], store)[-1]
    assert (event.kind, event.epoch) == ("failed", 3)
    assert "was resumed by another process" in event.message
    (row,) = store.runs()
    assert (row.state, row.resumes) == (RunState.RUNNING, 1)  # the other's, untouched
    taken[0].epoch(3, {"validation/mode_mse": 1.0, "actor/loss": 1.0})


def test_the_heart_beats_within_a_long_epoch(store: Store, cells: list[Cell], monkeypatch: pytest.MonkeyPatch) -> None:
    step, seen = Walk.run_epoch, set()

    def watched(loop: Walk) -> dict[str, float]:
        deadline = time.monotonic() + 20
        while loop.epoch == 0 and len(seen) < 4 and time.monotonic() < deadline:
            seen.add(store.runs()[0].heartbeat)
        return step(loop)

    monkeypatch.setattr(Walk, "run_epoch", watched)
    assert run(cells[0], store, RunSettings(heartbeat_seconds=0.05))[-1].kind == "finished"
    assert len(seen) == 4


def test_cuda_without_a_device_is_bad_input(store: Store, cells: list[Cell], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    (event,) = run(cells[0], store, RunSettings(device="cuda"))
    assert (event.kind, event.bad_input) == ("failed", True)
    assert event.message == "PyTorch finds no CUDA device on this machine; use --device cpu"


def test_jobs_and_events_survive_the_way_between_processes(cells: list[Cell]) -> None:
    job = Job(cells[2].spec, (2, 3), "sqlite:////tmp/a.db", RunSettings(resume=Resume.REQUIRE, heartbeat_seconds=1.5))
    assert Job.from_line(job.as_line()) == job
    assert Job.from_line(job.as_line()).cells == cells[2:]
    event = Event("epoch", cells[2], "abc", 1, 4, {"a": float("inf"), "b": 0.1}, "line\nbreak", True)
    assert Event.from_line(event.as_line(), cells[2].spec) == event
    assert "\n" not in event.as_line()


def test_a_finished_cell_is_skipped_only_while_its_data_file_is_the_same(store: Store, tmp_path: Path) -> None:
    path = tmp_path / "experts.npz"
    spec = build_spec("ssail", "yjunction", "smoke", [f"data.path={path}", "training.epochs=1"])
    save(generate(spec.data.yjunction), path)
    assert run(Cell(spec, 0), store, loop=TrainingLoop)[-1].kind == "finished"
    assert run(Cell(spec, 0), store, loop=TrainingLoop)[-1].kind == "skipped"
    save(generate(spec.data.yjunction.model_copy(update={"seed": 5})), path, force=True)
    (refused,) = run(Cell(spec, 0), store, loop=TrainingLoop)
    assert (refused.kind, refused.bad_input) == ("failed", True)
    assert "has changed since run" in refused.message
    assert run(Cell(spec, 0), store, RunSettings(resume=Resume.NEVER), loop=TrainingLoop)[-1].kind == "finished"
