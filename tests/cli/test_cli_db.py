"""`ssmail db`: what is printed, exit codes, and sentences."""

import json
from pathlib import Path

import pytest

from ssmail.store import RunState, Store
from tests.cli.command_line import CommandLine
from tests.store.databases import add, change, contents


@pytest.fixture
def filled(db: Path) -> Path:
    store = Store.open(db)
    add(store, 0)
    add(store, 1, state=RunState.DIVERGED)
    add(store, 2, [0.3], RunState.INTERRUPTED)
    store.close()
    return db


def test_info(cli: CommandLine, filled: Path) -> None:
    shown = cli("db", "info", "--db", filled)
    assert shown.code == 0
    assert [(row["method"], row["state"], row["runs"]) for row in shown.rows] == [
        ("ssail", "diverged", "1"),
        ("ssail", "finished", "1"),
        ("ssail", "interrupted", "1"),
    ]
    first, second = shown.err.splitlines()
    assert first.startswith(f"{filled}: schema 0001, ")
    assert first.endswith("3 runs")
    assert "1 array, 0 kB (" in second
    found = json.loads(cli("db", "info", "--json", "--db", filled).out)
    assert (found["revision"], found["arrays"], len(found["runs"])) == ("0001", 1, 3)
    assert 0 < found["array_share"] < 1
    assert found["size_bytes"] == filled.stat().st_size


def test_info_changes_nothing(cli: CommandLine, filled: Path) -> None:
    """Other commands would mark the silent run as interrupted."""
    change(filled, "UPDATE run SET state = 'running', heartbeat = '2026-01-01 00:00:00' WHERE seed = 2")
    before = contents(filled)
    assert "running" in cli("db", "info", "--db", filled).out
    assert contents(filled) == before


def test_check(cli: CommandLine, filled: Path) -> None:
    sound = cli("db", "check", "--db", filled)
    assert (sound.code, sound.out, sound.err) == (0, "", f"{filled}: no problem found\n")
    assert json.loads(cli("db", "check", "--json", "--db", filled).out) == []
    change(filled, "UPDATE run SET state = 'running', heartbeat = '2026-01-01 00:00:00' WHERE seed = 2")
    change(filled, "UPDATE array SET data = x'00'")
    broken = cli("db", "check", "--db", filled)
    assert (broken.code, broken.err) == (1, f"{filled}: 2 problems\n")
    arrays, stale = broken.out.splitlines()
    assert arrays.startswith("arrays: the array test/rollouts of run ")
    assert arrays.endswith(") and train it again")
    assert stale.startswith("stale: run ")
    found = cli("db", "check", "--json", "--db", filled)
    assert found.code == 1
    assert [problem["check"] for problem in json.loads(found.out)] == ["arrays", "stale"]


def test_backup_and_upgrade(cli: CommandLine, filled: Path, tmp_path: Path) -> None:
    copy = tmp_path / "backup.db"
    assert cli("db", "backup", copy, "--db", filled).out.startswith(f"wrote {copy}, ")
    assert contents(copy) == contents(filled)
    assert "exists already and is not overwritten" in cli("db", "backup", copy, "--db", filled).sentence
    assert cli("db", "upgrade", "--db", filled).out == f"{filled} already has the newest schema, 0001\n"
    assert json.loads(cli("db", "upgrade", "--json", "--db", filled).out)["backup"] is None


def test_merge(cli: CommandLine, filled: Path, tmp_path: Path) -> None:
    other = Store.open(tmp_path / "other" / "other.db")
    ours = Store.open(filled).runs()[0]
    theirs = add(other, 0, [0.3, 0.25])
    add(other, 7)
    other.close()
    merged = cli("db", "merge", other.where, "--db", filled)
    assert merged.code == 0
    difference, summary = merged.out.splitlines()
    assert difference == (
        f"nondeterminism: ssail on yjunction, spec {ours.spec_hash[:8]}, seed 0: test/mode_mse at epoch 2 is 0.1 in "
        f"run {ours.name}, which is kept, and 0.125 in run {theirs[:8]}, which is left out"
    )
    assert summary == (
        f"merged {other.where} into {filled}: 1 run added, 1 run left out: different from the run already there"
    )
    found = json.loads(cli("db", "merge", other.where, "--json", "--db", filled).out)
    assert {run["fate"] for run in found["runs"]} == {"different", "already there"}
    assert (found["differences"][0]["metric"], found["without_checkpoints"]) == ("test/mode_mse", [])
    new = tmp_path / "new" / "all.db"
    assert cli("db", "merge", filled, "--db", new).code == 0
    assert contents(new) == contents(filled)


def test_export(cli: CommandLine, filled: Path, tmp_path: Path) -> None:
    small = tmp_path / "small.db"
    assert "give --compact" in cli("db", "export", small, "--db", filled).sentence
    done = cli("db", "export", "--compact", small, "--db", filled, "--profile", "smoke")
    assert done.code == 0
    assert done.out.startswith(f"wrote {small}, ")
    assert done.out.endswith(": 2 runs\n")
    assert done.err.startswith("left out: 1 other run; 2 checkpoint files; ")
    assert "fig7 cannot be drawn from it (fig7 has nothing to draw" in done.err
    assert {row[8] for row in contents(small)["run"]} == {"finished", "diverged"}
    other = tmp_path / "other.db"
    none = cli("db", "export", "--compact", other, "--db", filled, "--profile", "quick")
    assert none.sentence.startswith(f"no finished or diverged run in {filled} meets these conditions")
    found = json.loads(cli("db", "export", "--compact", other, "--json", "--db", filled).out)
    assert (found["runs"], found["left_out_runs"], found["left_out_artifacts"]) == (2, 1, 2)


@pytest.mark.parametrize(
    "line", ["info", "upgrade", "check", "backup new.db", "merge other.db", "export --compact new.db"]
)
def test_what_is_no_database_of_ssmails_is_one_sentence(line: str, cli: CommandLine, tmp_path: Path) -> None:
    words = [str(tmp_path / word) if word.endswith(".db") else word for word in line.split()]
    Store.open(tmp_path / "other.db").close()
    nowhere = f"postgresql://host/name?host={tmp_path}"  # as the folder of a socket
    assert "cannot connect to the database" in cli("db", *words, "--db", nowhere).sentence
    (tmp_path / "notes.txt").write_bytes(b"These are my notes, not a database. " * 100)
    assert "is not an SQLite database" in cli("db", *words, "--db", tmp_path / "notes.txt").sentence
    change(tmp_path / "foreign.db", "CREATE TABLE run (id TEXT)")
    assert "another program" in cli("db", *words, "--db", tmp_path / "foreign.db").sentence
    if not line.startswith("merge"):  # which makes it
        assert "there is no database" in cli("db", *words, "--db", tmp_path / "missing.db").sentence
        assert not (tmp_path / "missing.db").exists()
    assert not (tmp_path / "new.db").exists()


def test_damaged_rows_are_noted_once(cli: CommandLine, filled: Path, tmp_path: Path) -> None:
    change(filled, "UPDATE run SET state = 'paused' WHERE seed = 0")
    for command in (
        ("runs", "list"),
        ("runs", "compare"),
        ("claims",),
        ("db", "export", "--compact", tmp_path / "x.db"),
    ):
        found = cli(*command, "--db", filled)
        (remark,) = (line for line in found.err.splitlines() if "damaged row " in line)
        assert remark == f"1 damaged row left out; `ssmail db check --db {filled}` says what is wrong"
    damaged = next(str(row[0]) for row in contents(filled)["run"] if "paused" in row)
    assert f"run {damaged[:8]} is damaged: its state is 'paused'" in cli("db", "check", "--db", filled).out
    assert (
        f"run {damaged[:8]} is damaged (its state is 'paused')" in cli("runs", "show", damaged, "--db", filled).sentence
    )
    merged = cli("db", "merge", filled, "--db", tmp_path / "own.db")
    assert merged.out.startswith(f"left out: run {damaged[:8]} is damaged: its state is 'paused'\n")
    assert "1 run left out: damaged" in merged.out
    assert cli("runs", "delete", "--yes", damaged, "--db", filled).code == 0
    assert cli("db", "check", "--db", filled).code == 0
