"""Point-to-plane ICP of a measured flange against its shape. Arrays only.

Not open3d's: its sums depend on the number of threads, and it gives some rotation about the
axis of a round plate, about which the plate says nothing. Here such a motion stays zero.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from flangeye.maths.geometry import rigid, rotation_exp
from flangeye.maths.statistics import rms
from flangeye.types import Floats
from flangeye_plugins.verify.surface import Surface

SIZE = 0.03
"""Radius of a flange [m]: brings rotations and translations to one scale."""
ITERATIONS = 200
STILL = 5e-6
"""Converged when no point moves further than this in one iteration [m]; near the end matches may
go on changing to and fro between neighbours, a micrometre each time. Before the last limit a
tenth of a millimetre is enough."""


@dataclass(frozen=True)
class Registration:
    """The result of an ICP that converged.

    Attributes:
        motion: (4, 4) that takes the measured points onto the surface.
        rms: Distance of the matched points from the surface afterwards [m].
        overlap: Share of the measured points that matched.
        roll_seen: Whether rotation about the plate's axis was determined.
    """

    motion: Floats
    rms: float
    overlap: float
    roll_seen: bool


def register(
    measured: Floats, surface: Surface, reach: float, distance: float
) -> Registration | str:
    """Move (N, 3) measured points onto a surface, both roughly in ``flange``, or say why not.

    Chen & Medioni (1992). Points further from the surface than a limit are left out; the limit
    falls from ``reach`` to ``distance`` by halves, and ICP converges at each.

    It fails when it does not converge, when less than half of the points match in the end, or
    when the matched points leave more than rotation about the axis undetermined.

    Args:
        measured: (N, 3) [m].
        surface: The plate, its axis along z through the origin.
        reach: First limit: how far off the calibration may be [m].
        distance: Last limit: what noise and other objects set it to [m].
    """
    source = measured[:: 1 + len(measured) // 6000]
    motion = np.eye(4)
    for limit in _limits(reach, distance):
        still = STILL if limit == distance else 20 * STILL
        converged = _converge(source, surface, motion, limit, still)
        if isinstance(converged, str):
            return converged
        motion, unknown = converged
    return _judge(source, surface, motion, unknown, distance)


def _limits(reach: float, distance: float) -> list[float]:
    halvings = max(0, int(np.ceil(np.log2(reach / distance))))
    return [max(distance, reach / 2**k) for k in range(halvings + 1)]


def _converge(
    source: Floats, surface: Surface, motion: Floats, limit: float, still: float
) -> tuple[Floats, Floats] | str:
    """Iterate at one limit; return the motion and the directions (k, 6) it says nothing about."""
    for _ in range(ITERATIONS):
        jacobian, distances = _equations(source, surface, motion, limit)
        if len(distances) < 6:
            return f"no points came within {limit * 1e3:g} mm of the flange's shape"
        step, unknown = _least_squares(jacobian, distances)
        motion = rigid(rotation_exp(step[:3]), step[3:]) @ motion
        if np.abs(step[:3]).max() * SIZE + np.abs(step[3:]).max() < still:
            return motion, unknown
    return f"no convergence in {ITERATIONS} iterations"


def _equations(
    source: Floats, surface: Surface, motion: Floats, limit: float
) -> tuple[Floats, Floats]:
    """Return the (K, 6) Jacobian in (rotation, translation) and (K,) point-to-plane distances."""
    moved = source @ motion[:3, :3].T + motion[:3, 3]
    gap, nearest = surface.tree.query(moved, distance_upper_bound=limit)
    matched = np.isfinite(gap)
    moved, nearest = moved[matched], nearest[matched]
    normals = surface.normals[nearest]
    distances = np.einsum("ni,ni->n", normals, moved - surface.points[nearest])
    return np.hstack([np.cross(moved, normals), normals]), distances


def _least_squares(jacobian: Floats, distances: Floats) -> tuple[Floats, Floats]:
    """Return the (6,) step, zero along the (k, 6) directions that are not determined."""
    scale = np.array([SIZE] * 3 + [1.0] * 3)
    scaled = jacobian / scale
    values, vectors = np.linalg.eigh(scaled.T @ scaled / len(distances))
    # A motion is determined when it changes the distances by 3 % of itself or more, rms. Turning
    # the published Aubo flange, of which five holes show, does by 8 %; normals that were estimated
    # near edges fake 1 % on a plate without holes
    known = values > 1e-3
    gradient = vectors[:, known].T @ (scaled.T @ distances / len(distances))
    step = -vectors[:, known] @ (gradient / values[known])
    return step / scale, np.asarray(vectors[:, ~known].T)


def _judge(
    source: Floats, surface: Surface, motion: Floats, unknown: Floats, distance: float
) -> Registration | str:
    about_axis = unknown[:, 2] ** 2
    if len(unknown) > 1 or (about_axis < 0.5).any():
        return "the matched points are too flat to tell a shift along the face"
    distances = _equations(source, surface, motion, distance)[1]
    overlap = len(distances) / len(source)
    if overlap < 0.5:
        return (
            f"{overlap:.0%} of the points came within {distance * 1e3:g} mm of the flange's shape"
        )
    return Registration(motion, rms(distances), overlap, len(unknown) == 0)
