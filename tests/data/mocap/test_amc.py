"""What an .amc file may look like, and what is wrong with one that is refused."""

import numpy as np
import pytest

from ssmail.data.mocap.amc import Motion, parse_motion
from ssmail.errors import InputError
from tests.data.mocap.handmade import PERSON, STILL, B, amc, skeleton, walk
from tests.data.mocap.refusal import sentence_of

HINGES = skeleton(B("upper", dof="rz rx"), B("middle", "upper", dof=""), B("lower", "middle", dof="ry"))
FULL = b"""#!OML:ASF nobody.ASF
:FULLY-SPECIFIED
:DEGREES
7
root 1 2 3 4 5 6   # a comment
upper 10 -20
lower 3e1
8
lower .5
upper 1. +2
middle
root -1 -2 -3 -4 -5 -6
"""


def parse(contents: bytes) -> Motion:
    return parse_motion(contents, "1_01.amc", HINGES)


@pytest.mark.parametrize("ending", [b"\n", b"\r\n", b"\r"])
def test_joints_by_name_in_any_order(ending: bytes) -> None:
    motion = parse(FULL.replace(b"\n", ending))
    assert (motion.first, len(motion)) == (7, 2)
    np.testing.assert_array_equal(motion.translation, [(1, 2, 3), (-1, -2, -3)])
    expected = [[(4, 5, 6), (-20, 0, 10), (0, 0, 0), (0, 30, 0)], [(-4, -5, -6), (2, 0, 1), (0, 0, 0), (0, 0.5, 0)]]
    np.testing.assert_allclose(np.rad2deg(motion.angles), expected, atol=1e-12)


def test_without_the_promise_a_missing_joint_rests() -> None:
    frames = [{"root": STILL, "upper": (1, 2)}, {"root": STILL}, {"root": STILL, "lower": (3,), "upper": (4, 5)}]
    motion = parse(amc(*frames, head=(":DEGREES",)))
    np.testing.assert_allclose(np.rad2deg(motion.angles[:, 1]), [(2, 0, 1), (0, 0, 0), (5, 0, 4)])
    np.testing.assert_allclose(np.rad2deg(motion.angles[:, 3, 1]), [0, 0, 3])
    with pytest.raises(InputError, match=r"^1_01\.amc, line 3: frame 1 lacks 'lower'"):
        parse(amc(*frames))
    with pytest.raises(InputError, match="line 4: frame 2 lacks 'root'"):
        parse(amc(frames[0], {"upper": (1, 2)}, head=()))


FAULTS: list[tuple[bytes, bytes, str]] = [
    (b"8\n", b"7\n", "line 8: here is frame '7' after frame 7"),
    (b"8\n", b"9\n", "line 8: here is frame '9' after frame 7"),
    (b"8\n", b"-8\n", "line 8: the skeleton has no joint '-8'"),
    (b"7\n", b"7" * 5000 + b"\n", "line 4: here is frame '777777777777777777777...', too large a number"),
    (b"8\n", b"", "line 8: frame 7 names 'lower' twice"),
    (b"7\n", b"", "line 4: 'root' stands before the number of the first frame"),
    (b":DEGREES", b"DEGREES", "line 3: 'DEGREES' stands where a keyword or the number of a frame should"),
    (b"lower 3e1\n", b"", "line 4: frame 7 lacks 'lower'"),
    (b"root -1 -2 -3 -4 -5 -6\n", b"", "line 8: frame 8 lacks 'root'"),
    (b"upper 1. +2", b"upper 1.", "line 10: 'upper' has 1 number, but the skeleton gives it 2"),
    (b"upper 1. +2", b"upper 1. +2 3", "line 10: 'upper' has 3 numbers, but the skeleton gives it 2"),
    (b"upper 1. +2", b"upper 1. two", "line 10: 'two' is not a finite number"),
    (b"upper 1. +2", b"upper 1. nan", "line 10: 'nan' is not a finite number"),
    (b"upper 1. +2", b"upper 1. -inf", "line 10: '-inf' is not a finite number"),
    (b"upper 1. +2", b"upper 1. 1e10", "line 10: '1e10' is not a finite number of at most 1e+09"),
    (b"upper 1. +2", b"upper 1. 1_0", "line 10: '1_0' is not a finite number"),
    (b"upper 1. +2", b"upper 1. 0x1", "line 10: '0x1' is not a finite number"),
    (
        b"upper 1. +2",
        b"knee 1. +2",
        "line 10: the skeleton has no joint 'knee'; is this the motion of another skeleton",
    ),
    (b"middle\n", b"middle 1\n", "line 11: 'middle' has 1 number, but the skeleton gives it 0"),
    (b"middle\n", b":middle\n", "line 11: the skeleton has no joint ':middle'"),
    (b"+2\n", b"+2\n\0", "line 11: this is not text"),
    (b"+2\n", b"+2" * 500_000, "line 10: the line has"),
]


@pytest.mark.parametrize(("old", "new", "complaint"), FAULTS)
def test_a_fault_is_one_sentence_with_file_and_line(old: bytes, new: bytes, complaint: str) -> None:
    assert FULL.count(old) >= 1
    with pytest.raises(InputError) as caught:
        parse(FULL.replace(old, new, 1))
    assert complaint in sentence_of(caught.value, "1_01.amc")


@pytest.mark.parametrize(("contents", "complaint"), [(b"", "is empty"), (b":DEGREES\n", "holds no frame")])
def test_a_file_without_frames(contents: bytes, complaint: str) -> None:
    with pytest.raises(InputError, match=f"^1_01.amc {complaint}"):
        parse(contents)


def test_a_cut_file_is_noticed_unless_cut_between_frames_or_within_its_last_number() -> None:
    person, whole = skeleton(*PERSON), walk(3, 0).rstrip()
    for cut in range(len(whole)):
        try:
            motion = parse_motion(whole[:cut], "35_01.amc", person)
        except InputError:
            continue
        last = whole[:cut].splitlines()[-1].split()[0]
        assert len(motion) < 3 or last == b"lfoot"
        assert last == b"lfoot"  # the last joint of every frame
