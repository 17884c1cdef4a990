"""AX = XB, rotation and translation at once, by dual quaternions."""

from __future__ import annotations

import numpy as np

from flangeye.errors import CalibrationRefused
from flangeye.estimation.closed.motions import Motions
from flangeye.maths.geometry import (
    hat,
    quaternion_from_rotation,
    rigid,
    rotation_from_quaternion,
    stack_rows,
)
from flangeye.types import Floats


def daniilidis(motions: Motions) -> Floats:
    """Return X (4, 4): Daniilidis, Int. J. Robotics Research 18(3), 1999, eq. (31) to (35).

    The unit dual quaternion in the two-dimensional null space of all motions' screw equations.

    Raises:
        CalibrationRefused: No member of that space is one.
    """
    rows = stack_rows(_screw_rows(motions))
    u, v = np.linalg.eigh(rows.T @ rows)[1][:, :2].T
    a, b, c = u[:4] @ u[4:], u[:4] @ v[4:] + v[:4] @ u[4:], v[:4] @ v[4:]
    candidates = [_normalised(s * u + t * v) for s, t in _ratios(a, b, c)]
    if not candidates:
        raise CalibrationRefused(
            "the motions have no dual quaternion in common: check that each scan belongs to its "
            "robot pose, and turn the arm about two axes at least"
        )
    real, dual = min(candidates, key=lambda q: float(np.linalg.norm(rows @ np.concatenate(q))))
    # t = 2 dual * conjugate(real), the quaternions being scalar first.
    translation = 2.0 * (real[0] * dual[1:] - dual[0] * real[1:] + np.cross(real[1:], dual[1:]))
    rotation = rotation_from_quaternion(np.concatenate([real[1:], real[:1]]))
    return rigid(rotation, translation)


def _screw_rows(motions: Motions) -> Floats:
    """Return the (K, 6, 8) equations: real and dual vector parts of ``a q = q b``."""
    (real_a, dual_a), (real_b, dual_b) = _dual(motions.a), _dual(motions.b)
    rows = np.zeros((len(real_a), 6, 8))
    rows[:, :3, 0], rows[:, :3, 1:4] = real_a - real_b, hat(real_a + real_b)
    rows[:, 3:, 0], rows[:, 3:, 1:4] = dual_a - dual_b, hat(dual_a + dual_b)
    rows[:, 3:, 4:] = rows[:, :3, :4]
    return rows


def _dual(motions: Floats) -> tuple[Floats, Floats]:
    """Return the vector parts (K, 3) of the real and dual quaternions of (K, 4, 4) motions."""
    q = quaternion_from_rotation(motions[:, :3, :3])
    shift = motions[:, :3, 3]
    return q[:, :3], 0.5 * (q[:, 3:] * shift + np.cross(shift, q[:, :3]))


def _ratios(a: float, b: float, c: float) -> list[tuple[float, float]]:
    """Return the (s, t) with ``a s^2 + b s t + c t^2 = 0``: real part across the dual."""
    discriminant = b * b - 4.0 * a * c
    if discriminant < 0.0:
        # Noise may leave the parabola short of zero: its vertex is the nearest.
        return [(-b, 2.0 * a)] if abs(a) >= abs(c) else [(2.0 * c, -b)]
    root = np.sqrt(discriminant)
    stable = -0.5 * (b + np.copysign(root, b))
    return [(stable, a), (c, stable)]


def _normalised(q: Floats) -> tuple[Floats, Floats]:
    length = max(float(np.linalg.norm(q[:4])), 1e-300)
    return q[:4] / length, q[4:] / length
