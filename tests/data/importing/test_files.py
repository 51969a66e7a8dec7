"""Tables and arrays: the same positions from every kind of file, what a set holds, and what was left out."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from ssmail.data import expert_sets
from ssmail.data.importing import tables
from ssmail.data.importing.tables import Columns
from ssmail.data.mocap.amc import parse_motion
from ssmail.data.mocap.asf import parse_skeleton
from ssmail.data.mocap.dataset import MocapParameters, prepare
from ssmail.data.mocap.kinematics import positions as placed
from ssmail.data.trajectories import SPLITS
from ssmail.errors import InputError
from tests.data.importing.walks import imported, table_of, walks
from tests.data.mocap.handmade import write_subject


def test_a_window_has_the_positions_of_its_frames(tmp_path: Path) -> None:
    positions = walks()
    table_of(positions).to_csv(tmp_path / "a.csv", index=False)
    experts, _ = imported(tmp_path / "a.csv")
    assert experts.parameters["identity"] is True
    assert experts.scenes == ("0", "1", "2", "3")
    count = 0
    for split in SPLITS:
        made = getattr(experts, split)
        for window, (scene, frame) in enumerate(zip(made.scene, made.frame, strict=True)):
            here = positions[scene, frame : frame + 4]
            np.testing.assert_array_equal(made.positions[window], here)
            np.testing.assert_array_equal(made.velocities[window], here - positions[scene, frame - 1 : frame + 3])
            count += 1
    assert count == 4 * 3  # beginning at the frames 1, 3 and 5, each with the frame before


def as_parquet(table: pd.DataFrame, path: Path) -> None:
    pytest.importorskip("pyarrow")
    table.to_parquet(path, index=False)


WRITERS: dict[str, Callable[[pd.DataFrame, Path], None]] = {
    "a.csv": lambda table, path: table.to_csv(path, index=False),
    "tabs.tsv": lambda table, path: table.to_csv(path, index=False, sep="\t"),
    "semicolons.csv": lambda table, path: table.to_csv(path, index=False, sep=";"),
    "spaces.txt": lambda table, path: path.write_text(table.to_string(index=False)) and None,
    "quotes.csv": lambda table, path: table.astype(str).to_csv(path, index=False, quoting=1),
    "bom.csv": lambda table, path: table.to_csv(path, index=False, encoding="utf-8-sig", lineterminator="\r\n"),
    "shuffled.csv": lambda table, path: table.sample(frac=1, random_state=1).to_csv(path, index=False),
    "floats.csv": lambda table, path: table.astype(float).to_csv(path, index=False),
    "more.csv": lambda table, path: table.assign(speed=1.5, note="hm").to_csv(path, index=False),
    "a.parquet": as_parquet,
    "floats.parquet": lambda table, path: as_parquet(table.astype(float), path),
    "text.parquet": lambda table, path: as_parquet(table.astype({"scene": str, "agent": str}), path),
}


@pytest.mark.parametrize("name", WRITERS)
def test_every_table_gives_the_same_set(tmp_path: Path, name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tables, "PIECE", 10)  # rows
    table = table_of(walks())
    table.to_csv(tmp_path / "plain.csv", index=False)
    WRITERS[name](table, tmp_path / name)
    assert imported(tmp_path / name)[0].hash == imported(tmp_path / "plain.csv")[0].hash


@pytest.mark.parametrize("axes", [1, 2, 3])
def test_arrays_give_the_set_of_their_table(tmp_path: Path, axes: int) -> None:
    positions = walks(axes=axes)
    table = table_of(positions)
    table.assign(scene="a/" + table["scene"].astype(str)).to_csv(tmp_path / "a.csv", index=False)
    hashes = {imported(tmp_path / "a.csv")[0].hash}
    np.save(tmp_path / "a.npy", positions)
    hashes.add(imported(tmp_path / "a.npy")[0].hash)
    np.savez(tmp_path / "a.npz", positions=np.asfortranarray(positions), other=np.zeros(3))
    hashes.add(imported(tmp_path / "a.npz")[0].hash)
    np.savez_compressed(tmp_path / "a.npz", positions)
    hashes.add(imported(tmp_path / "a.npz")[0].hash)
    assert len(hashes) == 1


def test_a_folder_of_files_that_are_scenes(tmp_path: Path) -> None:
    (tmp_path / "day" / "two").mkdir(parents=True)
    table = table_of(walks())
    for scene, name in enumerate(["one.csv", "day/one.csv", "day/two/x.txt", "z.csv"]):
        table[table["scene"] == scene].drop(columns="scene").to_csv(tmp_path / name, index=False)
    (tmp_path / "readme.md").write_text("nothing to import")
    experts, summary = imported(tmp_path)
    assert experts.scenes == ("day/one", "day/two/x", "one", "z")
    assert (summary.files, summary.rows, len(experts.sources)) == (4, 72, 4)


def test_hidden_files_of_a_folder_are_left_out(tmp_path: Path) -> None:
    """As editors and notebooks make them; a folder that is hidden itself can be named."""
    folder = tmp_path / ".data"
    table_of(walks()).to_csv(folder_file(folder, "a.csv"), index=False)
    before = imported(folder)[0]
    for copy in (".ipynb_checkpoints/a-checkpoint.csv", "deep/.cache/a.csv", ".a.csv"):
        folder_file(folder, copy).write_text("nothing,of,use\n")
    experts, summary = imported(folder)
    assert (summary.files, experts.sources, experts.hash) == (1, before.sources, before.hash)
    folder_file(folder, "deep/cache/a.csv").write_text("nothing,of,use\n")
    with pytest.raises(InputError, match="has no column 'frame'"):
        imported(folder)


def folder_file(folder: Path, name: str) -> Path:
    (folder / name).parent.mkdir(parents=True, exist_ok=True)
    return folder / name


def test_columns_have_other_names_and_frames_are_times(tmp_path: Path) -> None:
    table = table_of(walks())
    table.to_csv(tmp_path / "a.csv", index=False)
    named = table.rename(columns={"scene": "match", "frame": "t", "agent": "player", "x": "px", "y": "py"})
    named.assign(t=0.04 * named["t"]).to_csv(tmp_path / "b.csv", index=False)
    columns = Columns("match", "t", "player", "px", "py")
    made, summary = imported(tmp_path / "b.csv", columns=columns, dt=0.04)
    plain, plainly = imported(tmp_path / "a.csv", dt=0.04)
    assert made.hash == plain.hash
    assert summary.speeds == plainly.speeds
    assert summary.speeds["max"] == pytest.approx(25 * imported(tmp_path / "a.csv")[1].speeds["max"])


def test_agents_are_ordered_by_number_and_the_same_only_if_they_are_in_all_windows(tmp_path: Path) -> None:
    table = table_of(walks(agents=3))
    table["agent"] = table["agent"].map({0: 10, 1: 9, 2: 2})
    table.to_csv(tmp_path / "a.csv", index=False)
    experts, _ = imported(tmp_path / "a.csv")
    assert experts.parameters["identity"] is True
    first = table[(table["scene"] == experts.train.scene[0]) & (table["frame"] == experts.train.frame[0])]
    assert experts.train.positions[0, 0, :, 0].tolist() == first.sort_values("agent")["x"].tolist()
    table.loc[(table["scene"] == 2) & (table["agent"] == 9), "agent"] = 11
    table.to_csv(tmp_path / "a.csv", index=False)
    experts, summary = imported(tmp_path / "a.csv")
    assert experts.parameters["identity"] is summary.same_agents is False
    with pytest.raises(InputError, match=r"--same-agents: agent (9|11) is in a window of scene .*; name the ag"):
        imported(tmp_path / "a.csv", same_agents=True)


def test_agents_of_the_same_name_may_be_others_in_every_scene(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", walks())
    table_of(walks()).to_csv(tmp_path / "a.csv", index=False)
    for source in (tmp_path / "a.npy", tmp_path / "a.csv"):
        sets = {wanted: imported(source, same_agents=wanted) for wanted in (None, True, False)}
        told = {wanted: summary.same_agents for wanted, (_, summary) in sets.items()}
        assert told == {wanted: experts.parameters["identity"] for wanted, (experts, _) in sets.items()}
        assert told == {None: True, True: True, False: False}
        np.testing.assert_array_equal(sets[False][0].train.positions, sets[None][0].train.positions)
        assert sets[False][0].hash != sets[None][0].hash == sets[True][0].hash


def test_the_same_agents_are_wanted_where_they_come_and_go(tmp_path: Path) -> None:
    table = table_of(walks(agents=3))
    table[(table["scene"] != 1) | (table["agent"] != 2)].to_csv(tmp_path / "a.csv", index=False)
    with pytest.raises(InputError) as caught:
        imported(tmp_path / "a.csv", same_agents=True)
    assert "agent 2 is in a window of scene " in str(caught.value)
    assert "but not in one of scene 1; name the agents alike" in str(caught.value)
    assert imported(tmp_path / "a.csv", most_agents=2, same_agents=False)[1].same_agents is False


def test_one_scene_is_cut_by_time(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", walks(scenes=1, frames=60))
    experts, summary = imported(tmp_path / "a.npy")
    assert experts.parameters["split_by"] == "time"
    assert any("blocks of time" in remark for remark in summary.remarks)
    frames = [
        {int(first) + step for first in getattr(experts, split).frame for step in range(-1, 4)} for split in SPLITS
    ]
    assert [min(one) for one in frames] == [0, 42, 51]
    assert not frames[0] & frames[1]
    assert not frames[1] & frames[2]


def test_scenes_can_be_named(tmp_path: Path) -> None:
    table_of(walks(scenes=12)).to_csv(tmp_path / "a.csv", index=False)
    experts, _ = imported(tmp_path / "a.csv", validation=("3",), test=("1?", "5"))
    scenes = {split: {experts.scenes[scene] for scene in getattr(experts, split).scene} for split in SPLITS}
    assert (scenes["validation"], scenes["test"]) == ({"3"}, {"10", "11", "5"})
    assert scenes["train"] == {"0", "1", "2", "4", "6", "7", "8", "9"}
    for chosen, sentence in {
        (("3",), ()): "--validation and --test name scenes together; give both, or --split",
        (("3",), ("30",)): "unknown scene '30'",
        (("3",), ("*",)): "the scene 3 is named by --validation and by --test; name it once",
    }.items():
        with pytest.raises(InputError) as caught:
            imported(tmp_path / "a.csv", validation=chosen[0], test=chosen[1])
        assert sentence in str(caught.value)


def test_recorded_walking_gives_the_windows_of_mocap(tmp_path: Path) -> None:
    """The same positions as a table, cut without overlap, with the same trials in the splits."""
    wanted = MocapParameters(subject=35, train=(1, 2), validation=(3,), test=(4,), window=4, test_window=4)
    source = write_subject(tmp_path / "subject", {1: 9, 2: 14, 3: 5, 4: 17})
    mocap = prepare(source, wanted)
    skeleton = parse_skeleton((source / "35.asf").read_bytes(), "35.asf")
    tables = []
    for trial in (1, 2, 3, 4):
        motion = parse_motion((source / f"35_{trial:02d}.amc").read_bytes(), "amc", skeleton)
        tables.append(table_of(placed(skeleton, motion)[None]).assign(scene=trial))
    pd.concat(tables).assign(frame=lambda table: table["frame"] + 1).to_csv(tmp_path / "walking.csv", index=False)
    experts, _ = imported(tmp_path / "walking.csv", stride=4, validation=("3",), test=("4",))
    for split in SPLITS:
        one, other = getattr(experts, split), getattr(mocap, split)
        np.testing.assert_array_equal([int(experts.scenes[scene]) for scene in one.scene], other.trial)
        np.testing.assert_array_equal(one.frame, other.frame)
        np.testing.assert_allclose(one.positions, other.positions, rtol=1e-14)
        np.testing.assert_allclose(one.velocities, other.velocities, rtol=0, atol=1e-12)


def test_what_was_left_out_is_counted(tmp_path: Path) -> None:
    table = table_of(walks(scenes=5, agents=3))
    table = table.drop(table[(table["scene"] == 0) & (table["frame"] == 4) & (table["agent"] == 0)].index)
    table = table.drop(table[(table["scene"] == 4) & (table["frame"] > 2)].index)
    table.to_csv(tmp_path / "a.csv", index=False)
    _, summary = imported(tmp_path / "a.csv", fill_gaps=1, most_agents=2)
    assert summary.left_out["gaps filled"] == summary.left_out["frames filled in"] == 1
    assert summary.left_out["scenes without a window"] == 1
    assert summary.left_out["agents of windows beyond --agents"] == 12
    assert summary.left_out["gaps at which tracks were cut"] == 0
    _, summary = imported(tmp_path / "a.csv", least_agents=3)
    assert summary.left_out["gaps at which tracks were cut"] == 1
    assert summary.left_out["windows with too few agents"] == 3, "of scene 0"
    assert summary.left_out["rows in no window"] == 9 + 26


def test_interpolated_frames_are_no_rows_in_no_window(tmp_path: Path) -> None:
    """Windows take the frames 0 to 4 and 2 to 6; of the rows behind them, one is missing and filled in."""
    table = table_of(walks(frames=9, agents=1))
    late = (table["scene"] == 0) & (table["frame"] == 7)
    table[~late].to_csv(tmp_path / "a.csv", index=False)
    _, summary = imported(tmp_path / "a.csv", window=4, stride=100, fill_gaps=1)
    assert summary.left_out["frames filled in"] == 1
    assert summary.left_out["rows in no window"] == 4 * 4 - 1


def test_a_jump_is_told_and_a_fast_agent_is_not(tmp_path: Path) -> None:
    positions = np.ones((4, 9, 1, 1)).cumsum(axis=1)
    positions[2, 5:] += 99
    np.save(tmp_path / "a.npy", positions)
    assert imported(tmp_path / "a.npy")[1].remarks == []
    positions[2, 5:] += 1
    np.save(tmp_path / "a.npy", positions)
    (remark,) = imported(tmp_path / "a.npy")[1].remarks
    assert remark.startswith(
        "agents jump 1 times, faster than 100 times the median speed: agent 0 of scene a/2 by 101 "
    )
    assert "at frame 4;" in remark


@pytest.mark.parametrize("scene", range(3))
@pytest.mark.parametrize("length", [1e6, -1e7])
def test_a_jump_is_told_in_every_split(tmp_path: Path, scene: int, length: float) -> None:
    positions = walks(scenes=3) / 10
    positions[scene, 5, 1, 0] += length
    np.save(tmp_path / "a.npy", positions)
    experts, summary = imported(tmp_path / "a.npy", validation=("a/1",), test=("a/2",))
    (remark,) = summary.remarks
    assert f"agents jump 2 times, faster than 100 times the median speed: agent 1 of scene a/{scene} by 1e+0" in remark
    assert experts.is_scalable
    expert_sets.save(experts, tmp_path / "set.npz")
    assert expert_sets.load(tmp_path / "set.npz", "trajectories").hash == experts.hash


def test_a_jump_beyond_all_arithmetic_is_refused_with_its_place(tmp_path: Path) -> None:
    positions = walks(scenes=3) / 1000
    positions[2, 5:, 1, 0] += 9e11
    table_of(positions).to_csv(tmp_path / "a.csv", index=False)
    with pytest.raises(InputError) as caught:
        imported(tmp_path / "a.csv", validation=("1",), test=("2",))
    sentence = str(caught.value).replace(str(tmp_path / "a.csv"), "a.csv")
    assert sentence == (
        "the positions in a.csv differ too much in size to be scaled alike: leave out errors such as the fastest step, "
        "agent 1 of scene 2 by 9e+11 at frame 4; are these the right columns, and all in the same unit?"
    )
