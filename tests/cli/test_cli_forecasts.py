"""`ssmail plot forecast`, `trajectories` and `film` of forecasts, and what `plot all` and `report` make of own data."""

import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import pytest

from ssmail.config.experiments import build_spec
from ssmail.store import RunState, Store
from tests.cli.command_line import CommandLine
from tests.paper.handmade_arrays import arrays, forecasts, windows

FDE = {("ssail", 0): 1.0, ("ssail", 1): 3.0, ("dnri", 0): 4.0}


def add(
    store: Store,
    method: str,
    seed: int,
    environment: str = "trajectories",
    path: str = "flock.npz",
    contents: str = "",
    overrides: Sequence[str] = (),
    final: Mapping[str, float] | None = None,
) -> str:
    """A finished run of profile smoke; on trajectories with a final displacement error of FDE.

    contents: of the file, if they are not the usual ones of this path. final: instead of these metrics.
    """
    own = environment == "trajectories"
    spec = build_spec(method, environment, "smoke", [*([f"data.path={path}"] if own else []), *overrides])
    dataset_hash = (contents or path).encode().hex().ljust(64, "0")
    writer = store.start_run(spec, seed, dataset_hash=dataset_hash, device="cpu", repeat=bool(contents))
    writer.epoch(1, {"validation/energy": 0.1} if own else {"train/mode_mse": 0.1})
    writer.arrays({**forecasts(0.001), **windows()} if own else arrays())
    usual = {"test/fde": FDE[method, seed], "test_constant_velocity/fde": 9.0} if own and final is None else {}
    writer.final(1, usual if final is None else final)
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


def beside(fde: float, **changed: float) -> dict[str, float]:
    """What a run stores: its own errors, those of the baselines, and the collisions of the true futures."""
    own = dict.fromkeys(("ade", "fde", "min_fde_5", "min_fde_20", "mse_last"), fde)
    own |= {"min_fde_20_agent": fde / 2, "miss_rate_20": 0.5, "collisions": 0.25, "coverage": 0.75, "diverged": 0.0}
    still = {"test_constant_velocity": dict.fromkeys(own, 9.0), "test_copy_last": dict.fromkeys(own, 12.0)}
    values = {"test": own, **still, "test_expert": {"collisions": 0.125}}
    return {f"{prefix}/{name}": value for prefix, each in values.items() for name, value in each.items()} | changed


def documented(cli: CommandLine, store: Store, *options: str) -> list[str]:
    return cli("runs", "compare", "--format", "markdown", "--db", store.where, *options).out.splitlines()


def test_every_data_set_has_a_table_of_its_own(cli: CommandLine, store: Store) -> None:
    """Their errors cannot be compared; in CSV and JSON a column says which it is."""
    ssail, dnri = (build_spec(method, "trajectories", "smoke", ["data.path=flock.npz"]) for method in ("ssail", "dnri"))
    crossing = build_spec("ssail", "trajectories", "smoke", ["data.path=crossing.npz"])
    assert documented(cli, store) == [
        "flock (trajectories)",
        "",
        "| spec | seeds | test/fde |",
        "| --- | --- | --- |",
        f"| ssail {ssail.hash()[:8]} | 2/2 | 2 ± 1.4 |",
        f"| dnri {dnri.hash()[:8]} | 1/1 | 4 |",
        "| constant velocity | - | 9 |",
        "",
        "crossing (trajectories)",
        "",
        "| spec | seeds | test/fde |",
        "| --- | --- | --- |",
        f"| ssail {crossing.hash()[:8]} | 1/1 | 1 |",
        "| constant velocity | - | 9 |",
    ]
    latex = cli("runs", "compare", "--format", "latex", "--db", store.where).out.splitlines()
    assert [line for line in latex if line.startswith("%")] == ["% flock (trajectories)", "% crossing (trajectories)"]
    assert latex.count(r"\begin{tabular}{lll}") == 2
    rows = cli("runs", "compare", "--metric", "test/fde", "--db", store.where).rows
    found = [(row["data_set"], row["method"], float(row["mean"])) for row in rows]
    assert found == [("flock", "ssail", 2.0), ("flock", "dnri", 4.0), ("crossing", "ssail", 1.0)]
    items = json.loads(cli("runs", "compare", "--metric", "test/fde", "--json", "--db", store.where).out)
    assert [(item["data_set"], item["differs"]) for item in items] == [("flock", {}), ("flock", {}), ("crossing", {})]
    table = cli("runs", "compare", "--format", "table", "--db", store.where).out
    assert [line.partition(":")[0] for line in table.splitlines() if "mean ±" in line] == [
        "flock (trajectories)",
        "crossing (trajectories)",
    ]
    assert "dnri on flock (trajectories), profile smoke" in table


def test_a_file_that_was_written_anew_is_another_data_set(cli: CommandLine, store: Store) -> None:
    add(store, "ssail", 0, contents="other", final={"test/fde": 100.0})
    rows = cli("runs", "compare", "--metric", "test/fde", "--method", "ssail", "--db", store.where).rows
    found = {row["data_set"]: float(row["mean"]) for row in rows}
    assert found == {"flock-666c6f63": 2.0, "crossing": 1.0, "flock-6f746865": 100.0}


def test_generated_data_has_no_name(cli: CommandLine, store: Store) -> None:
    add(store, "ssail", 0, "yjunction", final={"test/mode_mse": 0.1})
    (row,) = cli("runs", "compare", "--env", "yjunction", "--metric", "test/mode_mse", "--db", store.where).rows
    assert (row["environment"], row["data_set"]) == ("yjunction", "")
    lines = documented(cli, store, "--metric", "test/mode_mse", "--env", "yjunction")
    assert lines[0] == "| spec | seeds | test/mode\\_mse |"
    assert "yjunction" in documented(cli, store)


def test_baselines_and_true_futures_stand_beside_the_methods(cli: CommandLine, store: Store) -> None:
    for method, fde in (("dnri", 4.0), ("ssail", 2.0)):
        add(store, method, 3, path="town.npz", final=beside(fde))
    lines = documented(cli, store, "--where", "seed=3")
    cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines[2:]]
    shown = [dict(zip(cells[0], row, strict=True)) for row in cells[2:]]
    fde = {row["spec"].rpartition(" ")[0] if "-" not in row["seeds"] else row["spec"]: row["test/fde"] for row in shown}
    assert fde == {"dnri": "4", "ssail": "2", "constant velocity": "9", "copy last": "12", "true futures": "-"}
    assert [row["test/collisions"] for row in shown] == ["0.25", "0.25", "9", "12", "0.125"]
    assert [row["test/min\\_fde\\_20\\_agent"] for row in shown] == ["2", "1", "9", "12", "-"]
    assert not any("constant" in heading for heading in cells[0])
    only = documented(cli, store, "--where", "seed=3", "--metric", "test_constant_velocity/fde")
    assert only[2] == "| spec | seeds | test\\_constant\\_velocity/fde |"


def test_a_baseline_has_one_row_unless_it_was_tested_otherwise(cli: CommandLine, store: Store) -> None:
    """A method that is the baseline itself is enough; values of another test are those of its spec."""
    options = ("--where", "seed=3", "--metric", "test/fde")
    add(store, "constant-velocity", 3, path="town.npz", final=beside(9.0))
    add(store, "dnri", 3, path="town.npz", final={"test/fde": 2.0, "test_constant_velocity/fde": 9.00001})
    names = [line.split("|")[1].strip() for line in documented(cli, store, *options)[4:]]
    assert [name.rpartition(" ")[0] for name in names] == ["constant-velocity", "dnri", "copy"]
    for frames, error in ((3, 11.0), (4, 8.0)):
        final = {"test/fde": 3.0, "test_constant_velocity/fde": error}
        add(store, "dnri", 3, path="town.npz", overrides=[f"forecast.observed={frames}"], final=final)
        if frames == 3:
            assert documented(cli, store, *options)[-2] == "| constant velocity | - | 11 |"
    assert documented(cli, store, *options)[-3:-1] == [
        "| constant velocity, as tested with dnri observed 3 | - | 11 |",
        "| constant velocity, as tested with dnri observed 4 | - | 8 |",
    ]


def test_single_agents_have_a_column_where_it_says_something_else(cli: CommandLine, store: Store) -> None:
    same = {"test/min_fde_20_agent": 4.0}
    add(store, "dnri", 3, path="town.npz", final=beside(4.0, **same))
    assert not any("agent" in line for line in documented(cli, store, "--where", "seed=3"))
    add(store, "ssail", 3, path="town.npz", final=beside(4.0))
    assert any("agent" in line for line in documented(cli, store, "--where", "seed=3"))


@pytest.mark.parametrize("columns", [80, 120])
def test_a_table_of_forecasts_is_as_wide_as_the_terminal(
    cli: CommandLine, store: Store, monkeypatch: pytest.MonkeyPatch, columns: int
) -> None:
    for method in ("dnri", "ssail", "gail"):
        for seed in (3, 4, 5):
            add(store, method, seed, path="town.npz", final=beside(1234.5678 / seed))
    monkeypatch.setenv("COLUMNS", str(columns))
    table = cli("runs", "compare", "--format", "table", "--where", "seed>2", "--db", store.where).out
    lines = [line for line in table.splitlines() if "(trajectories)" not in line]
    assert max(map(len, lines)) <= columns
    overview = table[table.index("mean ±") :]
    for word in ("fde", "min_fde", "_agent", "collisions"):
        assert word in overview
    assert next(line for line in overview.splitlines() if line.startswith("gail")).split()[2:4] == ["3/3", "322"]
    assert ("left out, as the terminal is narrow: test/min_fde_5" in overview) == (columns == 80)
