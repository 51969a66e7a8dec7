"""README.md is true: its commands run as they stand there, `make demo` included, and it is short.

One substitution, `smaller`, makes them small: the profile is smoke instead of quick, the only seed is 0, and the
ablation over beta has two values.
"""

import math
import re
import shlex
from itertools import product
from pathlib import Path

import pytest

from ssmail.config.experiments_file import ENVIRONMENT_VARIABLE
from ssmail.store import Store
from ssmail_cli.main import run

from .config.experiments_file import SHIPPED, write

ROOT = Path(__file__).parents[1]
TEXT = (ROOT / "README.md").read_text("utf-8")
MAKEFILE = (ROOT / "Makefile").read_text("utf-8")
MOST_WORDS = 700
BETAS = [0.0, 0.15]


def commands_of_readme() -> list[str]:
    """The lines of the shell blocks, without comments."""
    blocks = re.findall(r"```sh\n(.*?)```", TEXT, re.DOTALL)
    return [shlex.join(words) for line in "".join(blocks).splitlines() if (words := shlex.split(line, comments=True))]


def recipe(target: str) -> list[str]:
    """The ssmail commands of a target of the Makefile."""
    (lines,) = re.findall(rf"^{target}:.*\n((?:\t.*\n)+)", MAKEFILE, re.MULTILINE)
    return [line.strip().removeprefix("$(BIN)/") for line in lines.splitlines() if "$(BIN)/ssmail" in line]


def smaller(command: str) -> list[str]:
    """The arguments of a command of ssmail, at smoke size and with one seed."""
    program, *arguments = shlex.split(command.replace("--profile quick", "--profile smoke"))
    assert program == "ssmail"
    if "--seeds" in arguments:
        arguments[arguments.index("--seeds") + 1] = "0"
    elif arguments[0] in ("train", "ablate"):
        arguments += ["--seeds", "0"]
    return arguments


def write_table(path: Path) -> None:
    """Write 12 scenes in which two agents walk side by side for 60 frames."""
    lines = ["scene,frame,agent,x,y"]
    for scene, frame, agent in product(range(12), range(60), range(2)):
        x = frame + math.sin(0.3 * frame + scene)
        lines.append(f"{scene},{frame},{agent},{x:.4f},{5 * agent + 0.1 * x:.4f}")
    path.write_text("\n".join(lines) + "\n")


def test_the_commands_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    ablations = SHIPPED.ablations | {"beta": SHIPPED.ablations["beta"] | {"values": BETAS}}
    monkeypatch.setenv(ENVIRONMENT_VARIABLE, str(write(tmp_path / "experiments.yaml", ablations=ablations)))
    monkeypatch.delenv("SSMAIL_DB", raising=False)
    monkeypatch.chdir(tmp_path)

    demo = recipe("demo")
    assert len(demo) == 2
    assert [run(smaller(command)) for command in demo] == [0, 0], capsys.readouterr().err
    figures = [line for line in capsys.readouterr().out.splitlines() if line.startswith("results/figures/")]
    assert figures == re.findall(r"^results/figures/\S+$", TEXT, re.MULTILINE)  # README shows this output
    assert all(Path(file).is_file() for file in figures)

    commands = [command for command in commands_of_readme() if command.startswith("ssmail ")]
    assert len(commands) == 9
    write_table(Path("flock.csv"))
    for command in commands:
        assert run(smaller(command)) == 0, (command, capsys.readouterr().err)
    runs = Store.open("results/ssmail.db").runs()
    assert sorted(run.method for run in runs) == ["dnri", "dnri", "ssail", *["ssail"] * len(BETAS)]
    assert Path("results/figures/forecast_flock.png").is_file()
    assert {run.state for run in runs} == {"finished"}


def test_a_wrong_command_would_be_noticed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert run(smaller("ssmail ablate betta --profile quick --jobs 2")) == 2
    assert run(smaller("ssmail train --metod dnri --profile quick")) == 2


def test_make_has_the_targets_that_it_names() -> None:
    named = set(re.findall(r"(?:^|`)make ([a-z-]+)", TEXT, re.MULTILINE))
    assert named >= {"demo", "test", "docs"}
    assert named <= set(re.findall(r"^([a-z-]+):", MAKEFILE, re.MULTILINE))


def test_it_is_short() -> None:
    assert len(TEXT.split()) <= MOST_WORDS


def test_its_links_lead_somewhere() -> None:
    links = re.findall(r"\]\(([^)#]+)", TEXT)
    assert len(links) > 10
    assert [link for link in links if not (ROOT / link).exists()] == []
