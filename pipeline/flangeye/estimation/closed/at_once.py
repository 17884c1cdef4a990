"""Closed forms of rotation and translation together: AX = XB by dual quaternions, AX = ZB."""

from __future__ import annotations

import numpy as np

from flangeye.errors import CalibrationRefused
from flangeye.estimation.closed.motions import Motions
from flangeye.types import Floats
from flangeye.types.geometry import (
    hat,
    invert,
    nearest_rotation,
    quaternion_from_rotation,
    rigid,
    rotation_from_quaternion,
    stack_rows,
)


def daniilidis(motions: Motions) -> Floats:
    """Return X (4, 4): Daniilidis, Int. J. Robotics Research 18(3), 1999, eq. (31) to (35).

    The unit dual quaternion in the two-dimensional null space of all motions' screw equations.

    Raises:
        CalibrationRefused: That null space has no unit dual quaternion.
    """
    rows = stack_rows(_screw_rows(motions))
    u, v = np.linalg.eigh(rows.T @ rows)[1][:, :2].T
    a, b, c = u[:4] @ u[4:], u[:4] @ v[4:] + v[:4] @ u[4:], v[:4] @ v[4:]
    candidates = [_normalised(s * u + t * v) for s, t in _ratios(a, b, c)]
    if not candidates:
        raise CalibrationRefused(
            "no single transform fits all motions",
            "check that each scan belongs to its robot pose, and turn the arm about two axes at "
            "least",
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
    # The dual part is t q / 2, whose vector part is (w t + t x v) / 2
    q = quaternion_from_rotation(motions[:, :3, :3])
    shift = motions[:, :3, 3]
    return q[:, :3], 0.5 * (q[:, 3:] * shift + np.cross(shift, q[:, :3]))


def _ratios(a: float, b: float, c: float) -> list[tuple[float, float]]:
    """Return the (s, t) with ``a s^2 + b s t + c t^2 = 0``: real part orthogonal to dual part."""
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


def shah(carried: Floats, seen: Floats) -> tuple[Floats, Floats]:
    """Return X and Z (4, 4) of ``G X = Z inv(M)``: Shah, J. Mechanisms and Robotics 5(3), 2013.

    Rotations by the singular vectors of the summed Kronecker products, then both translations by
    linear least squares.

    Args:
        carried: (N, 4, 4) G, target_carrier_T_camera_carrier.
        seen: (N, 4, 4) M, camera_T_target.
    """
    eyes = invert(seen)
    products = np.einsum("nji,nlk->ikjl", carried[:, :3, :3], eyes[:, :3, :3])
    u, _, vt = np.linalg.svd(products.reshape(9, 9))
    return _with_translations(carried, eyes, u[:, 0].reshape(3, 3), vt[0].reshape(3, 3))


def li(carried: Floats, seen: Floats) -> tuple[Floats, Floats]:
    """Return X and Z (4, 4) of ``G X = Z inv(M)``: Li, Wang & Wu, Int. J. Phys. Sci. 5(10), 2010.

    One linear system for all 24 entries. It is written for the inverses, ``M inv(Z) = inv(X)
    inv(G)``, whose translations are the camera's, the noisier side. The rotations are then made
    orthonormal and the translations fitted to them again, as Shah shows to be necessary.

    Args:
        carried: (N, 4, 4) G, target_carrier_T_camera_carrier.
        seen: (N, 4, 4) M, camera_T_target.
    """
    bases, n, identity = invert(carried), len(seen), np.eye(3)
    rows = np.zeros((n, 12, 24))
    rows[:, :9, :9] = np.einsum("nij,kl->nikjl", seen[:, :3, :3], identity).reshape(n, 9, 9)
    rows[:, :9, 9:18] = -np.einsum("ij,nlk->nikjl", identity, bases[:, :3, :3]).reshape(n, 9, 9)
    rows[:, 9:, 9:18] = np.einsum("ij,nl->nijl", identity, bases[:, :3, 3]).reshape(n, 3, 9)
    rows[:, 9:, 18:21], rows[:, 9:, 21:] = -seen[:, :3, :3], identity
    right = np.concatenate([np.zeros((n, 9)), seen[:, :3, 3]], axis=1)
    found = np.linalg.lstsq(stack_rows(rows), right.ravel(), rcond=None)[0]
    z, x = found[:18].reshape(2, 3, 3).transpose(0, 2, 1)
    return _with_translations(carried, invert(seen), x, z)


def _with_translations(
    carried: Floats, eyes: Floats, x: Floats, z: Floats
) -> tuple[Floats, Floats]:
    """Return X and Z from their rotations, known up to a common sign and scale.

    ``R_G t_X - t_Z = R_Z t_N - t_G`` for every pose, N being the camera in the target.
    """
    x, z = (nearest_rotation(r * np.sign(np.linalg.det(r))) for r in (x, z))
    n = len(carried)
    left = np.zeros((n, 3, 6))
    left[:, :, :3], left[:, :, 3:] = carried[:, :3, :3], -np.eye(3)
    right = eyes[:, :3, 3] @ z.T - carried[:, :3, 3]
    found = np.asarray(np.linalg.lstsq(stack_rows(left), right.ravel(), rcond=None)[0], float)
    return rigid(x, found[:3]), rigid(z, found[3:])
