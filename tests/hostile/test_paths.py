"""Run ids, recorded paths, links, pipes and programs in databases from strangers: nothing outside is touched."""

import os
import shutil
import sqlite3
import subprocess
import sys
from contextlib import closing
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ssmail.errors import InputError
from ssmail.store import Store
from ssmail.store.checkpoint_files import fault_of, run_folder
from ssmail.store.maintenance.checks import check
from ssmail.store.maintenance.merge import merge
from ssmail.store.schema import is_run_id
from tests.hostile.harness import cases, hold, refused
from tests.store.databases import add
from tests.store.databases import change as change_file

BAD_IDS = [
    "../../precious",
    ".",
    "..",
    "",
    "/tmp/precious",
    "a" * 31,
    "A" * 32,
    "a" * 32 + "\n",
    "a" * 32 + "/..",
    "٣" * 32,
    "a" * 16 + "\0" + "a" * 15,
    ".merge-0123456789abcdef012345678",
]


def stored(folder: Path, seeds: int = 1) -> list[str]:
    """A database with runs that have checkpoints, in `folder`; return their ids."""
    store = Store.open(folder / "ssmail.db")
    ids = [
        add(store, seed, checkpoints={name: name.encode() for name in ("best.pt", "last.pt")}) for seed in range(seeds)
    ]
    store.close()
    return ids


def change(folder: Path, statement: str, *values: object) -> None:
    change_file(folder / "ssmail.db", statement, *values)


def renamed(folder: Path, run_id: str, new: object) -> None:
    change(folder, "UPDATE run SET id = ? WHERE id = ?", new, run_id)
    for table in ("metric", "metric_latest", "array", "artifact"):
        change(folder, f"UPDATE {table} SET run_id = ? WHERE run_id = ?", new, run_id)


@pytest.fixture
def precious(tmp_path: Path) -> Path:
    """A folder that nobody may touch, beside those of the databases."""
    folder = tmp_path / "precious"
    folder.mkdir()
    (folder / "thesis.txt").write_text("years of work")
    return folder


def is_untouched(precious: Path) -> bool:
    return [path.read_text() for path in precious.iterdir()] == ["years of work"]


@pytest.mark.parametrize("bad", BAD_IDS)
def test_an_id_that_is_none_is_never_a_path(tmp_path: Path, precious: Path, bad: str) -> None:
    first, second = stored(tmp_path / "results", seeds=2)
    renamed(tmp_path / "results", first, bad)
    assert not is_run_id(bad)
    with pytest.raises(InputError, match="is no run id"):
        run_folder(tmp_path / "results" / "checkpoints", bad)
    db = tmp_path / "results" / "ssmail.db"
    for command in (
        ("runs", "list"),
        ("runs", "delete", bad[:40] or "x", "--yes"),
        ("db", "check"),
        ("db", "info"),
        ("db", "merge", db, "--db", tmp_path / "mine" / "ssmail.db"),
    ):
        where = () if "--db" in command else ("--db", db)
        if "\0" not in "".join(map(str, command)):
            hold(tmp_path, *command, *where)
    assert is_untouched(precious)
    assert (tmp_path / "results" / "checkpoints" / second / "best.pt").exists()
    assert {path.name for path in (tmp_path / "mine").glob("checkpoints/*")} <= {second}


@cases(quick=60, fuzz=600)
@given(st.text(max_size=40) | st.from_regex(r"\A[0-9a-f]{32}.?\Z"))
def test_only_32_hexadecimal_digits_are_an_id(tmp_path: Path, text: str) -> None:
    good = len(text) == 32 and all(character in "0123456789abcdef" for character in text)
    assert is_run_id(text) is good
    if good:
        assert run_folder(tmp_path, text).parent == tmp_path
    else:
        with pytest.raises(InputError):
            run_folder(tmp_path, text)


@pytest.mark.parametrize("bad", ["A" * 32, "../" + "a" * 29, "a" * 33, "", "a" * 32 + "\0b", b"a" * 32])
def test_a_new_database_refuses_other_ids_itself(tmp_path: Path, bad: str | bytes) -> None:
    (run_id,) = stored(tmp_path)
    with (
        closing(sqlite3.connect(tmp_path / "ssmail.db")) as connection,
        pytest.raises(sqlite3.IntegrityError, match="CHECK"),
    ):
        connection.execute("UPDATE run SET id = ? WHERE id = ?", (bad, run_id))


@pytest.mark.parametrize(
    "path",
    [
        "/etc/hostname",
        "../../precious/thesis.txt",
        "{id}/../../precious/thesis.txt",
        "best.pt",
        "{id}/a/b",
        "{id}/",
        "{id}/..",
    ],
)
def test_a_recorded_path_elsewhere_is_no_path(tmp_path: Path, precious: Path, path: str) -> None:
    (run_id,) = stored(tmp_path / "theirs")
    change(tmp_path / "theirs", "UPDATE artifact SET path = ? WHERE name = 'best.pt'", path.format(id=run_id))
    store = Store.open(tmp_path / "theirs" / "ssmail.db")
    best, last = store.artifacts(run_id)
    store.close()
    assert best.path is None
    assert last.path is not None  # negative control
    assert (fault_of(best), fault_of(last)) == ("recorded in another folder", None)
    (problem,) = check(tmp_path / "theirs" / "ssmail.db")
    assert "recorded in another folder" in problem.problem
    assert str(precious) not in problem.remedy


def test_a_merge_copies_regular_files_and_nothing_behind_links(tmp_path: Path, precious: Path) -> None:
    (run_id,) = stored(tmp_path / "theirs")
    folder = tmp_path / "theirs" / "checkpoints" / run_id
    (folder / "best.pt").unlink()
    (folder / "best.pt").symlink_to(precious / "thesis.txt")
    (folder / "more").symlink_to(precious)
    os.mkfifo(folder / "pipe")
    code, _, _ = hold(
        tmp_path, "db", "merge", tmp_path / "theirs" / "ssmail.db", "--db", tmp_path / "mine" / "ssmail.db"
    )
    assert code == 0
    copied = tmp_path / "mine" / "checkpoints" / run_id
    assert [(path.name, path.read_bytes()) for path in copied.iterdir()] == [("last.pt", b"last.pt")]


def test_a_folder_of_a_run_that_is_a_link_is_refused(tmp_path: Path, precious: Path) -> None:
    (run_id,) = stored(tmp_path / "theirs")
    folder = tmp_path / "theirs" / "checkpoints" / run_id
    shutil.rmtree(folder)
    folder.symlink_to(precious)
    sentence = refused(
        tmp_path, "db", "merge", tmp_path / "theirs" / "ssmail.db", "--db", tmp_path / "mine" / "ssmail.db"
    )
    assert "is a link, which ssmail does not follow" in sentence
    assert "altered" in check(tmp_path / "theirs" / "ssmail.db")[0].problem or is_untouched(precious)
    hold(tmp_path, "runs", "delete", run_id, "--yes", "--db", tmp_path / "theirs" / "ssmail.db")
    assert is_untouched(precious)


def test_ones_own_checkpoints_may_lie_on_another_disk(tmp_path: Path) -> None:
    (run_id,) = stored(tmp_path / "mine")
    (tmp_path / "mine" / "checkpoints").rename(tmp_path / "scratch")
    (tmp_path / "mine" / "checkpoints").symlink_to(tmp_path / "scratch")
    assert check(tmp_path / "mine" / "ssmail.db") == []
    (other,) = stored(tmp_path / "theirs")
    change(tmp_path / "theirs", "UPDATE run SET seed = 7")
    merge(tmp_path / "mine" / "ssmail.db", tmp_path / "theirs" / "ssmail.db")
    assert {path.name for path in (tmp_path / "scratch").iterdir()} == {run_id, other}


@pytest.mark.parametrize("name", ["best.pt", "last.pt"])
def test_check_does_not_wait_for_a_pipe(tmp_path: Path, name: str) -> None:
    (run_id,) = stored(tmp_path)
    file = tmp_path / "checkpoints" / run_id / name
    file.unlink()
    os.mkfifo(file)
    code, _, _ = hold(tmp_path, "db", "check", "--db", tmp_path / "ssmail.db")
    assert code == 1


@pytest.mark.parametrize("kind", ["pipe", "folder", "device"])
def test_what_is_no_file_is_no_database(tmp_path: Path, kind: str) -> None:
    place = Path("/dev/zero") if kind == "device" else tmp_path / "ssmail.db"
    if kind == "pipe":
        os.mkfifo(place)
    elif kind == "folder":
        place.mkdir()
    for command in (("runs", "list", "--db"), ("db", "check", "--db"), ("db", "merge", "--db", tmp_path / "a.db")):
        assert "give the path of" in refused(tmp_path, *command, place)


ENDLESS = "WITH RECURSIVE n(x) AS (SELECT 1 UNION ALL SELECT x + 1 FROM n) SELECT x FROM n"
PROGRAMS = {
    "view": ["ALTER TABLE run RENAME TO other", f"CREATE VIEW run AS {ENDLESS}"],
    "extra view": [f"CREATE VIEW more AS {ENDLESS}"],
    "trigger": ["CREATE TRIGGER t AFTER UPDATE ON run BEGIN DELETE FROM metric; END"],
    "virtual table": ["CREATE VIRTUAL TABLE more USING fts5(x)"],
    "computed column": ["ALTER TABLE run ADD COLUMN more TEXT AS (hex(zeroblob(100000000)))"],
}


@pytest.mark.parametrize("kind", PROGRAMS)
def test_a_database_with_a_program_in_it_is_refused(tmp_path: Path, kind: str) -> None:
    stored(tmp_path / "theirs")
    for statement in PROGRAMS[kind]:
        change(tmp_path / "theirs", statement)
    db = tmp_path / "theirs" / "ssmail.db"
    for command in (("runs", "list"), ("db", "check"), ("db", "info"), ("claims",)):
        assert "which ssmail never makes" in refused(tmp_path, *command, "--db", db)
    refused(tmp_path, "db", "merge", db, "--db", tmp_path / "mine.db")


def test_a_neighbour_with_a_program_in_it_is_not_asked(tmp_path: Path) -> None:
    stored(tmp_path)
    (tmp_path / "checkpoints" / ("a" * 32)).mkdir()
    with closing(sqlite3.connect(tmp_path / "neighbour.db")) as connection:
        connection.execute(f"CREATE VIEW run AS {ENDLESS}")
    (problem,) = check(tmp_path / "ssmail.db")
    assert problem.check == "folders"


def test_a_journal_that_names_another_file_is_refused(tmp_path: Path, precious: Path) -> None:
    stored(tmp_path)
    name = str(precious / "thesis.txt").encode()
    magic = bytes.fromhex("d9d505f920a163d7")
    end = name + len(name).to_bytes(4, "big") + sum(name).to_bytes(4, "big") + magic
    (tmp_path / "ssmail.db-journal").write_bytes(magic + bytes(504) + end)
    (tmp_path / "link").mkdir()
    (tmp_path / "link" / "link.db").symlink_to(tmp_path / "ssmail.db")
    for place in (tmp_path / "ssmail.db", tmp_path / "link" / "link.db"):
        assert "ssmail.db-journal is not" in refused(tmp_path, "runs", "list", "--db", place)
    (tmp_path / "ssmail.db-journal").write_bytes(b"")  # negative control: one that SQLite leaves behind
    assert hold(tmp_path, "runs", "list", "--db", tmp_path / "ssmail.db")[0] == 0
    assert is_untouched(precious)


MERGE = "import sys; from ssmail_cli.main import main; sys.argv[1:] = ['db', 'merge', *sys.argv[1:]]; main()"


def test_four_merges_into_a_new_file_wait_for_each_other(tmp_path: Path) -> None:
    ids = []
    for number in range(4):
        (run_id,) = stored(tmp_path / f"from{number}")
        change(tmp_path / f"from{number}", "UPDATE run SET seed = ?", number)
        ids.append(run_id)
    target = tmp_path / "mine" / "ssmail.db"
    commands = [
        [sys.executable, "-c", MERGE, str(tmp_path / f"from{number}" / "ssmail.db"), "--db", str(target)]
        for number in range(4)
    ]
    processes = [subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE) for command in commands]
    ends = [(process.communicate()[1], process.returncode) for process in processes]
    assert [code for _, code in ends] == [0] * 4, ends
    store = Store.open(target)
    assert {run.id for run in store.runs()} == set(ids)
    store.close()
    assert check(target) == []


def test_a_database_whose_creation_was_killed_is_repaired_by_opening_it(tmp_path: Path) -> None:
    (tmp_path / "ssmail.db").touch()
    code, out, err = hold(tmp_path, "db", "check", "--db", tmp_path / "ssmail.db")
    assert code == 1
    assert "the next command that opens it makes them" in out + err
    (run_id,) = stored(tmp_path / "theirs")
    merge(tmp_path / "ssmail.db", tmp_path / "theirs" / "ssmail.db")
    assert hold(tmp_path, "db", "check", "--db", tmp_path / "ssmail.db")[0] == 0
    store = Store.open(tmp_path / "ssmail.db")
    assert [run.id for run in store.runs()] == [run_id]
    store.close()
