"""`ssmail db` and the other commands on a PostgreSQL server, and the places where its password must not appear."""

import json
import os
import shutil
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from sqlalchemy import make_url

from ssmail.errors import InputError
from ssmail.store import RunState, Store, connection
from ssmail.store.maintenance import postgres, whole_databases
from ssmail.store.maintenance.checks import check
from ssmail.store.maintenance.merge import Fate, merge
from ssmail_cli.main import run
from tests.store.databases import add, change, contents
from tests.store.postgres_server import PASSWORD, Server

Call = Callable[..., tuple[int, str, str]]


@pytest.fixture
def call(capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Call:
    """Run a command in the test's folder: exit code, stdout, stderr."""
    for name in ("SSMAIL_DB", "SSMAIL_EXPERIMENTS", "SSMAIL_DEBUG", "PGPASSWORD", "PGPASSFILE"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.chdir(tmp_path)

    def command(*words: object) -> tuple[int, str, str]:
        capsys.readouterr()
        code = run([str(word) for word in words])
        return code, *capsys.readouterr()

    return command


@pytest.fixture
def filled(tmp_path: Path) -> Iterator[Store]:
    """An SQLite file with one finished, one diverged and one interrupted run."""
    opened = Store.open(tmp_path / "here" / "here.db")
    add(opened, 0)
    add(opened, 1, state=RunState.DIVERGED)
    add(opened, 2, [0.3], RunState.INTERRUPTED)
    yield opened
    opened.close()


def test_runs_survive_the_way_to_a_server_and_back(
    filled: Store, url: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    there = merge(url, filled.where)
    assert [item.fate for item in there.runs] == [Fate.ADDED] * 3
    assert (there.target, there.without_checkpoints, there.damaged) == (connection.name_of(make_url(url)), (), ())
    assert [item.fate for item in merge(url, filled.where).runs] == [Fate.ALREADY_THERE] * 3
    assert check(url) == []
    back = tmp_path / "back" / "back.db"
    assert merge(back, url).count(Fate.ADDED) == 3
    assert contents(back) == contents(filled.where)
    assert check(back) == []
    with pytest.raises(InputError, match="is the database itself"):
        merge(url, url)


def test_a_merge_brings_only_what_is_missing(
    server: Server, url: str, tmp_path: Path, filled: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    other = server.url(server.new_database())
    store = Store.open(other)
    (ran,) = (add(store, 2, [0.3, 0.2]),)  # got further
    add(store, 0, [0.3, 0.25])  # differs
    store.close()
    done = merge(filled.where, other)
    assert [item.fate for item in done.runs] == [Fate.REPLACED, Fate.DIFFERENT]
    assert [run.id for run in filled.runs() if run.seed == 2] == [ran]
    assert merge(url, other).count(Fate.ADDED) == 2  # from server to server


def test_a_run_that_does_not_fit_is_left_out_and_named(filled: Store, url: str, tmp_path: Path, call: Call) -> None:
    """An SQLite file of an earlier version may hold a profile of 80 characters."""
    (long,) = [run for run in filled.runs() if run.seed == 1]
    spec = json.dumps({**json.loads(long.spec_json), "profile": "p" * 80})
    change(filled.where, "UPDATE run SET profile = ?, spec_json = ? WHERE id = ?", "p" * 80, spec, long.id)
    code, out, _ = call("db", "merge", filled.where, "--db", url)
    assert code == 0
    first, last = out.splitlines()
    assert first.startswith("left out: the run's profile 'ppp")
    assert first.endswith(f"has 80 characters, of which the database keeps 64 (run {long.name})")
    assert last.endswith("2 runs added, 1 run left out: damaged")


def test_check_finds_what_is_wrong(
    server: Server, database: str, url: str, tmp_path: Path, call: Call, monkeypatch: pytest.MonkeyPatch
) -> None:
    store = Store.open(url)
    first, second = add(store, 0), add(store, 1)
    silent = add(store, 2, state=RunState.RUNNING)
    assert check(url) == []
    with server.connect(database) as admin:
        admin.execute("UPDATE metric_latest SET value = 7 WHERE run_id = %s AND name = 'test/mode_mse'", (first,))
        admin.execute("UPDATE run SET heartbeat = '2026-01-01' WHERE id = %s", (silent,))
    shutil.rmtree(store.checkpoint_root / second)
    stray = store.checkpoint_root / ("a" * 32)
    stray.mkdir()
    store.close()
    code, out, err = call("db", "check", "--db", url)
    assert (code, "4 problems" in err) == (1, True)
    kinds = [line.partition(":")[0] for line in out.splitlines()]
    assert kinds == ["latest metrics", "stale", "checkpoints", "folders"]
    assert f"unless a database on a server has this run, delete the folder: `rm -r {stray}`" in out


def test_a_backup_can_be_restored(server: Server, url: str, tmp_path: Path, filled: Store, call: Call) -> None:
    merge(url, filled.where)
    code, out, _ = call("db", "backup", "copy.dump", "--db", url)
    assert (code, out.startswith("wrote copy.dump, ")) == (0, True)
    assert "exists already and is not overwritten" in call("db", "backup", "copy.dump", "--db", url)[2]
    new = server.new_database()
    words = ["pg_restore", "--no-owner", f"--dbname=host={server.folder} user=ssmail dbname={new}", "copy.dump"]
    subprocess.run(words, check=True, env={**os.environ, "PGPASSWORD": PASSWORD})
    merge(tmp_path / "restored.db", server.url(new))
    assert contents(tmp_path / "restored.db") == contents(filled.where)


def test_a_backup_that_pg_dump_refuses_is_one_sentence(url: str, call: Call, monkeypatch: pytest.MonkeyPatch) -> None:
    Store.open(url).close()
    words: list[list[str]] = []
    real = subprocess.run
    monkeypatch.setattr(
        postgres.subprocess,
        "run",
        lambda command, **options: (
            words.append(command)
            or real(["sh", "-c", "echo 'pg_dump: error: server version mismatch' >&2; exit 1"], **options)
        ),
    )
    code, out, err = call("db", "backup", "copy.dump", "--db", url)
    assert (code, out) == (2, "")
    assert "(pg_dump: error: server version mismatch); use the pg_dump of the server's version" in err
    assert not Path("copy.dump").exists()
    assert PASSWORD not in " ".join(map(str, words[0]))  # which all users of the machine see
    monkeypatch.setattr(postgres.shutil, "which", lambda _: None)
    assert "pg_dump is not installed; install PostgreSQL's client" in call("db", "backup", "x", "--db", url)[2]


def test_an_upgrade_leaves_a_backup(url: str, call: Call, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    Store.open(url).close()
    assert "already has the newest schema" in call("db", "upgrade", "--db", url)[1]
    monkeypatch.setattr(whole_databases, "connect", lambda _: Store.open(tmp_path / "x.db")._engine)
    for module in (connection, whole_databases):
        monkeypatch.setattr(module, "REVISIONS", ("0001", "0002"))
    done = whole_databases.upgrade(url)
    assert (done.before, done.after) == ("0001", "0002")
    assert done.backup is not None
    assert done.backup.parent == tmp_path / "results"
    assert done.backup.read_bytes().startswith(b"PGDMP")


COMMANDS = (
    ("runs", "list"),
    ("runs", "show", "zz"),
    ("runs", "compare", "--metric", "test/mode_mse"),
    ("runs", "compare", "--metric", "nosuch"),
    ("db", "info"),
    ("db", "info", "--json"),
    ("db", "check"),
    ("db", "upgrade"),
    ("db", "backup", "copy.dump"),
    ("db", "merge", "here/here.db", "--json"),
    ("db", "export", "--compact", "small.db"),
    ("plot", "training", "--metric", "validation/mode_mse", "--out", "figures"),
    ("plot", "fig9", "--out", "figures"),
    ("claims",),
    ("report", "--out", "report"),
    ("train", "--profile", "smoke", "--dry-run"),
)


def test_a_password_is_shown_nowhere(server: Server, database: str, tmp_path: Path, filled: Store, call: Call) -> None:
    url = server.url(database)
    merge(url, filled.where)
    said = []
    for words in COMMANDS:
        code, out, err = call(*words, "--db", url)
        assert code in (0, 2, 3), (words, err)
        assert "unexpected" not in err
        said += [out, err]
    assert [text for text in said if PASSWORD in text] == []
    files = [path for path in tmp_path.rglob("*") if path.is_file()]
    assert {path.suffix for path in files} >= {".db", ".dump", ".csv", ".png", ".html", ".md"}
    assert [path for path in files if PASSWORD.encode() in path.read_bytes()] == []
    stored = merge(tmp_path / "all.db", url).target
    assert PASSWORD.encode() not in Path(stored).read_bytes()
    with Store.open(url)._engine.connect() as open_connection:  # negative control: it is in use
        assert open_connection.engine.url.password == PASSWORD


@pytest.mark.parametrize("source", ["query", "PGPASSWORD", "PGPASSFILE"])
def test_the_password_may_be_elsewhere(
    source: str, server: Server, database: str, call: Call, monkeypatch: pytest.MonkeyPatch
) -> None:
    url = server.url(database, None)
    with pytest.raises(InputError, match="no password supplied"):  # negative control: it is needed
        Store.open(url)
    if source == "query":
        url += f"&password={PASSWORD}"
    elif source == "PGPASSWORD":
        monkeypatch.setenv("PGPASSWORD", PASSWORD)
    else:
        file = server.folder / f"{database}.passfile"
        file.write_text(f"*:*:*:ssmail:{PASSWORD}\n")
        file.chmod(0o600)
        monkeypatch.setenv("PGPASSFILE", str(file))
    Store.open(url).close()
    for words in (("db", "info"), ("db", "backup", "copy.dump")):
        code, out, err = call(*words, "--db", url)
        assert code == 0
        assert PASSWORD not in out + err
    assert PASSWORD.encode() not in Path("copy.dump").read_bytes()


def test_a_wrong_password_is_not_shown_either(
    server: Server, database: str, url: str, call: Call, monkeypatch: pytest.MonkeyPatch
) -> None:
    Store.open(url).close()
    wrong = server.url(database, "WRONG%40" + PASSWORD)
    for debug in ("", "1"):
        monkeypatch.setenv("SSMAIL_DEBUG", debug)
        for words in (("runs", "list"), ("db", "backup", "other.dump"), ("train", "--profile", "smoke")):
            code, out, err = call(*words, "--db", wrong)
            assert code == 2
            assert "password authentication failed" in err
            assert "WRONG" not in out + err
