"""Positions worked out by hand; quarter turns are counterclockwise, x to y about z, y to z about x, z to x about y."""

from itertools import permutations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from ssmail.data.mocap.amc import Motion, parse_motion
from ssmail.data.mocap.asf import Skeleton, parse_skeleton
from ssmail.data.mocap.kinematics import positions, rotation
from ssmail.data.trajectories import Floats
from tests.data.mocap.handmade import PERSON, STILL, B, asf, posed, walk

X, Y, Z = np.eye(3)
# Where a quarter turn about each axis, in this order, takes +x and +y.
TURNED = {"xyz": (-Z, Y), "xzy": (Y, X), "yxz": (-X, Z), "yzx": (Y, -X), "zxy": (X, Z), "zyx": (Z, -Y)}


@pytest.mark.parametrize(
    ("dof", "direction", "end"), [("rx", Y, Z), ("ry", Z, X), ("rz", X, Y), ("rx", X, X), ("ry", X, -Z), ("rz", Y, -X)]
)
def test_a_quarter_turn_about_each_axis(dof: str, direction: Floats, end: Floats) -> None:
    file = asf(B(direction=direction.tolist(), length=2, dof=dof))
    (frame,) = posed(file, {"root": (1, 2, 3, 0, 0, 0), "arm": (90,)})
    np.testing.assert_allclose(frame, [(1, 2, 3), (1, 2, 3) + 2 * end], atol=1e-12)


@pytest.mark.parametrize("order", TURNED)
def test_every_order_of_three_quarter_turns(order: str) -> None:
    east, north = (B(name, direction=to.tolist(), order=order.upper()) for name, to in (("east", X), ("north", Y)))
    (frame,) = posed(asf(east, north), {"root": STILL, "east": (90, 90, 90), "north": (90, 90, 90)})
    np.testing.assert_allclose(frame[1:], TURNED[order], atol=1e-12)
    assert np.abs(frame[1:] - TURNED[order[::-1]]).max() > 0.5  # the reverse order is told apart


@pytest.mark.parametrize("turns", [*permutations(("RX", "RY", "RZ"))])
def test_the_root_turns_in_the_order_of_its_order_and_not_of_its_axis(turns: tuple[str, ...]) -> None:
    file = asf(B(dof=""), root=(f"order {' '.join(turns)} TX TZ TY", "axis YXZ"))
    (frame,) = posed(file, {"root": (90, 90, 90, 1, 3, 2)})
    np.testing.assert_allclose(frame[0], (1, 2, 3))
    np.testing.assert_allclose(frame[1] - frame[0], TURNED["".join(t[1].lower() for t in turns)][0], atol=1e-12)


def test_the_order_of_the_dofs_is_that_of_the_numbers_only() -> None:
    names, numbers = ("rx", "ry", "rz"), (10, 20, 30)
    expected = posed(asf(B(order="YZX")), {"root": STILL, "arm": numbers})
    for shuffled in permutations(range(3)):
        file = asf(B(order="YZX", dof=" ".join(names[i] for i in shuffled)))
        shown = posed(file, {"root": STILL, "arm": [numbers[i] for i in shuffled]})
        np.testing.assert_allclose(shown, expected, atol=1e-12)
    assert np.abs(posed(asf(B(order="YZX")), {"root": STILL, "arm": numbers[::-1]}) - expected).max() > 0.1


def test_a_chain_of_two() -> None:
    file = asf(B("upper", length=2, dof="rz"), B("lower", "upper", dof="rz"))
    frames = posed(
        file,
        {"root": STILL, "upper": (0,), "lower": (0,)},
        {"root": STILL, "upper": (90,), "lower": (0,)},
        {"root": STILL, "upper": (0,), "lower": (90,)},
        {"root": STILL, "upper": (90,), "lower": (90,)},
        {"root": (0, 0, 5, 0, 0, 90), "upper": (90,), "lower": (90,)},
    )
    ends = [[(2, 0, 0), (3, 0, 0)], [(0, 2, 0), (0, 3, 0)], [(2, 0, 0), (2, 1, 0)], [(0, 2, 0), (-1, 2, 0)]]
    np.testing.assert_allclose(frames[:4, 1:], ends, atol=1e-12)
    np.testing.assert_allclose(frames[4, 1:], [(-2, 0, 5), (-2, -1, 5)], atol=1e-12)


def test_a_joint_turns_about_its_own_axes() -> None:
    """The local x of an axis turned by 90 degrees about z is the global y."""
    turned = posed(asf(B(axis=(0, 0, 90), dof="rx")), {"root": STILL, "arm": (90,)})
    np.testing.assert_allclose(turned[0, 1], -Z, atol=1e-12)  # C⁻¹ M C instead of C M C⁻¹ would give +z
    straight = posed(asf(B(dof="rx")), {"root": STILL, "arm": (90,)})
    np.testing.assert_allclose(straight[0, 1], X, atol=1e-12)


@pytest.mark.parametrize(("order", "direction", "end"), [("XYZ", X, Z), ("YXZ", -Z, Y), ("YXZ", X, X)])
def test_the_axis_has_an_order_too(order: str, direction: Floats, end: Floats) -> None:
    """90 degrees about x, then y: the local z goes to -y and stays there. About y, then x: to x, and stays there."""
    arm = B(direction=direction.tolist(), axis=(90, 90, 0), order=order, dof="rz")
    (frame,) = posed(asf(arm), {"root": STILL, "arm": (90,)})
    np.testing.assert_allclose(frame[1], end, atol=1e-12)


def test_the_rest_pose_does_not_depend_on_the_axes() -> None:
    rest = {"root": STILL, "spine": (0, 0, 0), "lleg": (0, 0), "lfoot": (0,)}
    expected = [(0, 0, 0), (0, 5, 0), (2.4, -3.2, 0), (2.4, -3.2, 1), (0, 0, -2)]
    np.testing.assert_allclose(posed(asf(*PERSON), rest)[0], expected, atol=1e-12)


def test_position_and_orientation_place_the_whole_motion() -> None:
    file = asf(B(dof=""), root=("order TX TY TZ RX RY RZ", "position 10 0 0", "orientation 0 0 90"))
    still, moved = posed(file, {"root": STILL}, {"root": (1, 0, 0, 90, 0, 0)})
    np.testing.assert_allclose(still, [(10, 0, 0), (10, 1, 0)], atol=1e-12)
    np.testing.assert_allclose(moved, [(10, 1, 0), (10, 2, 0)], atol=1e-12)
    (moved,) = posed(file, {"root": (0, 0, 0, 0, 90, 0)})
    np.testing.assert_allclose(moved[1], (10, 0, -1), atol=1e-12)


def test_radians_and_degrees() -> None:
    quarter, half = np.pi / 2, np.pi / 4
    degrees = posed(asf(B(axis=(45, 0, 90), dof="rx")), {"root": (0, 0, 0, 0, 45, 0), "arm": (90,)})
    radians = asf(B(axis=(half, 0, quarter), dof="rx"), angle="rad")
    moved = {"root": (0, 0, 0, 0, half, 0), "arm": (quarter,)}
    np.testing.assert_allclose(posed(radians, moved, head=()), degrees, atol=1e-12)
    np.testing.assert_allclose(posed(radians, moved, head=(":RADIANS",)), degrees, atol=1e-12)
    mixed = posed(radians, {"root": (0, 0, 0, 0, 45, 0), "arm": (90,)}, head=(":degrees",))
    np.testing.assert_allclose(mixed, degrees, atol=1e-12)


def slow_positions(skeleton: Skeleton, motion: Motion, frame: int) -> Floats:
    """One frame, joint by joint, by SciPy's rotations (lower-case orders are about fixed axes), up to the root."""

    def euler(angles: Floats, order: str) -> Rotation:
        return Rotation.from_euler(order, [angles["xyz".index(axis)] for axis in order])

    def orientation(joint: int) -> Rotation:
        angles = motion.angles[frame, joint]
        if joint == 0:
            return euler(angles, "".join(c[1] for c in skeleton.root.order if c[0] == "r"))
        bone = skeleton.bones[joint - 1]
        local = euler(np.array(bone.axis), bone.axis_order)
        return orientation(skeleton.parents[joint]) * local * euler(angles, bone.axis_order) * local.inv()

    def place(joint: int) -> Floats:
        if joint == 0:
            return motion.translation[frame]
        bone = skeleton.bones[joint - 1]
        return place(skeleton.parents[joint]) + orientation(joint).apply(bone.length * np.array(bone.direction))

    return np.stack([place(joint) for joint in range(len(skeleton.parents))])


@st.composite
def trees(draw: st.DrawFn) -> tuple[B, ...]:
    """Bones of any shape; some stand in the file before the bone that they hang on."""
    bones = []
    for index in range(draw(st.integers(1, 6))):
        theta, phi = draw(st.floats(0, 3.1)), draw(st.floats(0, 6.2))
        direction = (np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta))
        bones.append(
            B(
                name=f"b{index}",
                parent=f"b{draw(st.integers(0, index - 1))}" if index and draw(st.booleans()) else "root",
                direction=[float(d) for d in direction],
                length=draw(st.floats(0.1, 10)),
                axis=draw(st.tuples(*[st.floats(-180, 180)] * 3)),
                order="".join(draw(st.permutations("XYZ"))),
                dof=" ".join(draw(st.permutations(["rx", "ry", "rz"]))[: draw(st.integers(0, 3))]),
            )
        )
    return tuple(draw(st.permutations(bones)))


@settings(max_examples=40)
@given(bones=trees(), seed=st.integers(0, 99))
def test_equal_to_a_slow_implementation(bones: tuple[B, ...], seed: int) -> None:
    skeleton = parse_skeleton(asf(*bones), "35.asf")
    rng = np.random.default_rng(seed)
    motion = Motion(1, rng.normal(size=(2, 3)), rng.uniform(-3, 3, size=(2, len(bones) + 1, 3)))
    for joint, bone in enumerate(skeleton.bones, start=1):
        absent = [axis not in {dof[1] for dof in bone.dof} for axis in "xyz"]
        motion.angles[:, joint, absent] = 0
    fast = positions(skeleton, motion)
    np.testing.assert_allclose(fast, [slow_positions(skeleton, motion, frame) for frame in (0, 1)], atol=1e-9)
    lengths = np.linalg.norm(fast[:, 1:] - fast[:, list(skeleton.parents[1:])], axis=-1)
    np.testing.assert_allclose(lengths, [[bone.length for bone in skeleton.bones]] * 2, rtol=1e-9)


def test_rotations_are_rotations() -> None:
    matrices = rotation(np.random.default_rng(0).uniform(-9, 9, size=(5, 4, 3)), "zxy")
    products = matrices @ np.swapaxes(matrices, -1, -2)
    np.testing.assert_allclose(products, np.broadcast_to(np.eye(3), products.shape), atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(matrices), 1)


def test_a_longer_motion_frame_by_frame() -> None:
    skeleton = parse_skeleton(asf(*PERSON), "35.asf")
    motion = parse_motion(walk(20, 3), "35_03.amc", skeleton)
    expected = [slow_positions(skeleton, motion, frame) for frame in range(20)]
    np.testing.assert_allclose(positions(skeleton, motion), expected, atol=1e-9)
