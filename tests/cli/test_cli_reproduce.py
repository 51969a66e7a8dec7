"""`ssmail reproduce`: what it plans, how it counts, what it draws, and how it ends."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from ssmail.paper.results import CLAIMS, FIGURES
from ssmail.plots import provenance
from ssmail.store import Store
from ssmail_cli.reproduce import figure_cells
from tests.cli.command_line import CommandLine, FakeTraining, Outcome
from tests.data.mocap.handmade import write_subject
from tests.paper.handmade_arrays import forecasts
from tests.store.databases import change

SMOKE = ("reproduce", "--profile", "smoke", "--device", "cpu", "--seeds", "0-1")
LEFT_OUT = (
    "is left out: there is no data/mocap.npz; `ssmail prep-mocap --source DIR --out data/mocap.npz` makes it from "
    "files of the CMU database, and --download fetches those (or give --cmu-dir DIR)."
)


@pytest.fixture(autouse=True)
def walking(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder to work in, where a set of recorded walking seems to be; nothing reads it here."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("SSMAIL_CMU_DIR", raising=False)
    path = tmp_path / "data" / "mocap.npz"
    path.parent.mkdir()
    path.touch()
    return path


def plan(outcome: Outcome) -> dict[str, tuple[int, int, int]]:
    """(runs, stored, new) by figure."""
    assert outcome.code == 0
    found = {row["figure"]: row for row in outcome.rows}
    return {name: (int(row["runs"]), int(row["stored"]), int(row["new"])) for name, row in found.items()}


def needs(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, **figures: list[str]) -> None:
    """Let figures need the runs of these methods alone, so that they can be drawn from little."""
    from ssmail.config.experiments_file import load_experiments

    head = load_experiments().path.read_text().partition("\nfigures:\n")[0]
    entries = [f"  {name}: {{environment: yjunction, methods: {methods}}}" for name, methods in figures.items()]
    (tmp_path / "e.yaml").write_text("\n".join([head, "figures:", *entries, ""]))
    monkeypatch.setenv("SSMAIL_EXPERIMENTS", str(tmp_path / "e.yaml"))


def test_shared_cells_are_planned_once(cli: CommandLine, db: Path) -> None:
    figures = plan(cli(*SMOKE, "--dry-run", "--only", "fig5,stability,fig4,fig9", "--db", db))
    assert figures == {"fig5": (4, 0, 4), "fig4": (6, 0, 6), "fig9": (2, 0, 2), "total": (8, 0, 8)}
    assert not db.parent.exists()


def test_enqueued_runs_are_those_of_the_figures_and_nothing_is_drawn(
    cli: CommandLine, db: Path, tmp_path: Path, fake: FakeTraining
) -> None:
    words = ("fig4", "fig9", "--out", tmp_path / "figures", "--db", db)
    put = cli(*SMOKE, "--enqueue", *words)
    assert put.code == 0, put.err
    assert [row["action"] for row in put.rows] == ["queued"] * 6
    assert [row["action"] for row in cli(*SMOKE, "--enqueue", *words).rows] == ["waiting"] * 6
    assert "6 runs: 6 waiting" in cli("queue", "--db", db).err
    assert not (tmp_path / "figures").exists()


def test_without_only_every_figure_is_planned(cli: CommandLine, db: Path) -> None:
    figures = plan(cli(*SMOKE, "--dry-run", "--db", db))
    listed = dict.fromkeys(module.name for module in FIGURES.values())
    assert set(figures) == {*listed, "total"}
    assert set(CLAIMS) < set(listed)  # so the claims' runs are among them
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
    pages = [tmp_path / "report.md", tmp_path / "report.html"]
    assert [Path(line) for line in outcome.out.splitlines()] == [*(out / name for name in names), *pages]
    assert all(page.exists() for page in pages)
    assert [cell.seed for cell in given["cells"]] == [0, 1]
    assert given["jobs"] == 2
    assert set(provenance.read(out / "fig4_stability.png").run_ids) == {run.id for run in Store.open(db).runs()[-2:]}
    assert outcome.err.startswith("ssail, seed 0: started (run ")


def test_damaged_rows_are_noted(
    cli: CommandLine, fake: FakeTraining, db: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    needs(monkeypatch, tmp_path, fig9=["ssail"])
    fake()
    cli("train", "--profile", "smoke", "--seeds", "7", "--db", db)
    change(db, "UPDATE run SET state = 'paused' WHERE seed = 7")
    outcome = cli(*SMOKE, "--out", tmp_path / "figures", "--db", db)
    (remark,) = (line for line in outcome.err.splitlines() if "damaged row " in line)
    assert remark == f"1 damaged row left out; `ssmail db check --db {db}` says what is wrong"


def test_a_statistic_can_be_chosen_for_the_figures_that_have_one(
    cli: CommandLine, fake: FakeTraining, db: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    needs(monkeypatch, tmp_path, fig4=["ssail"], fig9=["ssail"])
    fake()
    options = ("--out", tmp_path / "figures", "--db", db)
    table = tmp_path / "figures" / "fig4_stability.csv"
    assert cli(*SMOKE, "--stat", "mean-std", *options).code == 0
    assert ("\nmedian," in table.read_text(), "\nmean," in table.read_text()) == (False, True)
    assert cli(*SMOKE, *options).code == 0
    assert ("\nmedian," in table.read_text(), "\nmean," in table.read_text()) == (True, False)


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
    page = tmp_path / "report.html"
    assert page.exists() == (code == 3)
    assert code != 3 or (words in page.read_text()) == (0 in ends or 1 in ends)
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


def test_without_recorded_walking_its_figures_are_left_out_before_anything_is_trained(
    cli: CommandLine, fake: FakeTraining, walking: Path, db: Path, tmp_path: Path
) -> None:
    walking.unlink()
    outcome = cli(*SMOKE, "--only", "fig7,fig9,fig8", "--dry-run", "--db", db)
    assert plan(outcome) == {"fig7": (4, 0, 0), "fig9": (2, 0, 2), "fig8": (4, 0, 0), "total": (2, 0, 2)}
    assert outcome.err.splitlines() == [f"fig7 {LEFT_OUT}", f"fig8 {LEFT_OUT}"]
    given = fake()
    outcome = cli(*SMOKE, "--only", "fig7,fig9", "--out", tmp_path / "figures", "--db", db)
    assert outcome.code == 3
    assert {cell.spec.environment for cell in given["cells"]} == {"yjunction"}
    assert outcome.err.splitlines()[0] == f"fig7 {LEFT_OUT}"
    assert "fig7 is not drawn: there is no data/mocap.npz; `ssmail prep-mocap" in outcome.err
    assert [Path(line).stem for line in outcome.out.splitlines()] == ["fig9_yjunction"] * 2
    assert cli(*SMOKE, "--only", "fig7", "--db", db).sentence.startswith("there is no data/mocap.npz; `ssmail prep-")


def test_stored_runs_are_drawn_without_their_data(
    cli: CommandLine, fake: FakeTraining, walking: Path, db: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("tests.cli.conftest.arrays", lambda _: forecasts(0.01))
    fake()
    assert cli(*SMOKE, "--only", "fig7", "--out", tmp_path / "figures", "--db", db).code == 0
    walking.unlink()
    given = fake()
    outcome = cli(*SMOKE, "--only", "fig7,fig9", "--out", tmp_path / "again", "--db", db)
    assert {cell.spec.environment for cell in given["cells"]} == {"yjunction"}
    assert (tmp_path / "again" / "fig7_noise.csv").exists(), outcome.err


def test_recorded_walking_is_made_of_the_files_that_are_named(
    cli: CommandLine, fake: FakeTraining, walking: Path, db: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    walking.unlink()
    seen: list[bool] = []
    folder = write_subject(tmp_path / "cmu", dict.fromkeys((*range(1, 17), *range(28, 35)), 110))
    monkeypatch.setenv("SSMAIL_CMU_DIR", str(folder))
    outcome = cli(*SMOKE, "--only", "fig7", "--dry-run", "--db", db)
    assert plan(outcome)["fig7"] == (4, 0, 4)
    assert outcome.err == f"data/mocap.npz is made from {folder}\n"
    assert not walking.exists()
    monkeypatch.setattr("ssmail_cli.reproduce.compute", lambda *_: seen.append(walking.exists()) or [])
    monkeypatch.setattr("ssmail_cli.reproduce.result_rows", lambda *_: [{"outcome": "interrupted"}])
    outcome = cli(*SMOKE, "--only", "fig7", "--db", db)
    assert (seen, outcome.code, outcome.out) == ([True], 130, "")
    assert "wrote data/mocap.npz" in outcome.err
    monkeypatch.setenv("SSMAIL_CMU_DIR", "absent")
    walking.unlink()
    assert cli(*SMOKE, "--only", "fig7", "--db", db).sentence.startswith("there is no absent; --cmu-dir (or SSMAIL_CMU")


def test_a_smoke_has_fewer_seeds_by_default(cli: CommandLine, db: Path) -> None:
    for profile, seeds in (("smoke", 2), ("quick", 5)):
        planned = plan(cli("reproduce", "--profile", profile, "--dry-run", "--only", "fig9", "--db", db))
        assert planned["fig9"] == (seeds, 0, seeds)


def test_a_report_that_cannot_be_written_loses_no_figure(
    cli: CommandLine, fake: FakeTraining, db: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    needs(monkeypatch, tmp_path, fig4=["ssail"])
    fake()
    monkeypatch.setattr("ssmail_cli.reproduce.write_report", lambda *_: 1 / 0)
    outcome = cli(*SMOKE, "--out", tmp_path / "figures", "--db", db)
    assert outcome.code == 1
    assert (tmp_path / "figures" / "fig4_stability.png").exists()
    assert "the report is not written: unexpected ZeroDivisionError" in outcome.err


def test_the_report_is_written_again_from_the_store(
    cli: CommandLine, fake: FakeTraining, db: Path, tmp_path: Path
) -> None:
    fake()
    assert cli(*SMOKE, "--only", "fig4,fig9", "--out", tmp_path / "figures", "--db", db).code == 0
    assert not (tmp_path / "report.html").exists()
    before = Store.open(db).runs()
    outcome = cli("report", "--out", tmp_path / "figures", "--format", "svg", "--db", db)
    assert outcome.code == 3  # the other figures have no runs
    assert Store.open(db).runs() == before
    assert [Path(line).name for line in outcome.out.splitlines()][-2:] == ["report.md", "report.html"]
    assert "](figures/fig4_stability.svg)" in (tmp_path / "report.md").read_text()
    page = (tmp_path / "report.html").read_text()
    drawn = {Path(line).stem for line in outcome.out.splitlines() if line.endswith(".svg")}
    assert {"fig4_stability", "fig9_yjunction"} <= drawn
    assert page.count("data:image/png;base64,") == len(drawn) == 9 - page.count("<strong>Not drawn:</strong>")
    assert all(f'id="run-{run.name}"' in page for run in before)
    assert "fig7 is not drawn: " in outcome.err
    assert cli("report", "--db", tmp_path / "absent.db").sentence.startswith("there is no database")
