"""What a new user types: about sixty natural guesses, each of which does the thing or is told the right command."""

import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import typer.main

from ssmail.config.experiments import build_spec
from ssmail.config.experiments_file import load_experiments
from ssmail.config.names import METHODS, flatten
from ssmail.config.spec import RunSpec, check_keys
from ssmail.store import RunState, Store
from ssmail_cli import guesses, options
from ssmail_cli.main import app
from tests.cli.command_line import CommandLine

DRY = "--profile smoke --dry-run"

# What is answered with another command: the line, and the end of the sentence.
ANSWERED = {
    "list": "did you mean `ssmail runs list`?",
    "ls": "did you mean `ssmail runs list`?",
    "status": "did you mean `ssmail runs list`?",
    "show": "did you mean `ssmail runs show` or `ssmail config show`?",
    "compare": "did you mean `ssmail runs compare`?",
    "evaluate": "did you mean `ssmail runs compare`?",
    "eval": "did you mean `ssmail runs compare`?",
    "test": "did you mean `ssmail runs compare`?",
    "results": "did you mean `ssmail runs compare`?",
    "delete": "did you mean `ssmail runs delete`?",
    "rm 3f2a": "did you mean `ssmail runs delete`?",
    "export": "did you mean `ssmail runs export` or `ssmail db export`?",
    "run --method ssail": "did you mean `ssmail train`?",
    "fit": "did you mean `ssmail train`?",
    "resume": "did you mean `ssmail train`?",
    "ssail": "did you mean `ssmail train ssail`?",
    "dnri --seeds 0-4": "did you mean `ssmail train dnri`?",
    "trian": "did you mean `ssmail train`?",
    "sweep": "did you mean `ssmail ablate`?",
    "tune": "did you mean `ssmail ablate`?",
    "alpha": "did you mean `ssmail plot fig8` or `ssmail ablate alpha`?",
    "draw fig5": "did you mean `ssmail plot`?",
    "figures": "did you mean `ssmail plot`?",
    "fig5": "did you mean `ssmail plot fig5`?",
    "modes": "did you mean `ssmail plot fig5`?",
    "film": "did you mean `ssmail plot film`?",
    "predict": "did you mean `ssmail forecast`?",
    "import flock.csv": "did you mean `ssmail import-data`?",
    "download": "did you mean `ssmail prep-mocap`?",
    "verify": "did you mean `ssmail claims`?",
    "backup": "did you mean `ssmail db backup`?",
    "version": "did you mean `ssmail --version`?",
    "methods": "did you mean `ssmail train`?",
    "xyzzy": "`ssmail --help` lists those it has.",
    "runs ls": "did you mean `ssmail runs list`?",
    "runs lst": "did you mean `ssmail runs list`?",
    "runs rm 3f2a": "did you mean `ssmail runs delete`?",
    "db list": "did you mean `ssmail runs list`?",
    "train --epochs 5": "did you mean --set training.epochs=N?",
    "train --num-epochs=5": "did you mean --set training.epochs=N?",
    "train --lr 0.001": "--set KEY=N with the key adversarial.learning_rate, sac.actor_learning_rate, "
    "sac.critic_learning_rate, sac.temperature_learning_rate or cloning.learning_rate?",
    "train --batch-size 8": "did you mean --set training.batch=N?",
    "train --gamma 0.9": "did you mean --set sac.gamma=N?",
    "train --beta 0.1": "did you mean --set curriculum.beta=N?",
    "train --gpu": "did you mean --device cuda?",
    "train --cuda": "did you mean --device cuda?",
    "train --device gpu": "--device takes auto, cpu, cuda or cuda:N, not 'gpu'; did you mean cuda?",
    "train --seed 3": "did you mean --seeds 0-4?",
    "train --workers 2": "did you mean --jobs?",
    "train --algo gail": "did you mean --method?",
    "train --environment letters": "did you mean --env?",
    "train --data flock.npz": "did you mean --set data.path=FILE?",
    "train --output x": "`ssmail train --help` lists those it has.",
    "train --method ssial": "unknown method 'ssial'; did you mean ssail?",
    "train gial": "unknown method 'gial'; did you mean gail?",
    "train --set gamma=0.9": "unknown key 'gamma' in --set; did you mean sac.gamma?",
    "plot": "name what to draw, such as fig4 or all; `ssmail plot --help` lists what there is.",
    "plot film 3f2a": "3f2a is no figure; name a run with --run, or those of a figure with --runs.",
    "plot fig4 --output x": "did you mean --out?",
    "reproduce fig55": "unknown figure 'fig55'; did you mean fig5?",
    "claims C9": "landscapes, C8, c8, vector-field.",
}
# What does the thing: the line, and what it prints on either stream.
DONE = {
    "": "Commands:",
    "-h": "Commands:",
    "help": "Commands:",
    "help train": "Usage: ssmail train",
    "help plot fig4": "Usage: ssmail plot fig4",
    "-v": "ssmail 0.",
    "-V": "ssmail 0.",
    "--version": "ssmail 0.",
    "runs": "run,state,method,",
    "runs --method ssail": "run,state,method,",
    "db": "schema",
    f"train gail {DRY}": "\n0,new,",
    f"train gail wail {DRY}": "method,seed,action,",
    f"train --method ssail --method gail --seeds 0-1 {DRY}": "gail,1,new,",
    f"train bc --env yjunction --env letters {DRY}": "letters,0,new,",
    f"train --seeds 5 {DRY}": "\n5,new,",
    f"train --device cuda:1 {DRY}": "\n0,new,",
    f"reproduce fig5 {DRY}": "fig5,4,0,4,",
    f"reproduce modes fig9 {DRY}": "fig9,",
    "claims c4": "C4,noise",
}


@pytest.fixture
def empty(db: Path) -> Path:
    """A database without runs."""
    Store.open(db).close()
    return db


def test_there_are_sixty() -> None:
    assert len(ANSWERED) >= 60


@pytest.mark.parametrize("line", ANSWERED)
def test_a_guess_is_answered_with_the_right_command(
    cli: CommandLine, empty: Path, monkeypatch: pytest.MonkeyPatch, line: str
) -> None:
    monkeypatch.setenv("SSMAIL_DB", str(empty))
    sentence = cli(*line.split()).sentence
    assert sentence.endswith(ANSWERED[line])


@pytest.mark.parametrize("line", DONE)
def test_a_guess_does_the_thing(cli: CommandLine, empty: Path, monkeypatch: pytest.MonkeyPatch, line: str) -> None:
    monkeypatch.setenv("SSMAIL_DB", str(empty))
    outcome = cli(*line.split())
    assert outcome.code == 0, outcome.err
    assert DONE[line] in outcome.out + outcome.err


def test_a_module_is_a_program() -> None:
    done = subprocess.run([sys.executable, "-m", "ssmail", "-v"], capture_output=True, text=True, check=True)
    assert done.stdout.startswith("ssmail 0.")


def group_of(words: list[str]) -> Any:
    found: Any = typer.main.get_command(app)
    for word in words:
        found = found.commands[word]
    return found


@pytest.mark.parametrize("target", sorted(set(guesses.WORDS.values())))
def test_what_a_word_leads_to_exists(target: str) -> None:
    words = [word for word in target.split() if not word.startswith("-")]
    assert group_of(words).help


def test_a_word_leads_to_no_command_that_has_its_name() -> None:
    """Such an entry would never be read, for the command comes first."""
    assert [word for word in guesses.WORDS if word in group_of([]).commands] == []


def test_what_an_option_leads_to_exists() -> None:
    known = {
        option
        for path in ([], ["train"], ["plot"], ["plot", "film"], ["reproduce"], ["import-data"])
        for parameter in group_of(path).params
        for option in parameter.opts
    }
    assert {meant.split()[0] for meant in guesses.OPTIONS.values()} <= known


@pytest.mark.parametrize("last", sorted(set(guesses.KEYS.values())))
def test_what_a_key_leads_to_exists(last: str) -> None:
    keys = [key for key in flatten(load_experiments().defaults) if f".{key}".endswith((f".{last}", f"_{last}"))]
    assert keys
    check_keys(dict.fromkeys(keys), "the table")


def test_the_keys_of_the_defaults_are_all_that_a_spec_has() -> None:
    """What the shell completes and --epochs is compared with, without reading the classes of the spec."""
    defaults = set(flatten(load_experiments().defaults))
    for method in METHODS:
        spec = build_spec(method, "yjunction", "smoke").model_dump()
        own = {key for key, value in flatten(spec).items() if value is not None and "." in key}
        assert own - defaults == set()
    assert RunSpec.model_fields.keys() >= {key.partition(".")[0] for key in defaults}


def test_the_states_of_the_help_are_those_of_the_store() -> None:
    assert list(options.STATES) == list(RunState)


@pytest.mark.parametrize("width", [60, 100])
def test_the_help_is_as_wide_as_the_terminal(cli: CommandLine, monkeypatch: pytest.MonkeyPatch, width: int) -> None:
    monkeypatch.setenv("COLUMNS", str(width))
    lines = cli("--help").out.splitlines()
    assert width - 15 < max(map(len, lines)) <= width
    assert "..." not in " ".join(lines).replace("[ARGS]...", "")  # no summary is cut


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("train", ["ssail", "copy-last", "trajectories", "smoke", "one seed, not a count", "cuda:1"]),
        ("runs list", ["dnri", "letters", "paper", "interrupted", "fig5 (modes)"]),
        ("runs compare", ["test/mode_mse", "test/stroke_distance", "test/fde"]),
        ("plot training", ["validation/energy", "gail"]),
        ("ablate", ["alpha, beta, curriculum, label", "any key", "mocap"]),
        ("reproduce", ["fig8 (alpha)"]),
        ("claims", ["stability", "vector-field"]),
    ],
)
def test_the_help_lists_what_may_be_given(cli: CommandLine, line: str, words: list[str]) -> None:
    text = " ".join(cli(*line.split(), "--help").out.split())
    assert [word for word in words if word not in text] == []


def test_the_sweep_says_what_it_will_compute(cli: CommandLine, db: Path, fake: Any) -> None:
    fake()
    options = ("--profile", "smoke", "--device", "cpu", "--db", db)
    first = cli("train", "--seeds", "5", *options).err.splitlines()[0]
    assert first == "1 run: ssail on yjunction, profile smoke, 1 seed: 5 (--seeds 0-4 for five)"
    both = cli("train", "ssail", "gail", "--seeds", "4-5", *options)
    lines = both.err.splitlines()
    assert lines[0].startswith("4 runs: ssail and gail on yjunction, profile smoke, 2 seeds: 4-5; 1 stored, 3 to train")
    assert lines[1].startswith("  ssail: 2 runs; 1 stored, 1 to train; about ")
    assert lines[2] == "  gail: 2 runs"
    assert [(row["method"], row["seed"]) for row in both.rows] == [
        ("ssail", "4"), ("ssail", "5"), ("gail", "4"), ("gail", "5"),
    ]  # fmt: skip
    assert set(both.rows[0]) == {
        "method", "seed", "outcome", "run", "test/mode_mse", "test/on_path", "test/path_rms", "test/lane_balance",
        "test_constant_velocity/mode_mse", "wall_seconds",
    }  # fmt: skip
