"""The tours of README and docs/usage.md run as they stand on a copy of the reference database, and train nothing."""

import re
import shlex
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

from ssmail.execution import local
from ssmail.store import Store
from ssmail_cli.main import run

ROOT = Path(__file__).parents[2]
NEEDS_TRAINING = ("train", "ablate", "reproduce")


def commands(page: str, heading: str) -> list[list[str]]:
    """The arguments of ssmail in the first block of commands below a heading."""
    (block,) = re.findall(
        rf"^## {heading}\n.*?```sh\n(.*?)```", (ROOT / page).read_text("utf-8"), re.DOTALL | re.MULTILINE
    )
    lines = [shlex.split(line, comments=True) for line in block.splitlines()]
    assert {program for program, *_ in lines} == {"ssmail"}
    return [arguments for _, *arguments in lines]


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A working folder with the reference database as its own, in which no process may be started."""
    (tmp_path / "results").mkdir()
    shutil.copy(ROOT / "results" / "reference" / "reference.db", tmp_path / "results" / "ssmail.db")
    monkeypatch.chdir(tmp_path)
    for name in ("SSMAIL_DB", "SSMAIL_EXPERIMENTS"):
        monkeypatch.delenv(name, raising=False)

    def started(*_: Any) -> None:
        raise AssertionError("the command trains a run that the reference database should hold")

    monkeypatch.setattr(local, "_Worker", started)
    return tmp_path


def shown(arguments: Sequence[str], capsys: pytest.CaptureFixture[str]) -> str:
    """What a command that succeeds prints on stdout."""
    code = run(list(arguments))
    printed = capsys.readouterr()
    assert code == 0, (arguments, printed.err)
    return printed.out


def test_the_six_commands_of_the_readme(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    tour = commands("README.md", "Six commands")
    assert len(tour) == 6
    before = len(Store.open("results/ssmail.db").runs())
    for arguments in tour:
        out = shown(arguments, capsys)
        if arguments[0] in ("train", "ablate"):
            assert out.count("skipped") == (5 if arguments[0] == "train" else 40)
    assert len(Store.open("results/ssmail.db").runs()) == before
    assert {path.name for path in Path("results/figures").glob("*.png")} == {"fig4_stability.png", "fig5_modes.png"}


@pytest.mark.slow
def test_the_tour_of_the_manual(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    tour = [
        line for line in commands("docs/usage.md", "A tour") if "--dry-run" in line or line[0] not in NEEDS_TRAINING
    ]
    assert len(tour) > 12
    for arguments in tour:
        if "RUN" not in arguments:  # of a run with forecasts, which the reference database does not hold
            shown(arguments, capsys)
    assert list(Path("results/figures").glob("film_0034c846*.gif"))
