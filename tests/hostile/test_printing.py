"""Every text that a database holds, printed by every command that prints any of it, in every form."""

import contextlib
import json
import sqlite3
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import matplotlib.font_manager  # noqa: F401 (keeps a list of fonts outside of the cases' folders)
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ssmail.store import RunState, Store
from tests.hostile.harness import cases, hold
from tests.store.databases import add

RUN_TEXTS = (
    "method",
    "environment",
    "profile",
    "host",
    "device",
    "error",
    "package_version",
    "torch_version",
    "git_commit",
    "dataset_hash",
    "spec_hash",
)
PLACES = (*RUN_TEXTS, "metric", "array", "artifact", "artifact path", "spec value", "spec key")
COMMANDS = (
    *(("runs", "list", "--format", form) for form in ("table", "csv", "json")),
    *(("runs", "show", "a" * 8, "--format", form) for form in ("table", "csv", "json")),
    *(("runs", "compare", "--format", form) for form in ("table", "csv", "json")),
    *(("runs", "export", "--format", form) for form in ("csv", "json")),
    ("runs", "delete", "a"),
    ("runs", "list", "--method", "zz"),
    ("runs", "compare", "--metric", "zz"),
    ("claims", "--format", "table"),
    ("claims", "--format", "csv"),
    ("db", "info"),
    ("db", "info", "--json"),
    ("db", "check"),
    ("db", "check", "--json"),
    ("report", "--out", "figures", "--format", "svg"),
    ("plot", "--out", "figures", "--format", "svg", "training", "--metric", "validation/mode_mse"),
    ("plot", "--out", "figures", "--format", "svg", "fig4"),
    ("db", "export", "--compact", "small.db"),
)
NASTY = "\x1b[]31m\x07\x9b\u202e\u2066\u200b\u2028\ufeff\U000e0041\n\r\t\x00|`*_<>&$\\'\"%{}[]/ab ="
TEXTS = st.one_of(
    st.text(st.sampled_from(NASTY), max_size=30),
    st.text(st.characters(exclude_categories=["Cs"]), max_size=30),
    st.sampled_from(["[/b]", "$\\nosuch$", "x" * 3000, "=1+1", "postgresql://u:pw@h/d", "-", "", "\x1b]0;title\x07"]),
)


@pytest.fixture(scope="module")
def original(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """A database of a finished run and a diverged one, whose ids begin with a and b."""
    path = tmp_path_factory.mktemp("printing") / "ssmail.db"
    store = Store.open(path)
    first, second = add(store, checkpoints={}), add(store, 1, state=RunState.DIVERGED, checkpoints={})
    store.close()
    with closing(sqlite3.connect(path, isolation_level=None)) as connection:
        for old, new in ((first, "a" * 32), (second, "b" * 32)):
            connection.execute("UPDATE run SET id = ? WHERE id = ?", (new, old))
            for table in ("metric", "metric_latest", "array", "artifact"):
                connection.execute(f"UPDATE {table} SET run_id = ? WHERE run_id = ?", (new, old))
        connection.execute("INSERT INTO artifact VALUES (?, 'last.pt', ?, 'x', 3)", ("a" * 32, "a" * 32 + "/last.pt"))
        connection.execute("PRAGMA journal_mode = DELETE")
    return path.read_bytes()


def spoil(path: Path, place: str, text: str) -> None:
    """Store the text in one place of the first run; where the database does not take it there, leave it as it was."""
    with closing(sqlite3.connect(path, isolation_level=None)) as connection:
        try:
            for statement, values in _statements(connection, place, text):
                connection.execute(statement, values)
        except sqlite3.IntegrityError:
            return


def _statements(connection: sqlite3.Connection, place: str, text: str) -> Iterator[tuple[str, tuple[str, ...]]]:
    run = "a" * 32
    if place in RUN_TEXTS:
        yield f"UPDATE run SET {place} = ? WHERE id = ?", (text, run)
    elif place == "metric":
        for table in ("metric", "metric_latest"):
            yield f"UPDATE {table} SET name = ? WHERE run_id = ? AND name = 'test/mode_mse'", (text, run)
    elif place == "array":
        yield "UPDATE array SET name = ? WHERE run_id = ?", (text, run)
    elif place.startswith("artifact"):
        yield f"UPDATE artifact SET {'path' if 'path' in place else 'name'} = ? WHERE run_id = ?", (text, run)
    else:
        ((stored,),) = connection.execute("SELECT spec_json FROM run WHERE id = ?", (run,))
        spec = json.loads(stored)
        if "key" in place:
            spec["curriculum"][text] = 1
        else:
            spec["curriculum"]["kind"] = text
        yield "UPDATE run SET spec_json = ? WHERE id = ?", (json.dumps(spec), run)


@cases(10, 500)
@given(place=st.sampled_from(PLACES), text=TEXTS, command=st.sampled_from(COMMANDS))
def test_a_stored_text_is_only_printed(
    original: bytes, tmp_path_factory: pytest.TempPathFactory, place: str, text: str, command: tuple[str, ...]
) -> None:
    folder = tmp_path_factory.mktemp("case")
    database = folder / "ssmail.db"
    database.write_bytes(original)
    spoil(database, place, text)
    with contextlib.chdir(folder):
        hold(folder, *command, "--db", database)


@pytest.mark.parametrize("place", ["method", "host", "error", "metric", "artifact", "artifact path", "spec value"])
def test_a_hostile_database_is_merged_or_refused_in_print(original: bytes, tmp_path: Path, place: str) -> None:
    other = tmp_path / "other.db"
    other.write_bytes(original)
    spoil(other, place, f"\x1b[2J\u202e\n{place}")
    hold(tmp_path, "db", "merge", other, "--db", tmp_path / "mine.db")
    hold(tmp_path, "db", "check", "--db", tmp_path / "mine.db")


@pytest.mark.parametrize("form", ["table", "csv", "json"])
def test_a_figure_of_a_hostile_database_is_explained_as_text(
    original: bytes, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, form: str
) -> None:
    database = tmp_path / "ssmail.db"
    database.write_bytes(original)
    spoil(database, "package_version", "\x1b[2J\u202e\npackage_version")
    monkeypatch.chdir(tmp_path)
    code, out, _ = hold(
        tmp_path, "plot", "--out", "figures", "training", "--metric", "validation/mode_mse", "--db", database
    )
    assert code == 0
    code, out, _ = hold(tmp_path, "explain", out.split()[0], "--format", form, "--db", database)
    assert code == 0
    assert r"\x1b[2J" in out or r"\u001b[2J" in out


@pytest.mark.parametrize("command", COMMANDS, ids=" ".join)
def test_escapes_everywhere_at_once(
    original: bytes, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, command: tuple[str, ...]
) -> None:
    database = tmp_path / "ssmail.db"
    database.write_bytes(original)
    for place in ("method", "profile", "host", "device", "error", "torch_version", "metric", "array", "artifact"):
        spoil(database, place, f"\x1b[2J\u202e\n{place}")
    monkeypatch.chdir(tmp_path)
    hold(tmp_path, *command, "--db", database)
    for path in tmp_path.rglob("*"):
        if path.suffix in (".md", ".html", ".csv"):
            assert "\x1b" not in path.read_text(encoding="utf-8")
            assert "\u202e" not in path.read_text(encoding="utf-8")
