import hashlib
import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from ssmail.config.data_sections import YJunctionSpec
from ssmail.data import expert_sets, yjunction
from ssmail.data.mocap.dataset import MocapParameters, prepare
from ssmail.data.trajectories import ExpertSet
from ssmail.errors import InputError
from tests.data.mocap.handmade import write_subject

PARAMS = YJunctionSpec(train=4, validation=3, test=2, agents=3, steps=50, lane_angle=43.0, jitter=1.0, seed=0)


@pytest.fixture
def saved(tmp_path: Path) -> Path:
    path = tmp_path / "sub" / "experts.npz"
    expert_sets.save(yjunction.generate(PARAMS), path)
    return path


def altered(path: Path, **changes: np.ndarray | None) -> Path:
    with np.load(path) as archive:
        contents = {k: archive[k] for k in archive.files} | {k.replace("__", "/"): v for k, v in changes.items()}
    np.savez(path, allow_pickle=False, **{k: v for k, v in contents.items() if v is not None})
    return path


def test_round_trip(saved: Path) -> None:
    made, read = yjunction.generate(PARAMS), expert_sets.load(saved)
    assert read.hash == made.hash
    assert read.parameters == made.parameters
    np.testing.assert_array_equal(read.validation.continuations, made.validation.continuations)
    assert list(saved.parent.iterdir()) == [saved], "no temporary file is left"


def test_refuses_to_overwrite(saved: Path) -> None:
    before = saved.read_bytes()
    with pytest.raises(InputError, match="--force"):
        expert_sets.save(yjunction.generate(PARAMS), saved)
    assert saved.read_bytes() == before
    expert_sets.save(yjunction.generate(PARAMS.model_copy(update={"seed": 1})), saved, force=True)
    assert expert_sets.load(saved).parameters["seed"] == 1


@settings(max_examples=40, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(cut=st.floats(0, 0.999))
def test_truncated_file(saved: Path, cut: float) -> None:
    whole = saved.read_bytes()
    broken = saved.with_name("broken.npz")
    broken.write_bytes(whole[: int(cut * len(whole))])
    with pytest.raises(InputError, match=r"broken\.npz is truncated or not an \.npz"):
        expert_sets.load(broken)


@settings(max_examples=40, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(junk=st.binary(max_size=200))
def test_junk(tmp_path: Path, junk: bytes) -> None:
    path = tmp_path / "junk.npz"
    path.write_bytes(junk)
    with pytest.raises(InputError, match=r"junk\.npz"):
        expert_sets.load(path)


def test_each_fault_is_named(saved: Path, tmp_path: Path) -> None:
    good = saved.read_bytes()

    def check(pattern: str, **changes: np.ndarray | None) -> None:
        saved.write_bytes(good)
        with pytest.raises(InputError, match=pattern) as caught:
            expert_sets.load(altered(saved, **changes))
        assert "\n" not in str(caught.value)
        assert str(saved) in str(caught.value)

    positions = yjunction.generate(PARAMS).train.positions
    check("shape", train__positions=positions[:, :-1])
    check("NaN or infinite", train__positions=np.full_like(positions, np.nan))
    check("float32", train__positions=positions.astype(np.float32))
    check("changed after it was written", train__positions=positions + 1e-9)
    check("no array 'test/mode'", test__mode=None)
    check("parameters inside", parameters=np.array("{"))
    check("parameters inside", parameters=np.array('{"train": -1}'))
    with pytest.raises(InputError, match="there is no file"):
        expert_sets.load(tmp_path / "absent.npz")
    single = tmp_path / "single.npy"
    np.save(single, positions)
    with pytest.raises(InputError, match="single array"):
        expert_sets.load(single)
    with pytest.raises(InputError, match="truncated or not"):
        expert_sets.load(tmp_path)


def test_unwritable_place(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="cannot write"):
        expert_sets.save(yjunction.generate(PARAMS), tmp_path / "file" / "experts.npz")


@pytest.fixture
def mocap(tmp_path: Path) -> ExpertSet:
    wanted = MocapParameters(subject=35, train=(1,), validation=(2,), test=(3,), window=4, test_window=8)
    return prepare(write_subject(tmp_path / "subject", {1: 9, 2: 5, 3: 17}), wanted)


@pytest.fixture
def recorded(mocap: ExpertSet, tmp_path: Path) -> Path:
    expert_sets.save(mocap, tmp_path / "mocap.npz")
    return tmp_path / "mocap.npz"


def test_mocap_round_trip(mocap: ExpertSet, recorded: Path) -> None:
    read = expert_sets.load(recorded, "mocap")
    for field in ("hash", "parameters", "joints", "parents", "sources", "environment", "scaling"):
        assert getattr(read, field) == getattr(mocap, field)
    for split in ("train", "validation", "test"):
        for field in ("positions", "velocities", "mode", "continuations", "trial", "frame"):
            made, kept = (getattr(getattr(experts, split), field) for experts in (mocap, read))
            np.testing.assert_array_equal(kept, made)
            assert kept.dtype == made.dtype
    with np.load(recorded, allow_pickle=False) as archive:
        assert "train/continuations" not in archive.files
        assert archive["joints"].tolist() == list(mocap.joints)
        scaling = mocap.scaling
        assert archive["scaling"].tolist() == [
            *(scaling.position_min, scaling.position_max, scaling.velocity_min, scaling.velocity_max)
        ]


def test_a_set_is_of_one_environment(saved: Path, recorded: Path) -> None:
    assert expert_sets.load(saved, "yjunction").environment == "yjunction"
    with pytest.raises(InputError, match=r"experts\.npz is an expert set of yjunction, not of mocap; .*--env yjunct"):
        expert_sets.load(saved, "mocap")
    with pytest.raises(InputError, match=r"mocap\.npz is an expert set of mocap, not of yjunction; .*--env mocap"):
        expert_sets.load(recorded, "yjunction")
    with pytest.raises(InputError, match=r"there is no file .*make it with `ssmail prep-mocap --out"):
        expert_sets.load(saved.with_name("absent.npz"), "mocap")


def test_sets_of_old_keep_their_hash(saved: Path) -> None:
    """Those of the first release do not name their environment; it must not get into the hash."""
    made, parameters = yjunction.generate(PARAMS), PARAMS.model_dump(mode="json")
    digest = hashlib.sha256(json.dumps(parameters, sort_keys=True).encode())
    for split in (made.train, made.validation, made.test):
        for array in (split.positions, split.velocities, split.mode, split.continuations):
            digest.update(np.ascontiguousarray(array).tobytes())
    digest.update(made.centre_lines.tobytes())
    assert expert_sets.load(saved).hash == made.hash == digest.hexdigest()
    named = np.array(json.dumps({"environment": "yjunction", **parameters}))
    assert expert_sets.load(altered(saved, parameters=named), "yjunction").hash == made.hash


def test_each_fault_of_a_mocap_set_is_named(mocap: ExpertSet, recorded: Path) -> None:
    good = recorded.read_bytes()

    def check(pattern: str, **changes: np.ndarray | None) -> None:
        recorded.write_bytes(good)
        with pytest.raises(InputError, match=pattern) as caught:
            expert_sets.load(altered(recorded, **changes))
        assert str(recorded) in str(caught.value)
        assert "`ssmail prep-mocap --force`" in str(caught.value)

    train, parameters = mocap.train, dict(mocap.parameters)
    check("shape", train__positions=train.positions[:, :-1])
    check("shape", joints=np.array(["a", "b"]))
    check("shape", train__trial=np.empty(0, dtype=np.int64))
    check("NaN or infinite", test__velocities=np.full_like(mocap.test.velocities, np.inf))
    check("int32", train__frame=np.array(train.frame, dtype=np.int32))
    check("joints in .* holds int64", joints=np.arange(5))
    check("no array 'validation/frame'", validation__frame=None)
    check("no array 'sources'", sources=None)
    check("changed after it was written", train__positions=train.positions + 1e-9)
    check("changed after it was written", joints=np.array(["root", "spine", "lleg", "lfoot", "nose"]))
    check("changed after it was written", parents=np.array([-1, 0, 0, 2, 2]))
    check("the scaling in .* is not that of its training split", scaling=np.array([0.0, 1, 0, 1]))
    check("parameters inside", parameters=np.array(json.dumps(parameters | {"window": 1})))
    check("parameters inside", sources=np.array("{"))


def test_an_environment_from_the_future(recorded: Path) -> None:
    altered(recorded, parameters=np.array('{"environment": "football"}'))
    with pytest.raises(InputError, match="is an expert set of 'football', which this ssmail does not know"):
        expert_sets.load(recorded)
