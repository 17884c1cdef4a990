"""Register a CAD to a scan: find the part, fit it, and reject poor or ambiguous fits.

Fitted poses are held against what the scanner saw, finely: for judging them, and to end a slide.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from flangeye import CalibrationRefused, StageError
from flangeye.files.clouds import PER_METRE, LengthUnit
from flangeye.maths.geometry import rigid, rotation_exp, rotation_log
from flangeye.maths.seam_geometry import distances_to_line
from flangeye.models.workpiece import CadSeam
from flangeye.types import Floats
from flangeye_plugins.seam.part import CadPart
from flangeye_plugins.seam.points import DepthMap, Oriented, depth_map, facing_camera, thinned
from flangeye_plugins.seam.refine import CadFit, moved, refine
from flangeye_plugins.seam.search import agreement, find_poses, model_of, shares

FINE = 200
"""How many times the finest thing looked at goes into the part's diagonal."""


class RayEvidence:
    """Evidence for a part's pose: rays that agree with it, and rays that contradict."""

    def __init__(
        self, part: CadPart, seam: CadSeam, seen: DepthMap, rng: np.random.Generator
    ) -> None:
        self.part, self.floor = part, part.diagonal / FINE
        self._model, self._seen = model_of(part, rng, 2 * self.floor), seen
        # Samples of the part that are looked at on the way
        sliding = 3000
        self._few = self._model.thinned(sliding, rng)
        surface = self._model.surface
        # How far around a seam the surface is its own, at least, as a share of the diagonal
        around = 0.05
        reach = max(2 * (seam.half_width or 0.0), around * part.diagonal)
        self._near_seam = surface.take(distances_to_line(surface.points, seam.points) < reach)

    def of(self, fit: CadFit) -> tuple[float, float]:
        """Return which shares of the surface towards the scanner were seen, and refuted."""
        return self._shares(fit, self._model.surface)

    def at_seam(self, fit: CadFit) -> tuple[float, float]:
        """Return the same for the surface around the seam."""
        return self._shares(fit, self._near_seam)

    def scores(self, poses: Floats, noise: float) -> Floats:
        """Return the (K,) agreements of many poses (K, 4, 4), from a part of the samples."""
        return agreement(poses, self._few, self._seen, self._tolerance(noise))

    def score(self, fit: CadFit) -> float:
        """Return the agreement of a fit."""
        tolerance = self._tolerance(fit.noise)
        return float(agreement(fit.pose[None], self._model, self._seen, tolerance)[0])

    def _shares(self, fit: CadFit, surface: Oriented) -> tuple[float, float]:
        tolerance = self._tolerance(fit.noise)
        seen, refuted = shares(fit.pose[None], surface, self._seen, tolerance)
        return float(seen[0]), float(refuted[0])

    def _tolerance(self, noise: float) -> float:
        return max(5 * noise, self.floor)


def slid(fit: CadFit, evidence: RayEvidence) -> CadFit:
    """Slide a part in the directions that its planes leave free, to where its outline agrees.

    A block with a straight groove can slide along it without any distance to a plane changing;
    where it begins and ends is then all there is to go by. Its deviation is a quarter of the
    width of the agreement's peak.
    """
    units = np.array([2 / evidence.part.diagonal] * 3 + [1.0] * 3)
    values, vectors = np.linalg.eigh(fit.covariance / np.outer(units, units))
    # Either way, as shares of the diagonal
    for k, share in product(np.nonzero(values > evidence.floor**2)[0], (0.2, 0.03)):
        ways = np.linspace(-share, share, 101) * evidence.part.diagonal
        poses = np.array([moved(fit.pose, w * vectors[:, k] * units, fit.about) for w in ways])
        way, values[k] = _peak(ways, evidence.scores(poses, fit.noise), values[k])
        fit = replace(fit, pose=moved(fit.pose, way * vectors[:, k] * units, fit.about))
    covariance = vectors @ np.diag(values) @ vectors.T * np.outer(units, units)
    return replace(fit, covariance=covariance)


def _peak(ways: Floats, scores: Floats, variance: float) -> tuple[float, float]:
    """Return where the peak is, and its variance; where there is none, what it was."""
    # The part of the peak that is taken for where its middle is
    top = scores > scores.max() - 0.3 * (scores.max() - np.median(scores))
    inside = ways[top]
    if top[[0, -1]].any() or np.ptp(inside) > 0.5 * np.ptp(ways):
        return 0.0, variance
    return float(inside.mean()), float((np.ptp(inside) / 4) ** 2)


STAGE = "seam.cad"
WORTH = 0.4
"""Candidates below this share of the best one's score are not."""
LARGER, FEWEST = 3.0, 300
"""A part this many times larger than all of the scan, or with fewer points, has a wrong unit."""
SAME = 1e-3
"""Two poses whose seams differ by less are one [m]."""


@dataclass(frozen=True)
class RegistrationLimits:
    """Limits that a registration must meet to be accepted.

    Attributes:
        seen: Least share of the surface towards the scanner that must have been seen.
        refuted: Largest share of what was looked at that may be missing.
        residual: Largest distance of the scan from the CAD, rms [m].
        distinct: By how much the second-best pose must agree less with the scan.
    """

    seen: float
    refuted: float
    residual: float
    distinct: float


@dataclass(frozen=True, eq=False)
class Registered:
    """A registration.

    Attributes:
        fit: Pose and covariance.
        seen: Share of the CAD's surface towards the scanner on which there are points.
        refuted: Share of it through which the scanner looked.
        second: Agreement of the next best pose with another seam, over that of this one.
    """

    fit: CadFit
    seen: float
    refuted: float
    second: float


def register(
    points: Floats,
    part: CadPart,
    seam: CadSeam,
    limits: RegistrationLimits,
    rng: np.random.Generator,
) -> Registered:
    """Register a CAD to the scan (N, 3) in ``camera``, globally and finely.

    Raises:
        StageError: The CAD cannot be in this scan: its unit is wrong.
        CalibrationRefused: The fit is poor, ambiguous, or leaves the seam undetermined.
    """
    check_unit(points, part)
    seen = depth_map(points.astype(np.float32))
    # Voxels along the part's diagonal to search in
    coarse = facing_camera(thinned(points, part.diagonal / 80))
    found = find_poses(coarse, part, seen, rng)
    worth = found.scores > WORTH * max(found.scores.max(initial=0.0), 0.0)
    evidence = RayEvidence(part, seam, seen, rng)
    # Candidates that are fitted
    tried = 6
    fits = _fits(points, found.poses[worth][:tried], evidence, rng)
    if not fits:
        raise CalibrationRefused(f"{STAGE}: the part is nowhere in the scan; {_look(part)}")
    return _judged(_with_turned(points, fits, evidence, rng), seam, evidence, limits)


def check_unit(points: Floats, part: CadPart) -> None:
    """Refuse a CAD that is far larger or smaller than anything in the scan.

    Raises:
        StageError: Names the unit that would fit.
    """
    sample = points[:: max(1, len(points) // 50_000)]
    if len(points) < FEWEST:
        raise StageError(f"{STAGE}: the scan has {len(points)} points; {FEWEST} are needed")
    extent = float(np.linalg.norm(np.ptp(sample, axis=0)))
    spacing = extent / np.sqrt(len(points))
    path, unit = part.workpiece.path, part.workpiece.unit
    if part.diagonal > LARGER * extent:
        what = f"{part.diagonal / extent:.0f} times larger than all of the scan ({extent:.3g} m)"
    elif part.diagonal < np.sqrt(FEWEST) * spacing:
        what = f"too small for the scan, whose points are about {spacing * 1e3:.2g} mm apart"
    else:
        return
    raise StageError(
        f"{path}: with unit: {unit} the part is {part.diagonal:.4g} m across, {what}; "
        f"{_other_unit(part, unit, extent)}"
    )


def _other_unit(part: CadPart, unit: LengthUnit, extent: float) -> str:
    other: LengthUnit = "m" if unit == "mm" else "mm"
    size = part.diagonal * PER_METRE[unit] / PER_METRE[other]
    if size < LARGER * extent:
        return f"with unit: {other} it would be {size:.4g} m: set unit: {other}"
    return "is the scan in the unit it was said to be, and of this part?"


def _fits(
    points: Floats, poses: Iterable[Floats], evidence: RayEvidence, rng: np.random.Generator
) -> list[CadFit]:
    """Fit candidates quickly, then each that is a pose of its own with all of its points."""
    part = evidence.part
    fits: list[CadFit] = []
    for pose in poses:
        around = _around(points, part, pose)
        # Candidates are fitted with so many points before the best is fitted with all
        few = around.take(rng.permutation(len(around))[:4000])
        # How far off a candidate may be, as a share of the diagonal
        reach = 0.05
        quick = refine(few, part, pose, reach * part.diagonal)
        if quick and all(_apart(quick.pose, fit.pose, part.corners) > SAME for fit in fits):
            whole = refine(around, part, quick.pose, 8 * quick.noise)
            fits += [slid(whole, evidence)] if whole else []
    return fits


def _with_turned(
    points: Floats, fits: list[CadFit], evidence: RayEvidence, rng: np.random.Generator
) -> list[CadFit]:
    """Add the best fit turned by right angles about the part's axes, where that agrees too.

    Most parts that can be taken for themselves turned can so by these; the search may have met
    one such pose and not the other.
    """
    best = max(fits, key=evidence.score)
    turns = [rotation_exp(k * np.pi / 2 * axis) for axis in np.eye(3) for k in (1, 2, 3)]
    centre = evidence.part.centre
    poses = [best.pose @ rigid(turn, centre - turn @ centre) for turn in turns]
    scores = evidence.scores(np.array(poses), best.noise)
    worth = scores > WORTH * evidence.score(best)
    return fits + _fits(points, np.array(poses)[worth], evidence, rng)


def _around(points: Floats, part: CadPart, pose: Floats) -> Oriented:
    """Return the scan near a pose of the part, thinned, with normals."""
    centre = pose[:3, :3] @ part.centre + pose[:3, 3]
    near = ((points - centre) ** 2).sum(axis=1) < (0.6 * part.diagonal) ** 2
    return facing_camera(thinned(points[near], part.diagonal / FINE))


def _apart(first: Floats, second: Floats, points: Floats) -> float:
    """Return the largest distance between points (N, 3) of the part in two poses."""
    step = points @ (first[:3, :3] - second[:3, :3]).T + first[:3, 3] - second[:3, 3]
    return float(np.linalg.norm(step, axis=1).max())


def _judged(
    fits: Sequence[CadFit], seam: CadSeam, evidence: RayEvidence, limits: RegistrationLimits
) -> Registered:
    """Return the best fit, or refuse it."""
    part = evidence.part
    scores = [evidence.score(fit) for fit in fits]
    ranked = sorted(range(len(fits)), key=lambda i: -scores[i])
    best = fits[ranked[0]]
    seen, refuted = evidence.of(best)
    _refuse_poor(part, best, seen, refuted, limits)
    _refuse_other(part, *evidence.at_seam(best), limits)
    second = 0.0
    for i in ranked[1:]:
        if _apart(best.pose, fits[i].pose, seam.points) > SAME:
            second = max(scores[i] / scores[ranked[0]], 0.0)
            if second > 1 - limits.distinct:
                _refuse_ambiguous(best, fits[i], seam, second)
            break
    return Registered(best, seen, refuted, second)


def _refuse_poor(
    part: CadPart, fit: CadFit, seen: float, refuted: float, limits: RegistrationLimits
) -> None:
    if seen < limits.seen:
        raise CalibrationRefused(
            f"{STAGE}: poor fit: of the CAD's surface towards the scanner {seen:.0%} was seen, at "
            f"least {limits.seen:.0%} is needed; {_look(part)}"
        )
    _refuse_missing(part, "the CAD's surface", refuted / (seen + refuted), limits)
    if fit.noise > limits.residual:
        raise CalibrationRefused(
            f"{STAGE}: poor fit: the scan is {fit.noise * 1e3:.3f} mm rms from the CAD, limit "
            f"{limits.residual * 1e3:g} mm (max_residual); {_look(part)}"
        )


def _refuse_other(part: CadPart, seen: float, refuted: float, limits: RegistrationLimits) -> None:
    """Refuse a part whose seam is not where the CAD has it, however well the rest fits."""
    if seen + refuted > 0:
        _refuse_missing(part, "the seam", refuted / (seen + refuted), limits)


def _refuse_missing(part: CadPart, what: str, share: float, limits: RegistrationLimits) -> None:
    if share > limits.refuted:
        raise CalibrationRefused(
            f"{STAGE}: poor fit: where the scanner looked at {what}, {share:.0%} of the surface is "
            f"not there, at most {limits.refuted:.0%} may be; {_look(part)}"
        )


def _look(part: CadPart) -> str:
    return f"is it {part.workpiece.title!r} ({part.workpiece.path.name}), and in view?"


def _refuse_ambiguous(best: CadFit, other: CadFit, seam: CadSeam, second: float) -> None:
    turn = rotation_log(best.pose[:3, :3].T @ other.pose[:3, :3])
    angle = float(np.linalg.norm(turn))
    axis = "xyz"[int(np.argmax(np.abs(turn)))]
    moved = f"turned by {np.degrees(angle):.0f} deg about the CAD's {axis}"
    if angle < np.radians(2):
        moved = f"shifted by {1e3 * _apart(best.pose, other.pose, seam.points):.0f} mm"
    raise CalibrationRefused(
        f"{STAGE}: ambiguous: the part {moved} agrees with the scan {second:.0%} as well, and its "
        f"seam would be up to {1e3 * _apart(best.pose, other.pose, seam.points):.0f} mm away; scan "
        "it so that a feature shows which way it lies, or find the seam without CAD (seam.joint)"
    )
