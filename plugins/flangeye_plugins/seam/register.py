"""Register a CAD to a scan: find the part, fit its pose, and reject poor or ambiguous fits."""

from dataclasses import dataclass

import numpy as np

from flangeye import CalibrationRefused, StageError
from flangeye.files.clouds import PER_METRE, FileUnit
from flangeye.maths.seam_geometry import distances_to_line
from flangeye.models.workpiece import CadSeam, Workpiece
from flangeye.types import Floats, Singles
from flangeye.types.geometry import invert, rotation_log
from flangeye_plugins.body.dense import BodyFit, fitted
from flangeye_plugins.body.looks import Looks
from flangeye_plugins.body.search import BodySearch, FoundPose, around

STAGE = "seam.cad"
LARGER, FEWEST_OF_PART = 3.0, 300
"""A part this many times larger than all of the scan, or with fewer points, has a wrong unit."""
SAME_SEAM = 1e-3
"""Poses whose seams differ by less than this count as the same [m]."""
AROUND = 0.05
"""Smallest reach of the surface around a seam that must be seen, as a share of the diagonal."""


@dataclass(frozen=True, eq=False)
class Registered:
    """A CAD part located in a scan, with the figures that show how well it fits.

    Attributes:
        fit: Pose ``camera_T_part`` and covariance.
        seen: Visible area, as a share of the part's area seen from its broadest side.
        refuted: Share of the surface in view that the scan contradicts, by measuring something
            behind it or a face that continues beyond the part's edge.
        second: Credit of the best pose with a different seam, over the credit of this pose.
    """

    fit: BodyFit
    seen: float
    refuted: float
    second: float


def register(
    points: Floats, workpiece: Workpiece, seam: CadSeam, max_residual: float
) -> Registered:
    """Register a CAD to a scan (N, 3) in ``camera``, without an initial guess.

    ``max_residual`` is the largest robust standard deviation of the scan from the CAD [m].

    Raises:
        StageError: The CAD's unit is wrong, as its size does not fit the scan.
        CalibrationRefused: The fit is poor or ambiguous.
    """
    check_unit(points, workpiece)
    # Measured points lie before the scanner; others are invalid.
    scan = points[points[:, 2] > 0.0].astype(np.float32)
    looks = Looks(workpiece.vertices, workpiece.triangles)
    # More of a part that is there is seen, though a third of it is covered. Less is seen of small
    # areas, like a plate's edge, that fit many things.
    least = 0.25
    search = BodySearch(scan, looks, lambda one: one.verdict.score > 0 and one.seen >= least)
    found = [one for one in search.everywhere() if one.verdict.score > 0]
    found.sort(key=_credit, reverse=True)
    fit = _laid(scan, looks, found[0].pose) if found else None
    if fit is None:
        raise CalibrationRefused(f"{STAGE}: the part is nowhere in the scan", _look(workpiece))
    best, seen = _credit(found[0]), found[0].seen
    if seen < least:
        raise CalibrationRefused(
            f"{STAGE}: poor fit: {seen:.0%} of the part's broadest side is in the scan, at least "
            f"{least:.0%} is needed",
            _look(workpiece),
        )
    goes_on = found[0].verdict.goes_on / max(found[0].verdict.agree, 1)
    refuted = goes_on + search.refuted(fit.pose, lambda at: np.ones(len(at), dtype=bool))
    _refuse_missing(workpiece, "the CAD's surface", refuted)
    if fit.noise > max_residual:
        raise CalibrationRefused(
            f"{STAGE}: poor fit: the scan is {fit.noise * 1e3:.3f} mm off the CAD, limit "
            f"{max_residual * 1e3:g} mm (max_residual)",
            _look(workpiece),
        )
    reach = max(2 * (seam.half_width or 0.0), AROUND * looks.size)
    beside = search.refuted(fit.pose, lambda at: distances_to_line(at, seam.points) < reach)
    _refuse_missing(workpiece, "the seam", beside)
    second = 0.0
    # Candidates are sorted: the first one with another seam is the strongest rival.
    for other in found[1:]:
        apart = _seam_apart(seam, invert(fit.pose) @ other.pose, looks.size)
        if apart > SAME_SEAM:
            second = _credit(other) / best
            if second > 0.97:  # the best pose is at least three percent better
                _refuse_ambiguous(fit.pose, other.pose, apart, second)
            break
    return Registered(fit, seen, refuted, second)


def _credit(found: FoundPose) -> float:
    """Return a pose's score times the share of the part in view that the scan shows."""
    # A plate turned over agrees with a scan of its back, and hides what stands on it
    return found.verdict.score * found.verdict.shown


def check_unit(points: Floats, workpiece: Workpiece) -> None:
    """Refuse a CAD that is far too large or too small for the scan.

    Raises:
        StageError: The message names the unit that would fit.
    """
    if len(points) < FEWEST_OF_PART:
        raise StageError(f"{STAGE}: the scan has {len(points)} points; {FEWEST_OF_PART} are needed")
    sample = points[:: max(1, len(points) // 50_000)]
    # For points on a square: a part with FEWEST points is sqrt(FEWEST) spacings wide
    extent = float(np.linalg.norm(np.ptp(sample, axis=0)))
    spacing, size, unit = extent / np.sqrt(len(points)), workpiece.diagonal, workpiece.unit
    if size > LARGER * extent:
        what = f"{size / extent:.0f} times larger than all of the scan ({extent:.3g} m)"
    elif size < np.sqrt(FEWEST_OF_PART) * spacing:
        what = f"too small for the scan, whose points are about {spacing * 1e3:.2g} mm apart"
    else:
        return
    raise StageError(
        f"{workpiece.path}: with unit: {unit} the part is {size:.4g} m across, {what}; "
        f"{_other_unit(size, unit, extent)}"
    )


def _other_unit(size: float, unit: FileUnit, extent: float) -> str:
    other: FileUnit = "m" if unit == "mm" else "mm"
    resized = size * PER_METRE[unit] / PER_METRE[other]
    if resized < LARGER * extent:
        return f"with unit: {other} it would be {resized:.4g} m: set unit: {other}"
    return "is the scan's unit as configured, and does it show this part?"


def _laid(scan: Singles, looks: Looks, pose: Floats) -> BodyFit | None:
    return fitted(around(scan, looks, pose), looks, pose)


def _seam_apart(seam: CadSeam, motion: Floats, size: float) -> float:
    """Return the displacement of a part's seam and opening by a motion (4, 4) [m].

    The motion of a closed seam along itself does not count.
    """
    # A second line, out along the openings, shows a turn about the seam itself
    lines = seam.points, seam.points + AROUND * size * seam.openings
    away = [
        distances_to_line(there, line) if seam.closed else np.linalg.norm(there - line, axis=1)
        for line in lines
        for there in [line @ motion[:3, :3].T + motion[:3, 3]]
    ]
    return float(np.max(away))


def _refuse_missing(workpiece: Workpiece, what: str, share: float) -> None:
    allowed = 0.05  # of the surface in view
    if share > allowed:
        raise CalibrationRefused(
            f"{STAGE}: poor fit: the scanner sees through {share:.0%} of {what}, at most "
            f"{allowed:.0%} is allowed",
            _look(workpiece),
        )


def _look(workpiece: Workpiece) -> str:
    return f"check that the part is {workpiece.title!r} ({workpiece.path.name}), and in view"


def _refuse_ambiguous(best: Floats, other: Floats, apart: float, second: float) -> None:
    turn = rotation_log(best[:3, :3].T @ other[:3, :3])
    angle = float(np.linalg.norm(turn))
    axis = "xyz"[int(np.argmax(np.abs(turn)))]
    moved = f"turned by {np.degrees(angle):.0f} deg about the CAD's {axis}"
    if angle < np.radians(2):
        moved = f"shifted by {1e3 * apart:.0f} mm"
    raise CalibrationRefused(
        f"{STAGE}: ambiguous: the part {moved} agrees with the scan {second:.0%} as well, and its "
        f"seam would be up to {1e3 * apart:.0f} mm away",
        "scan it so that a feature shows which way it lies, or find the seam without CAD "
        "(seam.joint)",
    )
