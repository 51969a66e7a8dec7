"""Backups of databases in use, upgrades that keep the old state, and what a database tells of itself."""

import sqlite3
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from ssmail.errors import InputError
from ssmail.store import RunState, Store, connection
from ssmail.store.maintenance import whole_databases
from ssmail.store.maintenance.checks import check
from ssmail.store.maintenance.whole_databases import RunCount, back_up, describe_contents, upgrade
from ssmail.store.schema import REVISIONS
from tests.store.databases import SPEC, add, change, contents, files


def test_a_backup_holds_the_same_and_is_never_overwritten(store: Store, tmp_path: Path) -> None:
    add(store)
    copy = tmp_path / "copies" / "backup.db"
    assert back_up(store.where, copy) == copy.stat().st_size
    assert contents(copy) == contents(store.where)
    assert [path.name for path in copy.parent.iterdir()] == ["backup.db"]
    before = copy.read_bytes()
    add(store, 1)
    with pytest.raises(InputError, match=r"backup\.db exists already and is not overwritten"):
        back_up(store.where, copy)
    assert copy.read_bytes() == before
    opened = Store.open(copy)
    add(opened, 2)  # it is a database like any other
    opened.close()


def test_a_backup_has_what_still_is_in_the_log(store: Store, tmp_path: Path) -> None:
    """A plain copy of the file, taken at the same moment, has not."""
    add(store, state=RunState.RUNNING)
    log = Path(f"{store.where}-wal")
    assert log.stat().st_size > 0
    back_up(store.where, tmp_path / "backup.db")
    assert contents(tmp_path / "backup.db") == contents(store.where)
    (tmp_path / "plain.db").write_bytes(Path(store.where).read_bytes())
    with pytest.raises(sqlite3.OperationalError, match="no such table"):
        contents(tmp_path / "plain.db")


def test_a_backup_during_writes_is_one_moment(store: Store, tmp_path: Path) -> None:
    """Every epoch is one transaction of 20 values: any copy holds all or none of them."""
    writer = store.start_run(SPEC, 0, dataset_hash=None, device="cpu")
    done = threading.Event()

    def write() -> None:
        epoch = 0
        while not done.is_set():
            epoch += 1
            writer.epoch(epoch, {f"metric/{number}": float(epoch) for number in range(20)})

    thread = threading.Thread(target=write)
    thread.start()
    try:
        for number in range(5):
            back_up(store.where, tmp_path / f"{number}.db")
    finally:
        done.set()
        thread.join()
    for number in range(5):
        copy = tmp_path / f"{number}.db"
        rows = contents(copy)
        assert len(rows["metric"]) % 20 == 0
        assert check(copy) == []


KILLED = """
import os, signal, sys
from pathlib import Path
from ssmail.store.maintenance import whole_databases
whole_databases._copy_pages = lambda path, partial: (partial.write_bytes(b"half"), os.kill(os.getpid(), signal.SIGKILL))
whole_databases.back_up(sys.argv[1], Path(sys.argv[2]))
"""


def test_a_backup_that_is_killed_leaves_no_half_file(store: Store, tmp_path: Path) -> None:
    add(store)
    target = tmp_path / "backup.db"
    assert subprocess.run([sys.executable, "-c", KILLED, store.where, str(target)], check=False).returncode == -9
    assert not target.exists()
    back_up(store.where, target)
    assert contents(target) == contents(store.where)


def test_a_damaged_database_is_not_backed_up(store: Store, tmp_path: Path) -> None:
    add(store)
    store.close()
    path = Path(store.where)
    path.write_bytes(path.read_bytes()[: 3 * 4096])
    with pytest.raises(InputError, match=r"damaged") as caught:
        back_up(path, tmp_path / "copies" / "backup.db")
    assert "\n" not in str(caught.value)
    assert list((tmp_path / "copies").glob("*")) == []


def test_what_cannot_be_backed_up_is_refused(store: Store, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="there is no database"):
        back_up(tmp_path / "missing.db", tmp_path / "backup.db")
    (tmp_path / "file").touch()
    with pytest.raises(InputError, match="cannot be written"):
        back_up(store.where, tmp_path / "file" / "backup.db")


REVISION = """
import sqlalchemy as sa
from alembic import op

revision = "9998"
down_revision = {before!r}


def upgrade():
    op.create_table("invented", sa.Column("id", sa.Integer, primary_key=True))
    {then}
"""


@pytest.fixture
def newer(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """This ssmail knows one revision more; the path of that."""
    scripts = tmp_path / "migrations"
    for name, content in files(connection._MIGRATIONS).items():
        if name.endswith(".py"):
            (scripts / name).parent.mkdir(parents=True, exist_ok=True)
            (scripts / name).write_bytes(content)
    path = scripts / "versions" / "revision_9998.py"
    path.write_text(REVISION.format(before=REVISIONS[-1], then=""))
    monkeypatch.setattr(connection, "_MIGRATIONS", scripts)
    for module in (connection, whole_databases):
        monkeypatch.setattr(module, "REVISIONS", (*REVISIONS, "9998"))
    return path


def test_an_upgrade_keeps_the_old_state(store: Store, newer: Path) -> None:
    add(store)
    store.close()
    before = contents(store.where)
    done = upgrade(store.where)
    assert (done.before, done.after) == (REVISIONS[-1], "9998")
    assert done.backup is not None
    assert whole_databases.revision(done.backup) == REVISIONS[-1]
    assert whole_databases.revision(Path(store.where)) == "9998"
    assert contents(done.backup) == contents(store.where) == before
    again = upgrade(store.where)
    assert (again.before, again.backup) == ("9998", None)


def test_an_upgrade_that_fails_changes_nothing(store: Store, newer: Path) -> None:
    add(store)
    store.close()
    newer.write_text(REVISION.format(before=REVISIONS[-1], then="raise RuntimeError('planted')"))
    with pytest.raises(RuntimeError, match="planted"):
        upgrade(store.where)
    assert whole_databases.revision(Path(store.where)) == REVISIONS[-1]


def test_an_empty_file_becomes_a_database_without_a_backup(tmp_path: Path) -> None:
    (tmp_path / "empty.db").touch()
    done = upgrade(tmp_path / "empty.db")
    assert (done.before, done.after, done.backup) == (None, REVISIONS[-1], None)
    assert check(tmp_path / "empty.db") == []


def test_the_numbers_of_a_database(store: Store) -> None:
    for seed in (0, 1):
        add(store, seed)
    add(store, 2, state=RunState.DIVERGED)
    found = describe_contents(store.where)
    assert found.runs == (
        RunCount("yjunction", "ssail", "smoke", "diverged", 1),
        RunCount("yjunction", "ssail", "smoke", "finished", 2),
    )
    rows = contents(store.where)
    assert (found.metrics, found.arrays, found.artifacts) == tuple(
        len(rows[table]) for table in ("metric", "array", "artifact")
    )
    assert found.array_bytes == sum(len(row[-1]) for row in rows["array"])
    assert found.revision == found.newest_revision == REVISIONS[-1]
    assert found.array_share == pytest.approx(found.array_bytes / found.size_bytes)
    assert found.size_bytes == sum(Path(f"{store.where}{end}").stat().st_size for end in ("", "-wal"))
    assert found.free_bytes == 0
    change(store.where, "DELETE FROM array")
    change(store.where, "DELETE FROM metric")
    change(store.where, "DELETE FROM run")
    assert describe_contents(store.where).array_bytes == 0


def test_an_empty_file_holds_nothing(tmp_path: Path) -> None:
    (tmp_path / "empty.db").touch()
    found = describe_contents(tmp_path / "empty.db")
    assert (found.revision, found.runs, found.size_bytes, found.array_share) == (None, (), 0, 0.0)
    assert (tmp_path / "empty.db").read_bytes() == b""
