"""AX = XB by relative motions, rotation first: Tsai & Lenz, Park & Martin and others.

With ``G = target_carrier_T_camera_carrier`` reported and ``M = camera_T_target`` measured, ``G X
M`` is the same at every pose: the target's place Z. This holds for a camera in hand and for a fixed
one. Two poses i, j therefore give ``A X = X B`` with ``A = inv(G_j) G_i`` and ``B = M_j inv(M_i)``.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from flangeye.errors import CalibrationRefused
from flangeye.types import Floats
from flangeye.types.geometry import (
    hat,
    invert,
    nearest_rotation,
    rigid,
    rotation_exp,
    rotation_from_quaternion,
    rotation_log,
    stack_rows,
)


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


def tsai_lenz(motions: Motions) -> Floats:
    """Return X (4, 4): Tsai & Lenz, IEEE Trans. Robotics and Automation 5(3), 1989, eq. (10)-(15).

    Their vector ``2 sin(angle / 2) axis`` cannot express a rotation by 180 degrees. So the system
    is set up four times: with the camera's frame as it is, and rotated by 180 degrees about each of
    its axes. The best conditioned system is solved: there X rotates least.
    """
    a, b = _half_sines(motions.alpha), _half_sines(motions.beta)
    # No turn, and half a turn about each axis
    half_turns = np.stack([np.eye(3), *(np.diag(d) for d in np.eye(3) * 2.0 - 1.0)])
    turned = np.einsum("kij,nj->kni", half_turns, b)
    systems = hat(a + turned).reshape(4, -1, 3)
    best = int(np.argmax(np.linalg.svd(systems, compute_uv=False)[:, -1]))
    tangent = np.linalg.lstsq(systems[best], (turned[best] - a).ravel(), rcond=None)[0]
    length = np.linalg.norm(tangent)
    angle = 2.0 * np.arctan(length) / max(float(length), 1e-300)
    rotation = rotation_exp(angle * tangent) @ half_turns[best]
    return rigid(rotation, translation_of(rotation, motions))


def _half_sines(vectors: Floats) -> Floats:
    """Return ``2 sin(angle / 2) axis`` of (K, 3) rotation vectors."""
    # np.sinc(x) is sin(pi x) / (pi x): finite where the angle is zero
    angles = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.asarray(vectors * np.sinc(angles / (2.0 * np.pi)))


def park_martin(motions: Motions) -> Floats:
    """Return X (4, 4): Park & Martin, IEEE Trans. Robotics and Automation 10(5), 1994.

    The rotation that takes the camera's rotation vectors to the carrier's by least squares, here
    by the singular value decomposition, which keeps it proper where the axes lie in a plane.
    """
    rotation = nearest_rotation(motions.alpha.T @ motions.beta)
    return rigid(rotation, translation_of(rotation, motions))


def horaud_dornaika(motions: Motions) -> Floats:
    """Return X (4, 4): Horaud & Dornaika, Int. J. Robotics Research 14(3), 1995, section 3.

    The unit quaternion q that minimises the sum of ``|a q - q b|^2``, an eigenvector.
    """
    rows = _commutators(_half_sines(motions.alpha), _half_sines(motions.beta))
    values = np.linalg.eigh(np.einsum("nij,nik->jk", rows, rows))
    rotation = rotation_from_quaternion(values[1][:, 0])
    return rigid(rotation, translation_of(rotation, motions))


def _commutators(a: Floats, b: Floats) -> Floats:
    """Return the (N, 4, 4) matrices C with ``C q = a q - q b`` for pure a, b; q is xyzw."""
    rows = np.zeros((len(a), 4, 4))
    rows[:, :3, :3], rows[:, :3, 3], rows[:, 3, :3] = hat(a + b), a - b, b - a
    return rows


def andreff(motions: Motions) -> Floats:
    """Return X (4, 4): Andreff, Horaud & Espiau, 3DIM 1999: linear in the rotation's entries.

    ``(R_A x 1 - 1 x R_B^T) vec(R_X) = 0`` with Kronecker products, and ``R_X t_B + t_X - R_A t_X =
    t_A``, together; the rotation is made orthonormal, and the translation fitted to it again.
    """
    n, identity = len(motions.a), np.eye(3)
    turns_a, turns_b = motions.a[:, :3, :3], motions.b[:, :3, :3]
    rows = np.zeros((n, 12, 12))
    # vec() stacks rows here: vec(A X) = (A x 1) vec(X), vec(X B) = (1 x B') vec(X)
    rows[:, :9, :9] = np.einsum("nij,kl->nikjl", turns_a, identity).reshape(n, 9, 9)
    rows[:, :9, :9] -= np.einsum("ij,nlk->nikjl", identity, turns_b).reshape(n, 9, 9)
    rows[:, 9:, :9] = np.einsum("ij,nl->nijl", identity, motions.b[:, :3, 3]).reshape(n, 3, 9)
    rows[:, 9:, 9:] = identity - turns_a
    right = np.concatenate([np.zeros((n, 9)), motions.a[:, :3, 3]], axis=1)
    found = np.linalg.lstsq(stack_rows(rows), right.ravel(), rcond=None)[0]
    # The nine numbers of a linear solution are no rotation under noise
    rotation = nearest_rotation(np.asarray(found[:9].reshape(3, 3), dtype=np.float64))
    return rigid(rotation, translation_of(rotation, motions))
