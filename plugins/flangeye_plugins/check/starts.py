"""Closed-form calibrations of every variant, to start from."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from flangeye.maths.geometry import nearest_rotation
from flangeye.types import Floats
from flangeye_plugins.check.equations import Equations
from flangeye_plugins.check.two_arms import (
    positions,
    rotations_of_circles,
    rotations_of_poses,
)

LEVER = 1e-3
"""A normal turns the camera as much as two centres that are this far apart [m]: they decide where
the centres lie on a line, and do no harm elsewhere where they are all wrong."""


class VariantUnknowns(NamedTuple):
    """What a variant leaves to be found.

    Attributes:
        rotation: (K, 3, 3) ``carrier_R_camera``.
        position: (K, 3) of the camera in the carrier [m].
        place: (K, N or 1, 3) of the target in the mount [m].
        turn: (K, 3, 3) ``mount_R_target``.
        other: (K, 4, 4) ``base_T_base2`` [m]; the identity where there is no second arm.
        free_place: Whether the place has to be found.
        free_turn: Whether the turn has to be found.
        free_other: Whether the second arm's base has to be found.
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
    """Return a closed-form solution of each variant; of two arms one from random rotations."""
    if equations.bases is not None:
        return _of_two_arms(equations)
    if equations.has_rotations:
        return _from_poses(equations)
    if equations.knows_place:
        return _from_known_places(equations)
    return _from_centres(equations)


def _of_two_arms(equations: Equations) -> VariantUnknowns:
    """Find the rotations first, then the positions, which are linear."""
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
    """Fit centres to where the arm has them, and normals to its axis (Umeyama 1991)."""
    mounts = equations.mounts
    there = (mounts[..., :3, :3] @ equations.places[..., None])[..., 0] + mounts[..., :3, 3]
    here, there = np.broadcast_arrays(equations.centres, there)
    seen = np.isfinite(here[..., :1])
    mean_here, mean_there = _mean(here, seen), _mean(there, seen)
    cross = _outer(there - mean_there[:, None], here - mean_here[:, None])
    cross = cross + LEVER**2 * _outer(mounts[..., :3, 2], equations.normals)
    rotation = nearest_rotation(cross)
    position = mean_there - (rotation @ mean_here[..., None])[..., 0]
    turn = np.broadcast_to(np.eye(3), rotation.shape)
    return VariantUnknowns(rotation, position, equations.places, turn, False, False)


def _from_poses(equations: Equations) -> VariantUnknowns:
    """Rotations from the Kronecker product (Shah 2013), then positions, which are linear."""
    k, n = np.broadcast_shapes(equations.mounts.shape[:2], equations.rotations.shape[:2])
    turns = np.broadcast_to(equations.mounts[..., :3, :3], (k, n, 3, 3))
    seen = np.broadcast_to(np.nan_to_num(equations.rotations), (k, n, 3, 3))
    # Row by row, vec(mount_R_target) = (turns' kron seen') vec(carrier_R_camera) at every sample.
    total = np.einsum("knia,knjb->kabij", turns, seen).reshape(k, 9, 9)
    u, _, vt = np.linalg.svd(total)
    turn, rotation = u[:, :, 0].reshape(k, 3, 3), vt[:, 0].reshape(k, 3, 3)
    sign = np.sign(np.linalg.det(rotation))[:, None, None]
    rotation, turn = nearest_rotation(sign * rotation), nearest_rotation(sign * turn)
    position, place = _positions(equations, rotation)
    return VariantUnknowns(rotation, position, place[:, None], turn, True, True)


def _positions(equations: Equations, rotation: Floats) -> tuple[Floats, Floats]:
    """Return the camera's position and the target's place (K, 3), the rotation being known."""
    turned = equations.centres @ rotation.swapaxes(-1, -2)
    rows, right = _linear(equations, equations.mounts[..., :3, 3] - turned)
    found = _least_squares(rows, right)
    return found[:, :3], found[:, 3:]


def _from_centres(equations: Equations) -> VariantUnknowns:
    """All but that the rotation is one is linear in the unknowns; then it is made one."""
    centres = np.nan_to_num(equations.centres)
    targets = np.where(
        np.isfinite(equations.centres), equations.mounts[..., :3, 3], np.nan
    )  # of samples that saw something
    rows, right = _linear(equations, targets)
    k, n = right.shape[:2]
    of_rotation = np.einsum("ij,knl->knijl", np.eye(3), np.broadcast_to(centres, (k, n, 3)))
    of_rotation = of_rotation.reshape(k, n, 3, 9) * np.isfinite(right)[..., None]
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
