"""`--enqueue`, `ssmail worker` and `ssmail queue`."""

import json
from pathlib import Path

import pytest

from ssmail.store import RunState, Store
from ssmail_cli.options import STATES
from tests.cli.command_line import CommandLine, FakeTraining

COPY = ("train", "copy-last", "--profile", "smoke", "--seeds", "0-1", "--device", "cpu")


def test_enqueued_runs_are_listed_and_computed_by_a_worker_as_train_does(
    cli: CommandLine, db: Path, tmp_path: Path
) -> None:
    put = cli(*COPY, "--enqueue", "--db", db)
    assert (put.code, [row["action"] for row in put.rows]) == (0, ["queued", "queued"])
    assert f"`ssmail worker --db {db}` computes them" in put.err
    listed = cli("queue", "--json", "--db", db)
    assert [(row["cell"], row["seed"]) for row in json.loads(listed.out)] == [("waiting", 0), ("waiting", 1)]
    assert "2 runs: 2 waiting, 0 running, 0 dead" in listed.err
    done = cli("worker", "--idle-exit", 0, "--device", "cpu", "--db", db)
    assert done.code == 0, done.err
    assert [(row["outcome"], row["seed"]) for row in done.rows] == [("finished", "0"), ("finished", "1")]
    assert cli("queue", "--db", db).rows == []
    again = cli(*COPY, "--enqueue", "--db", db)
    assert [row["action"] for row in again.rows] == ["stored", "stored"]
    assert "worker" not in again.err
    other = tmp_path / "other.db"
    assert cli(*COPY, "--db", other).code == 0
    errors = [
        {row["seed"]: row["test/mode_mse"] for row in cli("runs", "list", "--db", one).rows} for one in (db, other)
    ]
    assert errors[0] == errors[1]
    assert len(errors[0]) == 2


def test_the_queue_tells_the_living_from_the_dead(cli: CommandLine, db: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    cli(*COPY, "--enqueue", "--db", db)
    store = Store.open(db)
    store.queue.claim_waiting(lambda *_: 1, set())
    assert [row["cell"] for row in cli("queue", "--db", db).rows] == ["running", "waiting"]
    monkeypatch.setenv("SSMAIL_STALE_SECONDS", "0.000001")
    assert [row["cell"] for row in cli("queue", "--db", db).rows] == ["dead", "waiting"]
    short = cli("queue", "--limit", 1, "--db", db)
    assert [row["cell"] for row in short.rows] == ["dead"]
    assert "2 runs: 1 waiting, 0 running, 1 dead; only the first 1 of them here (--limit)" in short.err
    assert {str(row.state) for row in store.runs()} == {"queued", "running"}  # looking changes nothing


def test_a_sweep_takes_what_waits_and_a_plan_says_what_is_computed_elsewhere(
    cli: CommandLine, db: Path, fake: FakeTraining
) -> None:
    cli(*COPY, "--enqueue", "--db", db)
    store = Store.open(db)
    (first, _) = store.runs()
    store.queue.claim_waiting(lambda *_: 1, set())
    plan = cli(*COPY, "--dry-run", "--db", db)
    assert [(row["action"], row["seed"]) for row in plan.rows] == [("wait", "0"), ("resume", "1")]
    assert plan.rows[0]["run"] == first.id[:8]


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ((*COPY, "--enqueue", "--resume", "never"), "--enqueue is for --resume auto, not never; train without"),
        (("worker",), "there is no database"),
        (("queue",), "there is no database"),
        (("worker", "--max-hours", "nan"), "--max-hours takes a number that is not negative, not nan."),
        (("worker", "--idle-exit", "-1"), "--idle-exit takes a number that is not negative, not -1.0."),
    ],
)
def test_what_makes_no_sense_is_one_sentence(
    cli: CommandLine, db: Path, arguments: tuple[object, ...], sentence: str
) -> None:
    assert sentence in cli(*arguments, "--db", db).sentence
    assert not db.exists()


@pytest.mark.parametrize("value", ["soon", "0", "-3", "nan"])
def test_a_wrong_time_of_silence_is_refused(
    cli: CommandLine, db: Path, monkeypatch: pytest.MonkeyPatch, value: str
) -> None:
    monkeypatch.setenv("SSMAIL_STALE_SECONDS", value)
    assert "SSMAIL_STALE_SECONDS is" in cli(*COPY, "--db", db).sentence


def test_the_states_are_those_of_the_schema() -> None:
    assert set(STATES) == set(map(str, RunState))
