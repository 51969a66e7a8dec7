"""One module prints, and nothing that it prints is more than what it says."""

import ast
import csv
import io
import json
from collections.abc import Iterator
from pathlib import Path

import pytest

from ssmail.errors import SsmailError
from ssmail_cli import output
from ssmail_cli.output import Format

ROOT = Path(__file__).parents[2]
HOSTILE = "\x1b[2J\u202e\nfake [bold]$x$ \ud800"
SHOWN = r"\x1b[2J\u202e\nfake [bold]$x$ \ud800"
PRINTING = {"print", "echo", "secho", "confirm", "prompt", "Console", "stdout.write", "stderr.write", "getLogger"}
ALLOWED = {
    "cli/ssmail_cli/output.py",
    "src/ssmail/data/mocap/download.py",  # prints without a command line
    "src/ssmail/config/experiments_file.py",  # logs which file is in use,
    "src/ssmail/execution/sources.py",  # which run is left in the queue,
    "src/ssmail/execution/local.py",  # and that there are fewer GPUs than wanted processes,
    "src/ssmail/execution/launchers.py",  # a job of a cluster, whose stdout is its log
    "cli/ssmail_cli/main.py",  # and notes what is logged
}


def printing(tree: ast.AST) -> Iterator[str]:
    """What in a module prints: names of functions, and methods of the standard streams."""
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.module == "ssmail_cli.output":
            continue  # its `confirm`
        if isinstance(node, ast.Name) and node.id in PRINTING - {"confirm"}:
            yield node.id
        elif isinstance(node, ast.Attribute):
            whole = ast.unparse(node)
            if node.attr in PRINTING or ".".join(whole.split(".")[-2:]) in PRINTING:
                yield whole
        elif isinstance(node, ast.ImportFrom):
            yield from (alias.name for alias in node.names if alias.name in PRINTING)


def test_no_other_module_prints() -> None:
    found = {
        str(path.relative_to(ROOT)): list(printing(ast.parse(path.read_text())))
        for folder in ("cli", "src")
        for path in (ROOT / folder).rglob("*.py")
    }
    assert {path for path, names in found.items() if names} == ALLOWED, found


@pytest.mark.parametrize(
    "statement",
    [
        "print(1)",
        "say = print",
        "typer.echo(1)",
        "console.print(1)",
        "sys.stderr.write('')",
        "typer.confirm('')",
        "from rich.console import Console",
        "logging.getLogger('a')",
    ],
)
def test_a_planted_print_is_caught(statement: str) -> None:
    assert list(printing(ast.parse(statement)))


def test_lines_and_cells_are_printable(capsys: pytest.CaptureFixture[str]) -> None:
    rows = [{"a": HOSTILE, "b": 0.5, "c": [HOSTILE], "d": None}]
    output.say(HOSTILE, "second")
    output.note(HOSTILE)
    output.print_table(rows, {"a": f"first\n[/{HOSTILE.replace(chr(10), '')}]", "b": "b"})
    out, err = capsys.readouterr()
    assert out.startswith(f"{SHOWN}\nsecond\n")
    assert err == f"{SHOWN}\n"
    assert "[bold]$x$" in out.replace("\n", "").split("second")[1]  # as it is, not as markup
    output.print_rows(rows, {}, Format.CSV)
    text = capsys.readouterr().out
    assert list(csv.reader(io.StringIO(text)))[1] == [SHOWN, "0.5", json.dumps([HOSTILE]), ""]
    output.print_rows(rows, {}, Format.JSON)
    text = capsys.readouterr().out
    assert json.loads(text)[0]["a"] == HOSTILE  # escaped by JSON itself, and nothing is lost
    for printed in (out, err, text):
        assert all(character.isprintable() or character == "\n" for character in printed)


def test_the_csv_of_a_file_is_printable(tmp_path: Path) -> None:
    output.write_csv([{"a\x1b": HOSTILE}], ["a\x1b"], tmp_path / "a.csv")
    assert (tmp_path / "a.csv").read_text() == f"a\\x1b\n{SHOWN}\n"


def test_numbers_and_formulas_stay_as_they_are_in_csv(tmp_path: Path) -> None:
    output.write_csv([{"a": -1.5, "b": "=1+1", "c": "-2"}], ["a", "b", "c"], tmp_path / "a.csv")
    assert (tmp_path / "a.csv").read_text() == "a,b,c\n-1.5,=1+1,-2\n"


def test_a_value_of_no_known_type_is_written_as_text(capsys: pytest.CaptureFixture[str]) -> None:
    output.write_json({"a": b"\x00", "b": Path("c")}, None)
    assert json.loads(capsys.readouterr().out) == {"a": "b'\\x00'", "b": "c"}


@pytest.mark.parametrize("error", [SsmailError("a\n\x1b" + "b" * 1000 + "; do c."), ValueError("a\n" + "b" * 1000)])
def test_an_error_is_one_short_line(error: Exception, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("SSMAIL_DEBUG", raising=False)
    line = output.error_line(error)
    assert line.isprintable()
    assert len(line) == 300
    assert line.endswith(("; do c.", "(SSMAIL_DEBUG=1 shows the traceback)"))


def test_a_password_is_not_printed(capsys: pytest.CaptureFixture[str]) -> None:
    output.say("postgresql://u:SECRET@h/d")
    output.note("postgresql://u:SECRET@h/d")
    output.complain("postgresql://u:SECRET@h/d cannot be opened")
    assert "SECRET" not in "".join(capsys.readouterr())


def test_a_table_that_is_too_wide_is_folded_before_columns_are_left_out(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "26")
    rows = [{"spec": "ssail", "a": "1.23 ± 0.45", "b": "6.78 ± 0.9"}, {"spec": "bc", "a": "1.2", "b": None}]
    columns = {"spec": "spec", "a": "test/\nmin_fde\n_20", "b": "test/\nfde"}
    output.print_table(rows, columns, ("a",), fold=True)
    assert [line.rstrip() for line in capsys.readouterr().out.splitlines()] == [
        "      test/",
        "      min_fde test/",
        "spec  _20     fde",
        "ssail 1.23    6.78",
        "      ± 0.45  ± 0.9",
        "bc    1.2     -",
    ]
    output.print_table(rows, columns, ("a",))
    told = capsys.readouterr().out.splitlines()
    assert told[-3].split() == ["bc", "-"]
    assert " ".join(told[-2:]) == "left out, as the terminal is narrow: test/min_fde_20"
