"""Plan a seam along a V-groove that is found in the scan, without CAD."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from pydantic import Field

from flangeye import CalibrationRefused, StageError, stage
from flangeye.maths.seam_geometry import distances_to_line
from flangeye.models.robots import RobotModel
from flangeye.models.scanners import ScannerModel
from flangeye.types import Box, Floats, Seam, Seed, VerifiedHandEye, WorkpieceScan
from flangeye.units import Length, param
from flangeye_plugins.seam.planned import (
    SeamParams,
    answer_for,
    cloud_around,
    for_the_controller,
    refuse_outside,
)
from flangeye_plugins.seam.plates import CELL, Hollow, hollows
from flangeye_plugins.seam.points import facing_camera, thinned
from flangeye_plugins.seam.sections import Root, trace
from flangeye_plugins.seam.stitched import PlacedScan, seen_in_base

STAGE = "seam.groove"
SEED = 13
"""Tells this use of the recipe's seed from others."""
UNSHARED = 0.4
"""Of the sections' scatter, what does not average out along the groove: points are taken for a
wall by their own height, which leans it a little. Monte Carlo finds 0.4 (tests/plugins/seam)."""
FEWEST = 1000


class GrooveParams(SeamParams):
    """Parameters of ``seam.groove``."""

    near: tuple[Length, Length, Length] | None = Field(
        None, description="Point in base; of several grooves the nearest to it is used."
    )
    backwards: bool = Field(
        False, description="Start at the end farther from the robot's base instead of the nearer."
    )
    max_width: Length = param(
        "30 mm", gt=0, description="Largest width of the groove at its shoulders."
    )
    max_depth: Length = param(
        "25 mm", gt=0, description="Largest depth of the root below the face."
    )
    min_length: Length = param("40 mm", gt=0, description="Smallest length of the groove.")
    max_residual: Length = param(
        "0.5 mm",
        gt=0,
        description="Largest distance of the cross-sections' roots from a smooth line, rms.",
    )
    max_apart: Length = param(
        "1 mm",
        gt=0,
        description="Largest distance of clouds from neighbouring places where both show the same "
        "face, median.",
    )
    distinct: float = Field(
        0.7, gt=0, lt=1, description="A groove longer than this share of the longest is its equal."
    )


@dataclass(frozen=True, eq=False)
class Groove:
    """A groove that was found: its root, and the same in ``base``."""

    hollow: Hollow
    root: Root
    in_base: Floats

    @property
    def length(self) -> float:
        """Along the root [m]."""
        return float(np.linalg.norm(np.diff(self.root.points, axis=0), axis=1).sum())


@stage("seam.groove")
def seam_groove(  # noqa: PLR0913  what it asks the runner for
    calibration: VerifiedHandEye,
    scan: WorkpieceScan,
    seed: Seed,
    params: GrooveParams,
    workspace: Box | None = None,
    scanner: ScannerModel | None = None,
    robot: RobotModel | None = None,
) -> Seam:
    """Find a V-groove in a flat face and map its root into the base.

    A groove is a narrow hollow with the face on both of its sides. Its root is where two lines
    meet, one through each wall, in sections across it; a smooth line through the sections is the
    seam, straight or curved.

    Figures [m]: ``residual`` of the sections from that line, rms; ``registration``, the largest
    standard deviation of the line in the scan; ``sections``, the share that showed two walls; of a
    scan from several places ``apart``, the largest median distance of neighbouring clouds.

    Raises:
        StageError: The scan is empty.
        CalibrationRefused: There is no groove, or several as good, or it is rough, or outside the
            workspace; or clouds of several places do not agree.
    """
    if (count := len(scan.cloud.points())) < FEWEST:
        raise StageError(f"{STAGE}: the scan has {count} points; {FEWEST} are needed")
    answer = answer_for(STAGE, calibration, params)
    seen = seen_in_base(STAGE, scan, answer, robot)
    _refuse_apart(seen, params)
    groove = _chosen(_grooves(seen, params, seed), params)
    root, face = groove.root, groove.hollow.face
    order = slice(None, None, -1 if _starts_far(groove) != params.backwards else 1)
    line = face.camera(root.points)[order]
    covariances = (face.axes.T @ root.covariance @ face.axes)[order]
    covariances = covariances + (UNSHARED * root.residual) ** 2 * np.eye(3)
    deviation = float(np.sqrt(np.linalg.eigvalsh(covariances).max()))
    covariances = covariances + seen.of_scanner(line, scanner)
    mapped, covariance = seen.in_base(line, covariances)
    refuse_outside(STAGE, mapped, workspace)
    opening = seen.base_T_camera.rotation @ face.axes[2]
    seam = Seam(
        mapped,
        np.tile(opening, (len(mapped), 1)),
        covariance,
        half_angle=root.half_angle,
        half_width=root.half_width,
        source=f"V-groove in {scan.source}",
        figures=_figures(root, deviation, seen),
        cloud=cloud_around(seen.points, line, seen.base_T_camera),
    )
    return for_the_controller(seam, answer, robot, params)


def _refuse_apart(seen: PlacedScan, params: GrooveParams) -> None:
    """Refuse clouds of several places that do not agree where they show the same face."""
    if seen.apart is not None and seen.apart > params.max_apart:
        raise CalibrationRefused(
            f"{STAGE}: neighbouring clouds are {seen.apart * 1e3:.2f} mm apart where both show the "
            f"same face, limit {params.max_apart * 1e3:g} mm (max_apart); calibrate the scanner on "
            "the flange again"
        )


def _figures(root: Root, deviation: float, seen: PlacedScan) -> dict[str, float]:
    figures = {"residual": root.residual, "registration": deviation, "sections": root.share}
    return figures if seen.apart is None else {**figures, "apart": seen.apart}


def _grooves(seen: PlacedScan, params: GrooveParams, seed: int) -> list[Groove]:
    """Return the V-grooves of the scan that are long enough, the longest first."""
    points = seen.points
    rng = np.random.default_rng([SEED, seed])
    scan = facing_camera(thinned(points, CELL))
    found = []
    for hollow in hollows(scan, params.max_width, params.max_depth, rng):
        local = hollow.face.local(points)
        low, high = hollow.line.min(axis=0) - params.max_width, hollow.line.max(axis=0)
        around = ((local[:, :2] > low) & (local[:, :2] < high + params.max_width)).all(axis=1)
        around &= (local[:, 2] > -params.max_depth) & (local[:, 2] < 1e-3)
        root = trace(hollow, local[around], params.max_width, params.spacing)
        if root is not None:
            in_camera = hollow.face.camera(root.points)
            mapped = seen.base_T_camera.apply(in_camera)
            found.append(Groove(hollow, root, mapped))
    long = [groove for groove in found if groove.length >= params.min_length]
    return _distinct(sorted(long, key=lambda groove: -groove.length), params.max_width / 2)


def _distinct(grooves: list[Groove], apart: float) -> list[Groove]:
    """Return the grooves without those that another plane of the same face has found again."""
    kept: list[Groove] = []
    for groove in grooves:
        away = [distances_to_line(groove.in_base, other.in_base) for other in kept]
        if all(np.median(each) > apart for each in away):
            kept.append(groove)
    return kept


def _chosen(grooves: list[Groove], params: GrooveParams) -> Groove:
    if not grooves:
        raise CalibrationRefused(
            f"{STAGE}: no V-groove: no hollow up to {params.max_width * 1e3:g} mm wide and "
            f"{params.max_depth * 1e3:g} mm deep, with two walls and a flat face on both sides, is "
            f"{params.min_length * 1e3:g} mm long (max_width, max_depth, min_length)"
        )
    if params.near is not None:
        at = np.asarray(params.near)
        return min(grooves, key=lambda g: float(np.linalg.norm(g.in_base - at, axis=1).min()))
    equals = [g for g in grooves if g.length > params.distinct * grooves[0].length]
    if len(equals) > 1:
        listed = "; ".join(f"{g.length * 1e3:.0f} mm long at ({_mm(g)}) mm" for g in equals)
        raise CalibrationRefused(
            f"{STAGE}: ambiguous: {len(equals)} V-grooves are as good: {listed} in base; say which "
            "with near:"
        )
    return _not_rough(grooves[0], params)


def _not_rough(groove: Groove, params: GrooveParams) -> Groove:
    if groove.root.residual > params.max_residual:
        raise CalibrationRefused(
            f"{STAGE}: poor fit: the roots of the cross-sections are "
            f"{groove.root.residual * 1e3:.2f} mm rms from a smooth line, limit "
            f"{params.max_residual * 1e3:g} mm (max_residual)"
        )
    return groove


def _mm(groove: Groove) -> str:
    return ", ".join(f"{1e3 * x:.0f}" for x in groove.in_base[len(groove.in_base) // 2])


def _starts_far(groove: Groove) -> bool:
    """Return whether the first point is further from the robot's base than the last."""
    first, last = np.linalg.norm(groove.in_base[[0, -1]], axis=1)
    return bool(first > last)
