"""A session as equations, and many variants of it at once.

One form holds for every configuration. ``carrier_T_camera`` is the camera in what holds it (the
base, a link or the flange), ``carrier_T_mount`` what holds the target, seen from there as the
controllers report it, and ``mount_T_target`` the target in what holds it::

    carrier_T_camera @ camera_T_target = carrier_T_mount @ mount_T_target

With the camera beside the robot the mount is the flange; in the hand it is the base, and
``carrier_T_mount`` the inverse of the pose. With a second arm the mount is that arm's flange, and
where its base stands is unknown too: ``carrier_T_mount = carrier_T_base @ base_T_base2 @
base2_T_mount``.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from flangeye.doctor.diagnosis import RecordedSession
from flangeye.maths.geometry import invert
from flangeye.types import Floats, Mask


@dataclass(frozen=True, eq=False)
class Equations:
    """K variants of N samples; the arrays have leading dimensions (K, N), or (1, N) for all.

    Attributes:
        mounts: (K, N, 4, 4) ``carrier_T_mount`` [m]; with a second arm ``base2_T_mount``.
        bases: (K, N, 4, 4) ``carrier_T_base`` [m] where there is a second arm, else None.
        centres: (K, N, 3) in ``camera`` [m]; NaN where nothing was seen.
        normals: (K, N, 3) in ``camera``; NaN where none was measured.
        rotations: (K, N, 3, 3) ``camera_R_target``; NaN where it has none.
        places: (K, N, 3) the target's centre in the mount [m]; NaN where unknown.
    """

    mounts: Floats
    bases: Floats | None
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

    def carried(self, base_T_base2: Floats) -> Floats:
        """Return ``carrier_T_mount`` (K, N, 4, 4), the second arm's base being at (K, 4, 4)."""
        if self.bases is None:
            return self.mounts
        return np.asarray(self.bases @ base_T_base2[:, None] @ self.mounts)

    def without(self, mask: Mask) -> Equations:
        """Return variants in which the samples of a mask (K, N) saw nothing."""
        return replace(
            self,
            centres=np.where(mask[..., None], np.nan, self.centres),
            normals=np.where(mask[..., None], np.nan, self.normals),
            rotations=np.where(mask[..., None, None], np.nan, self.rotations),
        )

    def with_free_place(self) -> Equations:
        """Return the same with the target's place unknown."""
        return replace(self, places=np.full_like(self.places, np.nan))


def equations_of(*sessions: RecordedSession) -> Equations:
    """Return sessions of the same samples, each as one variant."""
    bases, mounts = zip(*map(_carriers, sessions), strict=True)
    return Equations(
        np.stack(mounts),
        None if sessions[0].seconds is None else np.stack(bases),
        np.stack([session.centres for session in sessions]),
        np.stack([session.normals for session in sessions]),
        np.stack([session.rotations for session in sessions]),
        np.stack([session.places for session in sessions]),
    )


def _carriers(session: RecordedSession) -> tuple[Floats, Floats]:
    """Return (N, 4, 4) of the base in the camera's carrier, and of the mount there.

    With a second arm the mount is that in its own base.
    """
    eye = np.broadcast_to(np.eye(4), session.poses.shape)
    camera = eye if session.carried == "target" else session.poses
    bases = invert(camera if session.links is None else session.links)
    if session.seconds is not None:
        return bases, np.asarray(session.seconds @ session.place)
    target = session.poses if session.carried == "target" else eye
    return bases, np.asarray(bases @ target @ session.place)
