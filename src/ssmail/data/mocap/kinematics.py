"""Forward kinematics of an Acclaim skeleton: joint angles to positions, all frames at once.

Conventions, column vectors throughout. A triple of angles with the order "xyz" turns about x first, then about y, then
about z, each time about axes that stay where they are; so the matrix is Rz Ry Rx, the first turn on the right.

Why a bone turns as it does. The skeleton file describes the rest pose in global coordinates: the direction d of a
bone, and its local axes, which are the columns of C (the bone's `axis` angles). A frame gives the angles of the joint
about these local axes. In local coordinates they make the rotation M; expressed in the global coordinates of the rest
pose, the same turn is C M C⁻¹: into local coordinates, turn, and back. Now let G(parent) be the rotation that takes the
parent from the rest pose to where it is. A child without angles of its own keeps its place relative to the parent, so
it is taken along by G(parent); with angles, it is turned first, while still in the rest pose:

    G = G(parent) C M C⁻¹,      end of the bone = end of the parent + length G d.

All angles zero give M = 1, hence G = 1 and the rest pose, whatever C is.

The root is taken as the definition of the format has it: position P and orientation O of the file place the whole
recorded motion, and a frame's translation t and rotation M are relative to that: G(root) = O M, and the root is at
P + O t. Both are zero in the CMU database, where the root is simply at t, turned by M.
"""

import numpy as np

from ssmail.data.mocap.amc import Motion
from ssmail.data.mocap.asf import Skeleton
from ssmail.data.trajectories import Floats


def rotation(angles: Floats, order: str) -> Floats:
    """(..., 3, 3) matrices of (..., 3) angles in radians about x, y, z, applied in the order given, as "zyx", about
    fixed axes.
    """
    result = np.eye(3)
    for axis in order:
        result = _about(axis, angles[..., "xyz".index(axis)]) @ result
    return result


def positions(skeleton: Skeleton, motion: Motion) -> Floats:
    """(F, N, 3) global position of every joint in file units: the root, and the end of each bone."""
    root = skeleton.root
    placed = rotation(np.array(root.orientation), root.axis_order)
    turns = "".join(channel[1] for channel in root.order if channel.startswith("r"))
    place = np.empty((len(motion), len(skeleton.parents), 3))
    place[:, 0] = np.array(root.position) + motion.translation @ placed.T
    turned = {0: placed @ rotation(motion.angles[:, 0], turns)}  # joint -> G, (F, 3, 3)
    for joint in skeleton.top_down[1:]:
        bone, parent = skeleton.bones[joint - 1], skeleton.parents[joint]
        turned[joint] = turned[parent]
        if bone.dof:
            local = rotation(np.array(bone.axis), bone.axis_order)
            turned[joint] = turned[parent] @ (local @ rotation(motion.angles[:, joint], bone.axis_order) @ local.T)
        place[:, joint] = place[:, parent] + turned[joint] @ (bone.length * np.array(bone.direction))
    return place


def _about(axis: str, angle: Floats) -> Floats:
    """(..., 3, 3) rotations by (...) radians about one axis, counterclockwise when it points at the viewer."""
    matrix = np.zeros((*angle.shape, 3, 3))
    own = "xyz".index(axis)
    one, two = (own + 1) % 3, (own + 2) % 3
    matrix[..., own, own] = 1
    matrix[..., one, one] = matrix[..., two, two] = np.cos(angle)
    matrix[..., two, one] = np.sin(angle)
    matrix[..., one, two] = -matrix[..., two, one]
    return matrix
