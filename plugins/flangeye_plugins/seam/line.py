"""``seam.line``: take a seam from a file of taught points, a table, a drawing or a CAD's edge."""

from pathlib import Path

import numpy as np

from flangeye import StageError, stage
from flangeye.files.clouds import PER_METRE, FileUnit
from flangeye.files.drawings import read_dxf
from flangeye.files.paths import RecipeFile
from flangeye.files.tables import read_table
from flangeye.maths.seam_geometry import chained, distances_to_line, sharp_edges
from flangeye.models.robots import RobotModel
from flangeye.models.workpiece import MESHES, STEP_SUFFIXES, read_mesh
from flangeye.plugin.stage import PlaceParams
from flangeye.types import Box, Floats, Seam, VerifiedHandEye
from flangeye.units import Angle, Length, param
from flangeye_plugins.seam.planned import (
    SPACING,
    SeamParams,
    answer_for,
    for_the_controller,
    refuse_outside,
    resampled,
)

STAGE = "seam.line"


class LineParams(SeamParams, PlaceParams):
    """Parameters of ``seam.line``; ``position`` and ``rpy`` are the file's frame in the base."""

    path: RecipeFile
    """Points or taught poses in order (CSV, YAML, JSON), a drawing (DXF), or CAD whose sharp edges
    are lines (STL, PLY, OBJ, STEP)."""
    unit: FileUnit
    """Unit of the coordinates."""
    near: tuple[Length, Length, Length] | None = None
    """Point in the file's frame; of several lines the nearest to it is used."""
    angle: Angle = param("30 deg", gt=0)
    """CAD: smallest bend of a sharp edge."""
    opening: tuple[float, float, float] = (0.0, 0.0, 1.0)
    """Direction out of the work towards the torch, in the file's frame."""
    deviation: Length = param("3 mm", gt=0)
    """Standard deviation of the line across it, in the base."""


@stage(STAGE)
def seam_line(
    calibration: VerifiedHandEye,
    params: LineParams,
    workspace: Box | None = None,
    robot: RobotModel | None = None,
) -> Seam:
    """Take a seam from a file, to be welded as it is or to serve as rough line of ``seam.joint``.

    Raises:
        StageError: The file cannot be read, has no line, or has several lines but ``near`` is not
            set.
        CalibrationRefused: The seam leaves the workspace.
    """
    pose = params.matrix
    points = resampled(_line(params), SPACING) @ pose[:3, :3].T + pose[:3, 3]
    opening = pose[:3, :3] @ np.asarray(params.opening)
    if not np.linalg.norm(opening) > 0:
        raise StageError(f"{STAGE}: opening has no direction")
    refuse_outside(STAGE, points, workspace)
    covariance = params.deviation**2 * np.eye(3)
    seam = Seam(
        points,
        np.tile(opening / np.linalg.norm(opening), (len(points), 1)),
        np.tile(covariance, (len(points), 1, 1)),
        source=f"line of {params.path.name}",
    )
    return for_the_controller(seam, answer_for(STAGE, calibration, params), robot, params)


def _line(params: LineParams) -> Floats:
    """Return the line (N, 3) in the file's frame [m]."""
    lines = _lines(params.path, params.unit, params.angle)
    if not lines:
        raise StageError(f"{params.path}: holds no line; two points at least are needed")
    if params.near is None and len(lines) > 1:
        raise StageError(f"{params.path}: holds {len(lines)} lines; say which with near:")
    at = np.array([params.near or (0.0, 0.0, 0.0)])
    return min(lines, key=lambda line: float(distances_to_line(at, line)[0]))


def _lines(path: Path, unit: FileUnit, angle: float) -> list[Floats]:
    """Return all lines (N, 3) of a file [m]."""
    suffix = path.suffix.lower()
    tables = (".csv", ".txt", ".yaml", ".yml", ".json")
    if suffix in tables:
        points = _points(path, unit) / PER_METRE[unit]
        moved = np.linalg.norm(np.diff(points, axis=0), axis=1) > 0
        points = points[np.append(True, moved)] if len(points) else points
        return [points] if len(points) > 1 else []
    meet = 1e-6  # ends this near to each other meet [m]
    if suffix == ".dxf":
        pieces, said = read_dxf(path)
        if said not in (None, unit):
            raise StageError(
                f"{path}: states the unit {said} ($INSUNITS), the recipe states unit: {unit}"
            )
        return chained(pieces / PER_METRE[unit], meet)
    if suffix in MESHES:
        # STEP comes in metres, whatever the drawing was in
        vertices, triangles = read_mesh(path)
        scale = 1.0 if suffix in STEP_SUFFIXES else PER_METRE[unit]
        return chained(sharp_edges(vertices / scale, triangles, angle), meet)
    known = ", ".join((*tables, ".dxf", *MESHES))
    raise StageError(f"{path}: '{path.suffix}' holds no line; known: {known}")


def _points(path: Path, unit: FileUnit) -> Floats:
    """Return the points (N, 3) of a table or of a list of poses, in the file's unit.

    They are the columns x, y, z or x_mm, y_mm, z_mm, the positions of poses in YAML or JSON, or the
    first three columns.
    """
    table = read_table(path.parent, path.name)
    if not table.rows:
        return np.zeros((0, 3))
    suffixed = tuple(f"{axis}_{unit}" for axis in "xyz")
    names: tuple[str | int, ...] = suffixed if suffixed[0] in table.heading else ("x", "y", "z")
    if any(name.startswith("position.") for name in table.heading):
        names = ("position",)
    points = table.numbers(table.indices(names if table.heading else (1, 2, 3)))
    if points.shape[1:] != (3,) or not np.isfinite(points).all():
        raise StageError(f"{path}: holds positions that are not three finite numbers")
    return points
