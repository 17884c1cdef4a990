"""The flange's shape, and point-to-plane ICP of a measured flange against it.

Open3D's ICP is not used, because its result depends on the number of threads and contains an
arbitrary rotation about the axis of a round plate, which is not observable. Here such a motion
stays zero.
"""

from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flangeye import StageError
from flangeye.files.clouds import FileUnit, read_cloud
from flangeye.maths.statistics import rms
from flangeye.models.targets import Flange
from flangeye.types import Floats
from flangeye.types.geometry import rigid, rotation_exp


@dataclass(frozen=True, eq=False)
class SampledSurface:
    """A sampled surface in ``flange``.

    Attributes:
        points: (N, 3) positions [m].
        normals: (N, 3) unit normals.
    """

    points: Floats
    normals: Floats

    @cached_property
    def tree(self) -> Any:
        """Search tree for nearest points; built once, because solvers compare many candidates."""
        from scipy.spatial import cKDTree

        return cKDTree(self.points)


@lru_cache(maxsize=8)
def surface_of(flange: Flange, spacing: float = 0.5e-3) -> SampledSurface:
    """Return samples of a flange's visible surface: face, chamfers, walls, bore, wrist behind it.

    Args:
        flange: The flange plate.
        spacing: Distance between neighbouring points [m].
    """
    rings = [
        _ring(start, end, spacing)
        for start, end in zip(_profile(flange)[:-1], _profile(flange)[1:], strict=True)
    ]
    points = np.concatenate([ring[0] for ring in rings])
    normals = np.concatenate([ring[1] for ring in rings])
    drilled = _in_a_hole(points, flange)
    return SampledSurface(points[~drilled], normals[~drilled])


def _profile(flange: Flange) -> list[tuple[float, float]]:
    """Return the profile's corners (radius, height), from the wrist's edge to the axis."""
    if flange.bore is None:  # a wrist circle: nothing is known but its disc
        return [(flange.rim, 0.0), (0.0, 0.0)]
    details = flange.details
    rim_chamfer, bore_chamfer = flange.outer - flange.rim, details.bore_chamfer
    bottom, behind = -details.bore_depth, -details.thickness
    return [
        (max(details.wrist / 2, flange.outer), behind),
        (flange.outer, behind),
        (flange.outer, -rim_chamfer),
        (flange.rim, 0.0),
        (flange.bore, 0.0),
        (flange.bore - bore_chamfer, -bore_chamfer),
        (flange.bore - bore_chamfer, bottom),
        (0.0, bottom),
    ]


def _ring(
    start: tuple[float, float], end: tuple[float, float], spacing: float
) -> tuple[Floats, Floats]:
    """Return samples of the surface of revolution of a line between two (radius, height)."""
    first, last = np.array(start), np.array(end)
    length = float(np.linalg.norm(last - first))
    steps = int(np.ceil(length / spacing))
    if steps == 0:
        return np.zeros((0, 3)), np.zeros((0, 3))
    along = (last - first) / length
    across = np.array([along[1], -along[0]])  # outwards, walking from the wrist to the axis
    points, normals = [], []
    for radius, height in first + (np.arange(steps)[:, None] + 0.5) / steps * (last - first):
        angles = np.arange(0.0, 2 * np.pi, spacing / max(radius, spacing))
        around = np.stack([np.cos(angles), np.sin(angles)], axis=1)
        points.append(np.column_stack([radius * around, np.full(len(angles), height)]))
        normals.append(np.column_stack([across[0] * around, np.full(len(angles), across[1])]))
    return np.concatenate(points), np.concatenate(normals)


def _in_a_hole(points: Floats, flange: Flange) -> NDArray[np.bool_]:
    """Return the mask of points (N, 3) of the face that are inside a hole."""
    holes = [(angle, flange.hole) for angle in flange.holes]
    holes += [(flange.pin, flange.pin_hole)] if flange.pin is not None else []
    drilled = np.zeros(len(points), dtype=bool)
    for angle, radius in holes:
        centre = flange.pitch * np.array([np.cos(angle), np.sin(angle)])
        drilled |= np.linalg.norm(points[:, :2] - centre, axis=1) < radius
    return np.asarray(drilled & (points[:, 2] == 0.0))


def read_surface(path: Path, unit: FileUnit, rotation: Floats, offset: Floats) -> SampledSurface:
    """Return a CAD cloud in ``flange``, with normals estimated from nearest neighbours.

    Args:
        path: A file that :func:`flangeye.files.clouds.read_cloud` reads.
        unit: Unit of its coordinates.
        rotation: (3, 3) ``flange_R_cad``.
        offset: (3,) origin of the CAD frame in ``flange`` [m].

    Raises:
        StageError: The file is not a cloud, or too small.
    """
    xyz = read_cloud(path, unit).points().astype(np.float64)
    fewest_points = 100
    if len(xyz) < fewest_points:
        raise StageError(f"{path}: {len(xyz)} points; a flange needs {fewest_points} or more")
    points = xyz @ rotation.T + offset
    return SampledSurface(points, _normals(points))


def _normals(points: Floats, neighbours: int = 12) -> Floats:
    """Return unit normals (N, 3): the direction of least variance around each point."""
    from scipy.spatial import cKDTree

    # A dozen neighbours average the CAD cloud's rounding and stay on one face of a plate.
    near = points[cKDTree(points).query(points, k=neighbours)[1]]
    centred = near - near.mean(axis=1, keepdims=True)
    return np.asarray(np.linalg.eigh(np.einsum("nki,nkj->nij", centred, centred))[1][:, :, 0])


FLANGE_RADIUS = 0.03
"""Radius of a flange [m]: brings rotations and translations to one scale."""
SMALLEST_STEP = 5e-6
"""Converged when no point moves further than this in one iteration [m]; near the end matches may
go on changing to and fro between neighbours, a micrometre each time. Before the last limit a
tenth of a millimetre is enough."""


@dataclass(frozen=True)
class Registration:
    """The result of an ICP that converged.

    Attributes:
        motion: (4, 4) motion of the measured points onto the surface.
        rms: Distance of the matched points from the surface after the motion, rms [m].
        overlap: Share of the measured points that matched.
        roll_seen: Whether the rotation about the plate's axis is observable.
    """

    motion: Floats
    rms: float
    overlap: float
    roll_seen: bool


def register(
    measured: Floats, surface: SampledSurface, reach: float, distance: float
) -> Registration | str:
    """Return the registration of measured points with a surface, or the reason for a failure.

    Point-to-plane ICP (Chen & Medioni 1992). Points farther from the surface than a limit are left
    out. The limit is halved from ``reach`` to ``distance``, and ICP converges at each value.

    It fails if it does not converge, if less than half of the points match at the end, or if more
    than the rotation about the axis is not observable.

    Args:
        measured: (N, 3) points, roughly in ``flange`` [m].
        surface: The plate's surface, with its axis along z through the origin.
        reach: First limit: largest error of the calibration [m].
        distance: Last limit, given by noise and other objects [m].
    """
    # 6,000 points suffice: the error of the motion falls with the square root of their number.
    source = measured[:: 1 + len(measured) // 6000]
    motion = np.eye(4)
    # Coarse to fine: a tight limit at the start would lose a plate that is off by more.
    for limit in _limits(reach, distance):
        still = SMALLEST_STEP if limit == distance else 20 * SMALLEST_STEP
        converged = _converge(source, surface, motion, limit, still)
        if isinstance(converged, str):
            return converged
        motion, unknown = converged
    return _judge(source, surface, motion, unknown, distance)


def _limits(reach: float, distance: float) -> list[float]:
    halvings = max(0, int(np.ceil(np.log2(reach / distance))))
    return [max(distance, reach / 2**k) for k in range(halvings + 1)]


def _converge(
    source: Floats, surface: SampledSurface, motion: Floats, limit: float, still: float
) -> tuple[Floats, Floats] | str:
    """Return the converged motion at one limit, and its unobservable directions (k, 6)."""
    iterations = 200
    for _ in range(iterations):
        jacobian, distances = _equations(source, surface, motion, limit)
        if len(distances) < 6:
            return f"no points came within {limit * 1e3:g} mm of the flange's shape"
        step, unknown = _least_squares(jacobian, distances)
        motion = rigid(rotation_exp(step[:3]), step[3:]) @ motion
        if np.abs(step[:3]).max() * FLANGE_RADIUS + np.abs(step[3:]).max() < still:
            return motion, unknown
    return f"no convergence in {iterations} iterations"


def _equations(
    source: Floats, surface: SampledSurface, motion: Floats, limit: float
) -> tuple[Floats, Floats]:
    """Return the Jacobian (K, 6) (rotation, translation), and point-to-plane distances (K,) [m]."""
    moved = source @ motion[:3, :3].T + motion[:3, 3]
    gap, nearest = surface.tree.query(moved, distance_upper_bound=limit)
    matched = np.isfinite(gap)
    moved, nearest = moved[matched], nearest[matched]
    normals = surface.normals[nearest]
    # Along the normal alone: points may slide on a plane, so this takes far fewer iterations than
    # point to point.
    distances = np.einsum("ni,ni->n", normals, moved - surface.points[nearest])
    # d/dphi of n . (phi x p) is p x n
    return np.hstack([np.cross(moved, normals), normals]), distances


def _least_squares(jacobian: Floats, distances: Floats) -> tuple[Floats, Floats]:
    """Return the step (6,), zero along unobservable directions, and these directions (k, 6)."""
    scale = np.array([FLANGE_RADIUS] * 3 + [1.0] * 3)
    scaled = jacobian / scale
    values, vectors = np.linalg.eigh(scaled.T @ scaled / len(distances))
    # A motion is determined when it changes the distances by 3 % of itself or more, rms. Turning
    # the published Aubo flange, of which five holes show, does by 8 %; normals that were estimated
    # near edges fake 1 % on a plate without holes
    known = values > 1e-3
    gradient = vectors[:, known].T @ (scaled.T @ distances / len(distances))
    # Only along determined directions: noise would turn a round plate about its axis for ever.
    step = -vectors[:, known] @ (gradient / values[known])
    return step / scale, np.asarray(vectors[:, ~known].T)


def _judge(
    source: Floats, surface: SampledSurface, motion: Floats, unknown: Floats, distance: float
) -> Registration | str:
    # The third number is the rotation about z, the plate's axis.
    about_axis = unknown[:, 2] ** 2
    if len(unknown) > 1 or (about_axis < 0.5).any():
        return "the matched points are too flat to show a shift along the face"
    distances = _equations(source, surface, motion, distance)[1]
    overlap = len(distances) / len(source)
    if overlap < 0.5:
        return (
            f"{overlap:.0%} of the points came within {distance * 1e3:g} mm of the flange's shape"
        )
    return Registration(motion, rms(distances), overlap, len(unknown) == 0)
