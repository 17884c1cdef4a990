"""Poses as controllers write them. Scalar code: it runs in every cycle of 2 ms.

The matrices agree with :mod:`flangeye.maths.geometry` (tested), whose functions take 25 us each.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from flangeye.types import Floats


def rotation_matrix(vector: Sequence[float] | Floats) -> Floats:
    """Return the (3, 3) rotation of a rotation vector (3,) [rad] (Rodrigues)."""
    x, y, z = (float(v) for v in vector)
    angle = math.sqrt(x * x + y * y + z * z)
    # Below 1e-4 rad the series is exact to 1e-17 and the quotients are not.
    if angle < 1e-4:
        a, b = 1.0 - angle * angle / 6.0, 0.5
    else:
        a, b = math.sin(angle) / angle, (1.0 - math.cos(angle)) / (angle * angle)
    c = 1.0 - b * angle * angle
    xy, xz, yz = b * x * y, b * x * z, b * y * z
    return np.array(
        [
            [c + b * x * x, xy - a * z, xz + a * y],
            [xy + a * z, c + b * y * y, yz - a * x],
            [xz - a * y, yz + a * x, c + b * z * z],
        ]
    )


def rotation_vector(rotation: Floats) -> Floats:
    """Return the rotation vector (3,) [rad] of a (3, 3) rotation, its length at most pi.

    Through the quaternion's largest component, which is at least 1/2 (Shepperd 1978).
    """
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = rotation.tolist()
    squares = (1 + xx - yy - zz, 1 - xx + yy - zz, 1 - xx - yy + zz, 1 + xx + yy + zz)
    largest = max(range(4), key=squares.__getitem__)
    quaternion = (
        (squares[0], xy + yx, xz + zx, zy - yz),
        (xy + yx, squares[1], yz + zy, xz - zx),
        (xz + zx, yz + zy, squares[2], yx - xy),
        (zy - yz, xz - zx, yx - xy, squares[3]),
    )[largest]
    x, y, z, w = quaternion
    length = math.sqrt(x * x + y * y + z * z)
    norm = math.sqrt(length * length + w * w)
    if length < 1e-12 * norm:
        return np.array([2 * x / w, 2 * y / w, 2 * z / w])
    scale = 2.0 * math.atan2(length, abs(w)) / math.copysign(length, w)
    return np.array([x * scale, y * scale, z * scale])


def pose_matrix(pose: Sequence[float] | Floats) -> Floats:
    """Return the (4, 4) matrix of a pose (6,): position [m] and rotation vector [rad]."""
    matrix = np.eye(4)
    matrix[:3, :3] = rotation_matrix(pose[3:6])
    matrix[:3, 3] = pose[:3]
    return matrix


def pose_vector(matrix: Floats) -> Floats:
    """Return the pose (6,) of a (4, 4) matrix: position [m] and rotation vector [rad]."""
    return np.concatenate([matrix[:3, 3], rotation_vector(matrix[:3, :3])])


def inverse_pose(matrix: Floats) -> Floats:
    """Return the inverse of a rigid (4, 4) matrix."""
    inverted = np.eye(4)
    inverted[:3, :3] = matrix[:3, :3].T
    inverted[:3, 3] = -matrix[:3, :3].T @ matrix[:3, 3]
    return inverted


def twist_between(start: Floats, end: Floats) -> Floats:
    """Return the (6,) twist in base that carries one (4, 4) pose to another in one second."""
    turn = end[:3, :3] @ start[:3, :3].T
    return np.concatenate([end[:3, 3] - start[:3, 3], rotation_vector(turn)])


def carried(pose: Floats, twist: Floats, seconds: float) -> Floats:
    """Return a (4, 4) pose after a constant (6,) twist in base, taken at the pose's origin."""
    moved = pose.copy()
    moved[:3, 3] += seconds * twist[:3]
    moved[:3, :3] = rotation_matrix(seconds * twist[3:]) @ pose[:3, :3]
    return moved
