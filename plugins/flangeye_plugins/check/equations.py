"""The calibration equations of a session, with closed-form solutions of many variants at once.

All configurations have the same form. ``carrier_T_camera`` is the camera in its carrier (the base,
a link or the flange), ``mount_T_target`` is the target in its mount, and ``carrier_T_mount`` is the
reported pose between the two::

    carrier_T_camera @ camera_T_target = carrier_T_mount @ mount_T_target

For a camera beside the robot the mount is the flange. For a camera on the flange it is the base,
and ``carrier_T_mount`` is the inverse of the reported pose. With a second arm the mount is that
arm's flange, and its base is a further unknown: ``carrier_T_mount = carrier_T_base @ base_T_base2 @
base2_T_mount``. The equation of two arms is

``X @ camera_T_target = carrier_T_base @ Y @ base2_T_mount @ Z`` with ``X = carrier_T_camera``, ``Y
= base_T_base2`` and ``Z = mount_T_target``.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from flangeye.estimation.start.closed import alternate
from flangeye.estimation.start.loops import entries, least_squares
from flangeye.types import Floats, Mask
from flangeye.types.geometry import each_applied, invert, nearest_rotation
from flangeye.workflow.doctor.diagnosis import RecordedSession


@dataclass(frozen=True, eq=False)
class Equations:
    """Equations of K variants of N samples; arrays (K, N, ...), or (1, N, ...) if common to all.

    Attributes:
        mounts: (K, N, 4, 4) ``carrier_T_mount`` [m]; with a second arm ``base2_T_mount``.
        bases: (K, N, 4, 4) ``carrier_T_base`` [m] with a second arm; else None.
        centres: (K, N, 3) measured centres in ``camera`` [m]; NaN if not seen.
        normals: (K, N, 3) measured normals in ``camera``; NaN if not measured.
        rotations: (K, N, 3, 3) measured ``camera_R_target``; NaN if not measured.
        places: (K, N, 3) the target's centre in the mount [m]; NaN if unknown.
    """

    mounts: Floats
    bases: Floats | None
    centres: Floats
    normals: Floats
    rotations: Floats
    places: Floats

    @property
    def knows_place(self) -> bool:
        """Whether the target's position in the mount is known."""
        return bool(np.isfinite(self.places).all())

    @property
    def has_rotations(self) -> bool:
        """Whether the target's full pose was measured."""
        return bool(np.isfinite(self.rotations).any())

    def carried(self, base_T_base2: Floats) -> Floats:
        """Return ``carrier_T_mount`` (K, N, 4, 4), given the second arm's base (K, 4, 4)."""
        if self.bases is None:
            return self.mounts
        return np.asarray(self.bases @ base_T_base2[:, None] @ self.mounts)

    def without(self, mask: Mask) -> Equations:
        """Return variants without the measurements of the samples in a mask (K, N)."""
        return replace(
            self,
            centres=np.where(mask[..., None], np.nan, self.centres),
            normals=np.where(mask[..., None], np.nan, self.normals),
            rotations=np.where(mask[..., None, None], np.nan, self.rotations),
        )

    def with_free_place(self) -> Equations:
        """Return the equations with the target's position unknown."""
        return replace(self, places=np.full_like(self.places, np.nan))


def equations_of(*sessions: RecordedSession) -> Equations:
    """Return the equations of sessions with the same samples, one variant for each."""
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
    """Return base and mount in the camera's carrier, (N, 4, 4) each.

    With a second arm the mount is given in that arm's base.
    """
    eye = np.broadcast_to(np.eye(4), session.poses.shape)
    camera = eye if session.carried == "target" else session.poses
    bases = invert(camera if session.links is None else session.links)
    if session.seconds is not None:
        return bases, np.asarray(session.seconds @ session.place)
    target = session.poses if session.carried == "target" else eye
    return bases, np.asarray(bases @ target @ session.place)


class VariantUnknowns(NamedTuple):
    """Values of the unknowns of K variants.

    Attributes:
        rotation: (K, 3, 3) ``carrier_R_camera``.
        position: (K, 3) position of the camera in the carrier [m].
        place: (K, N or 1, 3) position of the target in the mount [m].
        turn: (K, 3, 3) ``mount_R_target``.
        other: (K, 4, 4) ``base_T_base2`` [m]; the identity without a second arm.
        free_place: Whether ``place`` is estimated.
        free_turn: Whether ``turn`` is estimated.
        free_other: Whether ``other`` is estimated.
    """

    rotation: Floats
    position: Floats
    place: Floats
    turn: Floats
    free_place: bool
    free_turn: bool
    other: Floats = np.eye(4)[None]
    free_other: bool = False


def start_of(equations: Equations) -> VariantUnknowns:
    """Return an initial solution of each variant: rotations first, then positions linearly."""
    camera, base, target = (_of_poses if equations.has_rotations else _of_centres)(equations)
    two_arms = equations.bases is not None
    free = not equations.knows_place or (equations.has_rotations and not two_arms)
    other = np.tile(np.eye(4), (len(base), 1, 1))
    other[:, :3, :3] = base
    mounts, places = equations.carried(other), np.zeros((1, 1, 3)) if free else equations.places
    right = each_applied(mounts, places) - equations.centres @ camera.swapaxes(-1, -2)
    parts = [np.eye(3)[None, None]]
    parts += [] if equations.bases is None else [-equations.bases[..., :3, :3]]
    parts += [-mounts[..., :3, :3]] if free else []
    found = least_squares((parts, right)).reshape(len(camera), -1, 3).swapaxes(0, 1)
    if two_arms:
        other[:, :3, 3] = found[1]
    places = found[-1][:, None] if free else places
    return VariantUnknowns(
        camera, found[0], places, target, free, equations.has_rotations, other, two_arms
    )


Rotations = tuple[Floats, Floats, Floats]


def _of_poses(equations: Equations) -> Rotations:
    """Return the rotations (K, 3, 3) of camera, second base and target for full poses.

    Of one arm by the Kronecker product (Shah 2013); of two by alternation from two random starts:
    from one, 99 % of sessions converge. The joint fit does the rest.
    """
    eye = np.eye(3)[None, None]
    bases = eye if equations.bases is None else equations.bases[..., :3, :3].swapaxes(-1, -2)
    turns = bases, np.nan_to_num(equations.rotations), equations.mounts[..., :3, :3]
    k, n = np.broadcast_shapes(*(each.shape[:2] for each in turns))
    first, seen, second = (np.broadcast_to(each, (k, n, 3, 3)) for each in turns)
    if equations.bases is None:
        # Row by row, vec(mount_R_target) = (turns' kron seen') vec(carrier_R_camera) at every one
        u, _, vt = np.linalg.svd(np.einsum("knia,knjb->kabij", second, seen).reshape(k, 9, 9))
        target, camera = u[:, :, 0].reshape(k, 3, 3), vt[:, 0].reshape(k, 3, 3)
        sign = np.sign(np.linalg.det(camera))[:, None, None]
        still = np.broadcast_to(eye[0], camera.shape)
        return nearest_rotation(sign * camera), still, nearest_rotation(sign * target)
    drawn = nearest_rotation(np.random.default_rng(0).standard_normal((3, 1, 2, 3, 3)))
    x, y, z = np.repeat(drawn, k, axis=1)
    (x, y, z), errors = alternate((first, seen, second), (x, y, z), rounds=40)
    best = np.arange(k), np.argmin(errors, axis=1)
    return x[best], y[best], z[best]


def _of_centres(equations: Equations) -> Rotations:
    """Return the rotations (K, 3, 3) of camera and second base, and the identity, for centres.

    With one arm and known places by rigid registration (Umeyama 1991). Else by linear least
    squares, then projection onto rotations. With two arms the target's place is known, or near the
    origin: ``R_X c + t_X = R_b (R_Y p + t_Y) + t_b``, and likewise for the normals.
    """
    eye = np.eye(3)[None, None]
    mounts, centres, normals = equations.mounts, equations.centres, equations.normals
    there = each_applied(mounts, np.nan_to_num(equations.places))
    if equations.bases is None and equations.knows_place:
        here = np.nan_to_num(centres - np.nanmean(centres, axis=1, keepdims=True))
        # A normal turns the camera as much as two centres that are this far apart [m]: they decide
        # where the centres lie on a line, and do no harm elsewhere where they are all wrong
        axes = mounts[..., :3, 2].swapaxes(-1, -2) @ np.nan_to_num(normals)
        x = nearest_rotation(there.swapaxes(-1, -2) @ here + 1e-3**2 * axes)
        y = np.broadcast_to(eye[0], x.shape)
    elif equations.bases is None:
        right = np.where(np.isfinite(centres), mounts[..., :3, 3], np.nan)
        found = least_squares(([entries(eye, centres), eye, -mounts[..., :3, :3]], right))
        x = nearest_rotation(found[:, :9].reshape(-1, 3, 3))
        y = np.broadcast_to(eye[0], x.shape)
    else:
        turns, shifts = equations.bases[..., :3, :3], equations.bases[..., :3, 3]
        found = least_squares(
            *(
                (
                    [entries(eye, seen), one * eye, -entries(turns, at), -one * turns],
                    np.where(np.isfinite(seen), one * shifts, np.nan),
                )
                for seen, at, one in ((centres, there, 1), (normals, mounts[..., :3, 2], 0))
            )
        )
        x, y = (nearest_rotation(found[:, at : at + 9].reshape(-1, 3, 3)) for at in (0, 12))
    return x, y, np.broadcast_to(eye[0], x.shape)
