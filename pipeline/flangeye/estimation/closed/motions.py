"""Relative motions between poses, for closed forms of AX = XB.

With ``G = target_carrier_T_camera_carrier`` reported and ``M = camera_T_target`` measured, ``G X
M`` is the same at every pose: the target's place Z. This holds for a camera in hand and for a fixed
one. Two poses i, j therefore give ``A X = X B`` with ``A = inv(G_j) G_i`` and ``B = M_j inv(M_i)``.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from flangeye.errors import CalibrationRefused
from flangeye.types import Floats
from flangeye.types.geometry import invert, nearest_rotation, rigid, rotation_log, stack_rows


@dataclass(frozen=True, eq=False)
class Motions:
    """K pairs of poses, as motions of the carrier and of the camera.

    Attributes:
        a: (K, 4, 4) motions of the carrier.
        b: (K, 4, 4) motions of the camera.
        alpha: (K, 3) rotation vectors of the first [rad].
        beta: (K, 3) rotation vectors of the second [rad].
    """

    a: Floats
    b: Floats
    alpha: Floats
    beta: Floats


def motions_of(carried: Floats, seen: Floats) -> Motions:
    """Return the motions between all pairs of N poses that turn by clearly less than half a turn.

    Args:
        carried: (N, 4, 4) target_carrier_T_camera_carrier.
        seen: (N, 4, 4) camera_T_target.

    Raises:
        CalibrationRefused: There is no such pair.
    """
    i, j = np.triu_indices(len(carried), k=1)
    a = invert(carried[j]) @ carried[i]
    b = seen[j] @ invert(seen[i])
    alpha, beta = rotation_log(a[:, :3, :3]), rotation_log(b[:, :3, :3])
    turns = np.maximum(np.linalg.norm(alpha, axis=1), np.linalg.norm(beta, axis=1))
    # The axis of a rotation by half a turn may point either way: such pairs are left out
    kept = turns < np.radians(170.0)
    if not kept.any():
        raise CalibrationRefused(
            f"all {len(a)} motions between poses turn by {np.degrees(turns.min()):.0f} deg or "
            "more: the sign of the axis of a half turn is not determined",
            "add poses in between",
        )
    return Motions(a[kept], b[kept], alpha[kept], beta[kept])


def translation_of(rotation: Floats, motions: Motions) -> Floats:
    """Return the translation (3,) of X [m] that fits its rotation (3, 3) best.

    ``(R_A - 1) t_X = R_X t_B - t_A``, by least squares over all motions.
    """
    left = motions.a[:, :3, :3] - np.eye(3)
    right = motions.b[:, :3, 3] @ rotation.T - motions.a[:, :3, 3]
    # Of an arm that stood still rounding would make a shift of 1e12 m: a little pull to zero.
    rows = np.vstack([stack_rows(left), 1e-6 * np.eye(3)])
    return np.asarray(np.linalg.lstsq(rows, np.append(right.ravel(), np.zeros(3)), rcond=None)[0])


def place_of(carried: Floats, x: Floats, seen: Floats) -> Floats:
    """Return the (4, 4) place Z of the target: the mean of ``G X M`` over the poses."""
    each = carried @ x @ seen
    return rigid(nearest_rotation(each[:, :3, :3].mean(axis=0)), each[:, :3, 3].mean(axis=0))
