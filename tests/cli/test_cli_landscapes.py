"""`ssmail plot landscape`, `film` and `all`."""

from pathlib import Path

import pytest

from ssmail.config.experiments import build_spec, figure_requirements
from ssmail.config.experiments_file import load_experiments
from ssmail.paper.results import FIGURES
from ssmail.store import RunState, Store
from tests.cli.command_line import CommandLine
from tests.paper.handmade_arrays import arrays
from tests.paper.handmade_landscapes import landscapes, linear


@pytest.fixture
def run(tmp_path: Path) -> str:
    """A finished Y-Junction run of three epochs with landscapes."""
    store = Store.open(tmp_path / "ssmail.db")
    writer = store.start_run(build_spec("ssail", "yjunction", "smoke"), 0, dataset_hash="d" * 64, device="cpu")
    for epoch in (1, 2, 3):
        looked = {"landscape/slope_share": 1.0, "landscape/cosine": 0.5}
        writer.epoch(epoch, {"train/mode_mse": 0.1 / epoch, **looked})
    writer.arrays(arrays(0.0) | landscapes(linear()))
    writer.final(3, {"test/on_lane": 0.9, "test/lane_balance": 0.25, "test_constant_velocity/mode_mse": 0.045})
    writer.finish(RunState.FINISHED)
    store.close()
    return writer.run_id[:8]


@pytest.fixture
def where(tmp_path: Path) -> tuple[object, ...]:
    return ("--db", tmp_path / "ssmail.db", "--out", tmp_path / "figures")


def names(out: str) -> list[str]:
    return [Path(line).name for line in out.splitlines()]


def test_the_landscape_of_a_run(cli: CommandLine, run: str, where: tuple[object, ...], tmp_path: Path) -> None:
    outcome = cli("plot", "landscape", "--run", run, *where, "--format", "png", "--format", "svg")
    stem = f"landscape_{run}_3"
    assert names(outcome.out) == [f"{stem}.png", f"{stem}.svg", f"{stem}.csv"]
    assert outcome.err == f"landscape: run {run}: ssail on yjunction, seed 0, finished; landscapes of epochs 0, 1, 3.\n"
    untrained = cli("plot", "landscape", "--run", run, "--epoch", 0, *where)
    assert names(untrained.out)[0] == f"landscape_{run}_0.png"
    assert "choose one of 0, 1, 3" in cli("plot", "landscape", "--run", run, "--epoch", 2, *where).sentence


def test_the_film_of_a_run(cli: CommandLine, run: str, where: tuple[object, ...], tmp_path: Path) -> None:
    outcome = cli("plot", "film", "--run", run, *where)
    assert (outcome.code, names(outcome.out)) == (0, [f"film_{run}.gif"])
    assert (tmp_path / "figures" / f"film_{run}.gif").stat().st_size > 1000


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ("landscape", "missing option '--run'."),
        ("film --run zz", "no run id starts with 'zz'"),
        ("film --run {run} --epoch 1", "`ssmail plot film` has no option --epoch;"),
        ("fig4 --run {run}", "`ssmail plot fig4` has no option --run; did you mean --runs?"),
        ("film --run {run} --runs {run}", "`ssmail plot film` has no option --runs; did you mean --run?"),
        ("film --run {run} --profile smoke", "`ssmail plot film` has no option --profile;"),
        ("film --run {run} --stat mean-ci", "`ssmail plot film` has no option --stat;"),
        ("all fig4", "all is every figure already; give it alone."),
        ("all --runs {run}", "`ssmail plot all` has no option --runs;"),
        ("all --metric a", "`ssmail plot all` has no option --metric;"),
        ("landscpe", "unknown figure 'landscpe'; did you mean landscape"),
    ],
)
def test_what_does_not_go_together_is_said(
    cli: CommandLine, run: str, where: tuple[object, ...], arguments: str, sentence: str
) -> None:
    assert sentence in cli("plot", *arguments.format(run=run).split(), *where).sentence


def test_all_draws_what_is_there_and_says_what_makes_the_rest(
    cli: CommandLine, run: str, where: tuple[object, ...]
) -> None:
    outcome = cli("plot", "all", *where)
    assert outcome.code == 3
    drawn = {name.split("_")[0] for name in names(outcome.out) if name.endswith(".png")}
    missing = [line for line in outcome.err.splitlines() if " is not drawn: " in line]
    assert {"fig4", "fig5", "fig9"} <= drawn
    assert drawn | {line.split()[0] for line in missing} == {module.name for module in FIGURES.values()}
    assert len(missing) == len(load_experiments().figures) - len(drawn)
    for line in missing:
        assert "; run `ssmail " in line
    (mocap,) = (line for line in missing if line.startswith("fig7"))
    assert "ssmail train --method ssail --env mocap --profile quick --seeds 0-4" in mocap


def test_all_ends_well_when_nothing_is_missing(
    cli: CommandLine, run: str, where: tuple[object, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    there = {name: module for name, module in FIGURES.items() if module.name in ("fig4", "fig9")}
    monkeypatch.setattr("ssmail_cli.report.FIGURES", there)
    outcome = cli("plot", "all", "--stat", "mean-ci", *where)
    assert (outcome.code, "is not drawn" in outcome.err) == (0, False)


def test_the_remedies_are_commands_that_exist(cli: CommandLine, where: tuple[object, ...], tmp_path: Path) -> None:
    """Each command that `plot all` names for an empty database can be planned."""
    Store.open(tmp_path / "ssmail.db").close()
    outcome = cli("plot", "all", *where)
    assert outcome.code == 3
    remedies = {line.split("`ssmail ")[1].split("`")[0] for line in outcome.err.splitlines()}
    assert len(outcome.err.splitlines()) == len({module.name for module in FIGURES.values()})
    for remedy in remedies:
        if figure_requirements("fig7").environment not in remedy:  # its data may not be on this machine
            assert cli(*remedy.split(), "--dry-run", "--db", tmp_path / "ssmail.db").code == 0, remedy
