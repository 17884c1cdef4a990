"""Rotations by the batch: any leading dimensions."""

from __future__ import annotations

import numpy as np

from flangeye.maths.geometry import hat
from flangeye.types import Floats


def exp_of(vectors: Floats) -> Floats:
    """Return the rotations (..., 3, 3) of rotation vectors (..., 3) [rad] (Rodrigues)."""
    angle = np.linalg.norm(vectors, axis=-1)[..., None, None]
    k = hat(vectors)
    a, b = np.sinc(angle / np.pi), 0.5 * np.sinc(angle / (2 * np.pi)) ** 2
    return np.asarray(np.eye(3) + a * k + b * (k @ k))


def log_of(rotations: Floats) -> Floats:
    """Return the rotation vectors (..., 3) [rad] of rotations (..., 3, 3).

    Their lengths are right at any angle; close to half a turn their direction is rough.
    """
    twice_sine_axis = np.stack(
        [
            rotations[..., 2, 1] - rotations[..., 1, 2],
            rotations[..., 0, 2] - rotations[..., 2, 0],
            rotations[..., 1, 0] - rotations[..., 0, 1],
        ],
        axis=-1,
    )
    length = np.linalg.norm(twice_sine_axis, axis=-1, keepdims=True)
    trace = np.trace(rotations, axis1=-2, axis2=-1)[..., None]
    angle = np.arctan2(length, trace - 1.0)
    away = np.broadcast_to([1.0, 0.0, 0.0], twice_sine_axis.shape)
    direction = np.where(length > 1e-9, twice_sine_axis / np.maximum(length, 1e-9), away)
    small = 0.5 * twice_sine_axis
    return np.asarray(np.where(angle < 1e-6, small, angle * direction))


def nearest_rotation(matrices: Floats) -> Floats:
    """Return the proper rotations (..., 3, 3) nearest to matrices (..., 3, 3)."""
    u, _, vt = np.linalg.svd(matrices)
    u[..., :, 2] *= np.sign(np.linalg.det(u) * np.linalg.det(vt))[..., None]
    return np.asarray(u @ vt)


def inverse_of(poses: Floats) -> Floats:
    """Return the inverses of rigid transforms (..., 4, 4)."""
    out = np.zeros_like(poses)
    turned = poses[..., :3, :3].swapaxes(-1, -2)
    out[..., :3, :3] = turned
    out[..., :3, 3] = -(turned @ poses[..., :3, 3, None])[..., 0]
    out[..., 3, 3] = 1.0
    return out
