"""docs/database.md is true: it explains every column, and its examples run."""

import contextlib
import io
import re
import shutil
import sqlite3
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ssmail.store import HEARTBEAT_SECONDS, STALE_SECONDS, RunState
from ssmail.store.connection import BUSY_SECONDS
from ssmail.store.schema import metadata

TEXT = (Path(__file__).parents[2] / "docs" / "database.md").read_text()
ASSET = Path(__file__).parent / "assets" / "schema_0001.sqlite"


def blocks(language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", TEXT, re.DOTALL)


def section(table: str) -> str:
    """The text on one table."""
    return TEXT.split(f"\n**`{table}`**")[1].split("\n**`")[0].split("\n## ")[0]


@pytest.mark.parametrize("table", metadata.tables)
def test_every_column_is_explained_and_no_other(table: str) -> None:
    explained = section("metric" if table == "metric_latest" else table)
    rows = [line.split("|")[1] for line in explained.splitlines() if line.startswith("| `")]
    assert set(re.findall(r"`(\w+)`", " ".join(rows))) == {column.name for column in metadata.tables[table].columns}


def test_every_state_is_explained() -> None:
    rows = re.findall(r"^\| `(\w+)`", TEXT.split("## States")[1].split("\n## ")[0], re.MULTILINE)
    assert set(rows) == set(RunState)


def test_numbers_in_the_text() -> None:
    assert f"every {HEARTBEAT_SECONDS:.0f} s within long ones" in TEXT
    assert f"younger than {STALE_SECONDS:.0f} s" in TEXT
    assert "up to two minutes" in " ".join(TEXT.split())
    assert BUSY_SECONDS == 120


@pytest.fixture
def database(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The database that the examples name, in the folder they run in."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "results").mkdir()
    return Path(shutil.copy(ASSET, tmp_path / "results" / "ssmail.db"))


def test_the_python_examples_run(database: Path) -> None:
    found: list[dict[str, Any]] = []
    for code in blocks("python"):
        found.append({})
        with contextlib.redirect_stdout(io.StringIO()):
            exec(code, found[-1])
    with_ssmail, with_pandas, with_numpy = found
    assert with_ssmail["curves"]["value"].tolist() == [0.04, 0.005, 0.005]
    assert with_pandas["errors"]["value"].tolist() == [0.04, 0.005, 0.005, 0.04]
    np.testing.assert_array_equal(with_numpy["rollouts"], with_ssmail["rollouts"])
    with_ssmail["store"].close()


def test_the_sql_examples_run(database: Path) -> None:
    (summary,) = blocks("sql")
    (backup,) = re.findall(r'"(VACUUM .*?)"', "".join(blocks("sh")))
    connection = sqlite3.connect(database, isolation_level=None)
    rows = connection.execute(summary).fetchall()
    assert [(row[0], row[1], row[3], row[4]) for row in rows] == [
        ("ssail", "smoke", "finished", 1),
        ("ssail", "smoke", "interrupted", 1),
    ]
    connection.execute(backup)
    connection.close()
    copy = sqlite3.connect("backup.db")
    assert copy.execute("SELECT COUNT(*) FROM run").fetchone() == (2,)
    copy.close()
