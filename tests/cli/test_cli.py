"""The command line as a whole: its help, its start-up, and one line for everything that goes wrong."""

import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import typer.main

from ssmail import __version__
from ssmail.errors import SsmailError
from ssmail.store import Store
from ssmail_cli import train
from ssmail_cli.main import app
from tests.cli.command_line import CommandLine

HEAVY = {"torch", "pandas", "matplotlib", "scipy", "numpy", "sqlalchemy", "yaml"}


def commands(command: Any, path: str = "ssmail") -> Iterator[tuple[str, Any]]:
    yield path, command
    for name, child in getattr(command, "commands", {}).items():
        yield from commands(child, f"{path} {name}")


COMMANDS = dict(commands(typer.main.get_command(app)))


def test_the_commands_are_those_of_the_documentation() -> None:
    assert {path.removeprefix("ssmail").strip() for path in COMMANDS} == {
        "",
        "generate-yjunction",
        "generate-letters",
        "prep-mocap",
        "import-data",
        "train",
        "ablate",
        "ablate-alpha",
        "ablate-beta",
        "control",
        "reproduce",
        "worker",
        "queue",
        "report",
        "plot",
        *(f"plot fig{number}" for number in range(1, 10)),
        "plot all",
        "plot training",
        "plot ablation",
        "plot control",
        "plot forecast",
        "plot trajectories",
        "plot landscape",
        "plot film",
        "plot skeleton",
        "claims",
        "config",
        "config init",
        "config keys",
        "config show",
        "explain",
        "forecast",
        "export-model",
        "help",
        "runs",
        "runs list",
        "runs show",
        "runs compare",
        "runs export",
        "runs delete",
        "db",
        "db info",
        "db upgrade",
        "db check",
        "db backup",
        "db merge",
        "db export",
    }


@pytest.mark.parametrize("path", COMMANDS)
def test_every_command_and_option_has_help(path: str, cli: CommandLine) -> None:
    command = COMMANDS[path]
    assert command.help
    for parameter in command.params:
        assert getattr(parameter, "help", None), f"{path} {parameter.name} has no help"
    shown = cli(*path.split()[1:], "--help")
    assert shown.code == 0
    for parameter in command.params:
        for option in parameter.opts:
            assert option in shown.out or parameter.param_type_name == "argument"


def heavy_modules_after(statement: str) -> set[str]:
    code = f"import sys; {statement}; print(*sys.modules)"
    answer = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return HEAVY & set(answer.stdout.split())


def test_importing_the_command_line_imports_nothing_heavy() -> None:
    assert heavy_modules_after("import ssmail_cli.main") == set()
    assert "yaml" in heavy_modules_after("import ssmail_cli.main, ssmail.config.experiments")  # the test can fail


def modules_after(*arguments: str, **environment: str) -> int:
    count = "import atexit, sys; atexit.register(lambda: print(len(sys.modules), file=sys.stderr))"
    code = f"{count}; sys.argv[0] = 'ssmail'; from ssmail_cli.main import main; main()"
    answer = subprocess.run(
        [sys.executable, "-c", code, *arguments],
        env={**os.environ, **environment},
        capture_output=True,
        text=True,
        check=True,
    )
    return int(answer.stderr.split()[-1])


def test_help_and_completion_load_little() -> None:
    """What they cost is the modules that they load; `make bench` tells the seconds."""
    assert modules_after("--help") < 250
    assert modules_after(_SSMAIL_COMPLETE="complete_bash", COMP_WORDS="ssmail train --set sac.", COMP_CWORD="3") < 270
    assert modules_after("config", "keys") > 300  # pydantic, for one: the test can fail


def test_the_version(cli: CommandLine) -> None:
    assert cli("--version").out == f"ssmail {__version__}\n"


def test_without_a_command_the_help_is_shown(cli: CommandLine) -> None:
    assert cli() == cli("--help")
    assert "generate-yjunction" in cli().out


@pytest.mark.parametrize(
    ("line", "sentence"),
    [
        ("trian", "`ssmail` has no command trian; did you mean `ssmail train`?"),
        ("train --sed 3", "`ssmail train` has no option --sed; did you mean --seeds?"),
        ("train --jobs 0", "greater than or equal to 1"),
        ("train --resume maybe", "'maybe' is not one of 'auto', 'never', 'require'."),
        ("train --device gpu", "--device takes auto, cpu, cuda or cuda:N, not 'gpu'; did you mean cuda?"),
        ("train --seeds", "option '--seeds' requires an argument."),
        ("train more", "unknown method 'more'; choose from ssail, gail, "),
        ("train --method ssial", "unknown method 'ssial'; did you mean ssail?"),
        ("train --env yjuncton", "unknown environment 'yjuncton'; did you mean yjunction?"),
        ("train --profile quik", "unknown profile 'quik'; did you mean quick?"),
        ("train --set sac.gama=1", "unknown key 'sac.gama' in --set; did you mean sac.gamma?"),
        ("train --set curriculum.beta=-1", "curriculum.beta = -1 in --set should be greater than or equal to 0."),
        ("train --set self_supervision.alpha=[2,1]", "the range from 2 to 1 ends before it begins; swap them."),
        ("train --db /proc/no/such/place.db", "/proc/no"),
        ("runs lst", "`ssmail runs` has no command lst; did you mean `ssmail runs list`?"),
        ("runs list --format tabel", "'tabel' is not one of 'table', 'csv', 'json', 'latex', 'markdown'."),
        ("ablate", "missing argument 'NAME|KEY...'."),
        ("ablate bta", "unknown ablation or key 'bta'; did you mean beta?"),
        ("ablate-bta", "`ssmail` has no command ablate-bta; did you mean `ssmail ablate-beta`?"),
        ("ablate beta --profile quik", "unknown profile 'quik'; did you mean quick?"),
        ("ablate beta --values 0,2", "curriculum.beta = 2 in --values should be less than or equal to 1."),
        ("ablate-beta --values abc", "curriculum.beta = abc in --values should be a number."),
        ("ablate beta --values 0,,1", "--values takes values with commas between them, such as 0,0.15,1, not '0,,1'."),
        ("ablate beta --values [", "--values takes values with commas between them"),
        ("ablate beta --values=", "--values takes values with commas between them"),
        ("ablate beta --values [0,1]", "curriculum.beta = [0, 1] in --values should be a number."),
        ("ablate alpha --values 0,1", "self_supervision.alpha: takes a range [low, high], or weighted ranges"),
        ("ablate alpha --values [1,0]", "the range from 1 to 0 ends before it begins; swap them."),
        ("ablate alpha --env mocpa", "unknown environment 'mocpa'; did you mean mocap?"),
        ("ablate beta --set curriculum.beta=1", "give its values with --values, not --set."),
        ("ablate curriculum --values forcing", "curriculum.name = forcing in --values should be 'none'"),
        ("reproduce --only fig4,fig55", "unknown figure 'fig55'; did you mean fig5?"),
        ("reproduce --format jpg", "unknown figure format 'jpg'; did you mean png?"),
        ("reproduce --stat mean", "unknown statistic 'mean'; did you mean mean-ci?"),
        ("reproduce --only fig5,fig9 --stat mean-ci", "fig5, fig9 shows no centre and band; leave --stat out."),
        ("reproduce --profile quik", "unknown profile 'quik'; did you mean quick?"),
        ("reproduce --seeds 4-0", "the range 4-0 in --seeds runs backwards"),
        ("plot", "name what to draw, such as fig4 or all"),
        ("plot --out x", "name what to draw, such as fig4 or all"),
        ("plot --ot x", "`ssmail plot` has no option --ot; did you mean --out?"),
        ("plot fig4 --out", "option '--out' requires an argument."),
        ("plot fig55", "unknown figure 'fig55'; did you mean fig5?"),
    ],
)
def test_a_wrong_command_line_is_one_sentence_and_exit_code_2(cli: CommandLine, line: str, sentence: str) -> None:
    assert sentence in cli(*line.split()).sentence


@pytest.mark.parametrize(
    "line", ["runs list", "runs show a", "runs compare", "runs export", "runs delete a", "plot fig5"]
)
def test_reading_needs_a_database_and_makes_none(cli: CommandLine, line: str, tmp_path: Path) -> None:
    missing = tmp_path / "none.db"
    sentence = cli(*line.split(), "--db", missing).sentence
    assert sentence.startswith(f"there is no database {missing}; `ssmail train --method ssail")
    assert not missing.exists()


def test_the_database_may_be_named_by_the_environment(
    cli: CommandLine, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SSMAIL_DB", str(tmp_path / "mine.db"))
    assert str(tmp_path / "mine.db") in cli("runs", "list").sentence
    Store.open(tmp_path / "mine.db").close()
    assert cli("runs", "list").code == 0


@pytest.mark.parametrize(
    ("error", "code", "sentence"),
    [
        (
            RuntimeError("first\nsecond"),
            1,
            "unexpected RuntimeError: first second (SSMAIL_DEBUG=1 shows the traceback)",
        ),
        (SsmailError("the disk is full"), 1, "the disk is full"),
    ],
)
def test_whatever_fails_is_one_line(
    cli: CommandLine, monkeypatch: pytest.MonkeyPatch, error: Exception, code: int, sentence: str
) -> None:
    def fail(_: str) -> list[int]:
        raise error

    monkeypatch.setattr(train, "parse_seeds", fail)
    outcome = cli("train")
    assert (outcome.code, outcome.err) == (code, f"ssmail: {sentence}\n")


def test_ctrl_c_ends_with_its_own_exit_code(cli: CommandLine, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupt(_: str) -> list[int]:
        raise KeyboardInterrupt

    monkeypatch.setattr(train, "parse_seeds", interrupt)
    assert cli("train").code == 130


def test_a_developer_gets_the_traceback(cli: CommandLine, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SSMAIL_DEBUG", "1")
    monkeypatch.setattr(train, "parse_seeds", lambda _: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        cli("train")


def test_a_reader_that_stops_early_is_no_error(tmp_path: Path) -> None:
    Store.open(tmp_path / "ssmail.db").close()
    command = [sys.executable, "-m", "ssmail_cli", "runs", "list", "--db", str(tmp_path / "ssmail.db")]
    reading, writing = os.pipe()
    os.close(reading)
    with os.fdopen(writing, "w") as closed:
        process = subprocess.run(command, stdout=closed, stderr=subprocess.PIPE, text=True, check=False)
    assert "roken pipe" not in process.stderr
    assert "Traceback" not in process.stderr
