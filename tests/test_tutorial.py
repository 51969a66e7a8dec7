"""docs/tutorial.md is true: its program and its commands run as they stand there, in an empty folder."""

import re
import shlex
from pathlib import Path

import pytest

from ssmail.store import Store
from ssmail_cli.main import run

TEXT = Path(__file__).parents[1].joinpath("docs", "tutorial.md").read_text("utf-8")
(PROGRAM,) = re.findall(r"```python\n(.*?)```", TEXT, re.DOTALL)
COMMANDS = [
    shlex.split(line)[1:] for block in re.findall(r"```sh\n(.*?)```", TEXT, re.DOTALL) for line in block.splitlines()
]
(TABLE,) = re.findall(r"```text\n(.*?)```", TEXT, re.DOTALL)


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.delenv("SSMAIL_DB", raising=False)
    monkeypatch.chdir(tmp_path)
    exec(PROGRAM, {})
    return tmp_path


def test_the_program_writes_the_table_and_the_import_says_what_came_in(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert COMMANDS[0][0] == "import-data"
    assert run(COMMANDS[0]) == 0
    printed = [line.rstrip() for line in capsys.readouterr().out.splitlines()]
    assert printed[: TABLE.count("\n")] == TABLE.splitlines()


@pytest.mark.slow
def test_the_commands_run_from_the_table_to_the_figures(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for command in COMMANDS:
        arguments = command
        if "RUN" in command:
            (ssail,) = Store.open(folder / "results" / "ssmail.db").runs(method="ssail")
            arguments = [ssail.id if word == "RUN" else word for word in command]
        assert run(arguments) == 0, (command, capsys.readouterr().err)
    figures = {path.name.split(".")[0] for path in (folder / "results" / "figures").iterdir()}
    assert any(name.startswith("forecast") for name in figures)
    assert any(name.startswith("trajectories") for name in figures)
    futures = (folder / "futures.csv").read_text().splitlines()
    assert futures[0] == "window,scene,sample,step,frame,agent,x,y"
    assert len(futures) > 20
