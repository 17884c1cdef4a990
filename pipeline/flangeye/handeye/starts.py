"""Where the search for the most likely unknowns begins: closed forms, for every configuration."""

from __future__ import annotations

import numpy as np

from flangeye.errors import CalibrationRefused
from flangeye.handeye.closed.comanipulation import (
    alternate,
    random_rotations,
    with_translations,
)
from flangeye.handeye.closed.motions import motions_of, place_of
from flangeye.handeye.closed.separable import park_martin
from flangeye.handeye.measurements import Loop, Measurements
from flangeye.handeye.unknowns import Unknowns
from flangeye.maths.geometry import (
    basis_of_plane,
    invert,
    kabsch,
    nearest_rotation,
    rigid,
    stack_rows,
)
from flangeye.types import Floats

GOOD_ENOUGH = np.radians(1.0)
"""Rotations of two arms that agree to this [rad rms] are not looked for from another start."""
RESTARTS = 20
ROUNDS = 200
"""Steps of each further search; slower than that it is at the wrong place."""
DRAWS, DRAWN = 60, 8
"""Sets of poses that a target's size is told from, and the poses of each."""
SIZES = 0.01, 100.0
"""No target is so many times as large as was said."""


def fewest(measurements: Measurements, loop: Loop) -> int:
    """Return how many measurements a start needs."""
    if measurements.are_poses:
        return 6 if loop.y and loop.z else 3
    if not (loop.y or loop.z):
        return 3
    normals = measurements.have_normals
    return (5 if normals else 8) if loop.y else (4 if normals else 6)


def start_of(
    measurements: Measurements, loop: Loop, rng: np.random.Generator, restarts: int = RESTARTS
) -> Unknowns:
    """Return unknowns near the answer, were there no outliers.

    Args:
        measurements: What was seen.
        loop: What is unknown.
        rng: Draws the starts of what has no closed form.
        restarts: How many more of those, while none is good.

    Raises:
        CalibrationRefused: The configuration cannot be solved from such features.
    """
    return Unknowns.of_loop(*_start(measurements, loop, rng, restarts))


def size_of(measurements: Measurements, loop: Loop, rng: np.random.Generator) -> float:
    """Return how many times as large as was said the target of whole poses is, about; else 1.

    Rotations do not depend on it, and once they are known the loop's translations are linear in the
    places and the size (Andreff et al. 2001). Of small sets of poses that is taken which explains
    the better half of all poses best.
    """
    n, least, size = len(measurements), np.inf, 1.0
    for _ in range(DRAWS):
        chosen = rng.choice(n, min(DRAWN, n), replace=False)
        try:
            at = start_of(measurements.where(chosen), loop, rng, restarts=0)
        except (np.linalg.LinAlgError, CalibrationRefused):
            continue
        equations, wanted = _sized_translations(measurements, loop, at)
        found = np.linalg.lstsq(stack_rows(equations[chosen]), wanted[chosen].ravel(), rcond=None)[
            0
        ]
        median = float(np.median(np.linalg.norm(equations @ found - wanted, axis=1)))
        if median < least and SIZES[0] < found[-1] < SIZES[1]:
            least, size = median, float(found[-1])
    return size


def _sized_translations(
    measurements: Measurements, loop: Loop, at: Unknowns
) -> tuple[Floats, Floats]:
    """Return (N, 3, k + 1) equations of the unknown places, then the size, and (N, 3) their sides.

    Of the loop ``a x s = y b z``, whose s has its translation so many times as long.
    """
    a, b, n = measurements.a, measurements.b, len(measurements)
    turned_y = at.y[:3, :3] @ b[:, :3, :3]
    wanted = b[:, :3, 3] @ at.y[:3, :3].T - a[:, :3, 3]
    columns = [a[:, :3, :3]]
    if loop.y:
        columns.append(np.broadcast_to(-np.eye(3), (n, 3, 3)))
    else:
        wanted = wanted + at.y[:3, 3]
    if loop.z:
        columns.append(-turned_y)
    else:
        wanted = wanted + turned_y @ at.z[:3, 3]
    seen = a[:, :3, :3] @ (measurements.centres @ at.x[:3, :3].T)[..., None]
    return np.concatenate([*columns, seen], axis=2), wanted


def _start(
    measurements: Measurements, loop: Loop, rng: np.random.Generator, restarts: int
) -> tuple[Floats, Floats, Floats]:
    identity = np.eye(4)
    if not (loop.y or loop.z):
        return _of_camera(measurements, loop), identity, loop.place
    if loop.y and loop.z:
        return _of_two_arms(measurements, rng, restarts)
    if not measurements.are_poses:
        return _linear(measurements, loop)
    if loop.z:
        carried = invert(measurements.b) @ measurements.a
        x = park_martin(motions_of(carried, measurements.poses))
        return x, identity, place_of(carried, x, measurements.poses)
    seen = measurements.poses @ invert(measurements.b @ loop.place)
    x = park_martin(motions_of(measurements.a, seen))
    return x, place_of(measurements.a, x, seen), loop.place


def _of_camera(measurements: Measurements, loop: Loop) -> Floats:
    """Return X alone: the centres onto where the target is, in the camera's carrier."""
    in_target = measurements.offsets @ loop.place[:3, :3].T + loop.place[:3, 3]
    carried = invert(measurements.a) @ measurements.b
    known = (carried[:, :3, :3] @ in_target[..., None])[..., 0] + carried[:, :3, 3]
    return rigid(*kabsch(measurements.centres, known))


def _of_two_arms(
    measurements: Measurements, rng: np.random.Generator, restarts: int
) -> tuple[Floats, Floats, Floats]:
    """Return X, Y and Z: rotations by alternation from random starts, until one agrees."""
    if not measurements.are_poses:
        raise CalibrationRefused(
            "two arms and a circle whose place is not known cannot be solved: give its place, "
            "which for the flange's own circle is known, or use a marker"
        )
    given = measurements.a, measurements.poses, measurements.b
    rotations = given[0][:, :3, :3], given[1][:, :3, :3], given[2][:, :3, :3]
    best, error = alternate(rotations, random_rotations(rng))
    for _ in range(restarts):
        if error < GOOD_ENOUGH:
            break
        again, its = alternate(rotations, random_rotations(rng), rounds=ROUNDS)
        if its < error:
            best, error = again, its
    return with_translations(given, best)


def _linear(measurements: Measurements, loop: Loop) -> tuple[Floats, Floats, Floats]:
    """Return the unknowns of centres, and normals where all have one, by linear least squares.

    ``R_A (R_X c + t_X) + t_A`` is the target's centre f in the base, or where the second arm has
    it: ``R_Y p + t_Y``. Linear in the entries of R_X, t_X and of f or R_Y, t_Y; the rotations are
    then made orthonormal and the translations fitted again.
    """
    rows, right = _centre_rows(measurements, loop)
    if measurements.have_normals:
        extra = _normal_rows(measurements, loop)
        rows, right = np.vstack([rows, extra]), np.append(right, np.zeros(len(extra)))
    found = _least_squares(rows, right)
    of_x, of_y = nearest_rotation(found[:9].reshape(3, 3)), np.eye(3)
    if loop.y:
        of_y = nearest_rotation(found[12:21].reshape(3, 3))
    return _with_shifts(measurements, loop, (of_x, of_y), found)


def _centre_rows(s: Measurements, loop: Loop) -> tuple[Floats, Floats]:
    """Return rows and right side; unknowns R_X, t_X, then R_Y, t_Y or f and the axis."""
    n, a = len(s), s.a[:, :3, :3]
    rows = np.zeros((n, 3, 24))
    rows[:, :, :9] = np.einsum("nij,nk->nijk", a, s.centres).reshape(n, 3, 9)
    rows[:, :, 9:12] = a
    if loop.y:
        rows[:, :, 12:21] = -np.einsum("ij,nk->nijk", np.eye(3), _targets(s, loop)).reshape(n, 3, 9)
        rows[:, :, 21:] = -np.eye(3)
        return stack_rows(rows), -s.a[:, :3, 3].ravel()
    rows[:, :, 12:15] = -s.b[:, :3, :3]
    return stack_rows(rows), (s.b[:, :3, 3] - s.a[:, :3, 3]).ravel()


def _normal_rows(s: Measurements, loop: Loop) -> Floats:
    """Return rows that say where normals point: right side zero."""
    n, normals = len(s), s.rotations[:, :, 2]
    rows = np.zeros((n, 3, 24))
    rows[:, :, :9] = np.einsum("nij,nk->nijk", s.a[:, :3, :3], normals).reshape(n, 3, 9)
    if loop.y:
        axes = (s.b[:, :3, :3] @ loop.place[:3, 2, None])[..., 0]
        rows[:, :, 12:21] = -np.einsum("ij,nk->nijk", np.eye(3), axes).reshape(n, 3, 9)
    else:
        rows[:, :, 15:18] = -s.b[:, :3, :3]
    return stack_rows(rows)


def _targets(s: Measurements, loop: Loop) -> Floats:
    """Return the (N, 3) centres in the base of the arm that carries the target."""
    in_carrier = s.offsets @ loop.place[:3, :3].T + loop.place[:3, 3]
    return np.asarray((s.b[:, :3, :3] @ in_carrier[..., None])[..., 0] + s.b[:, :3, 3])


def _with_shifts(
    s: Measurements, loop: Loop, rotations: tuple[Floats, Floats], found: Floats
) -> tuple[Floats, Floats, Floats]:
    """Return X, Y, Z with the translations that fit their rotations."""
    of_x, of_y = rotations
    rows, right = _centre_rows(s, loop)
    known = np.zeros(24)
    known[:9] = of_x.ravel()
    if loop.y:
        known[12:21] = of_y.ravel()
    shifts = [9, 10, 11, 21, 22, 23] if loop.y else [9, 10, 11, 12, 13, 14]
    moved = _least_squares(rows[:, shifts], right - rows @ known)
    x = rigid(of_x, moved[:3])
    if loop.y:
        return x, rigid(of_y, moved[3:]), loop.place
    axis = found[15:18] if s.have_normals else np.array([0.0, 0.0, 1.0])
    return x, np.eye(4), rigid(_facing(axis), moved[3:])


def _least_squares(rows: Floats, right: Floats) -> Floats:
    return np.asarray(np.linalg.lstsq(rows, right, rcond=None)[0], dtype=np.float64)


def _facing(axis: Floats) -> Floats:
    """Return a rotation (3, 3) whose z is along an axis."""
    return basis_of_plane(axis).T
