"""Any argument for any command: the commands and options are those of the application itself."""

import os
import subprocess
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest
import typer
from hypothesis import given
from hypothesis import strategies as st

from ssmail.execution import local
from ssmail.execution.cells import Event
from ssmail.store import Store
from ssmail_cli.main import app
from tests.hostile.harness import cases, hold, refused
from tests.hostile.odd_values import WORDS
from tests.store.databases import add

DOWNLOADS = ("--download", "--cache")
"""They reach for the network."""
NUMBERS = ("-1", "0", "1", "2", "1e3", "9" * 30, "-" + "9" * 30, "9" * 5000, "nan", "inf", "1_0", "٣", "0x10", "", " 1")
SEEDS = (
    "0-99999999999",
    "9" * 5000,
    "0-",
    "-1",
    "3-1",
    "0,0,0",
    "0-999,1000-1999",
    "²",
    ",".join(f"{n}-{n + 900}" for n in range(0, 90000, 900)),
)
PATHS = (
    "~nobody/x",
    "~",
    "a" * 300,
    "b/" * 3000,
    "file.txt/x",
    "",
    ".",
    "\udcff\udcfe",
    "\x1b[31m",
    "x\ny",
)
URLS = (
    *("nosuch://x", "sqlite://", "sqlite:///", "sqlite:///:memory:", "mysql+idlelib://x", "idlelib://x", "ssmail_trap://x"),
    *("sqlite+ssmail_trap:///x", "postgresql+ssmail_trap://u:p@h/d", "://", "a b://", "sqlite:///" + "a" * 300, "http://x:y@z:b/"),
    *("sqlite:///file:x?mode=rw&uri=true", "postgresql://", "postgresql://h:99999999/x", "sqlite:///~nobody/x", "postgresql://h:x"),
)  # fmt: skip
VALUES = st.sampled_from((*NUMBERS, *SEEDS, *PATHS, *URLS, *WORDS)) | st.text(
    st.characters(exclude_categories=["Cs"]), max_size=20
)


def commands(command: Any, words: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], Any]]:
    """Every command of the application with the words that name it."""
    if hasattr(command, "commands"):
        for name, inner in command.commands.items():
            yield from commands(inner, (*words, name))
    else:
        yield words, command


COMMANDS = dict(commands(typer.main.get_command(app)))


def test_the_commands_are_found() -> None:
    assert {("train",), ("runs", "list"), ("db", "export"), ("plot", "fig6"), ("plot", "film")} <= set(COMMANDS)


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A working folder with a small database where it is by default; cells are not trained, but failed at once."""

    def run_cells(cells: Sequence[Any], **_: Any) -> list[Event]:
        return [Event("failed", cell, None, 0, 1, message="not trained") for cell in cells]

    monkeypatch.setattr(local, "run_cells", run_cells)
    monkeypatch.setattr("ssmail.execution.local.run_waiting", lambda *_, **__: ([], False))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HOME", str(tmp_path))
    (tmp_path / "file.txt").write_text("a file")
    (tmp_path / "results").mkdir()
    store = Store.open(tmp_path / "results" / "ssmail.db")
    add(store)
    add(store, 1, overrides=["curriculum.beta=0.5"])
    store.close()
    return tmp_path


def line(draw: st.DrawFn, words: tuple[str, ...]) -> list[str]:
    """The words of a command with up to four of its options, and arguments of some kind."""
    options = [option for option in COMMANDS[words].params if not set(option.opts) & {*DOWNLOADS, "--help"}]
    arguments: list[str] = []
    for option in draw(st.lists(st.sampled_from(options), max_size=4)) if options else ():
        name = draw(st.sampled_from(option.opts))
        value = draw(VALUES)
        if not name.startswith("-"):
            arguments.append(value)
        elif getattr(option, "is_flag", False):
            arguments.append(name)
        else:
            arguments += [name, value] if draw(st.booleans()) else [f"{name}={value}"]
    return [*words, *arguments]


@st.composite
def lines(draw: st.DrawFn) -> list[str]:
    return line(draw, draw(st.sampled_from(sorted(COMMANDS))))


@cases(60, 2600)
@given(words=lines())
def test_any_options_of_any_command(folder: Path, words: list[str]) -> None:
    if words[0] == "prep-mocap":
        words = [*words, "--source", "file.txt"]
    if words[0] == "worker":  # by default it waits for work until it is stopped
        words = [*words, "--idle-exit", "0"]
    hold(folder, *words)


@cases(20, 200)
@given(words=st.lists(VALUES, max_size=4))
def test_any_words(folder: Path, words: list[str]) -> None:
    hold(folder, *words)


@pytest.mark.parametrize("word", ["\udcff", "a\0b"])
def test_an_argument_that_is_no_text(folder: Path, word: str) -> None:
    for command in ("runs compare", "runs list --method", "plot all --out", "explain", "train --dry-run --db"):
        assert "is not UTF-8 text" in refused(folder, *command.split(), word)


@pytest.mark.parametrize("seeds", SEEDS, ids=lambda seeds: seeds[:12])
def test_seeds(folder: Path, seeds: str) -> None:
    code, _, _ = hold(folder, "train", "--dry-run", f"--seeds={seeds}")
    assert (code == 0) == (seeds == "0,0,0")


@pytest.mark.parametrize("url", URLS, ids=lambda url: url[:20])
def test_a_url_that_is_none_or_names_a_module(folder: Path, url: str) -> None:
    (folder / "ssmail_trap.py").write_text("")
    for command in ("runs list", "train --dry-run", "db info", "claims"):
        code, _, _ = hold(folder, *command.split(), "--db", url)
        assert code in (1, 2) or url == "sqlite:///~nobody/x"  # a folder of this name


@pytest.mark.parametrize("path", PATHS, ids=lambda path: ascii(path[:12]))
def test_an_odd_path(folder: Path, path: str) -> None:
    for command in ("runs list --db", "plot fig6 --out", "db backup", "db merge", "explain", "runs export --out"):
        hold(folder, *command.split(), path)


@pytest.mark.parametrize("backend", ["nonsense", "module://ssmail_trap", "TkAgg"])
def test_figures_are_drawn_whatever_the_backend(folder: Path, backend: str) -> None:
    """In a process of its own, since matplotlib reads the variable when it is imported."""
    command = [sys.executable, "-P", "-m", "ssmail_cli", "plot", "fig6", "--out", "figures"]
    settings = {"MPLBACKEND": backend, "MPLCONFIGDIR": str(folder), "PYTHONPATH": os.pathsep.join(sys.path)}
    done = subprocess.run(command, env={**os.environ, **settings}, capture_output=True, text=True, check=False)
    assert (done.returncode, len(done.stdout.splitlines())) == (0, 2), done.stderr
