"""Closed forms from which an estimate begins: AX = XB, AX = ZB and AXB = YCZ.

With ``G = target_carrier_T_camera_carrier`` reported and ``M = camera_T_target`` measured, ``G X
M`` is the same at every pose: the target's place Z. This holds for a camera in hand and for a fixed
one. Two poses i, j therefore give ``A X = X B`` with ``A = inv(G_j) G_i`` and ``B = M_j inv(M_i)``.

Of two arms ``A X B = Y C Z``: ``A`` is the first arm's flange in its base, ``B`` the target in the
camera, ``C`` the second arm's flange in its base; ``X`` the camera in the first flange, ``Y`` the
second base in the first, ``Z`` the target in the second flange.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from flangeye.errors import CalibrationRefused
from flangeye.types import Floats
from flangeye.types.geometry import (
    invert,
    nearest_rotation,
    rigid,
    rotation_exp,
    rotation_from_quaternion,
    rotation_log,
    stack_rows,
)

RotationTriple = tuple[Floats, Floats, Floats]


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


def park_martin(motions: Motions) -> Floats:
    """Return X (4, 4): Park & Martin, IEEE Trans. Robotics and Automation 10(5), 1994.

    The rotation that takes the camera's rotation vectors to the carrier's by least squares, here
    by the singular value decomposition, which keeps it proper where the axes lie in a plane.
    """
    rotation = nearest_rotation(motions.alpha.T @ motions.beta)
    return rigid(rotation, translation_of(rotation, motions))


def shah(carried: Floats, seen: Floats) -> tuple[Floats, Floats]:
    """Return X and Z (4, 4) of ``G X = Z inv(M)``: Shah, J. Mechanisms and Robotics 5(3), 2013.

    Rotations by the singular vectors of the summed Kronecker products, then both translations by
    linear least squares.

    G and M are (N, 4, 4), as in the module's head.
    """
    eyes = invert(seen)
    products = np.einsum("nji,nlk->ikjl", carried[:, :3, :3], eyes[:, :3, :3])
    u, _, vt = np.linalg.svd(products.reshape(9, 9))
    return two_translations(carried, eyes, u[:, 0].reshape(3, 3), vt[0].reshape(3, 3))


def two_translations(carried: Floats, eyes: Floats, x: Floats, z: Floats) -> tuple[Floats, Floats]:
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


def two_arms(given: RotationTriple, rng: np.random.Generator) -> RotationTriple:
    """Return X, Y, Z (4, 4) with the least error over many random starts.

    All starts alternate for a few rounds; the best ones continue by Gauss-Newton, which needs a
    hundredth of the steps near the end.

    A, B and C are each (N, 4, 4).
    """
    a, b, c = (each[:, :3, :3] for each in given)
    # 21 random starts of 20 rounds each; the best three go on with Newton's steps
    (x, y, z), errors = alternate((a, b, c), random_rotations(rng, (21,)), rounds=20)
    on = np.argsort(errors)[:3]
    return with_translations(given, _settled((a, b, c), (x[on], y[on], z[on])))


def _settled(given: RotationTriple, near: RotationTriple) -> RotationTriple:
    """Return the best of rotations (K, 3, 3) after a few Gauss-Newton steps, each (3, 3)."""
    (a, b, c), (x, y, z) = given, near
    steps = 10  # of Newton's
    for step in range(steps + 1):
        second = y[:, None] @ c
        apart = second @ z[:, None] @ np.swapaxes(a @ x[:, None] @ b, -1, -2)
        if step == steps:
            break
        off = 0.5 * (apart - np.swapaxes(apart, -1, -2))
        turns = np.stack([off[..., 2, 1], off[..., 0, 2], off[..., 1, 0]], axis=-1)
        by = np.broadcast_to(np.eye(3), second.shape)
        rows = np.concatenate([np.broadcast_to(-a, second.shape), by, second], axis=-1)
        # Keeps the equations solvable along turns that the poses do not determine
        normal = np.einsum("knia,knib->kab", rows, rows) + 1e-9 * len(a) * np.eye(9)
        right = np.einsum("knia,kni->ka", rows, turns)
        dx, dy, dz = -np.linalg.solve(normal, right[..., None]).reshape(-1, 3, 3).swapaxes(0, 1)
        x, y, z = rotation_exp(dx) @ x, rotation_exp(dy) @ y, rotation_exp(dz) @ z
    best = int(np.argmax(np.trace(apart, axis1=-2, axis2=-1).sum(axis=1)))
    return x[best], y[best], z[best]


def alternate(
    given: RotationTriple, starts: RotationTriple, rounds: int = 3000
) -> tuple[RotationTriple, Floats]:
    """Return rotations X, Y, Z (..., 3, 3) from any starts, and their errors (...) [rad rms].

    Each in turn is the rotation that fits best given the other two (Procrustes); the sum of
    squared Frobenius distances falls in every step. The poses enter only by the 729 sums of
    ``trace((A X B)' Y C Z)``, which is linear in each of the three.

    Args:
        given: Rotations of A, B, C, each (N, 3, 3), or (K, N, 3, 3) of K problems at once.
        starts: Initial rotations, each (..., 3, 3), or (K, ..., 3, 3).
        rounds: Largest number of steps.
    """
    a, b, c = given
    form = np.einsum("...nij,...nkl,...nmp->...jkimpl", a, b, c).reshape(*a.shape[:-3], 9, 9, 9)
    forms = [np.moveaxis(form, i, -1).reshape(*a.shape[:-3], 81, 9) for i in (-3, -2, -1)]
    x, y, z = starts
    before = np.full(x.shape[:-2], -np.inf)
    for _ in range(rounds):
        x = nearest_rotation(_third(forms[0], y, z))
        y = nearest_rotation(_third(forms[1], x, z))
        moved = _third(forms[2], x, y)
        z = nearest_rotation(moved)
        agreement = (moved * z).sum(axis=(-2, -1))
        if (agreement - before < 1e-10 * a.shape[-3]).all():
            break
        before = agreement
    # |R - 1|^2 = 2 * angle^2 for small angles, and 6 - 2 trace(R) in general.
    return (x, y, z), np.sqrt(np.maximum(3.0 - agreement / a.shape[-3], 0.0))


def _third(form: Floats, first: Floats, second: Floats) -> Floats:
    """Return (..., 3, 3): a trilinear form (..., 81, 9) contracted with two of its arguments."""
    lead, shape = form.shape[:-2], first.shape
    products = first.reshape(*lead, -1, 9, 1) * second.reshape(*lead, -1, 1, 9)
    return np.asarray((products.reshape(*lead, -1, 81) @ form).reshape(shape))


def random_rotations(rng: np.random.Generator, count: tuple[int, ...] = ()) -> RotationTriple:
    """Return three random rotations (*count, 3, 3), uniformly distributed."""
    x, y, z = (rotation_from_quaternion(q) for q in rng.standard_normal((3, *count, 4)))
    return x, y, z


def with_translations(given: RotationTriple, rotations: RotationTriple) -> RotationTriple:
    """Return X, Y, Z (4, 4): the translations fit the rotations by linear least squares.

    ``R_A t_X - R_Y R_C t_Z - t_Y = R_Y t_C - t_A - R_A R_X t_B`` for every pose. A, B and C are
    each (N, 4, 4), the rotations (3, 3).
    """
    (a, b, c), (x, y, z) = given, rotations
    rows = np.zeros((len(a), 3, 9))
    rows[:, :, :3], rows[:, :, 3:6] = a[:, :3, :3], -np.eye(3)
    rows[:, :, 6:] = -y @ c[:, :3, :3]
    seen = np.einsum("nij,jk,nk->ni", a[:, :3, :3], x, b[:, :3, 3])
    right = c[:, :3, 3] @ y.T - a[:, :3, 3] - seen
    found = np.linalg.lstsq(stack_rows(rows), right.ravel(), rcond=None)[0]
    return rigid(x, found[:3]), rigid(y, found[3:6]), rigid(z, found[6:])
