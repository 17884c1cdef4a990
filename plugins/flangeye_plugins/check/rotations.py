"""Rotations by the batch: any leading dimensions."""

from __future__ import annotations

import numpy as np

from flangeye.types import Floats


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
