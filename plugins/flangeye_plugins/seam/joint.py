"""``seam.joint``: find a joint in the scan by fitting its cross-section along a rough line."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from flangeye import CalibrationRefused, StageError, stage
from flangeye.maths.seam_geometry import distances_to_line
from flangeye.models.robots import RobotModel
from flangeye.models.scanners import ScannerModel
from flangeye.types import Box, Floats, Seam, VerifiedHandEye, WorkpieceScan
from flangeye.units import Length, param
from flangeye_plugins.seam.ends import (
    Rays,
    earliest_end,
    face_ends,
    last_in_strips,
    surface_end,
    surfaces,
)
from flangeye_plugins.seam.planned import (
    SPACING,
    SeamParams,
    answer_for,
    cloud_around,
    for_the_controller,
    refuse_outside,
)
from flangeye_plugins.seam.points import normals_of
from flangeye_plugins.seam.rough import Curve, JointPlace, Spline, course, rough_path
from flangeye_plugins.seam.stitched import PlacedScan, seen_in_base
from flangeye_plugins.seam.sweep import WIDE, Sweep, fitted, swept_from
from flangeye_plugins.seam.template import EDGES, FACES, JOINT_SHAPES, JointShape

STAGE = "seam.joint"


class JointParams(SeamParams):
    """Parameters of ``seam.joint``."""

    joint: Literal["vee", "bevel", "butt", "lap", "fillet", "corner"]
    """vee and bevel: a V-groove or half of one; butt: square edges with a gap; corner: an outside
    corner, open or closed."""
    line: tuple[tuple[Length, Length, Length], ...] | None = Field(None, min_length=2)
    """Rough points along the seam in base, in welding order; else an earlier seam."""
    closed: bool = False
    """Whether the line is closed: it returns to its first point."""
    reach: Length = param("15 mm", gt=0)
    """Largest distance of the seam and its ends from the line."""
    max_residual: Length = param("0.5 mm", gt=0)
    """Largest distance of points from the joint's surfaces, median."""
    max_deviation: Length = param("0.5 mm", gt=0)
    """Largest standard deviation of the seam across it, in the scan."""


@dataclass(frozen=True, eq=False)
class FoundJoint:
    """A joint found in a scan, in ``camera``.

    Attributes:
        course: Frames along the joint.
        swept: The fitted cross-section, relative to these frames.
        local: (N, 3) scan points near the joint, in local coordinates.
        pitch: Distance between neighbouring points [m].
        rays: The scanner's rays near the joint.
        ends: Start and end of the joint along the course [m].
        deviations: Standard deviations of both ends [m]; infinite for an end that was not seen.
    """

    course: Curve
    swept: Sweep
    local: Floats
    pitch: float
    rays: Rays
    ends: tuple[float, float] = (0.0, 0.0)
    deviations: tuple[float, float] = (np.inf, np.inf)

    @property
    def inside(self) -> Floats:
        """The local points (M, 3) between the ends."""
        s = self.local[:, 0]
        return self.local[(s > self.ends[0]) & (s < self.ends[1])]

    def along_fit(self, points: Floats, reach: float) -> FoundJoint:
        """Return the joint with points in local coordinates of frames along the fitted line."""
        line = self.course.moved(*self.swept.spline.at(self.course.s).T)
        flat = Spline.through(line.length, line.closed, line.s, np.zeros((len(line.s), 3)))
        local = line.local(points, reach)[1]
        return replace(self, course=line, swept=replace(self.swept, spline=flat), local=local)


@stage(STAGE)
def seam_joint(  # noqa: PLR0913  what it asks the runner for
    calibration: VerifiedHandEye,
    scan: WorkpieceScan,
    params: JointParams,
    seam: Seam | None = None,
    workspace: Box | None = None,
    scanner: ScannerModel | None = None,
    robot: RobotModel | None = None,
) -> Seam:
    """Fit a joint's cross-section to the scan along a rough line.

    The line is given by the step's parameters or by an earlier seam step. The seam is the line
    where the joint's surfaces meet, or the middle of the gap. It begins and ends where the plates
    do.

    The seam's figures are ``residual``, the standard deviation of the points on the joint [m];
    ``registration``, the largest standard deviation of the line in the scan [m]; ``start`` and
    ``end``, the standard deviations of both ends, if seen [m]; ``explained`` and ``coverage``, as
    the parameters define them; and ``apart``, for a scan from several poses [m].

    Raises:
        StageError: There is no rough line, or there are too few points near it.
        CalibrationRefused: The joint was not found, is too uncertain, or is ambiguous.
    """
    answer = answer_for(STAGE, calibration, params)
    seen = seen_in_base(STAGE, scan, answer, robot)
    _refuse_apart(seen)
    found = _found(seen, _rough(seen, params, seam), params)
    figures = _judged(found, params)
    line, openings, covariances = _line(found)
    covariances = covariances + seen.of_scanner(line, scanner)
    mapped, covariance = seen.in_base(line, covariances)
    refuse_outside(STAGE, mapped, workspace)
    section = found.swept.section
    planned = Seam(
        mapped,
        openings @ seen.base_T_camera.rotation.T,
        covariance,
        half_angle=section.half_angle,
        half_width=_half_width(found.swept),
        source=f"{params.joint} in {scan.source}",
        figures=figures if seen.apart is None else {**figures, "apart": seen.apart},
        notes=_notes(found, params),
        cloud=cloud_around(seen.points, line, seen.base_T_camera),
    )
    return for_the_controller(planned, answer, robot, params)


def _refuse_apart(seen: PlacedScan) -> None:
    """Refuse a scan from several poses whose clouds disagree on faces that they share."""
    limit = 1e-3  # more than a calibrated scanner on a real arm leaves between two places [m]
    if seen.apart is not None and seen.apart > limit:
        raise CalibrationRefused(
            f"{STAGE}: neighbouring clouds are {seen.apart * 1e3:.2f} mm apart where both show the "
            f"same face, limit {limit * 1e3:g} mm",
            "calibrate the scanner on the flange again",
        )


def _rough(seen: PlacedScan, params: JointParams, seam: Seam | None) -> Curve:
    """Return frames along the rough line, in ``camera``."""
    if params.line is None and seam is None:
        raise StageError(f"{STAGE}: no rough seam line; write line:, or put a seam step before it")
    given = np.array(params.line) if params.line else seam.points_in_base  # type: ignore[union-attr]
    steps = np.diff(given, axis=0)
    lengths = np.linalg.norm(steps, axis=1)
    if not (lengths > 0).all():
        raise StageError(f"{STAGE}: line has the same point twice in a row")
    # A rough line that turns by more goes back
    turned = np.cos(np.radians(120))
    back = np.einsum("ni,ni->n", steps[:-1], steps[1:]) < turned * lengths[:-1] * lengths[1:]
    if back.any():
        raise StageError(
            f"{STAGE}: line turns back at its point {int(np.argmax(back)) + 2}; give its points in "
            "their order along the seam"
        )
    line = seen.base_T_camera.inverse().apply(given)
    return course(line, seen.eyes, params.closed, params.reach)


def _found(seen: PlacedScan, rough: Curve, params: JointParams) -> FoundJoint:
    """Return the fitted joint with its ends."""
    # The seam may be off by `reach`, and its faces are fitted over WIDE; 10 mm are for the line's
    # bends.
    box = params.reach + WIDE + 10e-3
    points = seen.points
    at, local = rough.local(points, box)
    fewest = 300
    if len(at) < fewest:
        raise StageError(f"{STAGE}: {len(at)} points are near the line; {fewest} are needed")
    # Points that are fitted to; of more, every second, third,
    most_fitted = 400_000
    pitch, points = _solid(points[at[:: -(-len(at) // most_fitted)]])
    at, local = rough.local(points, box)
    normals = normals_of(points)
    # Beside a rough line's corners the sections are askew: the joint is sought again along the
    # smooth line through where it was found, which has none.
    line = rough.through(_placed(rough, local, normals[at], params))
    at, local = line.local(points, box)
    # The fit is local: it starts from the places that the search found.
    swept = swept_from(_placed(line, local, normals[at], params), line.length, line.closed)
    rays = Rays(seen.eyes, seen.clouds, line.points)
    found = FoundJoint(line, swept, local, pitch, rays, (0.0, line.length))
    # The second and third time along the line that the first has found
    refits = 3
    for k in range(refits):
        found = found.along_fit(points, box) if k else found
        edges = face_ends(found.swept, found.inside, pitch, params.max_residual)
        swept = fitted(found.swept, found.local, pitch, params.max_residual, edges)
        found = _with_ends(replace(found, swept=swept))
    return found


def _solid(points: Floats) -> tuple[float, Floats]:
    """Return the distance between neighbouring points [m], and the points without mixed pixels.

    A mixed pixel gives a point between two surfaces with few neighbours. On a surface 19 points lie
    within 2.5 spacings.
    """
    from scipy.spatial import cKDTree

    tree = cKDTree(points)
    some = points[:: max(1, len(points) // 2000)]
    pitch = float(np.median(tree.query(some, k=5)[0][:, 1:].mean(axis=1)))
    third = tree.query(points, k=[4])[0][:, 0]  # the first is the point itself
    return pitch, points[third <= 2.5 * pitch]


def _placed(rough: Curve, local: Floats, normals: Floats, params: JointParams) -> list[JointPlace]:
    """Return the joint's positions along the rough line, one per slab."""
    joint = JOINT_SHAPES[params.joint]
    joints: tuple[JointShape, ...] = (joint,)
    if joint.mirrored() != joint and params.joint != "fillet":
        joints = (joint, joint.mirrored())
    turned = np.einsum("nij,nj->ni", rough.at(local[:, 0])[1], normals)
    ways = rough_path(local, turned, joints, params.max_residual, params.reach)
    if not ways:
        raise CalibrationRefused(
            f"{STAGE}: no {params.joint} joint within {params.reach * 1e3:g} mm of the line "
            "(reach)",
            "name the joint that is there (joint), and see that the scan shows it",
        )
    scores = [sum(place.score for place in way) for way in ways]
    # A joint that explains this share of what the best one explains is its equal
    equal = 0.8
    if len(ways) > 1 and scores[1] > equal * scores[0]:
        raise CalibrationRefused(
            f"{STAGE}: ambiguous: a second {params.joint} joint is as good, "
            f"{_between(ways[0], ways[1]) * 1e3:.0f} mm beside the first",
            "move the line nearer to one of them and lower 'reach'",
        )
    return ways[0]


def _between(first: list[JointPlace], second: list[JointPlace]) -> float:
    line = np.array([[p.s, *p.q] for p in first])
    return float(np.median(distances_to_line(np.array([[p.s, *p.q] for p in second]), line)))


def _with_ends(found: FoundJoint) -> FoundJoint:
    """Return the joint with its ends; it ends where the first of its surfaces ends."""
    if found.course.closed:
        return replace(found, ends=(0.0, found.course.length), deviations=(0.0, 0.0))
    start, stop = (_end(found, sign) for sign in (-1, 1))
    return replace(found, ends=(start[0], stop[0]), deviations=(start[1], stop[1]))


def _end(found: FoundJoint, sign: int) -> tuple[float, float]:
    """Return the start (-1) or end (1) of the joint along its course, and its deviation [m].

    The deviation is infinite if the joint continues to the course's end.
    """
    swept, local, pitch = found.swept, found.local, found.pitch
    q = swept.in_section(local)
    across = np.linalg.norm(q, axis=1) * np.sign(q[:, 0])
    ends = []
    # Pixels beyond a surface's last point at which the scanner may look past its end
    beyond = (1.0, 2.0, 3.0, 4.0)
    for on in surfaces(swept, local, 4 * swept.sigma).values():
        last, more = last_in_strips(across[on], sign * local[on, 0], pitch)
        at = local[on][last, :3]
        on_beyond = sign * (more + pitch * np.array(beyond)[:, None]).ravel()
        there = np.tile(at, (len(beyond), 1)) + np.outer(on_beyond, [1, 0, 0])
        looked = found.rays.past(found.course.points_at(there), pitch, 5 * swept.sigma)
        past, covered = np.reshape(looked, (2, len(beyond), -1)).max(axis=1)
        end = surface_end(sign * at[:, 0] + more, past, covered, pitch)
        ends += [] if end is None else [end]
    limit = found.course.length if sign > 0 else 0.0
    # Two pixels short of the course's end the scan was cut, not the plate.
    place, deviation = earliest_end(ends, sign * limit - 2 * pitch)
    if np.isinf(deviation):
        return limit, deviation
    # Of a pixel, for those that scanners drop or invent beside a jump of depth: the simulated
    # PhoXi M drops 0.7 to 1.2 of one
    return sign * place, float(np.hypot(deviation, 0.5 * pitch))


def _line(found: FoundJoint) -> tuple[Floats, Floats, Floats]:
    """Return the seam's points (N, 3), openings (N, 3) and covariances (N, 3, 3) in ``camera``."""
    start, stop = found.ends
    count = max(2, round((stop - start) / SPACING) + 1)
    s = np.linspace(start, stop, count)
    origin, axes = found.course.at(s)
    y, z, roll = found.swept.spline.at(s).T
    line = origin + y[:, None] * axes[:, 1] + z[:, None] * axes[:, 2]
    # Out of the joint, along the bisector of the surfaces that meet at the seam
    turned = roll + found.swept.section.opening
    openings = np.sin(turned)[:, None] * axes[:, 1] + np.cos(turned)[:, None] * axes[:, 2]
    # Of a pixel, what an edge may be off for how pixels there are measured
    unshared = 0.15
    floor = (unshared * found.pitch) ** 2
    across = found.swept.line_covariance(s) + floor * np.eye(2)
    covariance = np.einsum("nai,nab,nbj->nij", axes[:, 1:], across, axes[:, 1:])
    for k, deviation in zip((0, -1), found.deviations, strict=True):
        if np.isfinite(deviation):
            # Only the two ends are uncertain along the seam: elsewhere a shift along a line is no
            # error.
            covariance[k] += deviation**2 * np.outer(axes[k, 0], axes[k, 0])
    return line, openings, covariance


def _half_width(swept: Sweep) -> float | None:
    """Return half the joint's width: the mean distance of the faces' ends from the opening [m]."""
    section = swept.section
    if section.joint.gap:
        return float(section.shape[6] / 2)
    ends = [v for v in section.vertices if np.linalg.norm(v) > 1e-4]
    aside = np.array([np.cos(section.opening), -np.sin(section.opening)])
    return float(np.mean(np.abs(np.array(ends) @ aside))) if len(ends) == 2 else None


def _judged(found: FoundJoint, params: JointParams) -> dict[str, float]:
    """Return the quality figures of the seam, or refuse it.

    Raises:
        CalibrationRefused: A figure exceeds its limit; the message gives both.
    """
    explained, coverage, astray = _shares(found)
    start, stop = found.ends
    s = np.linspace(start, stop, 50)
    deviation = float(np.sqrt(np.linalg.eigvalsh(found.swept.line_covariance(s)).max()))
    named = zip(("start", "end"), found.deviations, strict=True)
    ends = {name: value for name, value in named if np.isfinite(value)}
    limits = [
        (found.swept.sigma, params.max_residual, "points are {} from the joint", " (max_residual)"),
        (deviation, params.max_deviation, "the seam is known to {} (1 sigma)", " (max_deviation)"),
        *((x, 1e-3, f"its {end} is known to {{}} (1 sigma)", "") for end, x in ends.items()),
    ]
    for value, limit, what, name in limits:
        if not value <= limit:
            told = what.format(f"{value * 1e3:.3g} mm")
            raise CalibrationRefused(
                f"{STAGE}: {told}, limit {limit * 1e3:g} mm{name}", "scan more densely, or nearer"
            )
    # Before the angles: on a single plane any joint's angles fit somehow.
    _refuse_plane(found)
    leaning = np.abs(found.swept.section.shape[:4]) - 3 * np.radians(
        JOINT_SHAPES[params.joint].spread
    )
    # Of a joint, most points about its line are on it, and most of its length shows both plates.
    shares = {
        "of the points about the line are on it": explained,
        "of its length show both plates": coverage,
    }
    wrong = [f"{x:.0%} {what}, at least 60% are needed" for what, x in shares.items() if x < 0.6]
    if leaning.max() > 0:
        off = np.degrees(np.abs(found.swept.section.shape[:4]).max())
        wrong.insert(0, f"an angle between its surfaces is off by {off:.0f} deg")
    if wrong:
        told = f"{STAGE}: this is not a {params.joint} joint: {wrong[0]}"
        raise CalibrationRefused(told, "name the joint that is there (joint)")
    if astray is not None:
        raise CalibrationRefused(
            f"{STAGE}: from {astray[0] * 1e3:.0f} to {astray[1] * 1e3:.0f} mm along the seam most "
            f"points are not on the {params.joint} joint that was found",
            "give more rough points there, or end the line before",
        )
    return {
        "residual": found.swept.sigma,
        "registration": deviation,
        "explained": explained,
        "coverage": coverage,
        **ends,
    }


def _refuse_plane(found: FoundJoint) -> None:
    """Refuse a joint that a plane explains as well, and a gap between coplanar plates not seen."""
    section, pitch, tolerance = found.swept.section, found.pitch, 5 * found.swept.sigma
    q = found.swept.in_section(found.inside)
    q = q[np.linalg.norm(q, axis=1) < WIDE / 2 + section.shape[4:].max()]
    beyond = q @ np.nan_to_num(section.normals).T - section.heights
    on = np.abs(section.distances(q)[0]) < tolerance
    level = np.abs(beyond[:, list(FACES)]) < tolerance
    if not section.joint.gap:
        plane = 0.95  # as good as the joint
        if level[on].mean(axis=0).max(initial=0.0) > plane:
            raise CalibrationRefused(
                f"{STAGE}: no joint is seen: one plane explains {plane:.0%} of the points as well",
                "let the scan show both plates",
            )
        return
    # A point stands for a square of the pitch: so much of the gap's area has points in it
    gap, length = section.shape[6], found.ends[1] - found.ends[0]
    within = level[:, 0] & (beyond[:, list(EDGES)] > 0).all(axis=1)
    filled = min(float(within.sum() * pitch**2 / max(gap * length, 1e-12)), 1.0)
    if gap < 2 * pitch or filled > 1 / 3:
        raise CalibrationRefused(
            f"{STAGE}: no gap is seen: {gap * 1e3:.2f} mm fits best, but {filled:.0%} of its area "
            f"has points on it, which are {pitch * 1e3:.2f} mm apart",
            "scan nearer, or name another joint",
        )


def _shares(found: FoundJoint) -> tuple[float, float, tuple[float, float] | None]:
    """Return the share of points near the seam that are on the joint, the visible share, and a gap.

    The visible share is that of the seam's length. The gap is the longest interval in which most
    points are on something else [m]; None without one.
    """
    swept, local = found.swept, found.local
    q = swept.in_section(local)
    away, _ = swept.section.distances(q)
    inside = (local[:, 0] > found.ends[0]) & (local[:, 0] < found.ends[1])
    near = inside & (np.linalg.norm(q, axis=1) < WIDE / 2 + swept.section.shape[4:].max())
    on_joint = near & (np.abs(away) < 5 * swept.sigma)
    explained = float(on_joint.sum() / max(near.sum(), 1))
    # Lengths of the seam that are seen or not [m]
    cells = np.arange(found.ends[0], found.ends[1], 3e-3)
    groups = surfaces(swept, local, 5 * swept.sigma).values()
    counts = [np.histogram(local[on, 0], cells)[0] for on in groups]
    seen = np.all(np.array(counts) >= 4, axis=0)
    every, good = (np.histogram(local[which, 0], cells)[0] for which in (near, on_joint))
    # A stretch on another joint or part: the seam would leave the workpiece there.
    off = _longest_run((every >= 20) & (good < every / 2))
    # A crossing seam, or a clamp, is shorter [m]
    short = 20e-3
    astray = cells[off.start] - cells[0], cells[off.stop] - cells[0]
    coverage = float(np.mean(seen)) if len(cells) > 1 else 0.0
    return explained, coverage, astray if astray[1] - astray[0] > short else None


def _longest_run(flags: NDArray[np.bool_]) -> slice:
    """Return the slice of the longest run of true values."""
    steps = np.diff(np.concatenate([[0], flags.astype(int), [0]]))
    starts, stops = np.flatnonzero(steps > 0), np.flatnonzero(steps < 0)
    if not len(starts):
        return slice(0, 0)
    k = int(np.argmax(stops - starts))
    return slice(int(starts[k]), int(stops[k]))


def _notes(found: FoundJoint, params: JointParams) -> tuple[str, ...]:
    open_ends = [
        name
        for name, value in zip(("start", "end"), found.deviations, strict=True)
        if not np.isfinite(value)
    ]
    if not open_ends:
        return ()
    return (
        f"the joint goes on beyond {params.reach * 1e3:g} mm from the line's "
        f"{' and '.join(open_ends)} (reach): the seam ends there, not at the joint's end",
    )
