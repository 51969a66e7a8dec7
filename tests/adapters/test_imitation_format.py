"""Trajectories go to `imitation` and come back."""

import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ssmail.adapters.imitation_format import read_imitation, write_imitation
from ssmail.data.trajectories import Trajectories
from ssmail.errors import InputError

pytest.importorskip("datasets", reason="datasets is not installed (extra adapters)")


def windows(axes: int = 2, agents: int = 3, count: int = 4, steps: int = 7, seed: int = 0) -> Trajectories:
    path = np.random.default_rng(seed).normal(size=(count, steps + 1, agents, axes)).cumsum(axis=1)
    return Trajectories.single_mode(path[:, 1:], np.diff(path, axis=1))


def with_fewer_agents(whole: Trajectories) -> Trajectories:
    """The same windows, of which the second one has a single agent."""
    counts = np.array([3, 1, 3, 3])
    present = np.arange(3)[None, None, :, None] < counts[:, None, None, None]
    return Trajectories.single_mode(whole.positions * present, whole.velocities * present, agents=counts)


@settings(max_examples=10, deadline=None)
@given(axes=st.integers(1, 3), agents=st.integers(1, 4), steps=st.integers(2, 9), seed=st.integers(0, 99))
def test_windows_come_back(
    tmp_path_factory: pytest.TempPathFactory, axes: int, agents: int, steps: int, seed: int
) -> None:
    written = windows(axes, agents, steps=steps, seed=seed)
    folder = tmp_path_factory.mktemp("set") / "train"
    write_imitation(written, folder)
    for b, frames in enumerate(read_imitation(folder, axes=axes)):
        np.testing.assert_array_equal(frames[1:], written.positions[b])
        np.testing.assert_allclose(np.diff(frames, axis=0), written.velocities[b], atol=1e-12)


def test_windows_of_different_numbers_come_back_without_their_padding(tmp_path: Path) -> None:
    written = with_fewer_agents(windows())
    write_imitation(written, tmp_path / "train")
    read = read_imitation(tmp_path / "train")
    assert [frames.shape for frames in read] == [(8, 3, 2), (8, 1, 2), (8, 3, 2), (8, 3, 2)]
    np.testing.assert_array_equal(read[1][1:], written.positions[1, :, :1])


def test_imitation_loads_what_was_written(tmp_path: Path) -> None:
    serialize = pytest.importorskip("imitation.data.serialize", reason="imitation is not installed")
    written = windows()
    write_imitation(written, tmp_path / "train")
    loaded = serialize.load(tmp_path / "train")
    assert len(loaded) == 4
    for b, trajectory in enumerate(loaded):
        assert trajectory.obs.shape == (7, 12)
        np.testing.assert_array_equal(
            trajectory.obs[3, 4:8], [*written.positions[b, 3, 1], *written.velocities[b, 3, 1]]
        )
        np.testing.assert_array_equal(trajectory.acts, written.velocities[b, 1:].reshape(6, 6))
        assert not trajectory.terminal
        assert list(trajectory.infos) == [{}] * 6


@pytest.mark.parametrize("kind", [np.float32, np.float64])
def test_what_imitation_saves_is_read(tmp_path: Path, kind: type) -> None:
    """Also trajectories with rewards, of another layout: here the velocities stand before the positions."""
    serialize = pytest.importorskip("imitation.data.serialize", reason="imitation is not installed")
    types = pytest.importorskip("imitation.data.types")
    draw = np.random.default_rng(0)
    saved = [
        types.TrajectoryWithRew(
            obs=draw.normal(size=(steps, 8)).astype(kind),
            acts=draw.normal(size=(steps - 1, 4)).astype(kind),
            infos=np.array([{"step": t} for t in range(steps - 1)]),
            terminal=True,
            rews=np.zeros(steps - 1),
        )
        for steps in (5, 9)
    ]
    serialize.save(tmp_path / "saved", saved)
    read = read_imitation(tmp_path / "saved", positions=lambda obs: obs[:, 4:].reshape(-1, 2, 2))
    for frames, trajectory in zip(read, saved, strict=True):
        np.testing.assert_array_equal(frames.reshape(len(frames), -1), trajectory.obs[:, 4:])


def test_the_files_that_a_folder_names_are_not_opened(tmp_path: Path) -> None:
    """Its state.json may name others; imitation and datasets follow it."""
    write_imitation(windows(), tmp_path / "train")
    write_imitation(windows(seed=1), tmp_path / "other")
    state = tmp_path / "train" / "state.json"
    named = json.loads(state.read_text())
    (file,) = (tmp_path / "other").glob("data-*.arrow")
    named["_data_files"] = [{"filename": str(file)}]
    state.write_text(json.dumps(named))
    np.testing.assert_array_equal(read_imitation(tmp_path / "train")[0][1:], windows().positions[0])
    (own,) = (tmp_path / "train").glob("data-*.arrow")
    own.unlink()
    own.symlink_to(file)
    with pytest.raises(InputError, match="holds no trajectories"):
        read_imitation(tmp_path / "train")


def test_what_cannot_be_read_ends_as_one_sentence(tmp_path: Path) -> None:
    write_imitation(windows(), tmp_path / "train")
    with pytest.raises(InputError, match="exists already"):
        write_imitation(windows(), tmp_path / "train")
    with pytest.raises(InputError, match=r"trajectory 0 in .*train has 12 numbers .* on 5 axes"):
        read_imitation(tmp_path / "train", axes=5)
    with pytest.raises(InputError, match=r"`positions` makes \(7,\) of trajectory 0"):
        read_imitation(tmp_path / "train", positions=lambda obs: obs[:, 0])
    with pytest.raises(InputError, match=r"trajectory 0 .* NaN"):
        read_imitation(tmp_path / "train", positions=lambda obs: obs.reshape(7, -1, 2) * np.nan)
    with pytest.raises(InputError, match="is not a folder"):
        read_imitation(tmp_path / "absent")
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match=r"holds no data-\*.arrow"):
        read_imitation(tmp_path / "empty")


@pytest.mark.parametrize("damage", ["cut", "bytes", "flat"])
def test_a_damaged_file_ends_as_one_sentence(tmp_path: Path, damage: str) -> None:
    write_imitation(windows(), tmp_path / "train")
    (path,) = (tmp_path / "train").glob("data-*.arrow")
    contents = path.read_bytes()
    if damage == "flat":  # observations that are numbers, as of discrete spaces
        from datasets import Dataset

        Dataset.from_dict({"obs": [[1, 2, 3]]}).save_to_disk(tmp_path / "flat")
        (flat,) = (tmp_path / "flat").glob("data-*.arrow")
        contents = flat.read_bytes()
    path.write_bytes({"cut": contents[:200], "bytes": b"\x00" * 100, "flat": contents}[damage])
    with pytest.raises(InputError, match="holds no trajectories with observations"):
        read_imitation(tmp_path / "train")
