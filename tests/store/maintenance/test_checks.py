"""A sound database has no problem; every kind of damage is found, alone, with its remedy."""

import re
import shlex
import shutil
import sqlite3
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import pytest

from ssmail.config.experiments import build_spec
from ssmail.errors import InputError
from ssmail.store import RunState, Store
from ssmail.store.maintenance.checks import check
from tests.store.databases import add, change, contents, files

ASSET = Path(__file__).parents[1] / "assets" / "schema_0001.sqlite"


@pytest.fixture
def filled(store: Store) -> Path:
    """A run in every state that a database can have at rest."""
    for seed, state in enumerate((RunState.FINISHED, RunState.DIVERGED, RunState.INTERRUPTED, RunState.FAILED)):
        add(store, seed, state=state)
    store.close()
    return Path(store.where)


def first_run(path: Path) -> str:
    return str(contents(path)["run"][0][0])


def finished_run(path: Path) -> str:
    return next(str(row[0]) for row in contents(path)["run"] if "finished" in row)


def test_a_sound_database_has_no_problem_and_is_left_alone(filled: Path) -> None:
    before = files(filled.parent)
    assert check(filled) == []
    assert check(f"sqlite:///{filled}") == []
    assert files(filled.parent) == before


def test_a_run_that_is_being_computed_is_no_problem(store: Store) -> None:
    add(store, 0, state=RunState.RUNNING)
    assert check(store.where) == []
    change(store.where, "UPDATE run SET heartbeat = '2026-01-01 00:00:00'")
    (problem,) = check(store.where)  # negative control: the same run, silent
    assert (problem.check, problem.subject) == ("stale", store.runs()[0].id)


def test_the_checkpoint_of_a_run_at_work_may_change(store: Store) -> None:
    spec = build_spec("ssail", "yjunction", "smoke")
    writer = store.start_run(spec, 0, dataset_hash=None, device="cpu")
    path = store.checkpoint_root / writer.run_id / "last.pt"
    path.parent.mkdir(parents=True)
    path.write_bytes(b"one")
    writer.artifact("last.pt")
    path.write_bytes(b"two")
    assert check(store.where) == []
    writer.finish(RunState.INTERRUPTED)
    (problem,) = check(store.where)  # negative control
    assert problem.check == "checkpoints"


def test_a_database_that_cannot_be_opened_is_not_called_damaged(filled: Path) -> None:
    """As on a read-only mount, where SQLite cannot make the file beside a WAL database that reading requires."""
    filled.with_name(filled.name + "-wal").unlink(missing_ok=True)
    filled.with_name(filled.name + "-wal").mkdir()
    with pytest.raises(InputError, match=r"cannot write the database .* as even reading it requires; choose"):
        check(filled)


def without_run(path: Path) -> str:
    change(path, "DELETE FROM run WHERE id = ?", first_run(path))
    shutil.rmtree(path.parent / "checkpoints")
    return "metric"


def other_spec(path: Path) -> str:
    change(path, "UPDATE run SET spec_json = replace(spec_json, '\"epochs\":3', '\"epochs\":4') WHERE seed = 0")
    return finished_run(path)


def no_spec(path: Path) -> str:
    change(path, "UPDATE run SET spec_json = 'gone' WHERE seed = 0")
    return finished_run(path)


def no_final_metrics(path: Path) -> str:
    for table in ("metric", "metric_latest"):
        change(path, f"DELETE FROM {table} WHERE name LIKE 'test%'")
    return finished_run(path)


def broken_array(path: Path) -> str:
    change(path, "UPDATE array SET data = x'00'")
    return finished_run(path)


def misshapen_array(path: Path) -> str:
    change(path, "UPDATE array SET shape = '[5]'")
    return finished_run(path)


def changed_value(path: Path) -> str:
    change(path, "UPDATE metric_latest SET value = 0 WHERE name = 'test/mode_mse'")
    return finished_run(path)


def lost_latest(path: Path) -> str:
    change(path, "DELETE FROM metric_latest WHERE name = 'actor/loss' AND run_id = ?", finished_run(path))
    return finished_run(path)


def checkpoint(path: Path) -> Path:
    return path.parent / "checkpoints" / finished_run(path) / "last.pt"


def lost_checkpoint(path: Path) -> str:
    checkpoint(path).unlink()
    return finished_run(path)


def longer_checkpoint(path: Path) -> str:
    checkpoint(path).write_bytes(checkpoint(path).read_bytes() + b"!")
    return finished_run(path)


def other_checkpoint_of_equal_length(path: Path) -> str:
    checkpoint(path).write_bytes(checkpoint(path).read_bytes()[::-1])
    return finished_run(path)


def stray_folder(path: Path) -> str:
    (path.parent / "checkpoints" / ("a" * 32)).mkdir()
    return "a" * 32


def killed_merge(path: Path) -> str:
    (path.parent / "checkpoints" / ".merge-0123").mkdir()
    return ".merge-0123"


def silent_run(path: Path) -> str:
    change(path, "UPDATE run SET state = 'running', heartbeat = '2026-01-01 00:00:00' WHERE seed = 2")
    return next(str(row[0]) for row in contents(path)["run"] if "running" in row)


DAMAGE: dict[str, tuple[Callable[[Path], str], str, str]] = {
    "orphans": (without_run, "orphans", r"DELETE FROM metric "),
    "spec": (other_spec, "spec", r"ssmail runs delete \w{8}"),
    "no spec": (no_spec, "spec", r"ssmail runs delete \w{8}"),
    "final metrics": (no_final_metrics, "final metrics", r"train it again"),
    "array": (broken_array, "arrays", r"train it again"),
    "shape": (misshapen_array, "arrays", r"train it again"),
    "latest": (changed_value, "latest metrics", r"train it again"),
    "lost latest": (lost_latest, "latest metrics", r"train it again"),
    "missing": (lost_checkpoint, "checkpoints", r"copy it from a backup to .*/last\.pt, or delete the run"),
    "longer": (longer_checkpoint, "checkpoints", r"copy it from a backup"),
    "altered": (other_checkpoint_of_equal_length, "checkpoints", r"copy it from a backup"),
    "stray": (stray_folder, "folders", r"rm -r .*/a{32}"),
    "merge": (killed_merge, "folders", r"rm -r .*/\.merge-0123"),
    "stale": (silent_run, "stale", r"ssmail runs list"),
}


@pytest.mark.parametrize(("damage", "kind", "remedy"), DAMAGE.values(), ids=DAMAGE)
def test_each_damage_is_found(damage: Callable[[Path], str], kind: str, remedy: str, filled: Path) -> None:
    subject = damage(filled)
    found = [problem for problem in check(filled) if problem.subject == subject]
    assert [problem.check for problem in found] == [kind]
    assert re.search(remedy, found[0].remedy)
    assert "\n" not in found[0].problem + found[0].remedy
    others = [problem for problem in check(filled) if problem.subject != subject]
    assert {problem.check for problem in others} <= ({"orphans", "checkpoints"} if kind == "orphans" else set())


def test_the_remedies_for_orphans_and_stale_runs_help(filled: Path) -> None:
    silent_run(filled)
    change(filled, "INSERT INTO metric VALUES ('gone', 'x', 1, 0.0, 'finite')")
    change(filled, "INSERT INTO metric_latest VALUES ('gone', 'x', 1, 0.0, 'finite')")
    orphans = [problem for problem in check(filled) if problem.check == "orphans"]
    assert [problem.problem for problem in orphans] == [
        f"1 row belongs to no run in the table {table}" for table in ("metric", "metric_latest")
    ]
    for problem in orphans:
        _, _, statement = shlex.split(problem.remedy.split("`")[1])
        change(filled, statement)
    opened = Store.open(filled)
    opened.mark_stale()
    opened.close()
    assert check(filled) == []


def test_a_table_of_someone_else_gets_no_command(filled: Path) -> None:
    change(filled, 'CREATE TABLE "run; rm -r ~" (run_id TEXT REFERENCES run (id))')
    change(filled, "INSERT INTO \"run; rm -r ~\" VALUES ('gone')")
    (problem,) = check(filled)
    assert problem.check == "orphans"
    assert "`" not in problem.remedy


@pytest.mark.parametrize("name", ["a b", "a; touch gone", "a' $(touch gone)"])
def test_a_remedy_is_one_command_whatever_the_folder_is_called(name: str, filled: Path, tmp_path: Path) -> None:
    database = tmp_path / name / "results" / "ssmail.db"
    shutil.copytree(filled.parent, database.parent)
    folder = database.parent / "checkpoints" / ("a" * 32)
    folder.mkdir(parents=True)
    (problem,) = check(database)
    command = problem.remedy.split("`")[1]
    assert shlex.split(command) == ["rm", "-r", str(folder)]


def test_a_folder_that_cannot_be_printed_is_not_in_a_command(filled: Path, tmp_path: Path) -> None:
    database = tmp_path / "a\x1b[2Jb" / "results" / "ssmail.db"
    shutil.copytree(filled.parent, database.parent)
    (database.parent / "checkpoints" / ("a" * 32)).mkdir(parents=True)
    (problem,) = check(database)
    assert problem.remedy == "unless a database on a server has this run, delete the folder: `rm -r ...`"


def test_checkpoints_of_another_database_in_the_folder_are_no_strays(filled: Path) -> None:
    other = Store.open(filled.with_name("other.db"))
    add(other, 7)
    other.close()
    (filled.parent / "notes.txt").write_text("no database")
    (filled.parent / "checkpoints" / "mine").mkdir()  # not named as ssmail names folders
    assert check(filled) == []
    other_path = Path(other.where)
    other_path.unlink()
    assert [problem.check for problem in check(filled)] == ["folders"]  # negative control


def test_a_frozen_database_of_the_first_schema_is_sound_but_for_its_checkpoint(tmp_path: Path) -> None:
    copy = Path(shutil.copy(ASSET, tmp_path / "old.db"))
    assert {problem.check for problem in check(copy)} <= {"checkpoints", "spec"}


def test_damaged_pages_are_told(filled: Path) -> None:
    content = bytearray(filled.read_bytes())
    with closing(sqlite3.connect(filled)) as connection:
        ((page,),) = connection.execute("SELECT rootpage FROM sqlite_master WHERE name = 'run_cell'").fetchall()
        ((size,),) = connection.execute("PRAGMA page_size").fetchall()
    content[(page - 1) * size : page * size] = bytes(size)
    filled.write_bytes(content)
    found = check(filled)
    assert {problem.check for problem in found} == {"integrity"}
    assert "restore a backup" in found[0].remedy


def test_a_truncated_file_is_told(filled: Path) -> None:
    filled.write_bytes(filled.read_bytes()[: 3 * 4096])
    assert {problem.check for problem in check(filled)} == {"integrity"}


def test_an_empty_file_has_no_tables_yet(tmp_path: Path) -> None:
    (tmp_path / "empty.db").touch()
    (problem,) = check(tmp_path / "empty.db")
    assert problem.check == "schema"
    assert problem.problem.startswith("it has no tables yet")
    assert "the next command that opens it makes them" in problem.remedy
    Store.open(tmp_path / "empty.db").close()
    assert check(tmp_path / "empty.db") == []


def test_what_is_no_database_of_ssmails_is_refused(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_bytes(b"These are my notes, not a database. " * 100)
    with pytest.raises(InputError, match=r"notes\.txt is not an SQLite database"):
        check(tmp_path / "notes.txt")
    change(tmp_path / "other.db", "CREATE TABLE run (id TEXT)")
    with pytest.raises(InputError, match="another program"):
        check(tmp_path / "other.db")
    with pytest.raises(InputError, match="there is no database"):
        check(tmp_path / "missing.db")
    assert not (tmp_path / "missing.db").exists()
    with pytest.raises(InputError, match="is a folder"):
        check(tmp_path)
