"""The life of runs: begun, written, ended, resumed, given up, deleted."""

import dataclasses
import math
import sqlite3
import time
from collections.abc import Callable
from datetime import UTC, datetime, timedelta

import numpy as np
import pytest

from ssmail.config.spec import RunSpec
from ssmail.errors import InputError, SsmailError
from ssmail.store import RunRow, RunState, RunWriter, Store

STORED_TIME = "%Y-%m-%d %H:%M:%S.%f"
NOT_FINITE = {"nan": math.nan, "up": math.inf, "down": -math.inf}


def only(store: Store) -> RunRow:
    (row,) = store.runs()
    return row


def values(store: Store, run_id: str) -> dict[tuple[str, int], float]:
    frame = store.metrics([run_id])
    return {(name, step): value for name, step, value in zip(frame["name"], frame["step"], frame["value"], strict=True)}


def test_a_new_run_says_what_it_is_and_where_it_is_computed(store: Store, spec: RunSpec, writer: RunWriter) -> None:
    row = only(store)
    assert (row.id, row.name) == (writer.run_id, writer.run_id[:8])
    assert (row.method, row.environment, row.profile, row.seed) == ("ssail", "yjunction", "smoke", 0)
    assert row.spec == spec.model_dump(mode="json")
    assert (row.spec_hash, row.dataset_hash, row.device) == (spec.hash(), "d" * 64, "cpu")
    assert (row.state, row.error, row.finished, row.resumes) == (RunState.RUNNING, None, None, 0)
    assert abs((datetime.now(UTC) - row.started).total_seconds()) < 60
    assert row.torch_version.startswith("2.")
    assert row.host
    with pytest.raises(dataclasses.FrozenInstanceError):
        row.seed = 1  # type: ignore[misc]


def test_metrics_come_back_with_nan_and_infinities(store: Store, writer: RunWriter) -> None:
    writer.epoch(1, {"loss": 0.5, **NOT_FINITE})
    writer.epoch(2, {"loss": 1e-300})
    frame = store.metrics([writer.run_id])
    assert list(frame.columns) == ["run_id", "seed", "name", "step", "value"]
    assert set(frame["run_id"]) == {writer.run_id}
    assert set(frame["seed"]) == {0}
    found = values(store, writer.run_id)
    assert math.isnan(found.pop(("nan", 1)))
    assert found == {("loss", 1): 0.5, ("loss", 2): 1e-300, ("up", 1): math.inf, ("down", 1): -math.inf}


def test_the_column_kind_is_what_saves_nan(store: Store, writer: RunWriter) -> None:
    """Negative control: SQLite itself keeps no NaN, so without `kind` it would be lost."""
    writer.epoch(1, NOT_FINITE)
    with sqlite3.connect(store.where) as connection:
        assert connection.execute("SELECT ?", (math.nan,)).fetchone() == (None,)
        rows = connection.execute("SELECT name, value, kind FROM metric ORDER BY name").fetchall()
    connection.close()
    assert rows == [("down", None, "-inf"), ("nan", None, "nan"), ("up", None, "inf")]


def test_latest_metrics_and_choice_of_names(store: Store, writer: RunWriter) -> None:
    writer.epoch(1, {"a": 1.0, "b": 2.0})
    writer.epoch(2, {"a": 3.0})
    latest = store.latest_metrics([writer.run_id])
    assert latest.values.tolist() == [[writer.run_id, "a", 2, 3.0], [writer.run_id, "b", 1, 2.0]]
    assert store.latest_metrics([writer.run_id], ["b"])["value"].tolist() == [2.0]
    assert store.metrics([writer.run_id], ["a"])["value"].tolist() == [1.0, 3.0]


def test_no_metrics_still_give_typed_columns(store: Store, writer: RunWriter) -> None:
    for frame in (store.metrics([]), store.metrics([writer.run_id])):
        assert frame.empty
        assert frame.dtypes[["seed", "step", "value"]].tolist() == [np.int64, np.int64, np.float64]
    assert store.latest_metrics([]).empty


def test_a_step_is_recorded_once(store: Store, writer: RunWriter) -> None:
    writer.epoch(1, {"a": 1.0})
    with pytest.raises(SsmailError, match="already has metrics for step 1"):
        writer.epoch(1, {"b": 5.0, "a": 2.0})
    assert values(store, writer.run_id) == {("a", 1): 1.0}  # and nothing of the refused step


WRITES: dict[str, Callable[[RunWriter], None]] = {
    "epoch": lambda writer: writer.epoch(9, {"a": 1.0}),
    "final": lambda writer: writer.final(9, {"a": 1.0}),
    "heartbeat": lambda writer: writer.heartbeat(),
    "arrays": lambda writer: writer.arrays({"x": np.zeros(1)}),
    "artifact": lambda writer: writer.artifact("best.pt"),
    "finish": lambda writer: writer.finish(RunState.FAILED),
}


@pytest.mark.parametrize("write", WRITES.values(), ids=WRITES)
@pytest.mark.parametrize("state", [RunState.FINISHED, RunState.DIVERGED, RunState.FAILED, RunState.INTERRUPTED])
def test_a_run_that_ended_cannot_be_written(
    store: Store, writer: RunWriter, state: RunState, write: Callable[[RunWriter], None]
) -> None:
    write_to_running = WRITES["epoch"]
    write_to_running(writer)  # negative control: the very same call works while the run is running
    writer.folder.mkdir(parents=True)
    (writer.folder / "best.pt").touch()
    writer.finish(state, "why")
    before, recorded = only(store), values(store, writer.run_id)
    with pytest.raises(SsmailError, match=f"is {state} and can no longer be written"):
        write(writer)
    assert only(store) == before
    assert values(store, writer.run_id) == recorded
    assert store.array_names(writer.run_id) == []
    assert store.artifacts(writer.run_id) == []


@pytest.mark.parametrize("state", [RunState.FINISHED, RunState.DIVERGED])
def test_a_finished_or_diverged_run_cannot_be_resumed(store: Store, writer: RunWriter, state: RunState) -> None:
    writer.finish(state)
    with pytest.raises(SsmailError, match="cannot be resumed"):
        store.resume_run(writer.run_id, 0)


@pytest.mark.parametrize("state", [RunState.QUEUED, RunState.RUNNING])
def test_a_run_cannot_end_in_a_state_that_is_no_end(writer: RunWriter, state: RunState) -> None:
    with pytest.raises(SsmailError, match="cannot end"):
        writer.finish(state)


def test_resuming_drops_what_came_after_the_checkpoint(store: Store, writer: RunWriter) -> None:
    for step in (1, 2, 3):
        writer.epoch(step, {"a": step, "late": math.nan} if step == 3 else {"a": step})
    writer.finish(RunState.INTERRUPTED, "Ctrl-C")
    again = store.resume_run(writer.run_id, 2)
    row = only(store)
    assert (row.state, row.error, row.finished, row.resumes) == (RunState.RUNNING, None, None, 1)
    assert values(store, again.run_id) == {("a", 1): 1.0, ("a", 2): 2.0}
    assert store.latest_metrics([again.run_id]).values.tolist() == [[again.run_id, "a", 2, 2.0]]
    again.epoch(3, {"a": 30.0})
    assert values(store, again.run_id)[("a", 3)] == 30.0


def test_a_checkpoint_ahead_of_the_database_is_refused(store: Store, writer: RunWriter) -> None:
    writer.epoch(1, {"a": 1.0})
    writer.finish(RunState.INTERRUPTED)
    with pytest.raises(SsmailError, match=r"checkpoint of run .* is at epoch 2 but the database ends at epoch 1"):
        store.resume_run(writer.run_id, 2)
    assert only(store).state is RunState.INTERRUPTED
    store.resume_run(writer.run_id, 1)


def test_a_final_evaluation_cut_short_is_replaced(store: Store, writer: RunWriter) -> None:
    writer.epoch(1, {"a": 1.0})
    writer.final(1, {"test/a": 2.0})
    writer.finish(RunState.FAILED)
    again = store.resume_run(writer.run_id, 1)
    again.final(1, {"test/a": 3.0})
    assert values(store, again.run_id) == {("a", 1): 1.0, ("test/a", 1): 3.0}
    assert store.latest_metrics([again.run_id], ["test/a"])["value"].tolist() == [3.0]


def test_resources_add_up_over_resumes(store: Store, writer: RunWriter) -> None:
    deadline = time.process_time() + 0.05
    while time.process_time() < deadline:
        pass
    writer.finish(RunState.INTERRUPTED)
    first = only(store)
    again = store.resume_run(writer.run_id, 0)
    time.sleep(0.05)
    again.finish(RunState.FINISHED)
    second = only(store)
    assert first.wall_seconds >= 0.05
    assert first.cpu_seconds >= 0.05
    assert second.wall_seconds >= first.wall_seconds + 0.05
    assert second.cpu_seconds >= first.cpu_seconds
    assert first.peak_memory_bytes is not None
    assert second.peak_memory_bytes is not None
    assert 2**24 < first.peak_memory_bytes <= second.peak_memory_bytes < 2**36
    assert second.finished is not None
    assert second.finished > second.started


def test_runs_of_one_process_share_its_time(store: Store, spec: RunSpec, monkeypatch: pytest.MonkeyPatch) -> None:
    """Alone for 5 s; two for 8 s, then three for 30 s, then again one: 5 + 8 / 2 + 30 / 3 + 7. CPU time at half of it.

    A second run, which counts as alone throughout, has all 50 s.
    """
    clock = time.monotonic() + 100

    def wait(seconds: float) -> None:
        nonlocal clock
        clock += seconds

    monkeypatch.setattr(time, "monotonic", lambda: clock)
    monkeypatch.setattr(time, "process_time", lambda: clock / 2)
    shared = store.start_run(spec, 6, dataset_hash=None, device="cpu")
    whole = store.start_run(spec, 7, dataset_hash=None, device="cpu")
    wait(5)
    for runs, seconds in ((2, 8), (3, 30), (1, 7)):
        shared.share(runs)
        whole.share(1)
        wait(seconds)
    for one in (shared, whole):
        one.finish(RunState.INTERRUPTED)
    divided, single = ((row.wall_seconds, row.cpu_seconds) for row in store.runs())
    assert divided == pytest.approx((5 + 4 + 10 + 7, 2.5 + 2 + 5 + 3.5))
    assert single == pytest.approx((50, 25))  # negative control
    again = store.resume_run(shared.run_id, 0)
    again.share(4)
    wait(8)
    again.finish(RunState.FINISHED)
    assert store.runs()[0].wall_seconds == pytest.approx(26 + 2)


def test_who_lost_the_run_to_another_process_writes_no_more(store: Store, writer: RunWriter) -> None:
    writer.epoch(1, {"a": 1.0})
    store.stale_seconds = 0  # the first process was silent and counts as dead
    again = store.resume_run(writer.run_id, 1)
    with pytest.raises(SsmailError, match="resumed by another process"):
        writer.epoch(2, {"a": 666.0})
    again.epoch(2, {"a": 2.0})
    assert values(store, again.run_id) == {("a", 1): 1.0, ("a", 2): 2.0}


def test_a_running_cell_is_refused_until_it_falls_silent(store: Store, spec: RunSpec, writer: RunWriter) -> None:
    sentence = r"seed 0 of this spec is being computed by another process on .*; wait for it to end, or"
    for attempt in (
        lambda: store.start_run(spec, 0, dataset_hash=None, device="cpu", repeat=True),
        lambda: store.resume_run(writer.run_id, 0),
        lambda: store.delete([writer.run_id]),
    ):
        with pytest.raises(InputError, match=sentence):
            attempt()
    store.start_run(spec, 1, dataset_hash=None, device="cpu")  # another seed is another cell
    store.stale_seconds = 0
    store.start_run(spec, 0, dataset_hash=None, device="cpu")
    assert [row.state for row in store.runs() if row.seed == 0] == [RunState.INTERRUPTED, RunState.RUNNING]


def test_a_finished_cell_is_begun_again_only_on_request(store: Store, spec: RunSpec, writer: RunWriter) -> None:
    writer.finish(RunState.FINISHED)
    with pytest.raises(InputError, match=f"has finished already, as run {writer.run_id[:8]}"):
        store.start_run(spec, 0, dataset_hash=None, device="cpu")
    second = store.start_run(spec, 0, dataset_hash=None, device="cpu", repeat=True)
    assert [row.id for row in store.runs()] == [writer.run_id, second.run_id]
    newest = store.find_cell(spec.hash(), 0)
    assert newest is not None
    assert newest.id == second.run_id
    assert store.find_cell(spec.hash(), 1) is None


def test_silence_is_found(store: Store, writer: RunWriter) -> None:
    assert store.stale_seconds == 30
    assert store.is_alive(only(store))
    assert store.mark_stale() == []
    time.sleep(0.02)
    store.stale_seconds = 0.01
    (found,) = store.mark_stale()
    assert found.id == writer.run_id
    row = only(store)
    assert row.state is RunState.INTERRUPTED
    assert row.error is not None
    assert row.error.startswith("its process fell silent after 20")
    store.stale_seconds = 30
    assert not store.is_alive(row)
    store.stale_seconds = 0
    assert store.mark_stale() == []  # it is interrupted already


def set_heartbeat(store: Store, ahead: timedelta) -> None:
    with sqlite3.connect(store.where) as connection:
        connection.execute("UPDATE run SET heartbeat = ?", ((datetime.now(UTC) + ahead).strftime(STORED_TIME),))
    connection.close()


def test_a_heartbeat_far_in_the_future_is_of_a_dead_process(store: Store, spec: RunSpec, writer: RunWriter) -> None:
    set_heartbeat(store, timedelta(seconds=10))  # another machine's clock may be ahead by some seconds
    assert store.is_alive(only(store))
    assert store.mark_stale() == []
    with pytest.raises(InputError, match=r"last heartbeat (10|9) s ahead of this clock\); .* try again in (41|40) s$"):
        store.delete([writer.run_id])
    set_heartbeat(store, timedelta(days=1))  # the clock was set back
    assert not store.is_alive(only(store))
    store.resume_run(writer.run_id, 0)
    set_heartbeat(store, timedelta(days=1))
    (found,) = store.mark_stale()
    row = only(store)
    assert (found.id, row.state) == (writer.run_id, RunState.INTERRUPTED)
    assert row.error is not None
    assert row.error.startswith("its last heartbeat, of 20")
    assert row.error.endswith(" UTC, was ahead of the clock")
    store.delete([writer.run_id])
    assert store.runs() == []


def test_a_process_at_work_goes_on_after_the_clock_is_set_back(store: Store, writer: RunWriter) -> None:
    set_heartbeat(store, timedelta(days=1))
    writer.heartbeat()
    assert store.is_alive(only(store))
    writer.epoch(1, {"a": 1.0})
    writer.finish(RunState.FINISHED)
    assert 0 <= only(store).wall_seconds < 60


def test_a_heartbeat_moves_the_last_sign_of_life(store: Store, writer: RunWriter) -> None:
    before = only(store).heartbeat
    time.sleep(0.01)
    writer.heartbeat()
    assert only(store).heartbeat >= before + timedelta(seconds=0.01)


def test_ending_a_dead_run_leaves_others_alone(store: Store, writer: RunWriter) -> None:
    store.end_dead_run(writer.run_id, RunState.FAILED, "killed")
    assert (only(store).state, only(store).error) == (RunState.FAILED, "killed")
    store.end_dead_run(writer.run_id, RunState.INTERRUPTED, "later")
    assert (only(store).state, only(store).error) == (RunState.FAILED, "killed")


def test_delete_removes_rows_and_checkpoints_of_those_runs_only(store: Store, spec: RunSpec) -> None:
    writers = [store.start_run(spec, seed, dataset_hash=None, device="cpu") for seed in (0, 1)]
    for writer in writers:
        file = store.checkpoint_root / writer.run_id / "last.pt"
        file.parent.mkdir(parents=True)
        file.write_bytes(b"abc")
        writer.epoch(1, {"a": 1.0})
        writer.arrays({"x": np.zeros(2)})
        writer.artifact("last.pt")
        writer.finish(RunState.FINISHED)
    gone, kept = (writer.run_id for writer in writers)
    with pytest.raises(InputError, match="no run id starts with"):
        store.delete([gone, "zz"])
    assert len(store.runs()) == 2
    store.delete([gone[:12]])
    assert only(store).id == kept
    with sqlite3.connect(store.where) as connection:
        for table in ("metric", "metric_latest", "array", "artifact"):
            assert connection.execute(f"SELECT DISTINCT run_id FROM {table}").fetchall() == [(kept,)]
    connection.close()
    assert [path.name for path in store.checkpoint_root.iterdir()] == [kept]


def test_the_writer_of_a_deleted_run_is_told(store: Store, writer: RunWriter) -> None:
    store.stale_seconds = 0
    store.delete([writer.run_id])
    with pytest.raises(SsmailError, match="was deleted"):
        writer.epoch(1, {"a": 1.0})
