"""docs/python.md and docs/forecast.ipynb are true: their code runs, one block after the other, in an empty folder."""

import json
import os
import re
import shlex
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

import ssmail
from ssmail.store import Store
from ssmail_cli.main import run as command

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
TEXT = (DOCS / "python.md").read_text("utf-8")
BLOCKS = re.findall(r"```(sh|python)\n(.*?)```", TEXT, re.DOTALL)
EXAMPLE = "3f2a"


@pytest.fixture
def empty(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    for name in ("SSMAIL_DB", "SSMAIL_EXPERIMENTS"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("MPLBACKEND", "agg")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_the_tutorial_runs(empty: Path, capsys: pytest.CaptureFixture[str]) -> None:
    names: dict[str, Any] = {}
    run_id = EXAMPLE
    for language, block in BLOCKS:
        code = block.replace(EXAMPLE, run_id)
        if language == "python":
            exec(compile(code, "docs/python.md", "exec"), names)
            continue
        for line in code.splitlines():
            assert command(shlex.split(line)[1:]) == 0, (line, capsys.readouterr().err)
        (row,) = Store.open("results/ssmail.db").runs()
        run_id = row.id[:8]
    assert "two observed frames" in capsys.readouterr().out
    assert (empty / "futures.csv").is_file()


@pytest.mark.slow
def test_the_tutorial_runs_with_the_wheel_alone(tmp_path: Path) -> None:
    """In a fresh virtual environment, with no repository beside it.

    The first block of Python, which writes the table, then the commands, then the Python of all blocks.
    """
    folder = tmp_path / "empty"
    folder.mkdir()
    hidden = ("PYTHON", "SSMAIL", "VIRTUAL_ENV")
    environment = {name: value for name, value in os.environ.items() if not name.startswith(hidden)}

    def output(*words: str | Path) -> str:
        made = subprocess.run(
            words, cwd=folder, env=environment | {"MPLBACKEND": "agg"}, check=False, capture_output=True, text=True
        )
        assert made.returncode == 0, (words, made.stdout[-2000:], made.stderr[-2000:])
        return made.stdout

    output(sys.executable, "-m", "pip", "wheel", "--no-deps", "--wheel-dir", tmp_path, ROOT)
    (wheel,) = tmp_path.glob("ssmail-*.whl")
    output(sys.executable, "-m", "venv", tmp_path / "venv")
    programs = tmp_path / "venv" / "bin"
    output(programs / "python", "-m", "pip", "install", "--no-compile", "-c", ROOT / "constraints.txt", wheel)
    assert BLOCKS[0][0] == "python"
    output(programs / "python", "-c", BLOCKS[0][1])
    run_id = EXAMPLE
    for line in "".join(block for language, block in BLOCKS if language == "sh").splitlines():
        output(programs / "ssmail", *shlex.split(line.replace(EXAMPLE, run_id))[1:])
        if " train " in line:
            (row,) = json.loads(output(programs / "ssmail", "runs", "list", "--json"))
            run_id = row["id"]
    code = "".join(block for language, block in BLOCKS if language == "python").replace(EXAMPLE, run_id)
    (folder / "tutorial.py").write_text(f"{code}\nprint(ssmail.__file__)\n", "utf-8")
    told = output(programs / "python", "tutorial.py")
    assert "two observed frames" in told
    assert str(tmp_path / "venv") in told
    assert (folder / "futures.csv").is_file()


def test_the_table_of_attributes_names_what_there_is() -> None:
    (table,) = re.findall(r"\| attribute \| meaning \|\n(.*?)\n\n", TEXT, re.DOTALL)
    names = re.findall(r"`(\w+)`", " ".join(row.split("|")[1] for row in table.splitlines()))
    assert len(names) > 10
    fields = {*ssmail.TrainedRun.__dataclass_fields__, *vars(ssmail.TrainedRun)}
    assert [name for name in names if name not in fields] == []


def test_the_notebook_runs(empty: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """Cell by cell, with its commands in this process."""

    def in_this_process(line: str, *, shell: bool, check: bool) -> None:
        for part in line.split("&&"):
            assert command(shlex.split(part)[1:]) == 0, capsys.readouterr().err

    monkeypatch.setattr(subprocess, "run", in_this_process)
    notebook = json.loads((DOCS / "forecast.ipynb").read_text("utf-8"))
    assert (notebook["nbformat"], len({cell["id"] for cell in notebook["cells"]})) == (4, len(notebook["cells"]))
    names: dict[str, Any] = {}
    for cell in notebook["cells"]:
        assert cell.get("outputs", []) == []  # figures and numbers of one machine are no documentation
        if cell["cell_type"] == "code":
            exec(compile("".join(cell["source"]), "docs/forecast.ipynb", "exec"), names)
    assert names["samples"].shape == (20, 16, 20, 3, 2)
    assert "best of 20 samples" in capsys.readouterr().out
