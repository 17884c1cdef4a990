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

from flangeye.types import Floats, Mask
from flangeye.types.geometry import invert, nearest_rotation
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
    """Return a start solution of each variant; for two arms from random rotations."""
    if equations.bases is not None:
        return _of_two_arms(equations)
    if equations.has_rotations:
        return _from_poses(equations)
    if equations.knows_place:
        return _from_known_places(equations)
    return _from_centres(equations)


def _of_two_arms(equations: Equations) -> VariantUnknowns:
    """Return a solution for two arms: first the rotations, then the positions, which are linear."""
    seen = equations.has_rotations
    rotations = (rotations_of_poses if seen else rotations_of_circles)(equations)
    position, base, place = positions(equations, rotations)
    other = np.zeros((len(base), 4, 4))
    other[:, :3, :3], other[:, :3, 3], other[:, 3, 3] = rotations[1], base, 1.0
    return VariantUnknowns(
        rotations[0], position, place[:, None], rotations[2],
        not equations.knows_place, seen, other, True,
    )  # fmt: skip


def _from_known_places(equations: Equations) -> VariantUnknowns:
    """Return the solution for known target positions, by rigid registration (Umeyama 1991)."""
    mounts = equations.mounts
    there = (mounts[..., :3, :3] @ equations.places[..., None])[..., 0] + mounts[..., :3, 3]
    here, there = np.broadcast_arrays(equations.centres, there)
    seen = np.isfinite(here[..., :1])
    mean_here, mean_there = _mean(here, seen), _mean(there, seen)
    # Centroids first: the translation drops out, and the best rotation is that of the cross
    # covariance.
    cross = _outer(there - mean_there[:, None], here - mean_here[:, None])
    # A normal turns the camera as much as two centres that are this far apart [m]: they decide
    # where the centres lie on a line, and do no harm elsewhere where they are all wrong
    cross = cross + 1e-3**2 * _outer(mounts[..., :3, 2], equations.normals)
    rotation = nearest_rotation(cross)
    position = mean_there - (rotation @ mean_here[..., None])[..., 0]
    turn = np.broadcast_to(np.eye(3), rotation.shape)
    return VariantUnknowns(rotation, position, equations.places, turn, False, False)


def _from_poses(equations: Equations) -> VariantUnknowns:
    """Return the solution for full poses, by the Kronecker product (Shah 2013)."""
    k, n = np.broadcast_shapes(equations.mounts.shape[:2], equations.rotations.shape[:2])
    turns = np.broadcast_to(equations.mounts[..., :3, :3], (k, n, 3, 3))
    seen = np.broadcast_to(np.nan_to_num(equations.rotations), (k, n, 3, 3))
    # Row by row, vec(mount_R_target) = (turns' kron seen') vec(carrier_R_camera) at every sample.
    total = np.einsum("knia,knjb->kabij", turns, seen).reshape(k, 9, 9)
    # The first singular vectors are the two rotations up to a common sign and scale; the
    # determinant, which must be positive, gives the sign.
    u, _, vt = np.linalg.svd(total)
    turn, rotation = u[:, :, 0].reshape(k, 3, 3), vt[:, 0].reshape(k, 3, 3)
    sign = np.sign(np.linalg.det(rotation))[:, None, None]
    rotation, turn = nearest_rotation(sign * rotation), nearest_rotation(sign * turn)
    position, place = _positions(equations, rotation)
    return VariantUnknowns(rotation, position, place[:, None], turn, True, True)


def _positions(equations: Equations, rotation: Floats) -> tuple[Floats, Floats]:
    """Return the camera's and the target's positions (K, 3), given the rotation."""
    turned = equations.centres @ rotation.swapaxes(-1, -2)
    rows, right = _linear(equations, equations.mounts[..., :3, 3] - turned)
    found = _least_squares(rows, right)
    return found[:, :3], found[:, 3:]


def _from_centres(equations: Equations) -> VariantUnknowns:
    """Return the solution for centres: linear least squares, then projection onto a rotation."""
    centres = np.nan_to_num(equations.centres)
    targets = np.where(
        np.isfinite(equations.centres), equations.mounts[..., :3, 3], np.nan
    )  # of samples that saw something
    rows, right = _linear(equations, targets)
    k, n = right.shape[:2]
    of_rotation = np.einsum("ij,knl->knijl", np.eye(3), np.broadcast_to(centres, (k, n, 3)))
    of_rotation = of_rotation.reshape(k, n, 3, 9) * np.isfinite(right)[..., None]
    # The nine entries of the rotation are free here; orthogonality is restored afterwards, and the
    # positions are then solved again with the proper rotation.
    found = _least_squares(np.concatenate([rows, of_rotation], axis=-1), right)
    rotation = nearest_rotation(found[:, 6:].reshape(-1, 3, 3))
    position, place = _positions(equations, rotation)
    turn = np.broadcast_to(np.eye(3), rotation.shape)
    return VariantUnknowns(rotation, position, place[:, None], turn, True, False)


def _linear(equations: Equations, right: Floats) -> tuple[Floats, Floats]:
    """Return ``position - mount_R place = right`` as rows (K, N, 3, 6), zero where unseen."""
    turns = np.broadcast_to(equations.mounts[..., :3, :3], (*right.shape, 3))
    rows = np.concatenate([np.broadcast_to(np.eye(3), turns.shape), -turns], axis=-1)
    return rows * np.isfinite(right)[..., None], right


def _least_squares(rows: Floats, right: Floats) -> Floats:
    flat = rows.reshape(len(rows), -1, rows.shape[-1])
    return np.asarray(
        (np.linalg.pinv(flat, rcond=1e-8) @ np.nan_to_num(right).reshape(len(rows), -1, 1))[..., 0]
    )


def _mean(points: Floats, seen: Floats) -> Floats:
    return np.asarray((np.where(seen, points, 0.0)).sum(axis=1) / seen.sum(axis=1))


def _outer(there: Floats, here: Floats) -> Floats:
    there, here = np.broadcast_arrays(there, here)
    return np.asarray(
        np.nan_to_num(there * np.isfinite(here)).swapaxes(-1, -2) @ np.nan_to_num(here)
    )


Rotations = tuple[Floats, Floats, Floats]


def rotations_of_poses(equations: Equations) -> Rotations:
    """Return rotations (K, 3, 3) of X, Y and Z for full poses.

    Each one in turn is fitted given the other two (Procrustes), from random starts.
    """
    by_x, by_y, by_z = _by_unknown(*_rotations(equations))
    k = len(by_x)
    rng = np.random.default_rng(0)
    # Random rotations to start from: from one, 99 % of sessions converge
    x, y, z = nearest_rotation(rng.standard_normal((3, 2, 1, 3, 3)).repeat(k, axis=2))
    # Steps of the alternation; the joint fit does the rest
    for _ in range(40):
        x = nearest_rotation(_contracted(by_x, y, z))
        y = nearest_rotation(_contracted(by_y, x, z))
        moved = _contracted(by_z, x, y)
        z = nearest_rotation(moved)
    # The objective is the trace that the last step maximised: the start that ends highest wins.
    best = np.argmax((moved * z).sum(axis=(-1, -2)), axis=0), np.arange(k)
    return x[best], y[best], z[best]


def _by_unknown(left: Floats, seen: Floats, right: Floats) -> list[Floats]:
    """Return the objective ``sum_n tr(X seen_n (left_n Y right_n Z)^T)`` as three matrices.

    It is linear in each of X, Y and Z. The samples are summed once, so an iteration's cost does not
    depend on their number. Each matrix (K, 9, 81) has the entries of one unknown in its rows and
    the products of the other two in its columns.
    """
    # 729 sums over the samples hold all that the alternation needs of them.
    form = np.einsum("knac,knde,knbf->kabcdef", left, right, seen).reshape(-1, 9, 9, 9)
    return [np.moveaxis(form, axis, 1).reshape(-1, 9, 81) for axis in (1, 2, 3)]


def _contracted(form: Floats, one: Floats, other: Floats) -> Floats:
    """Return the matrix to which the rows' rotation must be closest, given the other two."""
    s, k = one.shape[:2]
    products = (one.reshape(s, k, 9, 1) * other.reshape(s, k, 1, 9)).reshape(s, k, 81, 1)
    return np.asarray((form @ products).reshape(s, k, 3, 3))


def _rotations(equations: Equations) -> Rotations:
    """Return the rotations (K, N, 3, 3) of bases, measurements (zero if none) and mounts."""
    bases = equations.mounts if equations.bases is None else equations.bases
    seen = np.nan_to_num(equations.rotations)
    mounts = equations.mounts[..., :3, :3]
    k, n = np.broadcast_shapes(mounts.shape[:2], seen.shape[:2], bases.shape[:2])
    left, middle, right = (
        np.broadcast_to(m, (k, n, 3, 3)) for m in (bases[..., :3, :3], seen, mounts)
    )
    return left, middle, right


def rotations_of_circles(equations: Equations) -> Rotations:
    """Return rotations (K, 3, 3) of X and Y, and the identity, for circles.

    The circles' position in the mount is known, or near its origin, so everything is linear except
    for the orthogonality of the rotations:
    ``R_X c + t_X = R_b (R_Y p + t_Y) + t_b``, and likewise for the normals.
    """
    rows, right = _rows_of_centres(equations)
    if np.isfinite(equations.normals).any():
        extra = _rows_of_normals(equations)
        rows = np.concatenate([rows, extra], axis=1)
        right = np.concatenate([right, np.zeros(extra.shape[:2])], axis=1)
    k = len(rows)
    found = (np.linalg.pinv(rows, rcond=1e-9) @ right[..., None])[..., 0]
    x, y = (nearest_rotation(found[:, at : at + 9].reshape(k, 3, 3)) for at in (0, 12))
    return x, y, np.broadcast_to(np.eye(3), (k, 3, 3))


def _rows_of_centres(equations: Equations) -> tuple[Floats, Floats]:
    """Return the rows (K, 3 N, 24) of centres and their right side; zero if not seen."""
    bases, mounts = _transforms(equations)
    places = np.nan_to_num(equations.places)
    carried = (mounts[..., :3, :3] @ places[..., None])[..., 0] + mounts[..., :3, 3]
    rows = _outer_rows(equations.centres, bases, carried)
    # Columns: R_X (9), t_X (3), R_Y (9), t_Y (3)
    rows[..., 9:12], rows[..., 21:] = np.eye(3), -bases[..., :3, :3]
    return _where_seen(equations.centres, rows, bases[..., :3, 3])


def _rows_of_normals(equations: Equations) -> Floats:
    bases, mounts = _transforms(equations)
    rows = _outer_rows(equations.normals, bases, mounts[..., :3, 2])
    return _where_seen(equations.normals, rows, np.zeros(rows.shape[:3]))[0]


def _outer_rows(here: Floats, bases: Floats, there: Floats) -> Floats:
    """Return the rows (K, N, 3, 24) by which the entries of R_X and R_Y move points."""
    k, n = bases.shape[:2]
    rows = np.zeros((k, n, 3, 24))
    here = np.broadcast_to(np.nan_to_num(here), (k, n, 3))
    rows[..., :9] = np.einsum("ij,knl->knijl", np.eye(3), here).reshape(k, n, 3, 9)
    moved = np.einsum("knij,knl->knijl", bases[..., :3, :3], np.broadcast_to(there, (k, n, 3)))
    rows[..., 12:21] = -moved.reshape(k, n, 3, 9)
    return rows


def _where_seen(seen: Floats, rows: Floats, right: Floats) -> tuple[Floats, Floats]:
    known = np.isfinite(seen[..., :1])
    k = len(rows)
    return (rows * known[..., None]).reshape(k, -1, 24), (right * known).reshape(k, -1)


def _transforms(equations: Equations) -> tuple[Floats, Floats]:
    """Return the transforms (K, N, 4, 4) of bases and mounts."""
    bases = equations.mounts if equations.bases is None else equations.bases
    seen = equations.centres.shape[:2]
    k, n = np.broadcast_shapes(equations.mounts.shape[:2], bases.shape[:2], seen)
    return np.broadcast_to(bases, (k, n, 4, 4)), np.broadcast_to(equations.mounts, (k, n, 4, 4))


def positions(equations: Equations, rotations: Rotations) -> tuple[Floats, Floats, Floats]:
    """Return the positions (K, 3) of X, Y and the target, given the rotations (linear).

    A known target position is kept.
    """
    x, y, _ = rotations
    bases, mounts = _transforms(equations)
    k, n = bases.shape[:2]
    to_base2 = bases[..., :3, :3] @ y[:, None]
    known = equations.places if equations.knows_place else np.zeros((1, 1, 3))
    carried = (mounts[..., :3, :3] @ known[..., None])[..., 0] + mounts[..., :3, 3]
    right = (to_base2 @ carried[..., None])[..., 0] + bases[..., :3, 3]
    right = right - np.broadcast_to(equations.centres, (k, n, 3)) @ x.swapaxes(-1, -2)
    eye = np.broadcast_to(np.eye(3), to_base2.shape)
    parts = [eye, -bases[..., :3, :3]]
    parts += [] if equations.knows_place else [-to_base2 @ mounts[..., :3, :3]]
    rows = np.concatenate(parts, axis=-1) * np.isfinite(right)[..., None]
    flat = rows.reshape(k, 3 * n, -1)
    found = np.linalg.pinv(flat, rcond=1e-8) @ np.nan_to_num(right).reshape(k, -1, 1)
    place = np.broadcast_to(known[:, 0], (k, 3)) if equations.knows_place else found[:, 6:, 0]
    return found[:, :3, 0], found[:, 3:6, 0], place
