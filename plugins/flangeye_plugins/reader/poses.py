"""Robot poses from files, validated, as (4, 4) matrices in metres."""

from collections.abc import Sequence

import numpy as np

from flangeye import StageError
from flangeye.types import Floats
from flangeye.types.geometry import rigid, rotation_exp, rotation_from_quaternion
from flangeye.types.pose_formats import MATRIX, NORM_TOLERANCE, pose_of_numbers

Numbers = Sequence[float] | Floats


def pose_from_quaternion(where: str, position: Numbers, xyzw: Numbers) -> Floats:
    """Return the pose of a position [m] and a unit quaternion xyzw.

    Args:
        where: Prefix of messages: the file and the pose's name.
        position: (3,) position [m].
        xyzw: (4,) quaternion.

    Raises:
        StageError: A value is not finite, or the quaternion's norm is not 1.
    """
    q = _finite(where, xyzw)
    norm = float(np.linalg.norm(q))
    if abs(norm - 1) > NORM_TOLERANCE:
        raise StageError(
            f"{where}: the quaternion's norm is {norm:.4g}; it must be 1 (within {NORM_TOLERANCE})"
        )
    return rigid(rotation_from_quaternion(q), _finite(where, position))


def pose_from_rotation_vector(where: str, position: Numbers, vector: Numbers) -> Floats:
    """Return the pose of a position [m] and a rotation vector [rad], as UR controllers use.

    Raises:
        StageError: A value is not finite.
    """
    return rigid(rotation_exp(_finite(where, vector)), _finite(where, position))


def pose_from_matrix(where: str, matrix: Floats) -> Floats:
    """Return a (4, 4) pose [m], validated.

    Raises:
        StageError: A value is not finite, or the rotation matrix is invalid.
    """
    try:
        return pose_of_numbers(_finite(where, matrix).ravel(), MATRIX, "m")
    except ValueError as error:
        raise StageError(f"{where}: {error}") from None


def _finite(where: str, values: Numbers) -> Floats:
    array = np.asarray(values, dtype=np.float64)
    if not np.isfinite(array).all():
        raise StageError(f"{where}: has values that are not finite")
    return array
