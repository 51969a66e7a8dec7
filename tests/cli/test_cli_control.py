"""`ssmail control`: the list, the sweep over arms and seeds, and the figure."""

import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from ssmail.config.controls import arm_specs, control_names
from ssmail.config.experiments import build_spec
from ssmail.plots import provenance
from ssmail.store import Store
from tests.cli.command_line import CommandLine, FakeTraining
from tests.config.experiments_file import SHIPPED, write

SMOKE = ("--profile", "smoke", "--device", "cpu", "--seeds", "0-1")
ARMS = ["ssail", "current-only", "past-only"]


@pytest.mark.parametrize("words", [(), ("list",)])
def test_the_list_says_what_each_control_asks(cli: CommandLine, words: tuple[str, ...]) -> None:
    rows = cli("control", *words).rows
    assert [row["control"] for row in rows] == control_names() == list(SHIPPED.controls)
    (replay,) = [row for row in rows if row["control"] == "replay"]
    assert replay == {
        "control": "replay",
        "claim": "C1, C2",
        "environment": "yjunction",
        "arms": ", ".join(ARMS),
        "question": SHIPPED.controls["replay"]["question"],
    }
    assert json.loads(cli("control", *words, "--json").out)[0]["control"] == rows[0]["control"]


def test_a_row_for_each_arm_and_seed(cli: CommandLine, fake: FakeTraining, db: Path) -> None:
    given = fake()
    outcome = cli("control", "replay", *SMOKE, "--set", "sac.gamma=0.5", "--db", db)
    assert outcome.code == 0
    assert [(row["control"], row["arm"], row["seed"]) for row in outcome.rows] == [
        ("replay", arm, seed) for arm in ARMS for seed in ("0", "1")
    ]
    specs = arm_specs("replay", "smoke", ["sac.gamma=0.5"])
    assert [(cell.spec, cell.seed) for cell in given["cells"]] == [
        (spec, seed) for spec in specs.values() for seed in (0, 1)
    ]


def test_a_run_that_several_arms_share_is_trained_once_and_that_of_train_is_found(
    cli: CommandLine, fake: FakeTraining, walk: Callable[[], None], db: Path
) -> None:
    fake()
    cli("train", "ssail", *SMOKE, "--db", db)
    planned = cli("control", "replay", "blur", *SMOKE, "--dry-run", "--db", db).rows
    assert [(row["control"], row["arm"], row["action"]) for row in planned if row["seed"] == "0"] == [
        ("replay", "ssail", "skip"),
        ("replay", "current-only", "new"),
        ("replay", "past-only", "new"),
        ("blur", "none", "new"),
        ("blur", "twice", "new"),
    ]
    walk()
    outcome = cli("control", "replay", *SMOKE, "--db", db)
    assert [row["outcome"] for row in outcome.rows] == ["skipped"] * 2 + ["finished"] * 4
    assert len(Store.open(db).runs()) == 6


def test_all_is_every_control(cli: CommandLine, db: Path) -> None:
    rows = cli("control", "all", *SMOKE, "--seeds", "0", "--dry-run", "--db", db).rows
    hashes = {spec.hash() for name in control_names() for spec in arm_specs(name, "smoke").values()}
    assert {row["spec_hash"] for row in rows} == hashes
    assert len(rows) == len(hashes)
    assert build_spec("ssail", "yjunction", "smoke").hash() in hashes
    assert not db.exists()


def test_runs_may_wait_for_a_worker(cli: CommandLine, db: Path) -> None:
    rows = cli("control", "pairing", *SMOKE, "--enqueue", "--db", db).rows
    assert [(row["arm"], row["action"]) for row in rows] == [
        (arm, "queued") for arm in ("nearest", "assignment", "start") for _ in range(2)
    ]
    assert [run.state for run in Store.open(db).runs()] == ["queued"] * 6


def test_on_a_terminal_the_figure_is_named(
    cli: CommandLine, fake: FakeTraining, db: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fake()
    assert "ssmail plot" not in cli("control", "replay", *SMOKE, "--db", db).err
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True)
    assert (
        f"`ssmail plot control replay --db {db}` draws these runs" in cli("control", "replay", *SMOKE, "--db", db).err
    )


@pytest.mark.parametrize(
    ("line", "sentence"),
    [
        ("control rplay", "unknown control 'rplay'; did you mean replay?"),
        ("control all replay", "all is every control already; give it alone."),
        ("control list replay", "list shows every control; give it alone."),
        ("control replay --profile quik", "unknown profile 'quik'; did you mean quick?"),
        ("control replay --set adversarial.past_share=0.5", "adversarial.past_share is what the control replay varies"),
        ("control averaging --set sac.gamma=0.5", "method dnri on yjunction has no section 'sac' to set in --set;"),
        ("control replay --seeds x", "--seeds takes whole numbers"),
        ("plot control", "missing argument 'NAME...'."),
        ("plot control rplay", "unknown control 'rplay'; did you mean replay?"),
        ("plot control all replay", "all is every control already; give it alone."),
        ("plot control replay --window 3", "`ssmail plot control` has no option --window"),
    ],
)
def test_a_wrong_command_line_is_one_sentence(cli: CommandLine, line: str, sentence: str, db: Path) -> None:
    Store.open(db).close()
    assert cli(*line.split(), "--db", db).sentence.startswith(sentence)


def test_a_wrong_entry_names_its_place(
    cli: CommandLine, tmp_path: Path, db: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    broken = {**SHIPPED.controls["replay"], "claim": "C9"}
    file = write(tmp_path / "mine.yaml", controls={**SHIPPED.controls, "replay": broken})
    monkeypatch.setenv("SSMAIL_EXPERIMENTS", str(file))
    for line in ("control", "control replay --dry-run", "control all --dry-run"):
        assert cli(*line.split(), "--db", db).sentence.startswith("controls.replay of mine.yaml has the claim 'C9'")


def draw(cli: CommandLine, db: Path, *words: str) -> Any:
    return cli("plot", *words, "--db", db, "--out", db.parent / "figures")


def test_the_figure_draws_one_control_or_several(cli: CommandLine, fake: FakeTraining, db: Path) -> None:
    fake()
    cli("control", "replay", *SMOKE, "--db", db)
    outcome = draw(cli, db, "control", "replay")
    assert outcome.code == 0
    assert [Path(path).name for path in outcome.out.split()] == ["control_replay.png", "control_replay.csv"]
    assert "control replay: test/mode_mse against ssail, two-sided p: current-only 1, past-only 1." in outcome.err
    found = provenance.read(db.parent / "figures" / "control_replay.png")
    assert found.options["arms"] == ARMS
    assert "Does it matter that part of D's generated batch" in found.caption
    several = draw(cli, db, "control", "replay", "actor", "--metric", "test/lane_balance")
    assert several.code == 3
    assert f"no run of the control actor is stored in {db}; train some with `ssmail control actor`." in several.err
    assert [Path(path).name for path in several.out.split() if path.endswith("csv")] == [
        "control_replay_test-lane_balance.csv",
    ]


def test_words_after_control_are_controls_and_those_before_are_figures(
    cli: CommandLine, fake: FakeTraining, db: Path
) -> None:
    fake()
    cli("control", "replay", *SMOKE, "--db", db)
    outcome = draw(cli, db, "fig9", "control", "--profile", "smoke", "replay")
    assert [Path(path).stem for path in outcome.out.split()] == ["fig9_yjunction"] * 2 + ["control_replay"] * 2
    assert draw(cli, db, "control", "replay", "fig9").sentence.startswith("unknown control 'fig9'; ")
