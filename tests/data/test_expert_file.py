from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from ssmail.data import expert_file, yjunction
from ssmail.errors import InputError
from ssmail.spec import YJunctionSpec

PARAMS = YJunctionSpec(train=4, validation=3, test=2, agents=3, steps=50, lane_angle=43.0, jitter=1.0, seed=0)


@pytest.fixture
def saved(tmp_path: Path) -> Path:
    path = tmp_path / "sub" / "experts.npz"
    expert_file.save(yjunction.generate(PARAMS), path)
    return path


def altered(path: Path, **changes: np.ndarray | None) -> Path:
    with np.load(path) as archive:
        contents = {k: archive[k] for k in archive.files} | {k.replace("__", "/"): v for k, v in changes.items()}
    np.savez(path, allow_pickle=False, **{k: v for k, v in contents.items() if v is not None})
    return path


def test_round_trip(saved: Path) -> None:
    made, read = yjunction.generate(PARAMS), expert_file.load(saved)
    assert read.hash == made.hash
    assert read.parameters == made.parameters
    np.testing.assert_array_equal(read.validation.continuations, made.validation.continuations)
    assert list(saved.parent.iterdir()) == [saved], "no temporary file is left"


def test_refuses_to_overwrite(saved: Path) -> None:
    before = saved.read_bytes()
    with pytest.raises(InputError, match="--force"):
        expert_file.save(yjunction.generate(PARAMS), saved)
    assert saved.read_bytes() == before
    expert_file.save(yjunction.generate(PARAMS.model_copy(update={"seed": 1})), saved, force=True)
    assert expert_file.load(saved).parameters["seed"] == 1


@settings(max_examples=40, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(cut=st.floats(0, 0.999))
def test_truncated_file(saved: Path, cut: float) -> None:
    whole = saved.read_bytes()
    broken = saved.with_name("broken.npz")
    broken.write_bytes(whole[: int(cut * len(whole))])
    with pytest.raises(InputError, match=r"broken\.npz is truncated or not an \.npz"):
        expert_file.load(broken)


@settings(max_examples=40, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(junk=st.binary(max_size=200))
def test_junk(tmp_path: Path, junk: bytes) -> None:
    path = tmp_path / "junk.npz"
    path.write_bytes(junk)
    with pytest.raises(InputError, match=r"junk\.npz"):
        expert_file.load(path)


def test_each_fault_is_named(saved: Path, tmp_path: Path) -> None:
    good = saved.read_bytes()

    def check(pattern: str, **changes: np.ndarray | None) -> None:
        saved.write_bytes(good)
        with pytest.raises(InputError, match=pattern) as caught:
            expert_file.load(altered(saved, **changes))
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
        expert_file.load(tmp_path / "absent.npz")
    single = tmp_path / "single.npy"
    np.save(single, positions)
    with pytest.raises(InputError, match="single array"):
        expert_file.load(single)
    with pytest.raises(InputError, match="truncated or not"):
        expert_file.load(tmp_path)


def test_unwritable_place(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="cannot write"):
        expert_file.save(yjunction.generate(PARAMS), tmp_path / "file" / "experts.npz")
