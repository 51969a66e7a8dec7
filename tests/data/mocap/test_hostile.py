"""Whatever is done to a good file: it is read, or refused in one sentence. (Time is bounded because reading is one pass
over lines of bounded length; `test_large_nonsense` would take very long otherwise.)
"""

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from ssmail.data.mocap.amc import parse_motion
from ssmail.data.mocap.asf import parse_skeleton
from ssmail.data.mocap.kinematics import positions
from ssmail.errors import InputError
from tests.data.mocap.handmade import PERSON, B, asf, skeleton, walk
from tests.data.mocap.refusal import sentence_of

SKELETON, MOTION = asf(*PERSON, B("arm", "spine", dof="rz ry")), walk(3, 0)
NONSENSE = (
    *(
        b"nan",
        b"-inf",
        b"1e999",
        b"1_0",
        b"0x10",
        b"-",
        b"1",
        b"2",
        b"3",
        b"99999999999999999999",
        b"1e9",
        b"-1e9",
        b"",
    ),
    *(b"root", b"spine", b"lleg", b"knee", b"begin", b"end", b":root", b":bonedata", b":hierarchy", b":units", b":x"),
    *(
        b"name",
        b"limits",
        b"limits 1",
        b"dof",
        b"rx",
        b"tx",
        b"XYZ",
        b"#",
        b"(",
        b"\0",
        b"\xff",
        b"\r",
        b"\x85",
        b"\x0b",
    ),
)
MANY = 300_000


@st.composite
def damaged(draw: st.DrawFn, whole: bytes) -> bytes:
    """One to four words, lines or bytes of a file dropped, doubled, replaced or moved."""
    contents = whole
    for _ in range(draw(st.integers(1, 4))):
        separator = draw(st.sampled_from([b" ", b"\n", None]))
        pieces = contents.split(separator) if separator else [bytes([byte]) for byte in contents]
        at, to = (draw(st.integers(0, max(len(pieces) - 1, 0))) for _ in range(2))
        piece = pieces[at] if pieces else b""
        what = draw(st.sampled_from(["drop", "double", "replace", "insert", "move", "cut"]))
        if what in ("drop", "move", "replace"):
            del pieces[at : at + 1]
        if what in ("double", "move"):
            pieces.insert(to, piece)
        if what in ("replace", "insert"):
            pieces.insert(at, draw(st.sampled_from(NONSENSE) | st.binary(max_size=3)))
        if what == "cut":
            del pieces[at:]
        contents = (separator or b"").join(pieces)
    return contents


def assert_read_or_refused(file: str, read: Callable[[], object]) -> None:
    try:
        read()
    except InputError as error:
        sentence_of(error, file)


@settings(max_examples=150)
@given(contents=damaged(SKELETON) | st.binary(max_size=300))
@example(contents=b":units\n:root\n:bonedata\n:hierarchy")
@example(contents=b"\xef\xbb\xbf")
def test_skeletons(contents: bytes) -> None:
    def read() -> None:
        parsed = parse_skeleton(contents, "a.asf")
        assert sorted(parsed.top_down) == list(range(len(parsed.joints)))
        assert len(parsed.joints) == len(parsed.parents) == len(set(parsed.joints))

    assert_read_or_refused("a.asf", read)


@settings(max_examples=150)
@given(contents=damaged(MOTION) | st.binary(max_size=300))
def test_motions(contents: bytes) -> None:
    person = skeleton(*PERSON)

    def read() -> None:
        placed = positions(person, parse_motion(contents, "a.amc", person))
        assert placed.shape[1:] == (5, 3)
        assert np.isfinite(placed).all()

    assert_read_or_refused("a.amc", read)


LARGE = {
    "one line": b"1 " * MANY,
    "one word": b"1" * MANY,
    "carriage returns": b"\r" * MANY + b"x",
    "comments": b"#\n" * MANY,
    "frames": b"".join(b"%d\n" % frame for frame in range(MANY // 10)),
    "limits": b":units\n:root\norder tx\n:hierarchy\n:bonedata\nbegin\nlimits 1\n" + b"1\n" * (MANY // 10),
    "sections": b"".join(b":s%d\n" % section for section in range(MANY // 50)),
    "bones": asf(*(B(f"b{index}", dof="") for index in range(5000))),
    "a chain": asf(*(B(f"b{index}", f"b{index - 1}" if index else "root", dof="") for index in range(1000))),
    "a circle": asf(*(B(f"b{index}", f"b{(index + 1) % 1000}", dof="") for index in range(1000))),
}


@pytest.mark.parametrize("contents", LARGE.values(), ids=LARGE)
def test_large_nonsense(contents: bytes) -> None:
    person = skeleton(*PERSON)
    assert_read_or_refused("a.asf", lambda: parse_skeleton(contents, "a.asf"))
    assert_read_or_refused("a.amc", lambda: parse_motion(contents, "a.amc", person))
