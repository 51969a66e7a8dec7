"""results/reference: the figures, verdicts and tables that we show come from the database that we show."""

import io
import os
import platform
import re
import shutil
import sqlite3
import subprocess
import sys
from pathlib import Path

import pandas as pd
import pytest

from ssmail.paper.judgement import judge
from ssmail.paper.results import FIGURES
from ssmail.plots.saving import csv_text
from ssmail.store import Store

from . import results_table

ROOT = Path(__file__).parents[2]
REFERENCE = ROOT / "results" / "reference"
NAMES = tuple(f"fig{number}" for number in range(1, 10))
LARGEST = 15_000_000  # bytes
# A row of a table of verdicts; the README's leaves out the column of what the paper says.
VERDICT = re.compile(r"^\| (C[1-8]) [^|]*\|(?:[^|]*\|)? \*\*(\w+)\*\* \|", re.MULTILINE)


@pytest.fixture(scope="module")
def copy(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Of the database, so that no test writes beside the committed one."""
    return Path(shutil.copy(REFERENCE / "reference.db", tmp_path_factory.mktemp("reference")))


@pytest.fixture(scope="module")
def store(copy: Path) -> Store:
    return Store.open(str(copy))


def redrawn(store: Store, name: str) -> pd.DataFrame:
    """What the figure shows of the store, as it would be read from its CSV."""
    return pd.read_csv(io.StringIO(csv_text(FIGURES[name].collect(store).table())))


def committed(name: str) -> pd.DataFrame:
    return pd.read_csv(REFERENCE / "figures" / f"{FIGURES[name].stem}.csv")


@pytest.mark.parametrize("name", NAMES)
def test_the_figure_shows_what_its_csv_says(store: Store, name: str) -> None:
    assert (REFERENCE / "figures" / f"{FIGURES[name].stem}.png").is_file()
    # another machine may add up in another order
    pd.testing.assert_frame_equal(redrawn(store, name), committed(name), rtol=1e-6, atol=1e-12)


def test_another_value_shows_in_the_figure(copy: Path, tmp_path: Path) -> None:
    """The control: one value of a run that figure 4 shows, a thousandth larger."""
    shown = committed("fig4")
    other = Path(shutil.copy(copy, tmp_path))
    database = sqlite3.connect(other)
    with database:
        changed = database.execute(
            "UPDATE metric SET value = value * 1.001 WHERE run_id = ? AND name = 'train/mode_mse' AND step = 3",
            (shown["run_id"].dropna().iloc[0],),
        )
    database.close()
    assert changed.rowcount == 1
    now = redrawn(Store.open(str(other)), "fig4")
    with pytest.raises(AssertionError):
        pd.testing.assert_frame_equal(now, shown, rtol=1e-6, atol=1e-12)


@pytest.mark.skipif(platform.machine() != "x86_64", reason="OpenBLAS has other kernels there")
def test_a_figure_agrees_on_every_processor(copy: Path) -> None:
    """Figure 7 has fitted slopes, whose last digits change with the kernel of OpenBLAS: one of these two differs."""
    figure = REFERENCE / "figures" / "fig7_noise.png"
    command = [sys.executable, "-m", "ssmail_cli", "explain", str(figure), "--db", str(copy)]
    told = []
    for kernel in ("Prescott", "Haswell"):
        processor = {**os.environ, "OPENBLAS_CORETYPE": kernel}
        run = subprocess.run(command, env=processor, capture_output=True, text=True, timeout=300, check=False)
        if run.returncode < 0:
            pytest.skip(f"this processor cannot run the kernel {kernel}")
        assert run.returncode == 0, run.stderr
        told.append(run.stderr.splitlines()[-1])
    agrees = f"{copy} agrees: it holds all runs, with the same values"
    assert all(line.startswith(agrees) for line in told)
    assert f"{agrees}, to within 1e-06 of each number" in told


def test_five_seeds_of_each_spec_and_every_run_has_ended(store: Store) -> None:
    seeds: dict[str, set[int]] = {}
    for run in store.runs():
        assert run.state in ("finished", "diverged")
        assert run.profile == "quick"
        seeds.setdefault(run.spec_hash, set()).add(run.seed)
    assert set(map(frozenset, seeds.values())) == {frozenset(range(5))}


def test_the_database_is_small(copy: Path) -> None:
    assert copy.stat().st_size < LARGEST


@pytest.mark.parametrize("page", [REFERENCE / "report.md", ROOT / "README.md", ROOT / "docs" / "results.md"])
def test_the_verdicts_that_are_shown_are_those_of_the_database(store: Store, page: Path) -> None:
    shown = dict(re.findall(VERDICT, page.read_text("utf-8")))
    assert shown == {found.claim.name: str(found.verdict) for found in judge(store)}


def test_the_table_of_results_is_that_of_the_database(store: Store) -> None:
    page, rows = results_table.PAGE.read_text("utf-8"), results_table.rows(store)
    assert {"ssail", "gail", "wail", "dnri", results_table.BASELINE} == rows.keys()
    assert results_table.updated(page, rows) == page
    other = rows | {"ssail": rows["ssail"].replace("0.0021", "0.0022")}
    assert results_table.updated(page, other) != page
