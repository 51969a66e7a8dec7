"""Sets of trajectories: how windows become a set, and the set a file."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from ssmail.data import expert_sets
from ssmail.data.recorded_sets import SetParameters, recorded_set, windows
from ssmail.data.scaling import Scaling
from ssmail.data.trajectories import SPLITS, ExpertSet, Trajectories
from ssmail.errors import InputError

PARAMS = SetParameters(axes=2, window=4, observed=2, predicted=2, stride=2)
SCENES = ("park", "street", "yard")
FIELDS = ("positions", "velocities", "agents", "scene", "frame")


def some_windows(scene: int, axes: int = 2) -> Trajectories:
    """Two windows of 3 agents and of 1, far from the origin."""
    frames = 1000 + np.random.default_rng(scene).normal(size=(2, 5, 3, axes)).cumsum(axis=1)
    return windows(frames, np.array([3, 1]), np.array([scene, scene]), np.array([1, 3]))


def make(params: SetParameters = PARAMS) -> ExpertSet:
    splits = {split: some_windows(number, params.axes) for number, split in enumerate(SPLITS)}
    return recorded_set(splits, SCENES, params, {"a.csv": "0" * 64})


@pytest.fixture
def saved(tmp_path: Path) -> Path:
    expert_sets.save(make(), tmp_path / "set.npz")
    return tmp_path / "set.npz"


def test_the_frame_before_gives_the_first_velocity() -> None:
    frames = np.arange(5.0)[None, :, None, None] ** 2  # 0, 1, 4, 9, 16
    cut = windows(frames, np.array([1]), np.array([0]), np.array([7]))
    assert cut.positions.ravel().tolist() == [1, 4, 9, 16]
    assert cut.velocities.ravel().tolist() == [1, 3, 5, 7]
    assert (cut.agents, cut.scene, cut.frame) == (np.array([1]), np.array([0]), np.array([7]))


def test_padding_is_zero_and_not_scaled_by() -> None:
    made = make()
    assert not made.train.positions[1, :, 1:].any()
    assert not made.train.velocities[1, :, 1:].any()
    assert made.train.present is not None
    assert made.train.present[:, 0, :, 0].tolist() == [[True] * 3, [True, False, False]]
    positions = np.concatenate([made.train.positions[0].ravel(), made.train.positions[1, :, 0].ravel()])
    assert (made.scaling.position_min, made.scaling.position_max) == (positions.min(), positions.max())
    assert Scaling.fit(made.train.positions, made.train.velocities).position_min == 0, "with the padding"


@pytest.mark.parametrize("axes", [1, 2, 3])
def test_round_trip(tmp_path: Path, axes: int) -> None:
    made = make(PARAMS.model_copy(update={"axes": axes, "dt": 0.4, "identity": True}))
    expert_sets.save(made, tmp_path / "set.npz")
    read = expert_sets.load(tmp_path / "set.npz", "trajectories")
    for name in ("hash", "parameters", "sources", "scenes", "scaling", "environment"):
        assert getattr(read, name) == getattr(made, name)
    for split in SPLITS:
        for field in (*FIELDS, "mode", "continuations"):
            one, other = (getattr(getattr(experts, split), field) for experts in (made, read))
            np.testing.assert_array_equal(one, other)
            assert one.dtype == other.dtype
    with np.load(tmp_path / "set.npz", allow_pickle=False) as archive:
        arrays = {f"{split}/{field}" for split in SPLITS for field in FIELDS}
        assert set(archive.files) == arrays | {"parameters", "hash", "scenes", "scaling", "sources"}


def test_the_hash_is_of_everything_but_the_sources() -> None:
    made = make()
    splits = {split: getattr(made, split) for split in SPLITS}
    assert recorded_set(splits, SCENES, PARAMS).hash == made.hash
    assert recorded_set(splits, ("park", "street", "garden"), PARAMS).hash != made.hash
    assert recorded_set(splits, SCENES, PARAMS.model_copy(update={"dt": 1.0})).hash != made.hash
    splits["test"] = dataclasses.replace(splits["test"], agents=np.array([3, 2]))
    assert recorded_set(splits, SCENES, PARAMS).hash != made.hash


def test_windows_can_be_chosen() -> None:
    chosen = make().train[np.array([1])]
    assert chosen.agents is not None
    assert chosen.scene is not None
    assert (len(chosen), chosen.agents.tolist(), chosen.scene.tolist()) == (1, [1], [0])


def replaced(params: SetParameters = PARAMS, scenes: tuple[str, ...] = SCENES, **changes: np.ndarray) -> ExpertSet:
    """The set with other arrays in its test split, unchecked."""
    made = make()
    splits = {"train": made.train, "validation": made.validation, "test": dataclasses.replace(made.test, **changes)}
    return ExpertSet.bundle(splits, made.centre_lines, params.model_dump(mode="json"), scenes=scenes)


BEYOND = make().test.positions + 0.0
BEYOND[1, 0, 2, 0] = 1e-9
FAULTS = {
    "a window without agents": ({"agents": np.array([3, 0])}, "a window of test has no agents"),
    "more agents than rows": ({"agents": np.array([3, 4])}, "test/agents in .* holds a number that it cannot hold"),
    "something in the padding": ({"positions": BEYOND}, "a window of test has positions beside those of its agents"),
    "no such scene": ({"scene": np.array([2, 3])}, "test/scene in .* holds a number that it cannot hold"),
    "a scene in two splits": ({"scene": np.array([1, 2])}, "the scene 'street' is both in validation and in test"),
    "a negative frame": ({"frame": np.array([-1, 2])}, "test/frame in .* holds a number that it cannot hold"),
    "NaN": ({"velocities": make().test.velocities * np.nan}, "test/velocities in .* holds NaN or infinite values"),
    "another shape": ({"positions": make().test.positions[:, 1:]}, "test/positions in .* has shape"),
    "a name twice": ({"scenes": ("park", "park", "yard")}, "the scenes have no proper names"),
    "a name of no text": ({"scenes": ("park", "\x1b[31m", "yard")}, "the scenes have no proper names"),
    "another window": ({"params": PARAMS.model_copy(update={"window": 5})}, "the parameters inside .* cannot be read"),
    "another format": ({"params": PARAMS.model_copy(update={"format": 2})}, "the parameters inside .* cannot be read"),
}


@pytest.mark.parametrize(("changes", "fault"), FAULTS.values(), ids=FAULTS)
def test_a_set_that_does_not_fit_together_is_refused(tmp_path: Path, changes: dict, fault: str) -> None:
    expert_sets.save(replaced(**changes), tmp_path / "set.npz")
    with pytest.raises(InputError, match=fault) as caught:
        expert_sets.load(tmp_path / "set.npz")
    assert str(tmp_path / "set.npz") in str(caught.value)
    assert "make it again with `ssmail import-data SOURCE --force`" in str(caught.value)


def test_one_scene_may_be_in_all_splits_if_it_was_cut_by_time(tmp_path: Path) -> None:
    splits = {split: some_windows(0) for split in SPLITS}
    with pytest.raises(ValueError, match="'park' is both in train and in validation"):
        recorded_set(splits, SCENES[:1], PARAMS)
    expert_sets.save(
        recorded_set(splits, SCENES[:1], PARAMS.model_copy(update={"split_by": "time"})), tmp_path / "a.npz"
    )
    assert expert_sets.load(tmp_path / "a.npz").scenes == ("park",)


def test_it_is_no_set_of_another_environment(saved: Path, tmp_path: Path) -> None:
    with pytest.raises(
        InputError, match=r"set\.npz is an expert set of trajectories, not of mocap; train with --env tr"
    ):
        expert_sets.load(saved, "mocap")
    with pytest.raises(InputError, match="make it with `ssmail import-data SOURCE --out "):
        expert_sets.load(tmp_path / "absent.npz", "trajectories")


def test_a_table_is_to_be_imported_first(tmp_path: Path) -> None:
    table = tmp_path / "walks.csv"
    table.write_text("scene,frame,agent,x\n")
    with pytest.raises(InputError, match=r"walks.csv is no expert set; .*`ssmail import-data .*csv --out .*walks.npz`"):
        expert_sets.load(table, "trajectories")
    with pytest.raises(InputError, match="truncated"):  # what --env mocap reads is not imported from tables
        expert_sets.load(table, "mocap")


def test_a_set_that_would_be_too_large_is_not_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(expert_sets, "LARGEST_FILE", expert_sets.LONGEST_TEXT + 100)
    with pytest.raises(InputError, match=r"the set has 0\.0 GiB, and 2 are the most; make it with fewer windows"):
        expert_sets.save(make(), tmp_path / "a.npz")
    assert not list(tmp_path.iterdir())
