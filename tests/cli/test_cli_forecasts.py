"""`ssmail plot forecast`, `trajectories` and `film` of forecasts, and what `plot all` and `report` make of own data."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from ssmail.config.experiments import build_spec
from ssmail.store import RunState, Store
from tests.cli.command_line import CommandLine
from tests.paper.handmade_arrays import arrays, forecasts, windows

FDE = {("ssail", 0): 1.0, ("ssail", 1): 3.0, ("dnri", 0): 4.0}


def add(store: Store, method: str, seed: int, environment: str = "trajectories", path: str = "flock.npz") -> str:
    """A finished run of profile smoke; on trajectories with a final displacement error of FDE."""
    own = environment == "trajectories"
    spec = build_spec(method, environment, "smoke", [f"data.path={path}"] if own else [])
    writer = store.start_run(spec, seed, dataset_hash=path.encode().hex().ljust(64, "0"), device="cpu")
    writer.epoch(1, {"validation/energy": 0.1} if own else {"train/mode_mse": 0.1})
    writer.arrays({**forecasts(0.001), **windows()} if own else arrays())
    writer.final(1, {"test/fde": FDE[method, seed], "test_constant_velocity/fde": 9.0} if own else {})
    writer.finish(RunState.FINISHED)
    return writer.run_id


@pytest.fixture
def store(db: Path) -> Iterator[Store]:
    """The two methods on one set, and one of them on another."""
    opened = Store.open(db)
    for method, seed in FDE:
        add(opened, method, seed)
    add(opened, "ssail", 0, path="crossing.npz")
    yield opened
    opened.close()


@pytest.fixture
def where(store: Store, tmp_path: Path) -> tuple[object, ...]:
    return ("--db", store.where, "--out", tmp_path / "figures")


def names(out: str) -> list[str]:
    return [Path(line).name for line in out.splitlines()]


def test_a_forecast_of_each_data_set(cli: CommandLine, where: tuple[object, ...]) -> None:
    outcome = cli("plot", "forecast", *where)
    assert outcome.code == 0
    assert names(outcome.out) == [f"forecast_{name}.{end}" for name in ("flock", "crossing") for end in ("png", "csv")]
    assert (
        "forecast: mean error at the last step (5): ssail 0.0035, dnri 0.0035, constant velocity 0.005" in outcome.err
    )
    one = cli("plot", "forecast", "--method", "dnri", "--stat", "median-iqr", *where)
    assert names(one.out) == ["forecast_flock.png", "forecast_flock.csv"]
    assert "median error at the last step (5): dnri 0.0035" in one.err


def test_trajectories_and_a_film_of_a_run(cli: CommandLine, store: Store, where: tuple[object, ...]) -> None:
    run = store.runs()[0].name
    outcome = cli("plot", "trajectories", "--run", run, "--window", 1, "--window", 0, *where)
    assert names(outcome.out) == [f"trajectories_{run}_1-0.{end}" for end in ("png", "csv")]
    assert outcome.err == f"trajectories: run {run}: ssail on flock, seed 0, finished; 2 windows of 3 stored ones, " + (
        "2 samples of each.\n"
    )
    film = cli("plot", "film", "--run", run, "--window", 2, *where)
    assert names(film.out) == [f"film_{run}_2.gif"]
    assert "but no window 3" in cli("plot", "film", "--run", run, "--window", 3, *where).sentence


def test_what_does_not_go_together_is_said(cli: CommandLine, store: Store, where: tuple[object, ...]) -> None:
    elsewhere = add(store, "ssail", 0, "yjunction")[:8]
    for arguments, sentence in (
        (f"film --run {elsewhere} --window 0", "is on yjunction, whose film shows no window; leave it out."),
        (f"forecast --runs {elsewhere}", "forecast has nothing to draw: none of the 1 chosen runs in"),
        ("forecast --error speed", "unknown error 'speed'; choose from mse, distance."),
        ("forecast --error distance", "has no array 'test/distance'"),
        ("trajectories --run zz", "no run id starts with 'zz'"),
        ("trajectories --runs zz", "`ssmail plot trajectories` has no option --runs; did you mean --run?"),
    ):
        assert sentence in cli("plot", *arguments.split(), *where).sentence


def test_the_database_agrees_with_the_figures(
    cli: CommandLine, store: Store, where: tuple[object, ...], tmp_path: Path
) -> None:
    run = store.runs()[0].name
    cli("plot", "forecast", "--stat", "median-iqr", *where)
    cli("plot", "trajectories", "--run", run, *where)
    cli("plot", "film", "--run", run, *where)
    for name in ("forecast_flock.png", "forecast_crossing.csv", f"trajectories_{run}.png"):
        told = cli("explain", tmp_path / "figures" / name, "--format", "table", "--db", store.where)
        assert "agrees: it holds all runs, with the same values" in told.out
    told = cli("explain", tmp_path / "figures" / f"film_{run}.gif", "--format", "table", "--db", store.where)
    assert (told.code, "cannot tell: a film keeps no hash of what it shows" in told.out) == (0, True)


def test_all_figures_of_own_data_are_those_of_own_data(
    cli: CommandLine, store: Store, where: tuple[object, ...]
) -> None:
    outcome = cli("plot", "all", *where)
    drawn = [name for name in names(outcome.out) if name.endswith(".png")]
    ids = {(run.method, run.seed, run.spec["data"]["path"]): run.name for run in store.runs()}
    assert (outcome.code, "is not drawn" in outcome.err) == (0, False)
    assert drawn == [
        "forecast_flock.png",
        f"trajectories_{ids['ssail', 0, 'flock.npz']}.png",
        f"trajectories_{ids['dnri', 0, 'flock.npz']}.png",
        "forecast_crossing.png",
        f"trajectories_{ids['ssail', 0, 'crossing.npz']}.png",
    ]


def test_beside_runs_of_the_paper_both_are_drawn(cli: CommandLine, store: Store, where: tuple[object, ...]) -> None:
    add(store, "ssail", 0, "yjunction")
    outcome = cli("plot", "all", *where)
    assert outcome.code == 3
    assert {"fig9_yjunction.png", "forecast_flock.png"} <= set(names(outcome.out))
    assert "fig7 is not drawn: " in outcome.err


def test_a_report_of_own_data_compares_methods_and_does_not_speak_of_the_paper(
    cli: CommandLine, store: Store, where: tuple[object, ...], tmp_path: Path
) -> None:
    outcome = cli("report", *where)
    assert (outcome.code, names(outcome.out)[-2:]) == (0, ["report.md", "report.html"])
    text, page = ((tmp_path / name).read_text() for name in ("report.md", "report.html"))
    for words in (text, page.partition("<body>")[2].partition("<script>")[0]):
        for word in ("paper", "claim", "Claim", "verdict", "Verdict", "SS-MAIL", *(f"fig{n}" for n in range(1, 10))):
            assert word not in words, word
    assert "# Forecasts of flock, crossing" in text
    assert "| ssail |  | 0-1 | 2 ± 1.4 | 9 ± 0 |" in text
    assert "| dnri |  | 0 | 4 | 9 |" in text
    assert "![trajectories: " in text
    for anchor in ("forecast-flock", "trajectories-flock-ssail", "trajectories-flock-dnri", "forecast-crossing"):
        assert page.count(f'<section id="{anchor}">') == 1


def test_a_report_of_both_judges_the_claims_and_compares_the_methods(
    cli: CommandLine, store: Store, where: tuple[object, ...], tmp_path: Path
) -> None:
    add(store, "ssail", 0, "yjunction")
    assert cli("report", *where).code == 3
    text = (tmp_path / "report.md").read_text()
    for heading in ("# SS-MAIL, reproduced", "## Verdicts", "## Methods compared", "### flock", "### fig9 yjunction"):
        assert heading in text
    assert "### forecast crossing" in text


def test_runs_compare_shows_what_counts_in_forecasts(cli: CommandLine, store: Store) -> None:
    rows = cli("runs", "compare", "--db", store.where).rows
    ours = {row["metric"]: row for row in rows if row["method"] == "ssail" and row["runs"] == "2"}
    assert {"test/fde", "test/min_fde_20", "test/coverage", "test_constant_velocity/fde"} <= ours.keys()
    assert float(ours["test/fde"]["mean"]) == 2.0
