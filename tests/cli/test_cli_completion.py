"""What the shell completes, asked as bash asks."""

import os
import sqlite3
import subprocess
import sys
from pathlib import Path

import pytest

from ssmail.config.experiments import build_spec
from ssmail.store import RunState, Store

SLOW = {"torch", "pandas", "matplotlib", "scipy", "numpy", "sqlalchemy", "pydantic"}


def complete(line: str) -> list[str]:
    """The completions of the last word of a line."""
    words = line.split(" ")
    asked = {"COMP_WORDS": line, "COMP_CWORD": str(len(words) - 1), "_SSMAIL_COMPLETE": "complete_bash"}
    command = [sys.executable, "-m", "ssmail_cli"]
    done = subprocess.run(command, env={**os.environ, **asked}, capture_output=True, text=True, check=True)
    assert done.stderr == ""
    return done.stdout.split()


@pytest.mark.parametrize(
    ("line", "found"),
    [
        ("ssmail tr", ["train"]),
        ("ssmail runs c", ["compare"]),
        ("ssmail train w", ["wail"]),
        ("ssmail train --method g", ["gail"]),
        ("ssmail train --env l", ["letters"]),
        ("ssmail train --profile p", ["paper"]),
        ("ssmail train --set sac.g", ["sac.gamma=", "sac.graph_entropy="]),
        ("ssmail train --device cu", ["cuda"]),
        ("ssmail ablate la", ["label"]),
        ("ssmail ablate curriculum.be", ["curriculum.beta"]),
        ("ssmail plot ablation --key cloning.i", ["cloning.input_noise"]),
        ("ssmail control av", ["averaging"]),
        ("ssmail control l", ["landscape-blur", "list"]),
        ("ssmail plot control re", ["reach", "replay"]),
        ("ssmail config keys sac.g", ["sac.gamma", "sac.graph_entropy"]),
        ("ssmail runs list --where sac.gam", ["sac.gamma="]),
        ("ssmail runs list --sort sac.gam", ["sac.gamma"]),
        ("ssmail plot fig4 fig5 --prof", ["--profile"]),
        ("ssmail plot fig9", ["fig9"]),
        ("ssmail reproduce mod", ["modes"]),
        ("ssmail claims C8", ["C8"]),
        ("ssmail runs list --state fi", ["finished"]),
        ("ssmail help plot tr", ["training", "trajectories"]),
        ("ssmail runs show 0", []),  # without a database
    ],
)
def test_words(line: str, found: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(path for path in sys.path if path))
    assert complete(line) == found
    assert list(tmp_path.iterdir()) == []


@pytest.fixture
def stored(db: Path) -> Store:
    """A database with two runs, one metric each."""
    store = Store.open(db)
    for seed in range(2):
        writer = store.start_run(build_spec("ssail", "yjunction", "smoke"), seed, dataset_hash="d" * 64, device="cpu")
        writer.epoch(1, {"train/mode_mse": 0.5})
        writer.finish(RunState.FINISHED)
    return store


def test_what_a_database_holds(stored: Store, db: Path) -> None:
    ids = [run.id for run in stored.runs()]
    assert sorted(complete(f"ssmail runs show --db {db} ")) == sorted(each[:8] for each in ids)
    assert complete(f"ssmail plot --db {db} film --run {ids[0][:9]}") == [ids[0][:9]]
    assert complete(f"ssmail runs compare --db {db} --metric train") == ["train/mode_mse"]


def test_a_database_of_a_stranger_computes_nothing_and_names_nothing_strange(stored: Store, db: Path) -> None:
    with sqlite3.connect(db) as connection:
        connection.execute("UPDATE metric_latest SET name = '$(reboot)' WHERE run_id = ?", (stored.runs()[0].id,))
    assert complete(f"ssmail runs compare --db {db} --metric ") == ["train/mode_mse"]
    with sqlite3.connect(db) as connection:
        connection.execute("PRAGMA foreign_keys = OFF")
        connection.execute("ALTER TABLE run RENAME TO other")
        endless = "WITH RECURSIVE n(x) AS (SELECT 1 UNION ALL SELECT x + 1 FROM n) SELECT x AS id, 1 AS started FROM n"
        connection.execute(f"CREATE VIEW run AS {endless}")
    assert complete(f"ssmail runs show --db {db} ") == []


def test_what_is_no_database_completes_nothing(tmp_path: Path) -> None:
    file = tmp_path / "no.db"
    file.write_text("no database\n" * 100)
    assert complete(f"ssmail runs show --db {file} ") == []


@pytest.mark.parametrize("line", ["ssmail train --set sac.", "ssmail plot fig4 --runs 0", "ssmail ablate "])
def test_completing_imports_nothing_slow(line: str, stored: Store, db: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SSMAIL_DB", str(db))
    code = (
        "import atexit, sys; atexit.register(lambda: print(*sys.modules, file=sys.stderr)); import ssmail_cli.__main__"
    )
    asked = {"COMP_WORDS": line, "COMP_CWORD": str(line.count(" ")), "_SSMAIL_COMPLETE": "complete_bash"}
    done = subprocess.run([sys.executable, "-c", code], env={**os.environ, **asked}, capture_output=True, text=True)
    assert "typer" in done.stderr.split()
    assert SLOW & set(done.stderr.split()) == set()
