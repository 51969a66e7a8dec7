"""Forward kinematics of an Acclaim skeleton: joint angles to positions, all frames at once.

Conventions: vectors are columns. Three angles with the order "xyz" turn about x first, then y, then z, each time about
fixed axes, so the matrix is Rz Ry Rx, with the first turn on the right.

The skeleton file describes the rest pose in global coordinates: the direction d of a bone, and its local axes, the
columns of C (from the bone's `axis` angles). A frame holds the angles of the joint about these local axes. In local
coordinates they form the rotation M; in the global coordinates of the rest pose, the same turn is C M C⁻¹: change to
local coordinates, turn, and change back. Let G(parent) be the rotation that takes the parent from its rest pose to its
current one. A child without angles of its own keeps its place relative to the parent, so G(parent) applies to it too. A
child with angles is turned first, while still in the rest pose:

    G = G(parent) C M C⁻¹,      end of the bone = end of the parent + length G d.

If all angles are zero, then M = 1, G = 1, and the skeleton is in its rest pose for any C.

The root follows the definition of the format: the position P and orientation O of the skeleton file place the whole
motion, and a frame's translation t and rotation M are relative to them: G(root) = O M, and the root is at P + O t. Both
are zero in the CMU database, where the root is at t, turned by M.
"""

import numpy as np

from ssmail.data.mocap.amc import Motion
from ssmail.data.mocap.asf import Skeleton
from ssmail.data.trajectories import Floats


def rotation(angles: Floats, order: str) -> Floats:
    """Return the matrices (..., 3, 3) of angles (..., 3) in radians about the fixed axes x, y, z.

    order: the order in which they are applied, such as "zyx".
    """
    result = np.eye(3)
    for axis in order:
        result = _about(axis, angles[..., "xyz".index(axis)]) @ result
    return result


def positions(skeleton: Skeleton, motion: Motion) -> Floats:
    """Return the global positions (F, N, 3) of all joints in file units: the root, and the end of each bone."""
    # the root: P + O t, and G = O M
    root = skeleton.root
    placed = rotation(np.array(root.orientation), root.axis_order)
    turns = "".join(channel[1] for channel in root.order if channel.startswith("r"))
    place = np.empty((len(motion), len(skeleton.parents), 3))
    place[:, 0] = np.array(root.position) + motion.translation @ placed.T
    turned = {0: placed @ rotation(motion.angles[:, 0], turns)}  # joint -> G, (F, 3, 3)
    # the bones, each after its parent: G = G(parent) C M C⁻¹, end = end of the parent + length G d
    for joint in skeleton.top_down[1:]:
        bone, parent = skeleton.bones[joint - 1], skeleton.parents[joint]
        turned[joint] = turned[parent]
        if bone.dof:
            local = rotation(np.array(bone.axis), bone.axis_order)
            turned[joint] = turned[parent] @ (local @ rotation(motion.angles[:, joint], bone.axis_order) @ local.T)
        place[:, joint] = place[:, parent] + turned[joint] @ (bone.length * np.array(bone.direction))
    return place


def _about(axis: str, angle: Floats) -> Floats:
    """Return rotations (..., 3, 3) by (...) radians about one axis, counterclockwise as seen from its tip."""
    matrix = np.zeros((*angle.shape, 3, 3))
    own = "xyz".index(axis)
    one, two = (own + 1) % 3, (own + 2) % 3
    matrix[..., own, own] = 1
    matrix[..., one, one] = matrix[..., two, two] = np.cos(angle)
    matrix[..., two, one] = np.sin(angle)
    matrix[..., one, two] = -matrix[..., two, one]
    return matrix
