"""`ssmail forecast`: a table or arrays of sampled futures, from an expert set or an array."""

import json
import os
from itertools import product
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from ssmail.data.expert_sets import save
from ssmail.data.importing.dataset import ImportOptions, import_set
from ssmail.inference.forecast import Forecast, forecast
from ssmail.inference.trained_run import load_run
from ssmail.inference.windows import Windows, read_windows
from ssmail_cli.main import run as command
from tests.inference.conftest import Train

WALK = np.cumsum(np.full((2, 4, 3, 2), 0.7), axis=1) + np.arange(3)[:, None] * 4


def test_the_table_has_a_row_for_each_position_and_none_for_padding() -> None:
    """Two samples of two windows, of which the second lacks the second agent; one step, one axis."""
    positions = np.array([[[[[1.0], [2.0]]], [[[3.0], [np.nan]]]], [[[[4.0], [5.0]]], [[[6.0], [np.nan]]]]])
    table = pd.concat(Forecast(positions, np.array([2, 1])).pieces())
    assert list(table.columns) == ["window", "sample", "step", "agent", "x"]
    assert table.to_numpy().tolist() == [
        [0, 0, 1, 0, 1.0],
        [0, 0, 1, 1, 2.0],
        [0, 1, 1, 0, 4.0],
        [0, 1, 1, 1, 5.0],
        [1, 0, 1, 0, 3.0],
        [1, 1, 1, 0, 6.0],
    ]


def test_windows_with_different_numbers_of_agents_are_predicted_by_number(train: Train) -> None:
    run = load_run(train("ssail").id, train("ssail").db)
    agents = np.array([3, 2, 3])
    padded = np.concatenate([WALK, WALK[:1]])
    padded[1, :, 2] = 0
    found = forecast(run, Windows(padded, agents), 4, 2, 7)
    np.testing.assert_array_equal(found.positions[:, [0, 2]], run.rollout(padded[[0, 2]], 4, 2, 7))
    np.testing.assert_array_equal(found.positions[:, 1, :, :2], run.rollout(padded[1, :, :2], 4, 2, 7))
    assert np.isnan(found.positions[:, 1, :, 2]).all()


def test_an_expert_set_is_observed_as_in_the_test_of_the_run(train: Train) -> None:
    trained = train("ssail", "mocap")
    assert trained.set is not None
    run = load_run(trained.id, trained.db)
    windows = read_windows(trained.set, run)
    test = trained.loop.data.test
    np.testing.assert_allclose(windows.positions[:, 1:], test.positions[:, :6])
    np.testing.assert_allclose(windows.positions[:, 1] - windows.positions[:, 0], test.velocities[:, 0])
    assert forecast(run, windows, None, 1, 0).positions.shape[2] == 10
    assert read_windows(trained.set, run, observed=3).positions.shape[1] == 4


def test_an_array_of_more_than_some_megabytes_is_read_whole(train: Train, tmp_path: Path) -> None:
    """As a .npy, and as the only array of a packed .npz."""
    run = load_run(train("ssail").id, train("ssail").db)
    large = np.random.default_rng(0).normal(size=(400, 60, 12, 2))  # 4.6 MB
    np.save(tmp_path / "large.npy", large)
    np.savez_compressed(tmp_path / "large.npz", large)
    for name in ("large.npy", "large.npz"):
        np.testing.assert_array_equal(read_windows(tmp_path / name, run).positions, large)


@pytest.fixture
def arguments(train: Train, tmp_path: Path) -> list[str]:
    """`ssmail forecast` of two windows by a run of ssail."""
    np.save(tmp_path / "walk.npy", WALK)
    trained = train("ssail")
    return ["forecast", trained.id[:12], str(tmp_path / "walk.npy"), "--db", str(trained.db), "--steps", "4"]


def test_every_format_holds_the_numbers_of_rollout(
    train: Train, arguments: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    expected = load_run(train("ssail").id, train("ssail").db).rollout(WALK, 4, samples=3, seed=9)
    table, packed = tmp_path / "futures.csv", tmp_path / "futures.npz"
    for out in (table, packed):
        assert command([*arguments, "--samples", "3", "--seed", "9", "--out", str(out), "--json"]) == 0
        said = json.loads(capsys.readouterr().out)
        assert (said["windows"], said["samples"], said["steps"], said["rows"]) == (2, 3, 4, 72)
    values = pd.read_csv(table)[["x", "y"]].to_numpy().reshape(2, 3, 4, 3, 2)
    np.testing.assert_allclose(values.swapaxes(0, 1), expected)
    with np.load(packed) as file:
        np.testing.assert_array_equal(file["positions"], expected)
        assert file["agents"].tolist() == [3, 3]

    written = table.read_bytes()
    assert command([*arguments, "--out", str(table)]) == 2
    assert "exists already" in capsys.readouterr().err
    assert table.read_bytes() == written
    assert command([*arguments, "--out", str(table), "--force"]) == 0
    assert table.read_bytes() != written


def test_parquet_holds_them_too(train: Train, arguments: list[str], tmp_path: Path) -> None:
    pytest.importorskip("pyarrow", reason="pyarrow, of the extra parquet, is not installed")
    assert command([*arguments, "--samples", "3", "--seed", "9", "--out", str(tmp_path / "futures.parquet")]) == 0
    expected = load_run(train("ssail").id, train("ssail").db).rollout(WALK, 4, samples=3, seed=9)
    table = pd.read_parquet(tmp_path / "futures.parquet")
    assert table.dtypes.astype(str).to_dict() == {
        **dict.fromkeys(("window", "sample", "step", "agent"), "int64"),
        **dict.fromkeys(("x", "y"), "float64"),
    }
    np.testing.assert_array_equal(table[["x", "y"]].to_numpy().reshape(2, 3, 4, 3, 2).swapaxes(0, 1), expected)


def test_a_missing_package_is_one_sentence(
    arguments: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("pyarrow", "pyarrow.parquet"):
        monkeypatch.setitem(__import__("sys").modules, name, None)
    assert command([*arguments, "--out", str(tmp_path / "futures.parquet")]) == 2
    assert capsys.readouterr().err.endswith("is not installed; run `pip install 'ssmail[parquet]'`\n")


def test_what_cannot_be_forecast_is_one_sentence(
    arguments: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder, out = tmp_path / "odd", tmp_path / "futures.csv"
    folder.mkdir()
    np.save(folder / "flat.npy", WALK[0])
    np.save(folder / "objects.npy", np.array([{}]), allow_pickle=True)
    np.save(folder / "nan.npy", np.full_like(WALK, np.nan))
    np.savez(folder / "two.npz", a=WALK, b=WALK)
    (folder / "short.npy").write_bytes((tmp_path / "walk.npy").read_bytes()[:-8])
    (folder / "text.npy").write_text("x,y\n1,2\n")
    os.mkfifo(folder / "pipe.npy")
    for name, said in (
        ("none.npy", "there is no file"),
        ("flat.npy", "is 4 x 3 x 2 instead of (M, T, N, P)"),
        ("objects.npy", "no array of numbers"),
        ("nan.npy", "NaN"),
        ("two.npz", "holds 2 arrays, and none is called positions"),
        ("short.npy", "no array of numbers as large as it says"),
        ("text.npy", "cannot be read"),
        ("pipe.npy", "not a regular file"),
    ):
        given = [*arguments[:2], str(folder / name), *arguments[3:], "--out", str(out)]
        assert command(given) == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert said in line
        assert name in line
    for more, said in (
        (["--observed", "1", "--out", str(out)], "2 to 4 of them can be observed, not 1"),
        (["--out", str(tmp_path / "futures.xlsx")], "unknown ending of --out '.xlsx'"),
        (["--model", "worst", "--out", str(out)], "a run has a best and a last model, not 'worst'"),
        (["--samples", "10000", "--steps", "100000", "--out", str(out)], "do not fit into memory"),
    ):
        assert command([*arguments, *more]) == 2
        assert said in capsys.readouterr().err
    assert not out.exists()


def write_walks(path: Path, seconds: float | None = None) -> Path:
    """The walks of WALK as two scenes that begin with another frame; in a third one nobody stays to the end."""
    names = ("frame", "agent", "scene") if seconds is None else ("t", "who", "place")
    lines = [f"{','.join(names)},x,y"]
    for scene, frames in enumerate(WALK):
        for frame, agents in enumerate([agents - 0.7 for agents in frames[:1]] + list(frames)):
            for name, (x, y) in zip(("zoe", "abe", "mia"), agents.tolist(), strict=True):
                number = 5 * frame if seconds is None else round(seconds * frame, 6)
                lines.append(f"{number},{name},day{scene},{x},{y}")
    lines += [f"{frame},{name},empty,0,0" for name, frame in (("abe", 0), ("abe", 5), ("mia", 10), ("mia", 15))]
    path.write_text("\n".join(lines) + "\n")
    return path


def test_a_table_is_forecast_beyond_the_end_of_its_scenes(
    train: Train, arguments: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """With the names, scenes and frames of the table. Agents come in the order of their names, as in an expert set."""
    write_walks(tmp_path / "walk.csv")
    command_line = [*arguments[:2], str(tmp_path / "walk.csv"), *arguments[3:], "--observed", "3", "--samples", "2"]
    assert command([*command_line, "--out", str(tmp_path / "futures.csv")]) == 0
    assert "1 of 3 scenes have no agent in all of their last 4 frames" in capsys.readouterr().err
    table = pd.read_csv(tmp_path / "futures.csv")
    assert list(table.columns) == ["window", "scene", "sample", "step", "frame", "agent", "x", "y"]
    expected = load_run(train("ssail").id, train("ssail").db).rollout(WALK[:, :, [1, 2, 0]], 4, samples=2, seed=0)
    values = table[["x", "y"]].to_numpy().reshape(2, 2, 4, 3, 2)
    np.testing.assert_allclose(values.swapaxes(0, 1), expected)
    assert table["scene"].tolist() == ["day0"] * 24 + ["day1"] * 24
    assert table["agent"].tolist() == ["abe", "mia", "zoe"] * 16
    assert table["frame"].tolist() == [25] * 3 + [30] * 3 + [35] * 3 + [40] * 3 + table["frame"].tolist()[12:]
    assert (table["frame"] == 20 + 5 * table["step"]).all()

    assert command([*command_line, "--out", str(tmp_path / "futures.npz")]) == 0
    with np.load(tmp_path / "futures.npz") as file:
        np.testing.assert_allclose(file["positions"], expected)
        assert file["scene"].tolist() == ["day0", "day1"]
        assert file["frame"].tolist() == [[25, 30, 35, 40]] * 2
        assert file["agent"].tolist() == [["abe", "mia", "zoe"]] * 2


def test_a_table_may_have_other_columns_and_times(
    train: Train, arguments: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_walks(tmp_path / "walk.csv", seconds=0.1)
    given = [*arguments[:2], str(tmp_path / "walk.csv"), *arguments[3:], "--observed", "2"]
    out = ["--out", str(tmp_path / "futures.csv")]
    assert command([*given, *out]) == 2
    assert "has no column 'frame'" in capsys.readouterr().err
    columns = ["--frame", "t", "--agent", "who", "--scene", "place", "--dt", "0.1"]
    (tmp_path / "walk.csv").write_text("\n".join((tmp_path / "walk.csv").read_text().splitlines()[:31]))
    assert command([*given, *columns, *out]) == 0
    table = pd.read_csv(tmp_path / "futures.csv")
    assert sorted(set(table["frame"])) == [0.5, 0.6, 0.7, 0.8]
    expected = load_run(train("ssail").id, train("ssail").db).rollout(WALK[:, 1:, [1, 2, 0]], 4, samples=20, seed=0)
    np.testing.assert_allclose(table[["x", "y"]].to_numpy().reshape(2, 20, 4, 3, 2).swapaxes(0, 1), expected)
    for more, said in (
        (["--observed", "9"], "no scene of"),
        (["--dt", "-1"], "--dt takes the seconds of a step"),
    ):
        assert command([*given, *columns, *more, *out, "--force"]) == 2
        assert said in capsys.readouterr().err


def test_windows_of_an_expert_set_have_their_scenes(train: Train, tmp_path: Path) -> None:
    """As the set has no names of agents, they have numbers."""
    grid = product(range(3), range(9), "ab")
    walks = pd.DataFrame(
        [(f"day{scene}", 5 + frame, agent, (1.0 + scene) * frame**2) for scene, frame, agent in grid],
        columns=["scene", "frame", "agent", "x"],
    )
    walks.to_csv(tmp_path / "walks.csv", index=False)
    experts, _ = import_set([tmp_path / "walks.csv"], ImportOptions(window=4, stride=4))
    save(experts, tmp_path / "walks.npz")
    trained = train("constant-velocity", "trajectories", f"data.path={tmp_path / 'walks.npz'}")
    run = load_run(trained.id, trained.db)
    found = forecast(run, read_windows(tmp_path / "walks.npz", run), None, 1, 0)
    table = pd.concat(found.pieces())
    assert list(table.columns) == ["window", "scene", "start", "sample", "step", "agent", "x"]
    (scene,) = set(table["scene"])
    assert scene in {"day0", "day1", "day2"}
    assert table["start"].tolist() == [6] * 4 + [10] * 4
    assert table["agent"].tolist() == [0, 1] * 4
    last, before = table["start"] - 4, table["start"] - 5
    expected = (1 + int(scene[-1])) * (last**2 + table["step"] * (last**2 - before**2))
    np.testing.assert_allclose(table["x"], expected)
