"""A session as equations, and many variants of it at once.

One form holds for every configuration with one arm. ``carrier_T_camera`` is the camera in what
holds it (the base, or the flange), ``carrier_T_mount`` the pose that the arm reports of what holds
the target, seen from there, and ``mount_T_target`` the target in what holds it::

    carrier_T_camera @ camera_T_target = carrier_T_mount @ mount_T_target

With the camera beside the robot the mount is the flange; in the hand it is the base, and
``carrier_T_mount`` the inverse of the pose.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from flangeye.diagnosis import Session
from flangeye_plugins.doctoring.rotations import inverse_of

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Equations:
    """K variants of N samples; the arrays have leading dimensions (K, N), or (1, N) for all.

    Attributes:
        mounts: (K, N, 4, 4) ``carrier_T_mount`` [m].
        centres: (K, N, 3) in ``camera`` [m]; NaN where nothing was seen.
        normals: (K, N, 3) in ``camera``; NaN where none was measured.
        rotations: (K, N, 3, 3) ``camera_R_target``; NaN where it has none.
        places: (K, N, 3) the target's centre in the mount [m]; NaN where unknown.
    """

    mounts: Floats
    centres: Floats
    normals: Floats
    rotations: Floats
    places: Floats

    @property
    def knows_place(self) -> bool:
        """Whether it is known where the mount has the target."""
        return bool(np.isfinite(self.places).all())

    @property
    def has_rotations(self) -> bool:
        """Whether the target has a whole pose."""
        return bool(np.isfinite(self.rotations).any())

    def with_mounts(self, mounts: Floats) -> Equations:
        """Return variants with other poses (K, N, 4, 4)."""
        return replace(self, mounts=mounts)

    def of_samples(self, index: NDArray[np.intp] | Mask) -> Equations:
        """Return the samples of an index or a mask (N,)."""
        return Equations(
            self.mounts[:, index],
            self.centres[:, index],
            self.normals[:, index],
            self.rotations[:, index],
            self.places[:, index],
        )

    def without(self, mask: Mask) -> Equations:
        """Return variants in which the samples of a mask (K, N) saw nothing."""
        return replace(
            self,
            centres=np.where(mask[..., None], np.nan, self.centres),
            normals=np.where(mask[..., None], np.nan, self.normals),
            rotations=np.where(mask[..., None, None], np.nan, self.rotations),
        )


def equations_of(session: Session) -> Equations:
    """Return the session as one variant."""
    return Equations(
        mounts_of(session, session.poses)[None],
        session.centres[None],
        session.normals[None],
        session.rotations[None],
        session.places[None],
    )


def mounts_of(session: Session, poses: Floats) -> Floats:
    """Return ``carrier_T_mount`` of robot poses (..., 4, 4), as the session's arm moves things."""
    mounts = poses if session.carried == "target" else inverse_of(poses)
    return np.asarray(mounts @ session.place)
