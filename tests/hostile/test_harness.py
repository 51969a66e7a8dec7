"""The harness notices what it is there for."""

import importlib
import time
from pathlib import Path

import pytest

from tests.hostile import harness


def test_writing_outside_the_folder_is_seen(tmp_path: Path) -> None:
    (tmp_path / "in").mkdir()
    with harness.watching(tmp_path / "in") as watch:
        (tmp_path / "in" / "a").write_text("fine")
        assert watch.wrong == []
        (tmp_path / "b").write_text("not fine")
        (tmp_path / "b").unlink()
    assert [entry.split()[0] for entry in watch.wrong] == ["open", "os.remove"]


def test_a_trap_that_is_imported_is_seen(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "ssmail_trap.py").write_text("")
    monkeypatch.syspath_prepend(tmp_path)
    with harness.watching(tmp_path) as watch:
        importlib.import_module("ssmail_trap")
    assert watch.wrong == ["imported ssmail_trap"]


@pytest.mark.parametrize(
    ("code", "err"),
    [
        (0, "\x1b[31m"),
        (2, "ssmail: a \u202e b"),
        (2, "ssmail: " + 301 * "a"),
        (1, "ssmail: unexpected KeyError: 'a'"),
        (2, "no name"),
        (130, ""),
    ],
)
def test_a_bad_end_is_seen(code: int, err: str) -> None:
    with pytest.raises(AssertionError):
        harness.held(code, "", err)


def test_a_case_that_takes_too_long_is_ended() -> None:
    with pytest.raises(TimeoutError), harness.time_limit(1):
        time.sleep(30)
