"""What an .asf file may look like, and what is wrong with one that is refused."""

import math

import pytest

from ssmail.data.mocap.asf import MOST_BONES, Bone, Root, parse_skeleton
from ssmail.errors import InputError
from tests.data.mocap.handmade import PERSON, B, asf, skeleton
from tests.data.mocap.refusal import sentence_of

FULL = b"""# made by hand
:Version 1.10
:name nobody  # a comment
:units
  mass 1.0
  length 0.45
  angle DEG
:documentation
   anything: begin end root 1 2 3
:root
   axis zyx
   order RZ tx TZ ry rx ty
   orientation 0 90 0
   position 1 2e0 -3E-1
:colours
   bones of this section are skipped
:bonedata
  begin
     id 2
     direction 0 0 1
     name hand
     bodymass 3
     length 0.5
     axis 0 90 0 zyx
  end
  begin
     name arm id
     length 2.
  end
:hierarchy
  begin
    arm hand
    root arm
  end
"""
ARM = b"""     name arm
     direction 1.0, 0, 0
     length 2.
     axis (10 -20 .5) X Z Y
     dof RZ rx
     limits (-10 20)
            (-inf inf)  # free
     id 1
"""
FULL = FULL.replace(b"     name arm id\n     length 2.\n", ARM)


def degrees(*angles: float) -> tuple[float, ...]:
    return tuple(math.radians(angle) for angle in angles)


def check(contents: bytes) -> None:
    parsed = parse_skeleton(contents, "1.asf")
    assert parsed.joints == ("root", "hand", "arm")
    assert parsed.parents == (-1, 2, 0)
    assert parsed.top_down == (0, 2, 1)
    assert (parsed.length_unit, parsed.degrees) == (0.45, True)
    assert parsed.root == Root((1, 2, -0.3), degrees(0, 90, 0), "zyx", ("rz", "tx", "tz", "ry", "rx", "ty"))
    hand, arm = parsed.bones
    assert hand == Bone("hand", (0, 0, 1), 0.5, degrees(0, 90, 0), "zyx", ())
    assert (arm.direction, arm.length, arm.axis_order, arm.dof) == ((1, 0, 0), 2, "xzy", ("rz", "rx"))
    assert arm.axis == degrees(10, -20, 0.5)


@pytest.mark.parametrize("ending", [b"\n", b"\r\n", b"\r"])
def test_everything_that_a_skeleton_may_say(ending: bytes) -> None:
    check(FULL.replace(b"\n", ending))


def test_spaces_byte_order_marks_and_upper_case() -> None:
    check(b"\xef\xbb\xbf" + FULL.replace(b" ", b"  \t ").replace(b"\n", b"  \n\n"))
    check(FULL.replace(b":root", b":ROOT").replace(b"begin", b"BEGIN").replace(b" length", b" Length"))
    check(FULL.rstrip(b"\n"))


def test_angles_in_radians() -> None:
    (arm,) = parse_skeleton(asf(B(axis=(0.5, 1, 2)), angle="rad"), "1.asf").bones
    assert arm.axis == (0.5, 1, 2)


FAULTS: list[tuple[bytes, bytes, str | None]] = [
    (b"direction 0 0 1", b"direction 0 0", "line 20: direction needs 3 numbers, not 2"),
    (b"direction 0 0 1", b"direction 0 0 x", "line 20: 'x' is not a finite number"),
    (b"direction 0 0 1", b"direction 0 0 nan", "line 20: 'nan' is not a finite number"),
    (b"direction 0 0 1", b"direction 0 0 2", "line 20: the direction of bone 'hand' has length 2 instead of 1"),
    (b"direction 0 0 1", b"direction 0 0 1_0", "line 20: '1_0' is not"),
    (b"length 0.5", b"length", "line 23: length needs 1 number, not 0"),
    (b"length 0.5", b"length -1", "line 23: bone 'hand' has the negative length -1"),
    (b"length 0.5", b"length 1e999", "line 23: '1e999' is not a finite number of at most 1e+09"),
    (b"length 0.5", b"length 1\n length 1", "line 24: 'length' is there twice, first in line 23"),
    (b"     length 0.5\n", b"", "line 18: bone 'hand' has no length"),
    (b"0 90 0 zyx", b"0 90 0", "line 24: the order of the axes is '', none such as XYZ"),
    (b"0 90 0 zyx", b"0 90 0 xxz", "line 24: the order of the axes is 'xxz'"),
    (b"name hand", b"name", "line 21: a bone needs one name"),
    (b"name hand", b"title hand", "line 18: a bone needs one name"),
    (b"name hand", b"name Root", "line 21: a bone is called root"),
    (b"name hand", b"name arm", "line 27: bone 'arm' is there twice, first in line 21"),
    (b"dof RZ rx", b"dof RZ rz", "line 31: bone 'arm' has rz twice"),
    (b"dof RZ rx", b"dof tx rx", "line 31: bone 'arm' has 'tx', which is none of rx, ry, rz"),
    (b"order RZ tx", b"order RZ rz", "line 12: the root has rz twice"),
    (b"order RZ tx", b"order RZ foo", "line 12: the root has 'foo'"),
    (b"   order RZ tx TZ ry rx ty\n", b"", "line 10: the root has no order"),
    (b"orientation 0", b"orientation inf", "line 13: 'inf' is not a finite number"),
    (b"angle DEG", b"angle gon", "line 7: the unit of angles is 'gon', neither deg nor rad"),
    (b"length 0.45", b"length 0", "line 6: the unit of length is 0, not a positive number"),
    (b"  begin\n    arm hand", b"    arm hand", None),
    (b"arm hand", b"arm hand hand", "line 38: bone 'hand' has a parent already, in line 38"),
    (b"arm hand", b"arm foot", "line 38: the hierarchy names 'foot', which is no bone of this file"),
    (b"arm hand", b"arm root", "line 38: the root hangs on a bone"),
    (b"arm hand", b"hand hand", "line 38: bone 'hand' does not hang on the root but in a circle"),
    (b"root arm", b"hand arm", "line 38: bone 'hand' does not hang on the root but in a circle"),
    (b"    arm hand\n", b"", "line 21: bone 'hand' is missing in the hierarchy"),
    (b"root arm\n  end", b"root arm", "line 37: the hierarchy that begins here does not end"),
    (b"     id 1\n  end\n", b"", "line 26: the bone that begins here does not end"),
    (b"  end\n  begin\n     name arm", b"  begin\n     name arm", "line 25: a bone begins before that of line 18"),
    (b":bonedata\n  begin", b":bonedata", "line 18: 'id' stands outside begin and end"),
    (b":Version", b"Version", "line 2: 'Version' stands where a section"),
    (b":colours", b":units", "line 15: the section ':units' is there twice"),
    (b":hierarchy", b":anarchy", "has no section :hierarchy"),
    (b"# made", b"x\0made", "line 1: this is not text"),
    (b"# made", b"#" * 10_001, "line 1: the line has 10,009 characters"),
    (b"angle DEG", b"angle " + b"h" * 99, "'hhhhhhhhhhhhhhhhhhhhh...'"),
]


@pytest.mark.parametrize(("old", "new", "complaint"), FAULTS)
def test_a_fault_is_one_sentence_with_file_and_line(old: bytes, new: bytes, complaint: str | None) -> None:
    assert old in FULL
    contents = FULL.replace(old, new, 1)
    if complaint is None:
        assert parse_skeleton(contents, "1.asf").joints == ("root", "hand", "arm")
        return
    with pytest.raises(InputError) as caught:
        parse_skeleton(contents, "1.asf")
    assert complaint in sentence_of(caught.value, "1.asf")


@pytest.mark.parametrize("contents", [b"", b" \r\n\t"])
def test_an_empty_file(contents: bytes) -> None:
    with pytest.raises(InputError, match=r"^1\.asf is empty"):
        parse_skeleton(contents, "1.asf")


def test_no_bones_and_too_many() -> None:
    with pytest.raises(InputError, match="there are no bones"):
        parse_skeleton(asf(), "1.asf")
    with pytest.raises(InputError, match="more than 1000 bones"):
        skeleton(*(B(f"b{index}") for index in range(MOST_BONES + 1)))


def test_a_bone_without_length_needs_no_direction() -> None:
    assert skeleton(B(length=0, direction=(0, 0, 0))).bones[0].length == 0


def test_every_cut_of_a_file_is_noticed() -> None:
    whole = asf(*PERSON)
    assert parse_skeleton(whole, "35.asf")
    for cut in range(len(whole.rstrip())):
        with pytest.raises(InputError):
            parse_skeleton(whole[:cut], "35.asf")


@pytest.mark.parametrize("limits", [b"(20 -10)", b"1 " * 20, b"1e", b""])
def test_limits_of_joints_are_skipped_whatever_they_say(limits: bytes) -> None:
    check(FULL.replace(b"(-10 20)", limits))
