"""`ssmail plot skeleton`: from a prepared set, without any run."""

from pathlib import Path

import pytest

from ssmail.data import expert_sets
from ssmail.data.mocap.dataset import MocapParameters, prepare
from ssmail.plots import skeleton
from tests.cli.command_line import CommandLine
from tests.data.mocap.handmade import write_subject


@pytest.fixture
def data(tmp_path: Path) -> Path:
    source = write_subject(tmp_path / "source", {1: 60, 2: 60, 3: 120})
    path = tmp_path / "mocap.npz"
    wanted = MocapParameters(subject=35, train=(1,), validation=(2,), test=(3,))
    expert_sets.save(prepare(source, wanted), path)
    return path


def test_it_needs_neither_runs_nor_a_database(cli: CommandLine, data: Path, tmp_path: Path) -> None:
    out, nowhere = tmp_path / "figures", tmp_path / "absent.db"
    outcome = cli("plot", "skeleton", "--data", data, "--out", out, "--db", nowhere, "--format", "svg")
    assert outcome.code == 0
    assert [Path(line).name for line in outcome.out.splitlines()] == ["skeleton_test-0.svg", "skeleton_test-0.csv"]
    assert outcome.err == "skeleton: test window 0 of 0-0: trial 35_03 from frame 2 on.\n"
    assert not nowhere.exists()


def test_a_film_of_another_split(cli: CommandLine, data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(skeleton, "STRIDE", 25)  # two pictures instead of 17
    options = ("--data", data, "--split", "train", "--window", 0, "--animate", "--out", tmp_path / "figures")
    names = [Path(line).name for line in cli("plot", "skeleton", *options).out.splitlines()]
    assert names == ["skeleton_train-0.png", "skeleton_train-0.csv", "skeleton_train-0.gif"]
    assert all((tmp_path / "figures" / name).stat().st_size for name in names)


def test_a_set_without_a_skeleton_is_refused_with_what_makes_one(cli: CommandLine, tmp_path: Path) -> None:
    lanes = tmp_path / "lanes.npz"
    assert cli("generate-yjunction", "--train", 2, "--validation", 2, "--test", 2, "--out", lanes).code == 0
    assert cli("plot", "skeleton", "--data", lanes, "--out", tmp_path / "figures").sentence == (
        f"{lanes} holds an expert set of yjunction, which has no skeleton; make a set of recorded walking with "
        "`ssmail prep-mocap` and name its file with --data."
    )
    assert not (tmp_path / "figures").exists()


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ("skeleton", "there is no file data/mocap.npz; make it with `ssmail prep-mocap"),
        ("skeleton --window 1", "there is no file data/mocap.npz"),
        ("skeleton --window -1", "'--window': it should be greater than or equal to 0"),
        ("skeleton --split tets", "unknown split 'tets'; did you mean test?"),
        ("skeleton --runs ab", "`ssmail plot skeleton` has no option --runs;"),
        ("skeleton --profile quick", "`ssmail plot skeleton` has no option --profile;"),
        ("skeleton --stat mean-ci", "`ssmail plot skeleton` has no option --stat;"),
        ("skeleton --metric a", "`ssmail plot skeleton` has no option --metric;"),
        ("fig4 --animate", "`ssmail plot fig4` has no option --animate;"),
        ("training skeleton --window 0", "`ssmail plot training` has no option --window;"),
        ("skeletn", "unknown figure 'skeletn'; did you mean skeleton?"),
    ],
)
def test_what_does_not_go_together_is_said(
    cli: CommandLine, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, arguments: str, sentence: str
) -> None:
    monkeypatch.chdir(tmp_path)
    assert sentence in cli("plot", *arguments.split()).sentence
