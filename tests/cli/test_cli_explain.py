"""`ssmail explain`: what is printed, exit codes, and sentences."""

import json
from collections.abc import Callable
from pathlib import Path

import pytest
from matplotlib.figure import Figure

from ssmail.store import Store
from tests.cli.command_line import CommandLine
from tests.store.databases import add, change


@pytest.fixture
def drawn(cli: CommandLine, db: Path, tmp_path: Path) -> Path:
    """Training curves of runs with two values of gamma."""
    store = Store.open(db)
    add(store, 0)
    add(store, 0, overrides=["sac.gamma=0.5"])
    store.close()
    outcome = cli("plot", "training", "--metric", "validation/mode_mse", "--db", db, "--out", tmp_path)
    assert outcome.code == 0
    return Path(outcome.out.splitlines()[0])


def test_the_runs_and_that_the_database_agrees(cli: CommandLine, drawn: Path, db: Path) -> None:
    shown = cli("explain", drawn, "--db", db)
    assert shown.code == 0
    assert [(row["seed"], row["differs"], row["database"]) for row in shown.rows] == [
        ("0", "gamma 0.95", "same"),
        ("0", "gamma 0.5", "same"),
    ]
    first, *_, last = shown.err.splitlines()
    assert first.startswith(f"{drawn}: training, metrics [validation/mode_mse], group_by method, statistic mean-std; ")
    assert f"CSV: {drawn.stem}.csv is as it was written with the figure" in shown.err
    assert last == f"{db} agrees: it holds all runs, with the same values"
    assert cli("explain", drawn.with_suffix(".csv"), "--db", db) == shown
    found = json.loads(cli("explain", drawn, "--json", "--db", db).out)
    assert (found["figure"], found["database"]["agrees"], found["csv"]["state"]) == ("training", True, "as written")
    assert [run["method"] for run in found["runs"]] == ["ssail", "ssail"]


def test_a_database_that_does_not_agree(cli: CommandLine, drawn: Path, db: Path, tmp_path: Path) -> None:
    change(db, "UPDATE metric SET value = 0.5 WHERE name = 'validation/mode_mse' AND step = 2")
    told = cli("explain", drawn, "--db", db)
    assert told.code == 1
    assert f"{db} does not agree: the values differ: line " in told.err
    ids = [run.id[:8] for run in Store.open(db).runs()]
    change(db, f"UPDATE run SET dataset_hash = '{'e' * 64}' WHERE id LIKE '{ids[0]}%'")
    changed = f"does not agree: 1 of 2 runs changed: {ids[0]} (data was {'d' * 64}, is {'e' * 64})"
    assert changed in cli("explain", drawn, "--db", db).err
    Store.open(tmp_path / "empty.db").close()
    told = cli("explain", drawn, "--db", tmp_path / "empty.db")
    assert told.code == 1
    assert "does not agree: 2 of 2 runs missing: " in told.err
    assert all(each in told.err for each in ids)


def test_without_a_database_the_figure_tells_what_it_knows(cli: CommandLine, drawn: Path, tmp_path: Path) -> None:
    told = cli("explain", drawn, "--db", tmp_path / "missing.db")
    assert told.code == 0
    assert told.err.splitlines()[-1].startswith("there is no database ")
    assert [row["database"] for row in told.rows] == ["", ""]
    assert json.loads(cli("explain", drawn, "--json", "--db", tmp_path / "missing.db").out)["database"] is None
    assert not (tmp_path / "missing.db").exists()


def picture(path: Path) -> None:
    Figure().savefig(path)


FOREIGN: dict[str, tuple[Callable[[Path], object], str]] = {
    "foreign.png": (picture, "carries no run ids of ssmail"),
    "foreign.pdf": (picture, "carries no run ids of ssmail"),
    "foreign.svg": (picture, "carries no run ids of ssmail"),
    "text.png": (lambda path: path.write_text("no image"), "is not a whole PNG image"),
    "text.pdf": (lambda path: path.write_text("no document"), "is not a whole PDF image"),
    "text.svg": (lambda path: path.write_text("no drawing"), "is not a whole SVG image"),
    "notes.txt": (lambda path: path.write_text("notes"), "is no figure of ssmail"),
    "missing.png": (lambda _: None, "cannot be read: No such file or directory"),
    "lonely.csv": (lambda path: path.write_text("a,b\n"), "has no figure beside it that tells its runs"),
}


@pytest.mark.parametrize("name", FOREIGN)
def test_what_is_no_figure_of_ssmails_is_one_sentence(name: str, cli: CommandLine, tmp_path: Path) -> None:
    make, sentence = FOREIGN[name]
    make(tmp_path / name)
    assert sentence in cli("explain", tmp_path / name).sentence
