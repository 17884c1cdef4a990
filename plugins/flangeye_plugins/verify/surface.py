"""The flange's shape as points with normals: from its dimensions, or from a CAD cloud."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flangeye import StageError
from flangeye.files.clouds import LengthUnit, read_cloud
from flangeye.models.targets import Flange
from flangeye.types import Floats

FEWEST_POINTS = 100


@dataclass(frozen=True, eq=False)
class Surface:
    """A sampled surface in ``flange``.

    Attributes:
        points: (N, 3) [m].
        normals: (N, 3) unit normals.
    """

    points: Floats
    normals: Floats

    @cached_property
    def tree(self) -> Any:
        """Finds nearest points; built once, for solvers compare many candidates."""
        from scipy.spatial import cKDTree

        return cKDTree(self.points)


@lru_cache(maxsize=8)
def surface_of(flange: Flange, spacing: float = 0.5e-3) -> Surface:
    """Sample what a scanner can see of a flange: face, chamfers, walls, bore, wrist behind it.

    Args:
        flange: The plate as this robot has it.
        spacing: Distance between neighbouring points [m].
    """
    rings = [
        _ring(start, end, spacing)
        for start, end in zip(_profile(flange)[:-1], _profile(flange)[1:], strict=True)
    ]
    points = np.concatenate([ring[0] for ring in rings])
    normals = np.concatenate([ring[1] for ring in rings])
    drilled = _in_a_hole(points, flange)
    return Surface(points[~drilled], normals[~drilled])


def _profile(flange: Flange) -> list[tuple[float, float]]:
    """Return (radius, height) of the outline's corners, from the wrist's edge to the axis."""
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
    """Sample the surface that a line from ``start`` to ``end`` (radius, height) sweeps."""
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
    """Return which (N, 3) points of the face are drilled away."""
    holes = [(angle, flange.hole) for angle in flange.holes]
    holes += [(flange.pin, flange.pin_hole)] if flange.pin is not None else []
    drilled = np.zeros(len(points), dtype=bool)
    for angle, radius in holes:
        centre = flange.pitch * np.array([np.cos(angle), np.sin(angle)])
        drilled |= np.linalg.norm(points[:, :2] - centre, axis=1) < radius
    return np.asarray(drilled & (points[:, 2] == 0.0))


def read_surface(path: Path, unit: LengthUnit, rotation: Floats, offset: Floats) -> Surface:
    """Read a CAD cloud and express it in ``flange``; normals come from the nearest neighbours.

    Args:
        path: A file that :func:`flangeye.files.clouds.read_cloud` reads.
        unit: Unit of its coordinates.
        rotation: (3, 3) flange_R_cad.
        offset: (3,) origin of the CAD frame in ``flange`` [m].

    Raises:
        StageError: The file is no cloud, or too small.
    """
    xyz = read_cloud(path, unit).points().astype(np.float64)
    if len(xyz) < FEWEST_POINTS:
        raise StageError(f"{path}: {len(xyz)} points; a flange needs {FEWEST_POINTS} or more")
    points = xyz @ rotation.T + offset
    return Surface(points, _normals(points))


def _normals(points: Floats, neighbours: int = 12) -> Floats:
    """Return the (N, 3) directions in which the neighbourhood of each point is thinnest."""
    from scipy.spatial import cKDTree

    near = points[cKDTree(points).query(points, k=neighbours)[1]]
    centred = near - near.mean(axis=1, keepdims=True)
    return np.asarray(np.linalg.eigh(np.einsum("nki,nkj->nij", centred, centred))[1][:, :, 0])
