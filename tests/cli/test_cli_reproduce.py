"""`ssmail reproduce`: what it plans, how it counts, what it draws, and how it ends."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from ssmail.execution.figure_cells import figure_cells
from ssmail.figures import FIGURES, provenance
from ssmail.store import Store
from ssmail_cli.reproduce import duration
from tests.cli.command_line import CommandLine, FakeTraining, Outcome

SMOKE = ("reproduce", "--profile", "smoke", "--device", "cpu", "--seeds", "0-1")


def plan(outcome: Outcome) -> dict[str, tuple[int, int, int]]:
    """(runs, stored, new) by figure."""
    assert outcome.code == 0
    found = {row["figure"]: row for row in outcome.rows}
    return {name: (int(row["runs"]), int(row["stored"]), int(row["new"])) for name, row in found.items()}


def needs(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, **figures: list[str]) -> None:
    """Let figures need the runs of these methods alone, so that they can be drawn from little."""
    from ssmail.experiments_file import load_experiments

    head = load_experiments().path.read_text().partition("\nfigures:\n")[0]
    entries = [f"  {name}: {{environment: yjunction, methods: {methods}}}" for name, methods in figures.items()]
    (tmp_path / "e.yaml").write_text("\n".join([head, "figures:", *entries, ""]))
    monkeypatch.setenv("SSMAIL_EXPERIMENTS", str(tmp_path / "e.yaml"))


def test_shared_cells_are_planned_once(cli: CommandLine, db: Path) -> None:
    figures = plan(cli(*SMOKE, "--dry-run", "--only", "fig5,stability,fig4,fig9", "--db", db))
    assert figures == {"fig5": (4, 0, 4), "fig4": (6, 0, 6), "fig9": (2, 0, 2), "total": (8, 0, 8)}
    assert not db.parent.exists()


def test_without_only_every_figure_is_planned(cli: CommandLine, db: Path) -> None:
    figures = plan(cli(*SMOKE, "--dry-run", "--db", db))
    listed = dict.fromkeys(module.name for module in FIGURES.values())
    assert set(figures) <= {*listed, "total"}
    assert {"fig4", "fig5", "fig9"} < set(figures)
    cells = {cell for name in figures if name != "total" for cell in figure_cells(name, "smoke", [0, 1])}
    assert figures["total"] == (len(cells), 0, len(cells))
    assert len(cells) < sum(runs for name, (runs, _, _) in figures.items() if name != "total")


def test_a_dry_run_counts_what_is_stored_and_judges_the_time_by_it(
    cli: CommandLine, fake: FakeTraining, db: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def rows() -> dict[str, Any]:
        found = json.loads(cli(*SMOKE, "--dry-run", "--json", "--only", "fig4,fig9", "--db", db).out)
        return {row["figure"]: (row["new"], row["seconds"], row["time"]) for row in found}

    assert rows()["total"] == (6, None, "unknown")
    fake()
    cli("train", "--profile", "smoke", "--seeds", "0", "--db", db)
    assert rows()["fig9"][0] == 1
    assert rows()["fig9"][1] == pytest.approx(Store.open(db).runs()[0].wall_seconds, abs=0.06)
    assert rows()["total"][:2] == (5, None)  # nothing is known of gail and wail
    assert rows()["total"][2].startswith("more than ")
    cli("train", "--profile", "smoke", "--seeds", "1", "--db", db)
    assert rows()["fig9"] == (0, 0.0, "none")


@pytest.mark.parametrize(
    ("seconds", "words"),
    [(0.2, "1 s"), (89, "89 s"), (90, "2 min"), (2999, "50 min"), (5399, "1 h 30 min"), (7500, "2 h 5 min")],
)
def test_durations(seconds: float, words: str) -> None:
    assert duration(seconds) == words


def test_figures_are_drawn_from_their_runs_alone(
    cli: CommandLine, fake: FakeTraining, db: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    needs(monkeypatch, tmp_path, fig4=["ssail"], fig9=["ssail"])
    given = fake()
    cli("train", "--profile", "smoke", "--seeds", "0-4", "--set", "sac.gamma=0.5", "--db", db)  # not to be drawn
    out = tmp_path / "figures"
    outcome = cli(*SMOKE, "--format", "svg", "--format", "png", "--out", out, "--db", db)
    assert outcome.code == 0
    names = [f"{FIGURES[name].stem}{suffix}" for name in ("fig4", "fig9") for suffix in (".svg", ".png", ".csv")]
    assert [Path(line) for line in outcome.out.splitlines()] == [out / name for name in names]
    assert [cell.seed for cell in given["cells"]] == [0, 1]
    assert given["jobs"] == 2
    assert set(provenance.read(out / "fig4_stability.png").run_ids) == {run.id for run in Store.open(db).runs()[-2:]}
    assert outcome.err.startswith("ssail, seed 0: started (run ")


def test_a_statistic_can_be_chosen_for_the_figures_that_have_one(
    cli: CommandLine, fake: FakeTraining, db: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    needs(monkeypatch, tmp_path, fig4=["ssail"], fig9=["ssail"])
    fake()
    options = ("--out", tmp_path / "figures", "--db", db)
    table = tmp_path / "figures" / "fig4_stability.csv"
    assert cli(*SMOKE, "--stat", "median-iqr", *options).code == 0
    assert ("\nmedian," in table.read_text(), "\nmean," in table.read_text()) == (True, False)
    assert cli(*SMOKE, *options).code == 0
    assert ("\nmedian," in table.read_text(), "\nmean," in table.read_text()) == (False, True)


def test_the_help_names_every_figure_with_a_statistic(cli: CommandLine) -> None:
    names = [name for name in dict.fromkeys(m.name for m in FIGURES.values()) if FIGURES[name].has_statistic]
    shown = " ".join(cli("reproduce", "--help").out.split())
    assert f"Centre and band of {', '.join(names[:-1])} and {names[-1]}:" in shown


@pytest.mark.parametrize(
    ("ends", "code", "drawn", "words"),
    [
        ({0: "diverged"}, 3, True, "ssail, seed 0 diverged: the reason"),
        ({1: "failed"}, 3, True, "ssail, seed 1 failed: the reason"),
        ({0: "failed", 1: "failed"}, 3, False, "ssail, seed 1 failed: the reason"),
        ({1: "interrupted"}, 130, False, "the same command continues"),
    ],
)
def test_a_run_that_fails_stops_nothing_else(
    cli: CommandLine,
    fake: FakeTraining,
    db: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    ends: dict[int, str],
    code: int,
    drawn: bool,
    words: str,
) -> None:
    needs(monkeypatch, tmp_path, fig4=["ssail"])
    fake(ends)
    outcome = cli(*SMOKE, "--out", tmp_path / "figures", "--db", db)
    assert (outcome.code, (tmp_path / "figures" / "fig4_stability.png").exists()) == (code, drawn)
    assert words in outcome.err.splitlines()[-1]
    assert ("fig4: 1 of its 2 runs are missing: not finished." in outcome.err) == (ends == {1: "failed"})
    assert ("fig4 is not drawn: none of its runs finished." in outcome.err) == (not drawn and code == 3)


def test_a_figure_that_cannot_be_drawn_is_a_sentence_and_stops_no_other(
    cli: CommandLine, fake: FakeTraining, db: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    needs(monkeypatch, tmp_path, fig4=["ssail"], fig9=["ssail"])
    monkeypatch.setattr("tests.cli.conftest.arrays", lambda _: {})  # fig9 draws arrays, fig4 none
    fake()
    outcome = cli(*SMOKE, "--only", "fig9,fig4", "--out", tmp_path / "figures", "--db", db)
    assert outcome.code == 1
    assert [Path(line).stem for line in outcome.out.splitlines()] == ["fig4_stability"] * 2
    (sentence,) = (line for line in outcome.err.splitlines() if "is not drawn" in line)
    assert sentence.startswith("fig9 is not drawn: none of the given runs holds the expert set")


def test_a_second_call_computes_only_what_is_missing(
    cli: CommandLine,
    fake: FakeTraining,
    walk: Callable[[], None],
    db: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    needs(monkeypatch, tmp_path, fig4=["ssail", "gail", "wail"], fig9=["ssail"])
    fake({1: "interrupted"})
    assert cli(*SMOKE, "--only", "fig9", "--db", db).code == 130
    fake()
    cli("train", "--method", "gail", "--profile", "smoke", "--seeds", "0-1", "--db", db)
    assert plan(cli(*SMOKE, "--dry-run", "--db", db)) == {"fig4": (6, 3, 3), "fig9": (2, 1, 1), "total": (6, 3, 3)}

    walk()
    outcome = cli(*SMOKE, "--out", tmp_path / "figures", "--db", db)
    begun = [
        line.partition(" (run ")[0] for line in outcome.err.splitlines() if "started (" in line or "resumed" in line
    ]
    assert set(begun) == {"wail, seed 0: started", "wail, seed 1: started", "ssail, seed 1: resumed after epoch 0"}
    assert [run.state for run in Store.open(db).runs()] == ["finished"] * 6
    assert plan(cli(*SMOKE, "--dry-run", "--db", db))["total"] == (6, 6, 0)
