"""Opening a database: places and files that cannot be used, old and newer schemas, several processes at once."""

import shutil
import sqlite3
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from alembic.autogenerate import compare_metadata
from alembic.config import Config
from alembic.migration import MigrationContext
from alembic.script import ScriptDirectory
from sqlalchemy import create_engine, event, make_url

import ssmail.store
from ssmail.config.spec import RunSpec
from ssmail.errors import InputError, SsmailError
from ssmail.store import RunState, Store, connection
from ssmail.store.maintenance.checks import check
from ssmail.store.schema import REVISIONS, metadata

ASSETS = Path(__file__).parent / "assets"


@pytest.mark.parametrize("asset", [None, *sorted(ASSETS.glob("schema_*.sqlite"))], ids=lambda path: path and path.stem)
def test_new_and_upgraded_databases_have_the_tables_of_the_schema(asset: Path | None, tmp_path: Path) -> None:
    """The migrations, applied one after the other, end in exactly the tables that the code uses."""
    if asset is not None:
        shutil.copy(asset, tmp_path / "ssmail.db")
    Store.open(tmp_path / "ssmail.db").close()
    engine = create_engine(f"sqlite:///{tmp_path / 'ssmail.db'}")
    with engine.connect() as open_connection:
        assert compare_metadata(MigrationContext.configure(open_connection), metadata) == []
        open_connection.exec_driver_sql("DROP INDEX run_cell")  # negative control
        assert len(compare_metadata(MigrationContext.configure(open_connection), metadata)) == 1
    engine.dispose()


def test_every_migration_is_known_in_order() -> None:
    config = Config()
    config.set_main_option("script_location", str(Path(ssmail.store.__file__).parent / "migrations"))
    scripts = list(ScriptDirectory.from_config(config).walk_revisions())
    assert tuple(script.revision for script in reversed(scripts)) == REVISIONS


def test_every_old_schema_is_kept_as_a_file() -> None:
    assert {path.stem for path in ASSETS.glob("*.sqlite")} >= {f"schema_{revision}" for revision in REVISIONS}


@pytest.mark.parametrize("asset", sorted(ASSETS.glob("schema_*.sqlite")), ids=lambda path: path.stem)
def test_a_database_of_each_schema_opens_with_all_it_holds(asset: Path, tmp_path: Path) -> None:
    copy = tmp_path / "old.db"
    shutil.copy(asset, copy)
    store = Store.open(copy)
    finished, interrupted = store.runs()
    assert (finished.state, finished.seed, finished.method) == (RunState.FINISHED, 0, "ssail")
    assert (interrupted.state, interrupted.seed, interrupted.error) == (
        RunState.INTERRUPTED,
        1,
        "stopped after epoch 1",
    )
    assert finished.spec["training"]["epochs"] == 3
    latest = store.latest_metrics([finished.id])
    assert dict(zip(latest["name"], latest["value"], strict=True)) == {
        "actor/loss": -np.inf,
        "best_epoch": 2.0,
        "test/mode_mse": 0.004,
        "validation/mode_mse": 0.005,
    }
    curve = store.metrics([finished.id], ["actor/loss"])["value"].tolist()
    np.testing.assert_array_equal(curve, [0.5, np.nan, -np.inf])
    expected = np.arange(12, dtype=np.float32).reshape(1, 2, 3, 1, 2)
    np.testing.assert_array_equal(store.array(finished.id, "test/rollouts"), expected)
    assert [row.name for row in store.artifacts(finished.id)] == ["best.pt"]
    writer = store.resume_run(interrupted.id, 1)
    writer.epoch(2, {"actor/loss": 1.0})
    writer.finish(RunState.FINISHED)
    store.close()


def test_opening_a_current_database_does_not_change_its_file(store: Store) -> None:
    store.close()
    before = Path(store.where).read_bytes()
    again = Store.open(store.where)
    again.runs()
    again.close()
    assert Path(store.where).read_bytes() == before


def test_the_url_opens_the_same_database(tmp_path: Path, spec: RunSpec) -> None:
    store = Store.open(tmp_path / "odd %41 ?x=1 #name.db")
    store.start_run(spec, 0, dataset_hash=None, device="cpu")
    again = Store.open(store.url)
    assert len(again.runs()) == 1
    assert again.where == store.where == str(tmp_path / "odd %41 ?x=1 #name.db")
    assert again.checkpoint_root == tmp_path / "checkpoints"
    store.close()
    again.close()


def test_a_relative_path_is_taken_from_here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    store = Store.open("results/ssmail.db")
    monkeypatch.chdir("/")
    assert store.where == str(tmp_path / "results" / "ssmail.db")
    assert Store.open(store.url).where == store.where
    store.close()


def garbage(folder: Path) -> str:
    (folder / "notes.txt").write_bytes(b"These are my notes, not a database. " * 100)
    return str(folder / "notes.txt")


def truncated(folder: Path) -> str:
    content = (ASSETS / "schema_0001.sqlite").read_bytes()
    (folder / "cut.db").write_bytes(content[: len(content) // 3])
    return str(folder / "cut.db")


def of_another_program(folder: Path) -> str:
    with sqlite3.connect(folder / "other.db") as other:
        other.execute("CREATE TABLE run (id TEXT)")
    other.close()
    return str(folder / "other.db")


def newer(folder: Path) -> str:
    path = folder / "newer.db"
    shutil.copy(ASSETS / "schema_0001.sqlite", path)
    with sqlite3.connect(path) as other:
        other.execute("UPDATE alembic_version SET version_num = '0999'")
    other.close()
    return str(path)


def below_a_file(folder: Path) -> str:
    (folder / "file").write_text("")
    return str(folder / "file" / "ssmail.db")


REFUSED: dict[str, tuple[Callable[[Path], str], str]] = {
    "garbage": (garbage, r"notes\.txt is not an SQLite database"),
    "truncated": (truncated, r"cut\.db is not an SQLite database, or is damaged"),
    "other": (of_another_program, r"other\.db is a database of another program"),
    "newer": (newer, r"newer\.db was written by a newer ssmail \(schema 0999; .* up to 0001\); upgrade ssmail"),
    "folder": (str, r"is a folder; give the path of the database file"),
    "below a file": (below_a_file, r"cannot create the folder .*file for the database"),
    "unwritable": (lambda _: "/proc/ssmail.db", r"cannot write the database /proc/ssmail\.db"),
    "memory": (lambda _: "sqlite://", "is not a file on disk"),
    "URI": (lambda folder: f"sqlite:///file:{folder}/a.db?uri=true", "is not a file on disk"),
    "no URL": (lambda _: "://", "neither a path nor a database URL"),
    "no dialect": (lambda _: "nosuch://host/name", "nosuch is no database that ssmail knows; use sqlite or postgresql"),
    "any module": (lambda _: "sqlite+idlelib:///x.db", "idlelib is no database that ssmail knows"),
    "no server": (lambda folder: f"postgresql:///name?host={folder}", r"cannot connect to the database postgresql:///"),
    "long": (lambda _: 300 * "a", "is no path; give that of a database file"),
}


@pytest.mark.parametrize(("make", "sentence"), REFUSED.values(), ids=REFUSED)
def test_what_cannot_be_used_is_one_sentence(make: Callable[[Path], str], sentence: str, tmp_path: Path) -> None:
    where = make(tmp_path)
    before = {path: path.read_bytes() for path in tmp_path.iterdir()}
    with pytest.raises(InputError, match=sentence) as caught:
        Store.open(where)
    assert "\n" not in str(caught.value)
    assert {path: path.read_bytes() for path in tmp_path.iterdir()} == before


def test_a_password_is_not_shown() -> None:
    with pytest.raises(InputError, match=r"postgresql://me:\*\*\*@127.0.0.1:1/name") as caught:
        Store.open("postgresql://me:secret@127.0.0.1:1/name")
    assert "secret" not in str(caught.value)


@pytest.mark.parametrize("url", ["postgresql://me:secret@host/name", "postgresql+psycopg://me:secret@host/name"])
def test_without_the_extra_the_sentence_says_how_to_install_it(url: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "psycopg", None)
    for use in (Store.open, check):
        with pytest.raises(InputError, match=r"run `pip install 'ssmail\[postgres\]'`$") as caught:
            use(url)
        assert "postgresql://me:***@host/name" in str(caught.value)


@pytest.mark.parametrize(
    "url",
    [
        "nosuch://me:secret@host/name",
        "nosuch://host/name?password=secret",
        "nosuch://host/name?p%61ssword=secret&user=me",
        "nosuch://me:sec@secret/@host/name",
        "postgresql://me:secret@host:port/name",
        "postgresql://me:secret@host:99999999/name?sslpassword=secret",
        "://me:secret@host",
        "sqlite://me:secret@host/",
    ],
)
def test_no_form_of_a_url_shows_a_password(url: str) -> None:
    with pytest.raises(InputError) as caught:
        Store.open(url)
    assert "secret" not in str(caught.value)


def test_a_store_on_a_server_is_named_without_its_password() -> None:
    for url in ("postgresql://me:secret@host/name", "postgresql://host/name?user=me&password=secret"):
        assert "secret" not in connection.name_of(make_url(url))
        assert "host" in connection.name_of(make_url(url))


def test_a_read_only_database_can_be_read_but_not_written(store: Store, spec: RunSpec) -> None:
    """Root may write where the file system forbids it, hence SQLite's own switch, which refuses in the same words."""
    store.start_run(spec, 0, dataset_hash=None, device="cpu")
    store.close()
    event.listen(store._engine, "connect", lambda connection, _: connection.execute("PRAGMA query_only = ON"))
    assert len(store.runs()) == 1
    with pytest.raises(InputError, match=r"cannot write the database .* choose a writable place"):
        store.start_run(spec, 1, dataset_hash=None, device="cpu")


def test_a_database_that_stays_locked_is_one_sentence(
    store: Store, spec: RunSpec, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(connection, "BUSY_SECONDS", 0.1)
    hasty = Store.open(store.where)
    holder = sqlite3.connect(store.where, isolation_level=None)
    holder.execute("BEGIN IMMEDIATE")
    with pytest.raises(SsmailError, match=r"another program locked the database .* for"):
        hasty.start_run(spec, 0, dataset_hash=None, device="cpu")
    assert hasty.runs() == []  # reading waits for nobody
    holder.close()
    hasty.start_run(spec, 0, dataset_hash=None, device="cpu")
    hasty.close()


OPEN_AT_ONCE = """
import sys, time
from ssmail.store import Store
print("ready", flush=True)
sys.stdin.readline()
print(len(Store.open(sys.argv[1]).runs()))
"""


def test_several_processes_may_create_the_same_database_at_once(tmp_path: Path) -> None:
    command = [sys.executable, "-c", OPEN_AT_ONCE, str(tmp_path / "new" / "ssmail.db")]
    pipe = subprocess.PIPE
    processes = [subprocess.Popen(command, stdin=pipe, stdout=pipe, stderr=pipe, text=True) for _ in range(4)]
    for process in processes:
        assert process.stdout is not None
        assert process.stdout.readline() == "ready\n"
    for process in processes:  # all have imported everything and now start together
        assert process.stdin is not None
        process.stdin.write("\n")
        process.stdin.flush()
    assert [process.communicate() for process in processes] == [("0\n", "")] * len(processes)
