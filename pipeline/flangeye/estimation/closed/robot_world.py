"""AX = ZB, hand-eye and target at once: Shah, Li et al."""

from __future__ import annotations

import numpy as np

from flangeye.maths.geometry import invert, nearest_rotation, rigid, stack_rows
from flangeye.types import Floats


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

    One linear system for all 24 entries, written for the inverses (``M inv(Z) = inv(X) inv(G)``,
    whose translations are the camera's, the noisier side); the rotations are then made orthonormal
    and, as Shah points out one must, the translations fitted to them again.

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
