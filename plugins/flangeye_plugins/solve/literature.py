"""Closed-form methods of the literature beyond those from which the estimator begins."""

from __future__ import annotations

import numpy as np

from flangeye.errors import CalibrationRefused
from flangeye.estimation.start.closed import (
    Motions,
    RotationTriple,
    motions_of,
    park_martin,
    place_of,
    translation_of,
    two_translations,
    with_translations,
)
from flangeye.types import Floats, Indices
from flangeye.types.geometry import (
    hat,
    invert,
    nearest_rotation,
    quaternion_from_rotation,
    rigid,
    rotation_exp,
    rotation_from_quaternion,
    stack_rows,
)

FEWEST_KRONECKER = 12
"""Poses from which the 90 products of the rotations' entries follow."""


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
    return two_translations(carried, invert(seen), x, z)


def kronecker(a: Floats, b: Floats, c: Floats) -> RotationTriple:
    """Return X, Y, Z (4, 4) by linear least squares, from at least 12 poses each (N, 4, 4).

    ``A X B`` is linear in the 9 entries of X, ``Y C Z`` in the 81 products of those of Y and Z
    (as in Wang, Wu, Meng & Ren, IROS 2014, there with quaternions). The null vector holds both;
    the products are then split by their largest singular vectors, and made rotations.
    """
    rotations = [m[:, :3, :3] for m in (a, b, c)]
    n, identity = len(a), np.eye(3)
    of_x = np.einsum("nik,nlj->nijkl", rotations[0], rotations[1]).reshape(n, 9, 9)
    of_yz = np.einsum("nkl,ia,jb->nijaklb", rotations[2], identity, identity).reshape(n, 9, 81)
    rows = stack_rows(np.concatenate([of_x, -of_yz], axis=2))
    null = np.linalg.eigh(rows.T @ rows)[1][:, 0]
    u, _, vt = np.linalg.svd(null[9:].reshape(9, 9))
    x, y, z = (
        nearest_rotation(r * np.sign(np.linalg.det(r)))
        for r in (null[:9].reshape(3, 3), u[:, 0].reshape(3, 3), vt[0].reshape(3, 3))
    )
    return with_translations((a, b, c), (x, y, z))


def two_steps(a: Floats, b: Floats, c: Floats) -> RotationTriple:
    """Return X, Y, Z (4, 4) by the paper's equation (6), from poses each (N, 4, 4).

    (a) The poses at which the second arm rests are eye-in-hand for the first; (b) those at which
    the first rests are eye-on-base for the second; (c) chains the two.

    Raises:
        CalibrationRefused: Fewer than three poses share a place of either arm.
    """
    first, second = _resting(c), _resting(a)
    _require_rest(len(first), "second", "first")
    _require_rest(len(second), "first", "second")
    x = park_martin(motions_of(a[first], b[first]))
    eyes = invert(b[second])
    z = park_martin(motions_of(c[second], eyes))
    base2_T_camera = place_of(c[second], z, eyes)
    y = a[second[0]] @ x @ invert(base2_T_camera)
    return x, y, z


def _resting(poses: Floats) -> Indices:
    """Return the indices of the largest group of equal poses."""
    apart = np.abs(poses[:, None] - poses[None]).max(axis=(2, 3))
    # It rested between two poses that differ by less [rad, m]
    together = apart < 1e-4
    return np.flatnonzero(together[int(np.argmax(together.sum(axis=1)))])


def _require_rest(count: int, resting: str, moving: str) -> None:
    if count < 3:
        raise CalibrationRefused(
            f"the {resting} arm stands still at no more than {count} poses; 3 poses at which only "
            f"the {moving} arm moves are needed",
            "record such poses, or use solve.robust, which needs none",
        )
