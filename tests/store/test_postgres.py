"""A database on a PostgreSQL server: the same contents as in SQLite, by any number of processes, whatever breaks."""

import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from typing import Any

import numpy as np
import pytest
from sqlalchemy import make_url, text

from ssmail.config.spec import RunSpec
from ssmail.errors import InputError, SsmailError
from ssmail.store import RunState, RunWriter, Store, connection, server
from ssmail.store.connection import as_url, describe, make_engine, write
from ssmail.store.queue import Claim, interrupt
from tests.store.databases import SPEC, add
from tests.store.postgres_server import PASSWORD, Server

VALUES = {"validation/mode_mse": 0.1 + 0.2, "b": np.nan, "B": -np.inf, "c": np.inf, "a_b": 5e-324, "a/b": 1e308}


def start(store: Store, seed: int = 0, spec: RunSpec = SPEC) -> RunWriter:
    return store.start_run(spec, seed, dataset_hash="d" * 64, device="cpu")


def terminate(server: Server, store: Store) -> int:
    """End all connections to the store's database, as an administrator does; how many there were."""
    with server.connect() as admin:
        query = "SELECT count(pg_terminate_backend(pid)) FROM pg_stat_activity WHERE datname = %s"
        row = admin.execute(query, (store._engine.url.database,)).fetchone()
    assert row is not None
    return int(row[0])


def test_what_is_stored_is_read_as_from_sqlite(remote: Store, store: Store) -> None:
    for each in (remote, store):
        writer = start(each)
        writer.epoch(1, VALUES)
        writer.epoch(2, {name: -value for name, value in VALUES.items()})
        writer.final(2, {"test/mode_mse": 1 / 3})
        writer.arrays({"x": np.arange(6.0).reshape(2, 3), "mask": np.array([True, False])})
        writer.finish(RunState.FINISHED)
    frames = []
    for each in (remote, store):
        (run,) = each.runs(method="ssail", state="finished")
        assert run.started.utcoffset() is not None
        np.testing.assert_array_equal(each.array(run.id, "x"), [[0, 1, 2], [3, 4, 5]])
        assert each.array_names(run.id) == ["mask", "x"]
        assert [row.id for row in each.runs(ids=[run.id[:6]])] == [run.id]
        frames += [(each.metrics([run.id]), each.latest_metrics([run.id]))]
    for there, here in zip(*frames, strict=True):
        assert there.drop(columns="run_id").equals(here.drop(columns="run_id"))
    assert [*dict.fromkeys(frames[0][0]["name"])] == sorted([*VALUES, "test/mode_mse"])  # in the order of bytes


def open_at_once(url: str, users: int = 8) -> list[str]:
    """Open a database from threads with an engine each; what went wrong."""
    barrier = threading.Barrier(users)

    def attempt(_: int) -> str:
        barrier.wait()
        try:
            Store.open(url).close()
        except SsmailError as error:
            return str(error)
        return ""

    with ThreadPoolExecutor(users) as pool:
        return [said for said in pool.map(attempt, range(users)) if said]


def test_a_new_database_may_be_opened_by_many_at_once(server: Server, monkeypatch: pytest.MonkeyPatch) -> None:
    assert open_at_once(server.url(server.new_database())) == []
    monkeypatch.setattr(connection.server, "lock_schema", lambda _: None)  # negative control
    assert any(open_at_once(server.url(server.new_database())) for _ in range(5))


def claim_at_once(url: str, seeds: int, users: int = 4) -> list[int]:
    """Let every user start a run of each cell; how many runs of each cell there are."""
    barrier, stores = threading.Barrier(users), [Store.open(url) for _ in range(users)]

    def attempt(own: Store) -> None:
        for seed in range(seeds):
            barrier.wait()
            with suppress(InputError):  # it is being computed by another process
                start(own, seed)

    with ThreadPoolExecutor(users) as pool:
        list(pool.map(attempt, stores))
    found = [run.seed for run in stores[0].runs()]
    for each in stores:
        each.close()
    return [found.count(seed) for seed in range(seeds)]


def test_one_of_several_gets_a_cell(server: Server, monkeypatch: pytest.MonkeyPatch) -> None:
    assert claim_at_once(server.url(server.new_database()), seeds=10) == [1] * 10
    monkeypatch.setattr(connection.server, "lock_cells", lambda _: None)  # negative control
    assert max(claim_at_once(server.url(server.new_database()), seeds=20)) > 1


def in_opposite_order(url: str, patience: float | None) -> list[str]:
    """Two transactions that lock two runs each, the second one first: one of them meets a deadlock."""
    barrier = threading.Barrier(2)

    def attempt(order: tuple[int, int]) -> str:
        own = Store.open(url)

        def work(open_connection: Any, again: bool) -> None:
            for seed in order:
                open_connection.execute(text(f"UPDATE run SET resumes = resumes + 1 WHERE seed = {seed}"))
                if not again and seed == order[0]:
                    barrier.wait()

        try:
            write(own._engine, work, patience)
        except SsmailError as error:
            return str(error)
        finally:
            own.close()
        return ""

    with ThreadPoolExecutor(2) as pool:
        return [said for said in pool.map(attempt, [(0, 1), (1, 0)]) if said]


def test_a_deadlock_is_tried_again(remote: Store) -> None:
    start(remote, 0)
    start(remote, 1)
    (said,) = in_opposite_order(remote.url, patience=0)  # negative control
    assert "deadlock detected" in said
    assert [run.resumes for run in remote.runs()] == [1, 1]
    assert in_opposite_order(remote.url, patience=None) == []
    assert [run.resumes for run in remote.runs()] == [3, 3]


def count_up_at_once(url: str, patience: float | None) -> list[str]:
    """Two serializable transactions that read and write the same row."""
    barrier = threading.Barrier(2)

    def attempt(own: Store) -> str:
        def work(open_connection: Any, again: bool) -> None:
            open_connection.execute(text("SET TRANSACTION ISOLATION LEVEL SERIALIZABLE"))
            found = open_connection.execute(text("SELECT resumes FROM run")).scalar_one()
            if not again:
                barrier.wait()
            open_connection.execute(text(f"UPDATE run SET resumes = {found + 1}"))

        try:
            write(own._engine, work, patience)
        except SsmailError as error:
            return str(error)
        return ""

    stores = [Store.open(url) for _ in range(2)]
    with ThreadPoolExecutor(2) as pool:
        said = [said for said in pool.map(attempt, stores) if said]
    for each in stores:
        each.close()
    return said


def test_a_serialization_failure_is_tried_again(remote: Store) -> None:
    start(remote)
    (said,) = count_up_at_once(remote.url, patience=0)  # negative control
    assert "could not serialize access" in said
    assert count_up_at_once(remote.url, patience=None) == []
    assert remote.runs()[0].resumes == 3


def lost_answer(store: Store, monkeypatch: pytest.MonkeyPatch) -> Callable[[], int]:
    """Lose the connection right after the next commit; the result says how many commits were asked for since."""
    import psycopg

    commit, commits = store._engine.dialect.do_commit, []

    def lose(dbapi_connection: Any) -> None:
        commit(dbapi_connection)
        commits.append(1)
        if len(commits) == 1:
            dbapi_connection.dbapi_connection.close()
            raise psycopg.OperationalError("server closed the connection unexpectedly")

    monkeypatch.setattr(store._engine.dialect, "do_commit", lose)
    return lambda: len(commits)


@pytest.mark.parametrize("step", ["start", "epoch", "final", "arrays", "resume", "finish", "delete"])
def test_a_commit_whose_answer_is_lost_counts_once(step: str, remote: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    if step == "start":
        commits = lost_answer(remote, monkeypatch)
        writer = start(remote)
    else:
        writer = start(remote)
        writer.epoch(1, {"a": 0.5, "b": np.nan})
        if step == "resume":
            writer.finish(RunState.INTERRUPTED)
        commits = lost_answer(remote, monkeypatch)
    if step == "epoch":
        writer.epoch(2, {"a": 1.0, "b": np.nan})
    elif step == "final":
        writer.final(1, {"test/a": 1.0})
    elif step == "arrays":
        writer.arrays({"x": np.zeros(2)})
    elif step == "resume":
        writer = remote.resume_run(writer.run_id, 1)
    elif step == "finish":
        writer.finish(RunState.FINISHED)
    elif step == "delete":
        writer.finish(RunState.FAILED)
        assert commits() == 2
        commits = lost_answer(remote, monkeypatch)
        remote.delete([writer.run_id])
    assert commits() == 2
    rows = remote.metrics([writer.run_id])[["name", "step"]].values.tolist()
    wanted = {"start": [], "delete": [], "epoch": [["a", 1], ["a", 2], ["b", 1], ["b", 2]]}
    assert rows == wanted.get(step, [["a", 1], ["b", 1]] + ([["test/a", 1]] if step == "final" else []))
    assert len(remote.runs()) == (step != "delete")
    if step == "resume":
        assert remote.runs()[0].resumes == 1
        writer.epoch(2, {"a": 1.0})


def test_a_claimed_run_is_resumed_once_though_the_answer_is_lost(
    remote: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    writer = start(remote)
    writer.epoch(1, {"a": 1.0})
    writer.finish(RunState.INTERRUPTED)
    (claim,) = remote.queue.claim([(SPEC, 0)], lambda _: True)
    assert isinstance(claim, Claim)
    commits = lost_answer(remote, monkeypatch)
    remote.resume_run(claim.run_id, 1, claim)
    assert (commits(), remote.runs()[0].resumes) == (2, 1)
    (new,) = remote.queue.claim([(SPEC, 1)], lambda _: True)
    assert isinstance(new, Claim)
    commits = lost_answer(remote, monkeypatch)
    remote.resume_run(new.run_id, 0, new, dataset_hash="d" * 64)
    assert (commits(), remote.runs()[-1].resumes) == (2, 0)


def test_an_epoch_that_is_not_recognized_would_be_refused(remote: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    """Negative control, for the epoch above; and an epoch that was there before is refused as in SQLite."""
    writer = start(remote)
    monkeypatch.setattr(RunWriter, "_has", lambda *_: False)
    lost_answer(remote, monkeypatch)
    with pytest.raises(SsmailError, match="already has metrics for step 1"):
        writer.epoch(1, {"a": 0.5})
    monkeypatch.undo()
    with pytest.raises(SsmailError, match="already has metrics for step 1"):
        writer.epoch(1, {"a": 0.5})


def test_a_connection_that_breaks_loses_no_epoch(server: Server, remote: Store) -> None:
    writer = start(remote)
    for epoch in range(1, 6):
        assert terminate(server, remote) > 0
        writer.epoch(epoch, {"a": epoch})
        terminate(server, remote)
        writer.heartbeat()
    terminate(server, remote)
    assert remote.metrics([writer.run_id])["step"].tolist() == [1, 2, 3, 4, 5]
    assert remote.still_stored([writer.run_id])


def test_a_server_that_is_killed_is_waited_for(server: Server, remote: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    writer = start(remote)
    server.kill()
    try:
        began = time.monotonic()
        with pytest.raises(SsmailError, match=r"cannot connect to the database|connection to the database .* broke"):
            writer.heartbeat()  # the next one is soon enough
        with pytest.raises(InputError, match=r"cannot connect to the database .* check its URL"):
            Store.open(remote.url)
        assert time.monotonic() - began < connection.BUSY_SECONDS
        monkeypatch.setattr(connection, "BUSY_SECONDS", 0.1)
        with pytest.raises(SsmailError):  # negative control: without patience
            writer.epoch(1, {"a": 1.0})
        monkeypatch.undo()
        thread = threading.Timer(0.3, server.start)
        thread.start()
        writer.epoch(1, {"a": 1.0})
        thread.join()
    finally:
        if server.process.poll() is not None:
            server.start()
    writer.finish(RunState.FINISHED)
    assert remote.metrics([writer.run_id])["step"].tolist() == [1]


def test_a_held_lock_is_one_sentence(server: Server, database: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(connection, "BUSY_SECONDS", 1)
    hasty = Store.open(server.url(database))
    writer = start(hasty)
    with server.connect(database) as holder, holder.transaction():
        holder.execute("LOCK TABLE run IN EXCLUSIVE MODE")
        with pytest.raises(SsmailError, match="another program holds a lock in the database"):
            writer.epoch(1, {"a": 1.0})
        assert len(hasty.runs()) == 1  # reading waits for nobody
    writer.epoch(1, {"a": 1.0})
    hasty.close()


def test_other_drivers_and_forms_of_a_url() -> None:
    assert as_url("postgresql://me@h/d").drivername == "postgresql+psycopg"
    assert as_url("postgres://me@h/d").drivername == "postgresql+psycopg"
    for driver in ("psycopg2", "pg8000"):
        with pytest.raises(InputError, match=rf"{driver} is no driver that ssmail uses; write postgresql://"):
            as_url(f"postgresql+{driver}://me@h/d")
    assert describe(make_engine(as_url("postgresql://me:pw@h/d"))) == "postgresql://me:***@h/d"
    found = server.arguments(make_url("postgresql+psycopg://h/d?connect_timeout=3&options=-cx%3D1"), 120)
    assert not found.keys() & {"connect_timeout", "options"}
    assert server.arguments(make_url("postgresql+psycopg://h/d"), 120)["options"] == "-c lock_timeout=120s"


def test_a_database_of_another_program_is_refused(server: Server, database: str) -> None:
    with server.connect(database) as admin:
        admin.execute("CREATE TABLE theirs (id int)")
    with pytest.raises(InputError, match="is a database of another program"):
        Store.open(server.url(database))
    with pytest.raises(InputError, match=r"cannot connect to the database .*nosuch.* does not exist"):
        Store.open(server.url("nosuch"))


def test_runs_are_deleted_with_all_they_recorded(remote: Store) -> None:
    run = add(remote)
    assert (remote.checkpoint_root / run).is_dir()
    remote.delete([run[:8]])
    assert remote.runs() == []
    assert remote.metrics([run]).empty
    assert not (remote.checkpoint_root / run).exists()
    assert PASSWORD not in remote.where


def test_runs_that_wait_are_claimed_once_and_those_of_a_silent_worker_again(remote: Store, url: str) -> None:
    remote.queue.add([(SPEC, seed) for seed in range(24)])

    def claim_all(_: int) -> list[Claim]:
        own, claims = Store.open(url), []
        while found := own.queue.claim_waiting(lambda row, waiting: 2, set()):
            claims += found
        own.close()
        return claims

    with ThreadPoolExecutor(8) as pool:
        claims = [claim for found in pool.map(claim_all, range(8)) for claim in found]
    assert sorted(claim.run_id for claim in claims) == sorted(row.id for row in remote.runs(state="running"))
    assert len(claims) == 24
    assert remote.queue.claim_waiting(lambda row, waiting: 24, set()) == []
    impatient = Store.open(url, stale_seconds=1e-6)
    assert len(impatient.queue.claim_waiting(lambda row, waiting: 24, set())) == 24
    impatient.close()


def test_what_another_process_is_taking_over_is_left_to_it(server: Server, database: str, remote: Store) -> None:
    """Two workers find the same silent run; the second one must not take it from the first."""
    remote.queue.add([(SPEC, 0)])
    (claim,) = remote.queue.claim_waiting(lambda *_: 1, set())
    with server.connect(database) as admin:
        admin.execute("UPDATE run SET heartbeat = '2026-01-01'")
    (silent,) = remote.runs()
    taken = "UPDATE run SET owner = 'queue-of-the-first', heartbeat = clock_timestamp() AT TIME ZONE 'utc'"
    with server.connect(database) as admin, admin.transaction():
        admin.execute(taken)
        assert remote.queue.claim_waiting(lambda *_: 1, set()) == []
    write(remote._engine, lambda connection, _: interrupt(connection, silent))  # as it was met before
    assert remote.queue.claim_waiting(lambda *_: 1, set()) == []
    (row,) = remote.runs()
    assert (row.owner, str(row.state)) == ("queue-of-the-first", "running")
    with server.connect(database) as admin:  # negative control
        admin.execute("UPDATE run SET heartbeat = '2026-01-01'")
    assert [found.run_id for found in remote.queue.claim_waiting(lambda *_: 1, set())] == [claim.run_id]
