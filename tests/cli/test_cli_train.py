"""`ssmail train`: seeds, plans, what it shows and how it ends. Training itself is faked but for one real run."""

import json
import re
import signal
import sys
from pathlib import Path

import pytest
import torch

from ssmail.config.experiments import build_spec
from ssmail.errors import InputError
from ssmail.execution import Resume, local
from ssmail.execution.cells import Cell, Event
from ssmail.store import Store
from ssmail_cli import progress
from ssmail_cli.options import MOST_SEEDS, parse_seeds, pick_device
from tests.cli.command_line import CommandLine, FakeTraining

SMOKE = ("train", "--profile", "smoke", "--device", "cpu")


@pytest.mark.parametrize(
    ("text", "seeds"),
    [
        ("0-4", [0, 1, 2, 3, 4]),
        ("0,2,5", [0, 2, 5]),
        ("0-2,7", [0, 1, 2, 7]),
        ("3", [3]),
        ("7,0-1", [7, 0, 1]),
        ("1,0-2, 1", [1, 0, 2]),
        ("5-5", [5]),
    ],
)
def test_seeds(text: str, seeds: list[int]) -> None:
    assert parse_seeds(text) == seeds


@pytest.mark.parametrize(
    "text", ["", "a", "1-", "-1", "1--2", "0,,1", "4-0", "1.5", f"0-{MOST_SEEDS}", str(2**31), "٣-x"]
)
def test_seeds_that_are_none(text: str) -> None:
    with pytest.raises(InputError, match="--seeds"):
        parse_seeds(text)


def test_the_options_reach_the_training(cli: CommandLine, fake: FakeTraining, db: Path) -> None:
    given = fake()
    more = (
        "--seeds",
        "3,1",
        "--jobs",
        "2",
        "--resume",
        "never",
        "--set",
        "sac.gamma=0.5",
        "--set",
        "training.epochs=4",
    )
    assert cli(*SMOKE, *more, "--db", db).code == 0
    assert [cell.seed for cell in given["cells"]] == [3, 1]
    assert given["jobs"] == 2
    assert given["device"] == "cpu"
    assert given["resume"] is Resume.NEVER
    assert Path(given["store_url"].removeprefix("sqlite:///")) == db
    assert (given["cells"][0].spec.sac.gamma, given["cells"][0].spec.epochs) == (0.5, 4)


def test_results_are_rows_in_the_order_of_the_seeds(cli: CommandLine, fake: FakeTraining, db: Path) -> None:
    fake()
    outcome = cli(*SMOKE, "--seeds", "2,0", "--db", db)
    assert [(row["seed"], row["outcome"], row["test/mode_mse"]) for row in outcome.rows] == [
        ("2", "finished", "0.003"),
        ("0", "finished", "0.001"),
    ]
    found = json.loads(cli(*SMOKE, "--seeds", "5", "--db", db, "--json").out)
    assert [(row["seed"], row["test/mode_mse"], row["test/min_fde_20"]) for row in found] == [(5, 0.006, None)]


def test_results_on_letters_have_their_own_columns(
    cli: CommandLine, fake: FakeTraining, db: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fake()
    drawn = (*SMOKE, "--env", "letters", "--seeds", "0,6", "--db", db)
    outcome = cli(*drawn)
    assert float(outcome.rows[1]["test/stroke_distance"]) == pytest.approx(0.0864192)
    assert "test/mode_mse" not in outcome.rows[1]
    assert "seed 0: epoch 1/3  val 0.1  critic 0.5" in outcome.err.splitlines()
    assert outcome.err.splitlines()[-1].endswith(": test error 0.125")
    monkeypatch.setenv("COLUMNS", "90")
    monkeypatch.setenv("TERM", "dumb")
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True)
    table = cli(*drawn, "--resume", "never").out.splitlines()
    assert max(map(len, table)) <= 90
    headings = ["seed", "outcome", "run", "distance", "mean", "epoch", "ade", "velocity", "diverged", "seconds"]
    assert table[1].split() == headings


def test_a_real_training_on_letters(cli: CommandLine, db: Path, tmp_path: Path) -> None:
    """From the command line to the table and the curve."""
    word = ("--set", "data.letters.word=IT")
    outcome = cli(*SMOKE, "--env", "letters", *word, "--db", db, "--json")
    assert outcome.code == 0
    (row,) = json.loads(outcome.out)
    assert row["outcome"] == "finished"
    assert 0 < row["test/stroke_distance"] < 2
    (run,) = Store.open(db).runs()
    assert Store.open(db).array(run.id, "test/rollouts").shape == (3, 16, 60, 2, 2)
    drawn = cli("plot", "training", "--env", "letters", "--db", db, "--out", tmp_path / "figures")
    assert drawn.code == 0
    compared = {row["metric"]: row["mean"] for row in cli("runs", "compare", "--db", db).rows}
    assert float(compared["test/stroke_distance"]) == row["test/stroke_distance"]


def test_a_word_that_cannot_be_drawn(cli: CommandLine, db: Path) -> None:
    sentence = cli(*SMOKE, "--env", "letters", "--set", "data.letters.word=Hello", "--db", db).sentence
    assert sentence == "data.letters.word: takes 1 to 6 capital letters A to Z, not 'Hello'."


def test_results_on_mocap_have_its_own_columns(
    cli: CommandLine, fake: FakeTraining, db: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """For programs every metric by name, for people the few that matter, within 80 columns."""
    fake()
    mocap = (*SMOKE, "--env", "mocap", "--seeds", "0,6", "--db", db)
    outcome = cli(*mocap)
    assert float(outcome.rows[1]["test/mse_40"]) == pytest.approx(0.3456768)
    assert outcome.rows[1]["test_noisy/mse_40"] == "0.00123456"
    assert "test/mode_mse" not in outcome.rows[1]
    lines = outcome.err.splitlines()
    assert "seed 0: epoch 1/3  val 0.1  critic 0.5" in lines
    assert lines[-1].endswith(": test error 0.25")
    monkeypatch.setenv("COLUMNS", "80")
    monkeypatch.setenv("TERM", "dumb")  # no bold headings
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True)
    table = cli(*mocap, "--resume", "never").out.splitlines()
    assert max(map(len, table)) <= 80
    assert [line.split() for line in table[:2]] == [
        ["noisy", "const."],
        ["seed", "outcome", "run", "mse_10", "mse_20", "mse_40", "mse_40", "velocity", "diverged", "seconds"],
    ]
    assert len(table) == 4  # nothing is folded
    assert table[3].split()[3:9] == ["0.0864", "0.173", "0.346", "0.00123", "0.0457", "0"]
    monkeypatch.setenv("COLUMNS", "120")  # room for another digit
    monkeypatch.setenv("TERM", "xterm")  # a dumb one has 80 columns
    assert cli(*mocap, "--resume", "never").out.splitlines()[3].split()[6:8] == ["0.001235", "0.04568"]


def test_without_a_terminal_progress_is_a_few_lines(cli: CommandLine, fake: FakeTraining, db: Path) -> None:
    fake()
    lines = cli(*SMOKE, "--set", "training.epochs=100", "--db", db).err.splitlines()
    assert lines[0].startswith("1 run: ssail on yjunction, profile smoke, 1 seed: 0")
    assert lines[1].startswith("seed 0: started (run ")
    assert lines[2] == "seed 0: epoch 10/100  val 0.01  critic 0.5"
    assert lines[-1].startswith("seed 0: finished (run ")
    assert len(lines) == 13


def test_the_log_of_a_long_run_says_how_much_is_left(capsys: pytest.CaptureFixture[str]) -> None:
    """100 epochs of 30 s after a start at epoch 10, on a clock of the test's own."""
    cell = Cell(build_spec("ssail", "yjunction", "smoke", ["training.epochs=110"]), 0)
    clock = iter([0.0, *(30.0 * epoch for epoch in range(1, 101))])
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(progress.time, "monotonic", lambda: next(clock))
        with progress.reporter({cell: {"seed": 0}}) as report:
            report(Event("loading", cell, None, 0, 110))
            report(Event("resumed", cell, "a" * 32, 10, 110))
            for epoch in range(11, 111):
                report(Event("epoch", cell, "a" * 32, epoch, 110, {"critic/loss": 0.5}))
    lines = capsys.readouterr().err.splitlines()
    assert lines[1] == "seed 0: epoch 11/110  critic 0.5  about 50 min left"
    assert lines[2] == "seed 0: epoch 22/110  critic 0.5  about 44 min left"
    assert lines[-1] == "seed 0: epoch 110/110  critic 0.5"


def test_on_a_terminal_there_is_a_line_for_each_seed(
    cli: CommandLine, fake: FakeTraining, db: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fake({1: "failed"})
    monkeypatch.setenv("COLUMNS", "100")
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    outcome = cli(*SMOKE, "--seeds", "0-1", "--db", db)
    assert outcome.code == 3
    assert outcome.err.splitlines()[1].startswith("columns: run, epochs done, val (validation/mode_mse) and losses")
    assert "seed 0 " in outcome.err
    assert "3/3 finished (run " in outcome.err
    assert "3/3 failed (run " in outcome.err


def test_no_color_is_respected(cli: CommandLine, fake: FakeTraining, db: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fake()
    monkeypatch.setenv("TERM", "xterm-256color")
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    colour = re.compile(r"\x1b\[[0-9;]*3[0-9]")
    monkeypatch.delenv("NO_COLOR", raising=False)
    assert colour.search(cli(*SMOKE, "--db", db).err)
    monkeypatch.setenv("NO_COLOR", "1")
    assert not colour.search(cli(*SMOKE, "--db", db).err)


def test_a_diverged_run_is_skipped_but_is_no_success(
    cli: CommandLine, fake: FakeTraining, db: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    real = local.run_cells
    fake({0: "diverged"})
    cli(*SMOKE, "--db", db)
    monkeypatch.setattr(local, "run_cells", real)
    outcome = cli(*SMOKE, "--db", db)
    assert "seed 0: skipped: diverged already" in outcome.err
    assert outcome.code == 3


def test_a_dry_run_tells_what_would_run_and_makes_nothing(cli: CommandLine, fake: FakeTraining, db: Path) -> None:
    def plan(*options: str) -> list[tuple[str, str]]:
        outcome = cli(*SMOKE, "--seeds", "0-2", "--dry-run", "--db", db, *options)
        assert outcome.code == 0
        return [(row["seed"], row["action"]) for row in outcome.rows]

    assert plan() == [("0", "new"), ("1", "new"), ("2", "new")]
    assert not db.parent.exists()
    fake({1: "interrupted"})
    cli(*SMOKE, "--seeds", "0-1", "--db", db)
    before = len(Store.open(db).runs())
    assert plan() == [("0", "skip"), ("1", "resume"), ("2", "new")]
    assert plan("--resume", "never") == [("0", "new"), ("1", "new"), ("2", "new")]
    assert plan("--set", "sac.gamma=0.5") == [("0", "new"), ("1", "new"), ("2", "new")]
    assert len(Store.open(db).runs()) == before


@pytest.mark.parametrize("options", [[], ["--dry-run"]])
def test_nothing_to_resume(cli: CommandLine, db: Path, options: list[str]) -> None:
    refused = cli(*SMOKE, "--resume", "require", "--db", db, *options)
    assert "--resume auto" in refused.err.splitlines()[-1]
    assert refused.code == 2


@pytest.mark.skipif(torch.cuda.is_available(), reason="this machine has a GPU")
def test_cuda_without_a_gpu(cli: CommandLine, fake: FakeTraining, db: Path) -> None:
    sentence = cli("train", "--profile", "smoke", "--device", "cuda", "--db", db).sentence
    assert sentence == "--device cuda needs a CUDA GPU, and none is found; use --device cpu."
    assert "--device cuda:1 needs a CUDA GPU, and none" in cli(*SMOKE[:-2], "--device", "cuda:1", "--db", db).sentence
    given = fake()
    assert cli("train", "--profile", "smoke", "--device", "auto", "--db", db).code == 0
    assert given["device"] == "cpu"


def test_one_of_several_gpus(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("torch.cuda.device_count", lambda: 2)
    assert [pick_device(name) for name in ("auto", "cpu", "cuda", "cuda:0", "cuda:1")] == [
        "cuda", "cpu", "cuda", "cuda:0", "cuda:1",
    ]  # fmt: skip
    with pytest.raises(InputError, match="only cuda:0, cuda:1 found; use --device cuda:0"):
        pick_device("cuda:2")


def test_a_data_file_that_does_not_exist(cli: CommandLine, db: Path, tmp_path: Path) -> None:
    outcome = cli(*SMOKE, "--set", f"data.path={tmp_path}/none.npz", "--db", db)
    assert outcome.code == 2
    assert f"{tmp_path}/none.npz" in outcome.err.splitlines()[-1]


def test_a_real_training_from_the_command_line_to_the_figure(cli: CommandLine, db: Path, tmp_path: Path) -> None:
    before = signal.getsignal(signal.SIGINT)
    outcome = cli(*SMOKE, "--db", db, "--json")
    assert outcome.code == 0
    (row,) = json.loads(outcome.out)
    assert row["outcome"] == "finished"
    assert 0 < row["test/mode_mse"] < 1
    assert signal.getsignal(signal.SIGINT) is before  # handed back
    again = cli(*SMOKE, "--db", db, "--json")
    assert "seed 0: skipped: finished already" in again.err
    assert json.loads(again.out)[0]["test/mode_mse"] == row["test/mode_mse"]
    drawn = cli("plot", "fig5", "--db", db, "--out", tmp_path / "figures")
    assert [Path(line).suffix for line in drawn.out.splitlines()] == [".png", ".csv"]
