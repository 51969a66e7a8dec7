"""`ssmail ablate`: the grid of values and seeds, its names, its plan, and what a second call still computes."""

import contextlib
import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given as drawn
from hypothesis import settings
from hypothesis import strategies as st

from ssmail.config.experiments import ablation, ablation_specs, build_spec
from ssmail.config.experiments_file import load_experiments
from ssmail.errors import InputError
from ssmail.execution import Resume
from ssmail.store import Store
from ssmail_cli.progress import FEW
from ssmail_cli.train import parse_values
from tests.cli.command_line import CommandLine, FakeTraining

SMOKE = ("ablate", "beta", "--profile", "smoke", "--device", "cpu")


@pytest.mark.parametrize(
    ("text", "values"),
    [
        ("0,0.1,0.15", [0, 0.1, 0.15]),
        ("1e-2", [0.01]),
        (" 1 , 2", [1, 2]),
        ("a,b-c", ["a", "b-c"]),
        ("[0,1]", [[0, 1]]),
        ("[0,1],[-1,1],[[-1,0,1],[0,1,3]]", [[0, 1], [-1, 1], [[-1, 0, 1], [0, 1, 3]]]),
        ("[0,1] # of the paper", [[0, 1]]),
        ("null,5,true", [None, 5, True]),
        ("identity, shaping:steep,[[0,0],[1,1]]", ["identity", "shaping:steep", [[0, 0], [1, 1]]]),
    ],
)
def test_values(text: str, values: list[Any]) -> None:
    assert parse_values(text) == values


def test_a_row_for_each_value_and_seed_under_the_name_of_the_key(
    cli: CommandLine, fake: FakeTraining, db: Path
) -> None:
    given = fake()
    outcome = cli(*SMOKE, "--values", "0.5,0,0.50", "--seeds", "3,1", "--jobs", 2, "--resume", "never", "--db", db)
    assert outcome.code == 0
    assert [(row["beta"], row["seed"], row["test/mode_mse"]) for row in outcome.rows] == [
        ("0.5", "3", "0.004"),
        ("0.5", "1", "0.002"),
        ("0.0", "3", "0.004"),
        ("0.0", "1", "0.002"),
    ]
    specs = ablation_specs("beta", "smoke", [0.5, 0])
    assert [(cell.spec, cell.seed) for cell in given["cells"]] == [
        (specs[value], seed) for value in (0.5, 0.0) for seed in (3, 1)
    ]
    assert (given["jobs"], given["device"], given["resume"]) == (2, "cpu", Resume.NEVER)


def test_the_default_is_the_grid_of_experiments_yaml_with_five_seeds(
    cli: CommandLine, fake: FakeTraining, db: Path
) -> None:
    outcome = cli(*SMOKE, "--dry-run", "--json", "--db", db)
    found = [(row["beta"], row["seed"]) for row in json.loads(outcome.out)]
    assert found == [(value, seed) for value in ablation("beta").values for seed in range(5)]
    assert not db.parent.exists()


def test_labels_are_words_and_knots(cli: CommandLine, fake: FakeTraining, db: Path) -> None:
    fake()
    options = ("--profile", "smoke", "--device", "cpu", "--seeds", "0", "--db", db)
    outcome = cli("ablate", "label", "--values", "identity,[[0,0],[1,1],[1.5,0]]", *options)
    assert outcome.code == 0
    assert [row["label"] for row in outcome.rows] == ["identity", "[[0, 0], [1, 1], [1.5, 0]]"]


@pytest.mark.parametrize("dry_run", [True, False])
def test_a_misleading_label_is_refused_before_anything_is_trained(
    cli: CommandLine, fake: FakeTraining, db: Path, dry_run: bool
) -> None:
    given = fake()
    options = ("--profile", "smoke", "--device", "cpu", "--db", db, *["--dry-run"] * dry_run)
    refused = cli("ablate", "label", "--values", "identity,[[0,0],[1,0.5]]", *options)
    assert refused.sentence.startswith("self_supervision.label: the line through the knots is 0.5 at alpha 1, where ")
    assert not given
    assert not db.exists()


def test_settings_reach_every_value(cli: CommandLine, fake: FakeTraining, db: Path) -> None:
    given = fake()
    cli(*SMOKE, "--values", "0,1", "--seeds", "0", "--set", "sac.gamma=0.5", "--db", db)
    assert [(cell.spec.sac.gamma, cell.spec.curriculum.beta) for cell in given["cells"]] == [(0.5, 0.0), (0.5, 1.0)]


def test_the_short_name_is_the_same_command(cli: CommandLine, db: Path) -> None:
    options = ("--profile", "smoke", "--values", "0.25,0.75", "--seeds", "1-2", "--dry-run", "--db", db)
    long, short = cli("ablate", "beta", *options), cli("ablate-beta", *options)
    assert long.code == 0
    assert long == short
    assert len(long.rows) == 4


def test_a_last_part_that_says_little_is_not_used_alone(cli: CommandLine, db: Path) -> None:
    outcome = cli("ablate", "curriculum", "--profile", "smoke", "--seeds", "0", "--dry-run", "--db", db)
    assert [row["curriculum.name"] for row in outcome.rows] == list(ablation("curriculum").values)


@pytest.mark.parametrize(
    "text", ["", " ", ",", "0,,1", "0,", ",0", "[", "]", "[0,1],[1", "0],[1", "0] # [", "[] , [", "{a", "\t'"]
)
def test_values_that_are_none(text: str) -> None:
    with pytest.raises(InputError, match=r"^--values takes values with commas between them, such as 0,0\.15,1, not "):
        parse_values(text)


@settings(max_examples=50)
@drawn(st.text("[]{},:#'\"|>&*!~-0a \n", max_size=12))
def test_any_text_is_values_or_a_sentence(text: str) -> None:
    with contextlib.suppress(InputError):
        assert parse_values(text)


def test_ranges_are_shown_as_they_are_written(cli: CommandLine, fake: FakeTraining, db: Path) -> None:
    options = ("--profile", "smoke", "--seeds", "0", "--device", "cpu", "--db", db)
    ranges = ("--values", "[0,1],[-1,1],[[-1,0,1],[0,1.5,3]]")
    assert [row["alpha"] for row in cli("ablate-alpha", *options, "--dry-run").rows] == ["[0, 1]", "[-1, 1]"]
    told = json.loads(cli("ablate", "alpha", *ranges, *options, "--dry-run", "--json").out)
    assert [row["alpha"] for row in told] == [[0, 1], [-1, 1], [[-1, 0, 1], [0, 1.5, 3]]]
    fake()
    outcome = cli("ablate", "alpha", *ranges, *options)
    assert outcome.code == 0
    assert [row["alpha"] for row in outcome.rows] == ["[0, 1]", "[-1, 1]", "[[-1, 0, 1], [0, 1.5, 3]]"]
    assert outcome.err.splitlines()[1] == "  alpha [0, 1]: 1 run"
    assert "\nalpha [0, 1], seed 0: started (run " in outcome.err


def test_another_environment(cli: CommandLine, fake: FakeTraining, db: Path) -> None:
    options = ("--profile", "smoke", "--seeds", "0", "--device", "cpu", "--db", db)
    given = fake()
    cli("ablate", "alpha", *options)
    assert [cell.spec.environment for cell in given["cells"]] == ["mocap"] * 2
    cli("ablate", "alpha", "--env", "yjunction", *options)
    assert [(cell.spec.environment, cell.spec) for cell in given["cells"]] == [
        ("yjunction", spec) for spec in ablation_specs("alpha", "smoke", environment="yjunction").values()
    ]


QUICKLY = ("--profile", "smoke", "--device", "cpu", "--seeds", "0")


def test_any_key_is_varied_without_an_entry_of_experiments_yaml(cli: CommandLine, fake: FakeTraining, db: Path) -> None:
    given = fake()
    outcome = cli("ablate", "sac.gamma", "--values", "0.5,0.75", "--set", "training.batch=2", *QUICKLY, "--db", db)
    assert [(row["gamma"], row["seed"]) for row in outcome.rows] == [("0.5", "0"), ("0.75", "0")]
    assert [cell.spec for cell in given["cells"]] == [
        build_spec("ssail", "yjunction", "smoke", [f"sac.gamma={value}", "training.batch=2"]) for value in (0.5, 0.75)
    ]
    cli("ablate", "wasserstein.penalty=1", "--method", "wail", "--env", "letters", *QUICKLY, "--db", db)
    assert [cell.spec for cell in given["cells"]] == [build_spec("wail", "letters", "smoke", ["wasserstein.penalty=1"])]


@pytest.mark.parametrize(
    "words",
    [
        ("sac.gamma", "--values", "0.5,0.75", "curriculum.beta", "--values", "0,1"),
        ("sac.gamma", "curriculum.beta", "--values", "0.5,0.75", "--values", "0,1"),
        ("sac.gamma=0.5,0.75", "curriculum.beta=0,1"),
        ("sac.gamma=0.5,0.75", "curriculum.beta", "--values", "0,1"),
    ],
)
def test_two_keys_are_a_grid(cli: CommandLine, db: Path, words: tuple[str, ...]) -> None:
    rows = cli("ablate", *words, *QUICKLY, "--dry-run", "--db", db).rows
    hashes = [
        build_spec("ssail", "yjunction", "smoke", [f"sac.gamma={gamma}", f"curriculum.beta={beta}"]).hash()
        for gamma in (0.5, 0.75)
        for beta in (0, 1)
    ]
    assert [row["spec_hash"] for row in rows] == hashes
    assert [(row["gamma"], row["beta"]) for row in rows] == [
        (gamma, beta) for gamma in ("0.5", "0.75") for beta in ("0.0", "1.0")
    ]


def test_a_named_ablation_and_a_key_are_a_grid_with_the_settings_of_the_name(cli: CommandLine, db: Path) -> None:
    rows = cli("ablate", "label", "sac.gamma=0.5", *QUICKLY, "--dry-run", "--db", db).rows
    specs = ablation_specs("label", "smoke", overrides=["sac.gamma=0.5"])
    assert [row["spec_hash"] for row in rows] == [spec.hash() for spec in specs.values()]


def test_keys_of_the_same_last_part_have_their_whole_names_as_headings(cli: CommandLine, db: Path) -> None:
    words = ("adversarial.updates=1,2", "training.updates=1")
    rows = cli("ablate", *words, *QUICKLY, "--dry-run", "--db", db).rows
    assert [(row["adversarial.updates"], row["training.updates"]) for row in rows] == [("1", "1"), ("2", "1")]


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (("gamma", "--values", "1"), "unknown ablation or key 'gamma'; did you mean sac.gamma?"),
        (("bta",), "unknown ablation or key 'bta'; did you mean beta?"),
        (("sac.gama=1",), "unknown key 'sac.gama' in --values; did you mean sac.gamma?"),
        (("training", "--values", "1"), "unknown ablation or key 'training'; did you mean training.epochs or "),
        (("sac.gamma",), "sac.gamma has no values of its own; give them with --values."),
        (("sac.gamma=1.5",), "sac.gamma = 1.5 in --values should be less than 1."),
        (("sac.gamma=0.5", "sac.gamma=0.6"), "sac.gamma is varied twice; give all of its values at once."),
        (("sac.gamma=0.5", "--set", "sac.gamma=0.6"), "sac.gamma is what the command varies; give its values with "),
        (("beta", "sac.gamma", "--values", "0.1"), "--values is given 1 time for 2 names; give it once for each, "),
        (("sac.gamma=0.1", "--values", "0.1"), "--values is given 1 time for 0 names; "),
        (("beta", "alpha"), "these ablations are of yjunction and mocap; choose one with --env."),
        (("wasserstein.clip=1",), "method ssail on yjunction has no section 'wasserstein' to set in --values"),
        (("data.yjunction.seed=" + ",".join(map(str, range(1001))),), "1001 combinations of values are "),
    ],
)  # fmt: skip
def test_a_wrong_grid_is_one_sentence(cli: CommandLine, db: Path, words: tuple[str, ...], sentence: str) -> None:
    assert cli("ablate", *words, "--db", db).sentence.startswith(sentence)
    assert not db.exists()


def test_an_ablation_of_ones_own(cli: CommandLine, tmp_path: Path, db: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    text = load_experiments().path.read_text()
    mine = "  size: {method: ssail, environment: yjunction, key: model.hidden, values: [4, 8]}\n"
    (tmp_path / "mine.yaml").write_text(text.replace("\nablations:\n", f"\nablations:\n{mine}"))
    monkeypatch.setenv("SSMAIL_EXPERIMENTS", str(tmp_path / "mine.yaml"))
    outcome = cli("ablate", "size", "--profile", "smoke", "--seeds", "0", "--dry-run", "--db", db)
    assert [row["hidden"] for row in outcome.rows] == ["4", "8"]


def test_progress_says_which_value_and_which_seed(cli: CommandLine, fake: FakeTraining, db: Path) -> None:
    fake()

    def told(values: str, seeds: str) -> list[str]:
        lines = cli(*SMOKE, "--values", values, "--seeds", seeds, "--db", db).err.splitlines()
        return [line for line in lines if line.startswith("beta ")]

    few = told("0.1,0.2", "0-1")
    assert few[0].startswith("beta 0.1, seed 0: started (run ")
    assert few[1] == "beta 0.1, seed 0: epoch 1/3  val 0.1  critic 0.5"
    assert few[-1].startswith("beta 0.2, seed 1: finished (run ")
    many = told("0.3,0.4", f"0-{FEW // 2}")
    assert len(many) == 2 * 2 * (FEW // 2 + 1)  # a line for the start and one for the end of each run
    assert many[-1].endswith(f"[{FEW + 2}/{FEW + 2}]")


def test_on_a_terminal_many_runs_have_one_line_together(
    cli: CommandLine, fake: FakeTraining, db: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fake({0: "failed"})
    monkeypatch.setenv("COLUMNS", "120")
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    outcome = cli(*SMOKE, "--values", "0.3,0.4", "--seeds", f"0-{FEW // 2}", "--db", db)
    assert f"{FEW + 2} of {FEW + 2} runs ended" in outcome.err
    assert f"{3 * (FEW + 2)}/{3 * (FEW + 2)}" in outcome.err  # epochs
    assert "beta 0.4, seed 0: failed (run " in outcome.err
    assert "waiting" not in outcome.err
    assert outcome.code == 3


def test_on_a_terminal_the_figure_is_named(
    cli: CommandLine, fake: FakeTraining, db: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fake()
    options = (*SMOKE, "--values", "0.5", "--seeds", "0", "--db", db)
    monkeypatch.setattr("ssmail.paper.results.FIGURES", {"fig6": None})
    assert "ssmail plot" not in cli(*options).err
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True)
    assert f"`ssmail plot fig6 --db {db}` draws these runs" in cli(*options).err
    fake({0: "interrupted"})
    assert "ssmail plot" not in cli(*options).err


def test_of_another_environment_only_a_figure_that_draws_it_is_named(
    cli: CommandLine, fake: FakeTraining, db: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fake()
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True)
    options = ("--profile", "smoke", "--seeds", "0", "--device", "cpu", "--db", db)
    assert f"`ssmail plot fig8 --db {db}` draws these runs" in cli("ablate", "alpha", *options).err
    elsewhere = cli("ablate", "alpha", "--env", "yjunction", *options)
    assert f"`ssmail plot fig8 --env yjunction --db {db}` draws these runs" in elsewhere.err
    other = cli("ablate", "beta", "--env", "mocap", "--values", "0.5", *options).err
    assert "fig6" not in other
    assert f"`ssmail plot ablation --key curriculum.beta --env mocap --db {db}` draws these runs" in other


def test_a_second_call_computes_only_what_is_missing(
    cli: CommandLine, fake: FakeTraining, walk: Callable[[], None], db: Path
) -> None:
    fake()
    options = ("--seeds", "0-1", "--db", db)
    cli(*SMOKE, "--values", "0.1", *options)
    stored = {run.id for run in Store.open(db).runs()}
    fake({0: "interrupted"})
    cli(*SMOKE, "--values", "0.2", "--seeds", "0", "--db", db)

    planned = cli(*SMOKE, "--values", "0.1,0.2", *options, "--dry-run")
    assert [row["action"] for row in planned.rows] == ["skip", "skip", "resume", "new"]
    walk()
    outcome = cli(*SMOKE, "--values", "0.1,0.2", *options)
    assert outcome.code == 0
    assert [row["outcome"] for row in outcome.rows] == ["skipped", "skipped", "finished", "finished"]
    assert outcome.err.count(": started (run ") + outcome.err.count(": resumed after epoch ") == 2
    runs = Store.open(db).runs()
    assert stored < {run.id for run in runs}
    assert [run.state for run in runs] == ["finished"] * 4
