"""Standard streams that are closed, full, or read by nobody: commands say so or go on, and never lose a run."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from ssmail.store import RunState, Store

FULL = Path("/dev/full")
TRAIN = ("train", "--profile", "smoke", "--method", "constant-velocity")


def shell(redirection: str, *arguments: object) -> subprocess.CompletedProcess[str]:
    """Run a command of ssmail with a redirection of the shell."""
    command = [sys.executable, "-m", "ssmail_cli", *map(str, arguments)]
    line = ["sh", "-c", f'"$@" {redirection}', "sh", *command]
    return subprocess.run(line, capture_output=True, text=True, check=False)


@pytest.fixture(scope="module")
def database(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("streams") / "ssmail.db"
    Store.open(path).close()
    return path


@pytest.mark.parametrize(
    ("redirection", "reason"), [(">&-", "Bad file descriptor"), ("> /dev/full", "No space left on device")]
)
@pytest.mark.parametrize("arguments", [["runs", "list", "--format", "json"], ["--help"]])
def test_a_result_that_cannot_be_written_is_a_failure(
    database: Path, redirection: str, reason: str, arguments: list[str]
) -> None:
    if "full" in redirection and not FULL.exists():
        pytest.skip("no /dev/full")
    ended = shell(redirection, *arguments, *(["--db", database] if "runs" in arguments else []))
    assert ended.returncode == 1
    *_, last = ended.stderr.splitlines()
    assert last.startswith(f"ssmail: the result cannot be written to stdout ({reason}); ")
    assert "Traceback" not in ended.stderr
    assert "unexpected" not in ended.stderr


def test_nothing_to_ask_with_is_refused_as_usual(database: Path) -> None:
    ended = shell("<&-", "runs", "delete", "abc", "--db", database)
    assert ended.returncode == 2
    assert "unexpected" not in ended.stderr


def test_without_any_stream_the_exit_code_still_tells(database: Path) -> None:
    assert shell("<&- >&- 2>&-", "runs", "show", "zz", "--db", database).returncode == 2
    assert shell("2>&-", "runs", "list", "--db", database).returncode == 0
    assert database.read_bytes().startswith(b"SQLite format 3")  # nothing was printed into it


@pytest.mark.parametrize("redirection", ["2> /dev/full", "<&- >&- 2>&-"])
def test_training_goes_on_when_its_progress_cannot_be_written(tmp_path: Path, redirection: str) -> None:
    if "full" in redirection and not FULL.exists():
        pytest.skip("no /dev/full")
    ended = shell(redirection, *TRAIN, "--db", tmp_path / "a.db")
    assert ended.returncode == (1 if ">&- 2" in redirection else 0), ended.stderr
    store = Store.open(tmp_path / "a.db")
    assert [run.state for run in store.runs()] == [RunState.FINISHED]
    store.close()


def test_training_goes_on_when_nobody_reads_its_progress(tmp_path: Path) -> None:
    reading, writing = os.pipe()
    os.close(reading)
    command = [sys.executable, "-m", "ssmail_cli", *TRAIN, "--db", str(tmp_path / "a.db")]
    with os.fdopen(writing, "w") as nobody:
        ended = subprocess.run(command, stdout=subprocess.PIPE, stderr=nobody, check=False)
    assert ended.returncode == 0
    assert b"finished" in ended.stdout
