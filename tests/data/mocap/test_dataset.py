"""Trials to windows."""

import hashlib
import zipfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ssmail.data.mocap import dataset
from ssmail.data.mocap.amc import parse_motion
from ssmail.data.mocap.dataset import MocapParameters, parse_trials, prepare
from ssmail.data.mocap.kinematics import positions
from ssmail.data.trajectories import Floats
from ssmail.errors import InputError
from tests.data.mocap.handmade import PERSON, STILL, amc, skeleton, walk, write_subject

FRAMES = {1: 9, 2: 11, 3: 10, 7: 25, 9: 16}
WANTED = MocapParameters(subject=35, train=(2, 1), validation=(3,), test=(9, 7), window=4, test_window=8)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return write_subject(tmp_path / "subject", FRAMES)


def placed(trial: int) -> Floats:
    person = skeleton(*PERSON)
    return positions(person, parse_motion(walk(FRAMES[trial], trial), "", person))


def test_windows_follow_one_another_and_drop_the_rest(folder: Path) -> None:
    """9 frames are 8 locations, two windows of 4; 11 frames are 10; 16 frames are one window of 8 short of two."""
    experts = prepare(folder, WANTED)
    assert (len(experts.train), len(experts.validation), len(experts.test)) == (4, 2, 4)
    assert experts.train.trial is not None
    assert experts.test.trial is not None
    assert experts.test.frame is not None
    assert experts.train.trial.tolist() == [2, 2, 1, 1]
    assert experts.test.trial.tolist() == [9, 7, 7, 7]
    assert experts.test.frame.tolist() == [2, 2, 10, 18]
    p = placed(7)
    np.testing.assert_array_equal(experts.test.positions[2], p[9:17])
    np.testing.assert_array_equal(experts.test.velocities[2], p[9:17] - p[8:16])
    np.testing.assert_array_equal(experts.train.velocities[:, 1:], np.diff(experts.train.positions, axis=1))
    assert experts.train.positions.shape == experts.train.velocities.shape == (4, 4, 5, 3)


def test_what_the_set_says_of_itself(folder: Path) -> None:
    experts = prepare(folder, WANTED)
    assert experts.environment == "mocap"
    assert experts.joints == ("root", "spine", "lleg", "lfoot", "tail")
    assert experts.parents == (-1, 0, 0, 2, 0)
    assert experts.centre_lines.size == 0
    np.testing.assert_array_equal(experts.test.continuations, experts.test.positions[None])
    assert not experts.test.mode.any()
    assert experts.parameters["train"] == [2, 1]
    assert experts.parameters["length_unit"] == 0.45
    assert set(experts.sources) == {"35.asf", *(f"35_{trial:02d}.amc" for trial in FRAMES)}
    assert experts.sources["35_07.amc"] == hashlib.sha256((folder / "35_07.amc").read_bytes()).hexdigest()
    chosen = experts.test[np.array([3, 0])]
    assert (chosen.trial is not None, chosen.frame is not None) == (True, True)
    assert np.array(chosen.frame).tolist() == [18, 2]


def test_the_hash_is_that_of_the_data(folder: Path, tmp_path: Path) -> None:
    reference = prepare(folder, WANTED)
    with zipfile.ZipFile(tmp_path / "other.zip", "w") as archive:
        for file in folder.iterdir():
            archive.writestr(f"deep/{file.name.upper()}", file.read_bytes().replace(b"\n", b"\r\n"))
    packed = prepare(tmp_path / "other.zip", WANTED)
    assert packed.hash == reference.hash
    assert packed.sources != reference.sources
    others = [
        WANTED.model_copy(update=change)
        for change in ({"train": (1, 2)}, {"window": 3}, {"validation": (1,), "train": (2, 3)})
    ]
    hashes = [prepare(folder, other).hash for other in others]
    assert len({reference.hash, *hashes}) == 4
    text = (folder / "35_07.amc").read_text()
    (folder / "35_07.amc").write_text(text.replace("lfoot 0", "lfoot 1", 1).replace("lfoot -0", "lfoot 1", 1))
    assert prepare(folder, WANTED).hash != reference.hash


def test_a_missing_trial_is_named(folder: Path) -> None:
    (folder / "35_02.amc").unlink()
    (folder / "35_07.amc").unlink()
    with pytest.raises(InputError, match=r"subject lacks 35_02\.amc, 35_07\.amc; add them, or insist with --allow-m"):
        prepare(folder, WANTED)
    experts = prepare(folder, WANTED, allow_missing=True)
    assert experts.parameters["missing"] == [2, 7]
    assert (experts.parameters["train"], experts.parameters["test"]) == ([1], [9])
    (folder / "35_09.amc").unlink()
    with pytest.raises(InputError, match="so nothing is left to test"):
        prepare(folder, WANTED, allow_missing=True)


def test_a_trial_is_used_once(folder: Path) -> None:
    with pytest.raises(InputError, match="trial 01 is in train and in test; name each trial once"):
        prepare(folder, WANTED.model_copy(update={"test": (7, 1)}))
    with pytest.raises(InputError, match="trial 07 is twice in test"):
        prepare(folder, WANTED.model_copy(update={"test": (7, 7)}))


def test_too_short_and_motionless_trials(folder: Path) -> None:
    with pytest.raises(InputError, match=r"35_01\.amc has 9 frames, too few for a window of 9 and one before it"):
        prepare(folder, WANTED.model_copy(update={"window": 9}))
    still = {"root": STILL, "spine": (0, 0, 0), "lleg": (0, 0), "lfoot": (0,)}
    for trial in (1, 2):
        (folder / f"35_{trial:02d}.amc").write_bytes(amc(*[still] * 9))
    with pytest.raises(InputError, match="nothing moves in the training windows"):
        prepare(folder, WANTED)


def test_more_frames_than_fit_into_memory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each trial alone may be small enough."""
    folder = write_subject(tmp_path / "subject", {1: 60, 2: 60, 3: 60, 4: 60})
    wanted = WANTED.model_copy(update={"train": (1, 2), "validation": (3,), "test": (4,)})
    monkeypatch.setattr(dataset, "MOST_PLACES", 600)  # 60 frames of 5 joints, twice
    prepare(folder, wanted)
    monkeypatch.setattr(dataset, "MOST_PLACES", 599)
    with pytest.raises(
        InputError, match=r"35_02\.amc and those before it have too many frames for one set; name fewer"
    ):
        prepare(folder, wanted)


def test_of_many_missing_trials_only_the_first_are_named(tmp_path: Path) -> None:
    folder = write_subject(tmp_path / "subject", {1: 60})
    wanted = WANTED.model_copy(update={"train": (1,), "validation": tuple(range(2, 900)), "test": (900,)})
    with pytest.raises(InputError, match=r"35_08\.amc, 35_09\.amc and 891 more trials; add them, or insist"):
        prepare(folder, wanted)


def test_trials_of_different_size(tmp_path: Path) -> None:
    """A test trial in metres, as if the others were in micrometres."""
    folder = write_subject(tmp_path / "subject", {1: 60, 2: 60, 3: 60})
    far = {"root": (1e9, 0, 0, 0, 0, 0), "spine": (0, 0, 0), "lleg": (0, 0), "lfoot": (0,)}
    (folder / "35_03.amc").write_bytes(amc(*[far] * 60))
    wanted = WANTED.model_copy(update={"train": (1,), "validation": (2,), "test": (3,)})
    with pytest.raises(InputError, match="differ too much in size to be scaled alike"):
        prepare(folder, wanted)


@pytest.mark.parametrize(
    ("text", "trials"), [("01-03", [1, 2, 3]), ("7", [7]), ("1-2, 009 ,4 - 5", [1, 2, 9, 4, 5]), ("5-5", [5])]
)
def test_trial_lists(text: str, trials: list[int]) -> None:
    assert list(parse_trials(text, "--train")) == trials


@pytest.mark.parametrize("text", ["", ",", "1,,2", "a", "1-", "-1", "0", "0-3", "1.5", "1-2-3", "٣", "1" * 9, "1\n-x"])
def test_wrong_trial_lists(text: str) -> None:
    with pytest.raises(InputError, match=r"^--train takes trials such as 01-12 or 1-3,7, not '"):
        parse_trials(text, "--train")


def test_backward_and_endless_ranges() -> None:
    with pytest.raises(InputError, match="the range 09-07 in --train runs backwards; swap its ends"):
        parse_trials("9-7", "--train")
    with pytest.raises(InputError, match="--train names more than 1000 trials"):
        parse_trials("1-999999", "--train")


@given(st.lists(st.integers(1, 99), min_size=1, max_size=20))
def test_any_list_is_read_as_written(trials: list[int]) -> None:
    assert list(parse_trials(",".join(f"{trial:02d}" for trial in trials), "--train")) == trials
