"""The real subject 35, where it is at hand: the numbers of the protocol, and that it looks like somebody walking."""

import os
from pathlib import Path

import numpy as np
import pytest

from ssmail.data.mocap import kinematics
from ssmail.data.mocap.amc import Motion, parse_motion
from ssmail.data.mocap.asf import Skeleton, parse_skeleton
from ssmail.data.mocap.dataset import MocapParameters, parse_trials, prepare
from ssmail.data.trajectories import ExpertSet, Floats

CMU = os.environ.get("SSMAIL_CMU_DIR")
pytestmark = pytest.mark.skipif(not CMU, reason="SSMAIL_CMU_DIR does not name a folder with CMU's subject 35")
TRIALS = {"train": "01-12", "validation": "13-16", "test": "28-34"}
WANTED = MocapParameters(subject=35, **{split: parse_trials(text, split) for split, text in TRIALS.items()})


@pytest.fixture(scope="module")
def experts() -> ExpertSet:
    return prepare(Path(str(CMU)), WANTED)


@pytest.fixture(scope="module")
def skeleton() -> Skeleton:
    return parse_skeleton((Path(str(CMU)) / "35.asf").read_bytes(), "35.asf")


@pytest.fixture(scope="module")
def motion(skeleton: Skeleton) -> Motion:
    return parse_motion((Path(str(CMU)) / "35_01.amc").read_bytes(), "35_01.amc", skeleton)


@pytest.fixture(scope="module")
def walk(skeleton: Skeleton, motion: Motion) -> dict[str, Floats]:
    """(F, 3) of each joint; y is up."""
    return dict(zip(skeleton.joints, np.moveaxis(kinematics.positions(skeleton, motion), 1, 0), strict=True))


def test_the_numbers_of_the_protocol(experts: ExpertSet) -> None:
    assert (len(experts.train), len(experts.validation), len(experts.test)) == (92, 33, 27)
    assert experts.train.positions.shape == (92, 50, 31, 3)
    assert experts.test.positions.shape == (27, 100, 31, 3)
    scaling = experts.scaling
    found = (scaling.position_min, scaling.position_max, scaling.velocity_min, scaling.velocity_max)
    assert [f"{value:#.6g}" for value in found] == ["-35.1817", "58.2083", "-1.69260", "2.17829"]
    assert np.quantile(np.linalg.norm(experts.train.velocities, axis=-1), 0.999) == pytest.approx(0.66, abs=0.005)


def test_bones_keep_their_lengths(experts: ExpertSet, skeleton: Skeleton) -> None:
    lengths = [bone.length * np.linalg.norm(bone.direction) for bone in skeleton.bones]
    for split in (experts.train, experts.validation, experts.test):
        bones = split.positions[:, :, 1:] - split.positions[:, :, list(experts.parents[1:])]
        measured = np.linalg.norm(bones, axis=-1)
        assert np.abs(measured - lengths).max() < 1e-9
    np.testing.assert_allclose(lengths, [bone.length for bone in skeleton.bones], rtol=1e-6)


def test_the_frames_of_a_window_are_those_of_its_trial(experts: ExpertSet, walk: dict[str, Floats]) -> None:
    assert experts.train.trial is not None
    assert experts.train.frame is not None
    assert experts.train.trial.tolist()[:8] == [1] * 7 + [2]
    assert experts.train.frame.tolist()[:8] == [2, 52, 102, 152, 202, 252, 302, 2]
    np.testing.assert_array_equal(experts.train.positions[1, :, 0], walk["root"][51:101])


def test_it_walks(walk: dict[str, Floats]) -> None:
    heights = {joint: place[:, 1] for joint, place in walk.items()}
    assert all((heights["head"] > height).all() for joint, height in heights.items() if joint != "head")
    ground = min(height.min() for height in heights.values())
    assert ground == min(heights["ltoes"].min(), heights["rtoes"].min())
    lowest = np.minimum(heights["ltoes"], heights["rtoes"])
    assert (lowest - ground).max() < 1.0  # 1/20 of the height of the root: one foot is always down
    assert heights["root"].mean() - ground == pytest.approx(17, abs=1)
    course = walk["root"][-1] - walk["root"][0]
    ahead = course / np.linalg.norm(course)
    left = np.cross([0, 1, 0], ahead)
    assert abs(course[1]) < 1
    for pair in ("femur", "foot", "humerus", "hand"):
        assert ((walk[f"l{pair}"] - walk[f"r{pair}"]) @ left).mean() > 0.5
    for side in "lr":
        hip, knee, ankle = (walk[f"{side}{bone}"] for bone in ("hipjoint", "femur", "tibia"))
        straight = (hip + ankle) / 2
        assert ((knee - straight) @ ahead).mean() > 0  # knees bend forwards
        shoulder, elbow, wrist = (walk[f"{side}{bone}"] for bone in ("clavicle", "humerus", "radius"))
        assert ((elbow - (shoulder + wrist) / 2) @ ahead).mean() < 0  # and elbows backwards
        toes = walk[f"{side}toes"] - walk[f"{side}tibia"]
        assert (toes @ ahead).mean() > 0
    arms, legs = ((walk[f"l{end}"] - walk[f"r{end}"]) @ ahead for end in ("hand", "foot"))
    assert np.corrcoef(arms, legs)[0, 1] < -0.5  # the left arm swings with the right leg


def test_wrong_kinematics_would_be_noticed(
    skeleton: Skeleton, motion: Motion, walk: dict[str, Floats], monkeypatch: pytest.MonkeyPatch
) -> None:
    rotation = kinematics.rotation
    monkeypatch.setattr(kinematics, "rotation", lambda angles, order: rotation(angles, order[::-1]))
    wrong = kinematics.positions(skeleton, motion)
    assert np.abs(wrong - np.stack([*walk.values()], axis=1)).max() > 1
