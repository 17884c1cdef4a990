"""AXB = YCZ, two arms: Kronecker products, alternation, and the paper's decomposition (6).

``A`` is the first arm's flange in its base, ``B`` the target in the camera, ``C`` the second
arm's flange in its base; ``X`` the camera in the first flange, ``Y`` the second base in the first,
``Z`` the target in the second flange.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from flangeye.errors import CalibrationRefused
from flangeye.estimation.closed.motions import motions_of, park_martin, place_of
from flangeye.types import Floats
from flangeye.types.geometry import (
    invert,
    nearest_rotation,
    rigid,
    rotation_exp,
    rotation_from_quaternion,
    stack_rows,
)

RotationTriple = tuple[Floats, Floats, Floats]

FEWEST_KRONECKER = 12
"""Poses from which the 90 products of the rotations' entries follow."""


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


def best_rotations(given: RotationTriple, rng: np.random.Generator) -> RotationTriple:
    """Return the rotations X, Y, Z (3, 3) with the least error over many random starts.

    All starts alternate for a few rounds; the best ones continue by Gauss-Newton, which needs a
    hundredth of the steps near the end.

    Args:
        given: Rotations of A, B, C, each (N, 3, 3).
        rng: Draws the starts.
    """
    # 21 random starts of 20 rounds each; the best three go on with Newton's steps
    (x, y, z), errors = alternate(given, random_rotations(rng, (21,)), rounds=20)
    on = np.argsort(errors)[:3]
    return _settled(given, (x[on], y[on], z[on]))


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

    ``R_A t_X - R_Y R_C t_Z - t_Y = R_Y t_C - t_A - R_A R_X t_B`` for every pose.

    Args:
        given: A, B, C, each (N, 4, 4).
        rotations: Rotations of X, Y, Z, each (3, 3).
    """
    (a, b, c), (x, y, z) = given, rotations
    rows = np.zeros((len(a), 3, 9))
    rows[:, :, :3], rows[:, :, 3:6] = a[:, :3, :3], -np.eye(3)
    rows[:, :, 6:] = -y @ c[:, :3, :3]
    seen = np.einsum("nij,jk,nk->ni", a[:, :3, :3], x, b[:, :3, 3])
    right = c[:, :3, 3] @ y.T - a[:, :3, 3] - seen
    found = np.linalg.lstsq(stack_rows(rows), right.ravel(), rcond=None)[0]
    return rigid(x, found[:3]), rigid(y, found[3:6]), rigid(z, found[6:])


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


def _resting(poses: Floats) -> NDArray[np.intp]:
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
