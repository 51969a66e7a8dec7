"""`ssmail generate-yjunction`, `ssmail generate-letters` and `ssmail plot`."""

import json
from pathlib import Path

import pytest

from ssmail.config.data_sections import LettersSpec
from ssmail.config.experiments import build_spec
from ssmail.data import expert_sets, letters
from ssmail.evaluation.statistics import Statistic
from ssmail.paper.results import FIGURES
from ssmail.plots import provenance
from ssmail.store import RunState, Store
from tests.cli.command_line import CommandLine
from tests.paper.handmade_arrays import arrays


@pytest.fixture
def db(tmp_path: Path) -> Path:
    """A database with one finished run."""
    store = Store.open(tmp_path / "ssmail.db")
    writer = store.start_run(build_spec("ssail", "yjunction", "smoke"), 0, dataset_hash="d" * 64, device="cpu")
    for epoch in (1, 2, 3):
        writer.epoch(epoch, {"train/mode_mse": 0.1 / epoch})
    writer.arrays(arrays(0.0))
    writer.final(3, {"test/on_lane": 0.9, "test/lane_balance": 0.25, "test_constant_velocity/mode_mse": 0.045})
    writer.finish(RunState.FINISHED)
    return tmp_path / "ssmail.db"


def test_the_default_set_is_that_of_experiments_yaml(cli: CommandLine, tmp_path: Path) -> None:
    out = tmp_path / "deep" / "set.npz"
    outcome = cli("generate-yjunction", "--out", out)
    assert outcome.code == 0
    data = build_spec("ssail", "yjunction", "quick").data
    params = data.yjunction
    assert params is not None
    experts = expert_sets.load(out)
    assert experts.hash == expert_sets.generate(data, 1).hash  # its own seed is 0
    own = build_spec("ssail", "yjunction", "quick", ["data.yjunction.seed=null"]).data
    assert experts.hash == expert_sets.generate(own, 0).hash != expert_sets.generate(own, 1).hash
    assert experts.hash[:16] in outcome.out
    assert f"{params.train}/{params.validation}/{params.test}" in outcome.out


def test_every_option_reaches_the_generator(cli: CommandLine, tmp_path: Path) -> None:
    wanted = {
        "train": 3,
        "validation": 4,
        "test": 5,
        "agents": 2,
        "steps": 60,
        "lane_angle": 20.0,
        "jitter": 0.5,
        "seed": 7,
    }
    options = [part for key, value in wanted.items() for part in (f"--{key.replace('_', '-')}", value)]
    outcome = cli("generate-yjunction", "--out", tmp_path / "set.npz", "--json", *options)
    told = json.loads(outcome.out)
    assert told["parameters"] == wanted
    assert told["hash"] == expert_sets.load(tmp_path / "set.npz").hash


def test_letters_are_those_of_experiments_yaml_or_of_the_options(cli: CommandLine, tmp_path: Path) -> None:
    out = tmp_path / "letters.npz"
    assert cli("generate-letters", "--out", out).code == 0
    data = build_spec("ssail", "letters", "quick").data
    assert expert_sets.load(out, "letters").hash == expert_sets.generate(data, 0).hash
    wanted = {"word": "NO", "train": 3, "validation": 4, "test": 5, "steps": 40, "jitter": 0.5, "seed": 7}
    options = [part for key, value in wanted.items() for part in (f"--{key}", value)]
    told = json.loads(cli("generate-letters", "--out", out, "--force", "--json", *options).out)
    assert told["parameters"] == {"environment": "letters", **wanted}  # NO is a word, though YAML reads "no" in it
    read = expert_sets.load(out, "letters")
    assert told["hash"] == read.hash
    made = letters.generate(LettersSpec(**wanted))
    assert made.hash == read.hash
    assert (read.validation.continuations == made.validation.continuations).all()
    refused = cli("train", "--set", f"data.path={out}", "--db", tmp_path / "x.db")
    assert "not of yjunction" in refused.err.splitlines()[-1]


@pytest.mark.parametrize("word", ["ml", "TOOLONG", "", "M1", "1"])
def test_a_bad_word(cli: CommandLine, tmp_path: Path, word: str) -> None:
    sentence = cli("generate-letters", "--out", tmp_path / "letters.npz", "--word", word).sentence
    assert sentence == f"data.letters.word: takes 1 to 6 capital letters A to Z, not {word!r}."
    assert not list(tmp_path.iterdir())


def test_a_file_is_overwritten_only_with_force(cli: CommandLine, tmp_path: Path) -> None:
    out = tmp_path / "set.npz"
    small = ("generate-yjunction", "--out", out, "--train", 4, "--validation", 4, "--test", 4)
    cli(*small)
    before = out.read_bytes()
    assert cli(*small, "--seed", 1).sentence.startswith(f"{out} exists already")
    assert out.read_bytes() == before
    assert cli(*small, "--seed", 1, "--force").code == 0
    assert expert_sets.load(out).parameters["seed"] == 1


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ("--lane-angle 90", "data.yjunction.lane_angle = 90.0 in the options should be less than 90."),
        ("--train 0", "data.yjunction.train = 0 in the options should be greater than or equal to 1."),
        ("--jitter -1", "data.yjunction.jitter = -1.0 in the options should be greater than or equal to 0."),
        ("--agents 60", "60 agents"),
        ("--agents two", "'--agents'"),
        ("--out /proc/none/set.npz", "cannot write /proc/none/set.npz"),
    ],
)
def test_bad_input(cli: CommandLine, tmp_path: Path, options: str, sentence: str) -> None:
    outcome = cli("generate-yjunction", "--out", tmp_path / "set.npz", *options.split())
    assert sentence in outcome.sentence
    assert not list(tmp_path.iterdir())


def test_figures_are_written_in_every_format_with_their_runs(cli: CommandLine, db: Path, tmp_path: Path) -> None:
    out = tmp_path / "figures"
    outcome = cli("plot", "fig4", "modes", "fig4", "--format", "png", "--format", "svg", "--out", out, "--db", db)
    paths = [Path(line) for line in outcome.out.splitlines()]
    assert [path.name for path in paths] == [
        f"{FIGURES[name].stem}{suffix}" for name in ("fig4", "fig5") for suffix in (".png", ".svg", ".csv")
    ]
    (run,) = Store.open(db).runs()
    assert provenance.read(paths[0]).run_ids == (run.id,)
    assert "fig4: ssail: spec" in outcome.err


def test_runs_can_be_chosen(cli: CommandLine, db: Path, tmp_path: Path) -> None:
    (run,) = Store.open(db).runs()
    chosen = cli("plot", "fig4", "--runs", run.id[:8], "--out", tmp_path / "figures", "--db", db)
    assert chosen.code == 0
    twice = cli("plot", "fig4", "--runs", f"{run.id[:8]},zzzz", "--out", tmp_path / "figures", "--db", db)
    assert "'zzzz'" in twice.sentence


def test_a_figure_without_runs_names_the_command_that_makes_them(cli: CommandLine, tmp_path: Path) -> None:
    Store.open(tmp_path / "empty.db").close()
    sentence = cli("plot", "fig5", "--db", tmp_path / "empty.db").sentence
    assert "ssmail train --method ssail --env yjunction" in sentence


def test_an_unknown_format(cli: CommandLine, db: Path, tmp_path: Path) -> None:
    outcome = cli("plot", "fig4", "--format", "jpg", "--out", tmp_path / "figures", "--db", db)
    assert outcome.sentence == "unknown figure format 'jpg'; did you mean png?"


def test_the_help_names_every_figure_and_statistic(cli: CommandLine) -> None:
    shown = " ".join(cli("plot", "--help").out.split())
    for module in FIGURES.values():
        assert f"{module.name} ({module.alias})" in shown
        own = " ".join(cli("plot", module.alias, "--help").out.split())
        assert f"Usage: ssmail plot {module.name} " in own
        assert ("--env" in own) == module.has_environment
        assert ("--stat" in own) == module.has_statistic
        assert not module.has_statistic or all(statistic in own for statistic in Statistic)


def test_a_statistic_can_be_chosen(cli: CommandLine, db: Path, tmp_path: Path) -> None:
    out = tmp_path / "figures"
    outcome = cli("plot", "fig4", "fig5", "--stat", "mean-std", "--out", out, "--db", db)
    assert outcome.code == 0
    assert "\nmedian," not in (out / "fig4_stability.csv").read_text()
    assert "\nmean," in (out / "fig4_stability.csv").read_text()
    cli("plot", "fig4", "--out", out, "--db", db)
    assert "\nmedian," in (out / "fig4_stability.csv").read_text()


def test_training_curves_of_any_metric(cli: CommandLine, db: Path, tmp_path: Path) -> None:
    out = tmp_path / "figures"
    options = ("--metric", "train/mode_mse", "--method", "ssail", "--env", "yjunction", "--profile", "smoke")
    outcome = cli("plot", "training", *options, "--group-by", "seed", "--out", out, "--db", db)
    names = [Path(line).name for line in outcome.out.splitlines()]
    assert names == ["training_train-mode_mse.png", "training_train-mode_mse.csv"]
    (run,) = Store.open(db).runs()
    assert provenance.read(out / names[0]).run_ids == (run.id,)
    assert "seed 0" in (out / names[1]).read_text()
    both = cli("plot", "training", "fig4", "--runs", run.id[:8], "--out", out, "--db", db)
    assert [Path(line).name for line in both.out.splitlines()][2:] == ["fig4_stability.png", "fig4_stability.csv"]


def test_training_curves_of_each_environment(cli: CommandLine, db: Path, tmp_path: Path) -> None:
    """By its own error, where no metric is asked for."""
    writer = Store.open(db).start_run(build_spec("dnri", "mocap", "smoke"), 0, dataset_hash="e" * 64, device="cpu")
    for epoch in (1, 2):
        writer.epoch(epoch, {"validation/mse": 0.1 / epoch, "validation/mse_10": 0.2})
    writer.finish(RunState.FINISHED)

    def drawn(*options: str) -> list[str]:
        outcome = cli("plot", "training", *options, "--out", tmp_path / "figures", "--db", db)
        return [Path(line).stem for line in outcome.out.splitlines()][::2]

    asked = ("--env", "mocap", "--metric", "validation/mse", "--metric", "validation/mse_10")
    assert drawn(*asked) == ["training_validation-mse_validation-mse_10"]
    assert drawn("--env", "mocap") == ["training_validation-mse"]
    assert drawn("--env", "yjunction") == ["training_train-mode_mse"]
    assert drawn() == ["training_train-mode_mse_validation-mse"]


def test_options_may_stand_anywhere(cli: CommandLine, db: Path, tmp_path: Path) -> None:
    """Before, between and after the names; --stat applies to the figures that have it."""
    out = tmp_path / "fig5"
    line = ("--out", out, "fig4", "--format=svg", "modes", "--stat", "mean-ci", "fig4", "--db", db)
    names = [Path(path).name for path in cli("plot", *line).out.splitlines()]
    assert names == [f"{FIGURES[name].stem}{suffix}" for name in ("fig4", "fig5") for suffix in (".svg", ".csv")]
    assert {path.name for path in out.iterdir()} == set(names)


def test_a_value_may_be_called_like_a_figure(
    cli: CommandLine, db: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert cli("plot", "--out", "fig5", "fig9", "--db", db).code == 0
    assert {path.stem for path in (tmp_path / "fig5").iterdir()} == {"fig9_yjunction"}


@pytest.mark.parametrize(
    "arguments",
    [
        "training fig9 --metric train/mode_mse",
        "training fig9 --runs RUN --profile smoke",
        "fig9 fig4 --stat mean",
        "fig9 --format bmp",
    ],
)
def test_nothing_is_drawn_before_all_options_are_checked(
    cli: CommandLine, db: Path, tmp_path: Path, arguments: str
) -> None:
    words = arguments.replace("RUN", Store.open(db).runs()[0].id).split()
    outcome = cli("plot", *words, "--out", tmp_path / "figures", "--db", db)
    assert (outcome.code, (tmp_path / "figures").exists()) == (2, False)


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ("fig4 --metric train/mode_mse", "`ssmail plot fig4` has no option --metric;"),
        ("training fig4 --group-by seed", "`ssmail plot fig4` has no option --group-by;"),
        ("fig8 fig4 --env yjunction", "`ssmail plot fig4` has no option --env;"),
        ("fig8 --env yjunctoin", "unknown environment 'yjunctoin'; did you mean yjunction?"),
        (
            "fig8 --env yjunction --profile quick",
            "run `ssmail ablate alpha --env yjunction --profile quick --seeds 0-4`.",
        ),
        ("fig8", "no run of the ablation alpha on mocap; run `ssmail ablate alpha --profile quick --seeds 0-4`."),
        ("fig9 --stat mean-ci", "`ssmail plot fig9` has no option --stat;"),
        ("fig4 --stat mean", "unknown statistic 'mean'; did you mean mean-ci?"),
        ("fig10", "unknown figure 'fig10'; did you mean fig"),
        ("trainin", "unknown figure 'trainin'; did you mean training?"),
        ("fig4 --runs ab --profile smoke", "--runs names the runs already; leave --profile out."),
        ("training --method sail", "unknown method 'sail'; did you mean ssail?"),
        ("training --method bc", "meets these conditions; `ssmail runs list` shows those there are."),
        ("training --metric mode_mse", "has a metric 'mode_mse'; the nearest stored are "),
        (
            "training --group-by curriculum.bta",
            "unknown key to group by 'curriculum.bta'; did you mean curriculum.beta?",
        ),
        ("fig6 --profile quick", "run `ssmail ablate beta --profile quick --seeds 0-4`."),
    ],
)
def test_what_does_not_go_together_is_said(cli: CommandLine, db: Path, arguments: str, sentence: str) -> None:
    assert sentence in cli("plot", *arguments.split(), "--db", db).sentence


def test_an_ablation_of_any_key_is_drawn(cli: CommandLine, tmp_path: Path) -> None:
    store = Store.open(tmp_path / "ssmail.db")
    for number, gamma in enumerate((0.5, 0.9)):
        for batch in (2, 3):
            spec = build_spec("ssail", "yjunction", "smoke", [f"sac.gamma={gamma}", f"training.batch={batch}"])
            writer = store.start_run(spec, 0, dataset_hash="d" * 64, device="cpu")
            writer.final(3, {"test/mode_mse": 0.1 + number, "test/lane_balance": 0.25})
            writer.finish(RunState.FINISHED)
    options = ("--out", tmp_path / "figures", "--db", tmp_path / "ssmail.db")
    one = cli("plot", "ablation", "--key", "sac.gamma", "--where", "training.batch=2", *options)
    assert one.out.splitlines()[-1] == str(tmp_path / "figures" / "ablation_sac.gamma_test-mode_mse.csv")
    assert "profile smoke + training.batch=2), 2 values of sac.gamma" in one.err
    words = ("--key", "sac.gamma", "--key", "training.batch", "--metric", "test/lane_balance", "--format", "svg")
    (figure, _) = cli("plot", "ablation", *words, *options).out.splitlines()
    assert provenance.read(Path(figure)).options["keys"] == ["sac.gamma", "training.batch"]
    assert cli("explain", figure, "--db", tmp_path / "ssmail.db").code == 0
    absent = cli("plot", "ablation", "--key", "beta", *options)
    assert "differ in curriculum.beta alone; others differ in sac.gamma, training.batch; train some" in absent.sentence
    assert "no option --metrik" in cli("plot", "ablation", "--metrik", "x", "--key", "beta", *options).sentence
