"""Flange roll: the rotation of the bolt pattern about the flange's axis.

The camera's pose does not depend on it, since centres and normals do not show it; a seam found in
the flange's frame, or a registration of its whole shape, does.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from flangeye.maths.geometry import basis_of_plane
from flangeye.maths.statistics import SIGMA_OF_MAD
from flangeye.types import Floats, Observation


def roll_note(
    observations: Sequence[Observation], base_R_camera: Floats, covariance: Floats
) -> str:
    """Return a note on the flange roll, or that it is not observable.

    Args:
        observations: The poses that agree.
        base_R_camera: (3, 3) what they agree on.
        covariance: (3, 3) of its rotation [rad^2].
    """
    turns = roll_of(observations, base_R_camera)
    # Fewer have no scatter that means anything
    if len(turns) < 3:
        return (
            f"flange roll is not observable: the bolt holes show in {len(turns)} of "
            f"{len(observations)} poses; the camera's pose does not depend on it"
        )
    mean = np.angle(np.exp(1j * turns).mean())  # the angles may lie about half a turn
    off = np.angle(np.exp(1j * (turns - mean)))
    degrees = round(float(np.degrees(mean + np.median(off))), 2)
    middle = 180 - (180 - degrees) % 360  # within (-180, 180]
    of_one = SIGMA_OF_MAD * float(np.median(np.abs(off - np.median(off))))
    rotation = float(np.sqrt(np.linalg.eigvalsh(covariance)[-1]))
    # A median's standard deviation is 1.25 times a mean's.
    deviation = np.hypot(1.25 * of_one / np.sqrt(len(turns)), rotation)
    return (
        f"flange roll against the controller's frame: {middle:.2f} +- {np.degrees(deviation):.2f} "
        f"deg (bolt pattern in {len(turns)} poses); the camera's pose does not depend on it"
    )


def roll_of(observations: Sequence[Observation], base_R_camera: Floats) -> Floats:
    """Return the (M,) angles of the hole pattern about the flange's z [rad], where holes show."""
    turns = []
    for o in observations:
        if o.circle.roll is None or o.circle.normal is None:
            continue
        across = basis_of_plane(o.circle.normal)
        angle = o.circle.roll
        x_in_camera = np.cos(angle) * across[0] + np.sin(angle) * across[1]
        x, y, _ = o.base_T_flange.rotation.T @ base_R_camera @ x_in_camera
        turns.append(np.arctan2(y, x))
    return np.array(turns)
