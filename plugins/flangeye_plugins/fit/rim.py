"""``fit.rim``, the default: the flange's face as a plane, rim and bore as concentric circles."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import ClassVar, NamedTuple

import numpy as np

from flangeye import stage
from flangeye.maths.circles import distances, edge_points, fringe, sectors, vote_centre
from flangeye.maths.planes import Plane, chosen, fit_plane, thinned
from flangeye.models.targets import Flange, roll_angle
from flangeye.types import CircleFeature, FlangeCloud, Floats, Indices, Mask, Rejected
from flangeye.types.geometry import basis_of_plane
from flangeye.units import Length, param
from flangeye_plugins.fit.circles import (
    Circles,
    cauchy_curvature,
    cauchy_weights,
    circle_jacobian,
    circle_residuals,
    disc_face,
    fit_concentric,
)
from flangeye_plugins.fit.uncertainty import (
    STRETCHES,
    ScannerErrorParams,
    clustered_covariance,
    plane_covariance,
)

FEWEST_POINTS = 100


LEAST_NOISE = 3e-5
"""Scanners round edges by this much, however small their noise is [m]."""


class RimParams(ScannerErrorParams):
    """Parameters of ``fit.rim``."""

    inlier: Length = param("0.3 mm", gt=0)
    """Largest distance of a rim point from the circle."""
    # Smallest share of the rim's circumference, and of the bore's, to be seen
    min_coverage: ClassVar[float] = 0.3
    radius_tolerance: Length = param("1.5 mm", gt=0)
    """Largest difference of a fitted radius from the flange's: room for chamfers and for what the
    scanner wears off an edge."""
    # Standard deviation of what shifts a whole edge unseen (chamfer, shadow); added to the
    # centre's covariance in the face [m]
    edge_bias: ClassVar[float] = 0.05e-3
    # Width of the band the face lies in (ISO 9409-1: 0.04 mm), which no number of points averages
    # out; added to the covariance across the face [m]
    flatness: ClassVar[float] = 0.04e-3


@stage("fit.rim")
def fit_rim(cloud: FlangeCloud, flange: Flange, params: RimParams) -> CircleFeature | Rejected:
    """Fit the flange's rim and bore as concentric circles in its face.

    A robust plane gives depth and normal. The outermost and innermost points of the face in each
    sector give two circles with one centre and free radii. The covariance contains the edges'
    scatter in the face, with correlated neighbours, and the plane's covariance across it. The fit
    is deterministic. For a wrist circle the centre is moved along the normal by the plate's
    thickness, to the origin of the robot's flange frame.
    """
    return circle_of(cloud, flange, flange.radii, params)


def circle_of(
    cloud: FlangeCloud, flange: Flange, radii: Mapping[str, float], params: RimParams
) -> CircleFeature | Rejected:
    """Return a flange's circle as ``fit.rim`` does, from its edges of the given ``radii`` [m]."""
    points = cloud.cloud.xyz.astype(np.float64, order="F")
    rough = Plane(cloud.centre, cloud.normal)
    # The face is sought within 3 mm of the rough plane.
    face = disc_face(points, rough, _ring_of(flange), 3e-3)
    if face is None:
        return Rejected(f"fewer than 3 of {len(points)} points lie on a common plane")
    flat = face.flatten(chosen(points, _on_face(face, points)))
    if len(flat) < FEWEST_POINTS:
        return Rejected(f"{len(flat)} points on the face, at least {FEWEST_POINTS} are needed")
    start = face.flatten(cloud.centre[None])[0]
    nominal = np.array(list(radii.values()))
    rings = find_rings(flat, nominal, start, params.inlier / 2)
    if problem := _why_not(rings, radii, params):
        return Rejected(problem)
    plane = away_from_edges(points, face, rings, flange)
    found = _feature(points, plane, face, rings, flange, params)
    return replace(found, radii=dict(zip(radii, rings.circles.radii.tolist(), strict=True)))


def _ring_of(flange: Flange) -> tuple[float, float]:
    # Before a wrist circle's plane stands the plate; only what is outside it is in the plane.
    # Where the plate has ended, in radii of a wrist circle: of the robots known, wrists are 75 to
    # 90 mm across and plates 63
    return (0.85 * flange.rim if flange.bore is None else 0.0, 1.5 * flange.outer)


def _on_face(face: Plane, points: Floats) -> Mask:
    heights, sigma = face.heights(points), max(face.sigma, LEAST_NOISE)
    # Chamfers and mixed pixels lie behind the face; before it there is nothing but noise.
    return np.asarray((heights > -2.5 * sigma) & (heights < 6.0 * sigma))


def _why_not(rings: Rings, radii: Mapping[str, float], params: RimParams) -> str | None:
    """Return the reason why the circles are not the flange's; None if they are."""
    coverage = rings.coverage(params.inlier)
    for k, (name, expected) in enumerate(radii.items()):
        if coverage[k] < params.min_coverage:
            return (
                f"{coverage[k]:.0%} of the {name} lies within {params.inlier * 1e3:g} mm of a "
                f"circle, at least {params.min_coverage:.0%} is needed"
            )
        got = rings.circles.radii[k]
        if abs(got - expected) > params.radius_tolerance:
            return (
                f"{name} radius {got * 1e3:.2f} mm, expected {expected * 1e3:.2f} mm "
                f"within {params.radius_tolerance * 1e3:g} mm"
            )
    return None


def away_from_edges(points: Floats, face: Plane, rings: Rings, flange: Flange) -> Plane:
    """Return the face's plane from points at least a millimetre away from rim and bore.

    Near edges chamfers, mixed pixels and reflections displace points, mostly backwards. With 0.2 mm
    of noise they cannot be detected as outliers and would shift the plane by 0.015 mm.
    """
    offsets = face.flatten(points) - rings.circles.centre
    radius = distances(offsets)
    rim, *bore = rings.circles.radii
    edge = 1e-3  # how far from an edge a point is beyond its influence [m]
    inside = (radius < rim - edge) & (radius > (bore[0] if bore else _ring_of(flange)[0]) + edge)
    inner = chosen(points, inside)
    plane, half = face, 3 * max(face.sigma, LEAST_NOISE)
    # The face is near enough already for a few rounds of its own slab to settle it.
    for some in (thinned(inner), thinned(inner), inner):
        near = chosen(some, np.abs(plane.heights(some)) < half)
        if len(near) < FEWEST_POINTS:
            return face
        plane = fit_plane(near, face.normal)
    return plane


def _feature(
    points: Floats, plane: Plane, face: Plane, rings: Rings, flange: Flange, params: RimParams
) -> CircleFeature:
    """Return the circle's feature, moved from ``face`` to ``plane``, with its covariances."""
    centre = face.lift(rings.circles.centre)
    centre = centre - plane.heights(centre) * plane.normal
    axes = basis_of_plane(plane.normal)
    heights = plane.heights(points)
    near = np.abs(heights) < 3 * max(plane.sigma, LEAST_NOISE)
    about_centre = Plane(centre, plane.normal).flatten(chosen(points, near))
    of_plane = plane_covariance(about_centre, heights[near]) + _unevenness(flange, params)
    to_flange = flange.details.thickness if flange.bore is None else 0.0
    return CircleFeature(
        centre=centre + to_flange * plane.normal,
        normal=plane.normal,
        radii={},
        covariance=axes.T @ _centre_covariance(rings, of_plane, params) @ axes,
        normal_covariance=axes[:2].T @ of_plane[:2, :2] @ axes[:2],
        arc_coverage=float(rings.coverage(params.inlier)[0]),
        roll=roll_angle(about_centre, flange),
    )


def _unevenness(flange: Flange, params: RimParams) -> Floats:
    """Return the covariance (3, 3) of a face's slopes and height from its flatness tolerance.

    A surface uniform within a band has the standard deviation width / sqrt(12). For a slope this is
    divided by half the radius, the standard deviation of a disc's points along an axis.
    """
    height = params.flatness**2 / 12
    slope = height / (flange.rim / 2) ** 2
    return np.diag([slope, slope, height])


def _centre_covariance(rings: Rings, of_plane: Floats, params: RimParams) -> Floats:
    """Return the centre's covariance (3, 3) in the face's axes, with the normal last [m^2]."""
    covariance = params.scanner_error**2 * np.eye(3)
    covariance[:2, :2] += params.edge_bias**2 * np.eye(2)
    covariance[:2, :2] += rings.covariance()[:2, :2]
    covariance[2, 2] += of_plane[2, 2]
    return covariance


class Rings(NamedTuple):
    """Rim, and bore if there is one, with the edge points they were fitted to.

    Attributes:
        circles: Circles in the face's coordinates; radii in the order rim, bore.
        points: (N, 2) edge points [m].
        ring: (N,) 0 for rim, 1 for bore.
        bins: (k,) number of sectors for each ring.
        scale: Distance at which an edge point's weight is a half [m].
    """

    circles: Circles
    points: Floats
    ring: Indices
    bins: Indices
    scale: float

    @property
    def residuals(self) -> Floats:
        """Signed distances (N,) of edge points from their circles, positive outside [m]."""
        return circle_residuals(self.circles, self.points, self.ring)

    def coverage(self, inlier: float) -> Floats:
        """Return the share of each circle (k,) that has an edge point within ``inlier`` of it."""
        on_circle = np.abs(self.residuals) <= inlier
        return np.bincount(self.ring[on_circle], minlength=len(self.bins)) / self.bins

    def covariance(self) -> Floats:
        """Return the covariance (2 + k, 2 + k) of centre and radii [m^2]."""
        jacobian = circle_jacobian(self.circles, self.points, self.ring)
        stretch = sectors(self.points - self.circles.centre, STRETCHES) + STRETCHES * self.ring
        residuals, scale = self.residuals, self.scale
        weights, curvature = cauchy_weights(residuals, scale), cauchy_curvature(residuals, scale)
        return clustered_covariance(jacobian, residuals, weights, stretch, curvature)


def find_rings(flat: Floats, nominal: Floats, start: Floats, scale: float) -> Rings:
    """Return the concentric circles along the outer and inner edge of flat points.

    Args:
        flat: (N, 2) points of the face [m].
        nominal: (k,) radii to look for: rim, and bore if any [m].
        start: (2,) a point inside the bore, or near the centre [m].
        scale: Distance at which an edge point's weight is a half [m].
    """
    few = thinned(flat)
    bins = _sectors_for(few, nominal)
    edges = [few[edge_points(few, start, int(n), k == 0)] for k, n in enumerate(bins)]
    votes = tuple((e, float(r)) for e, r in zip(edges, nominal, strict=True))
    circles = Circles(vote_centre(votes, start, float(nominal[0])), nominal)
    if len(few) < len(flat):
        # A step as small [m] is the last with a few of the points
        circles = _settled(few, circles, nominal, bins, scale, 1e-4).circles
        bins = _sectors_for(flat, nominal)
        # How deep behind an edge its points are kept while the circles settle [m]
        flat, _ = _edges_near(flat, circles.centre, nominal, bins, 1e-3)
    # And so small with all
    return _settled(flat, circles, nominal, bins, scale, 1e-7)


def _settled(
    flat: Floats, circles: Circles, nominal: Floats, bins: Indices, scale: float, within: float
) -> Rings:
    """Return the circles through the edge points, iterated until the centre converges.

    The choice of edge points depends on the centre, and the centre on the edge points.
    """
    # Rounds of choosing edge points and fitting
    for _ in range(12):
        before = circles.centre
        points, ring = _edges_near(flat, circles.centre, nominal, bins)
        circles = fit_concentric(points, ring, circles, scale, 0.1 * within)
        if np.abs(circles.centre - before).max() < within:
            break
    return Rings(circles, points, ring, bins, scale)


def _sectors_for(flat: Floats, nominal: Floats) -> Indices:
    """Return the number of sectors for each ring (k,), each about two points wide.

    Narrower sectors often have no point at the edge itself; wider ones lose detail.
    """
    rim, *bore = nominal**2
    spacing = np.sqrt(np.pi * (rim - sum(bore)) / len(flat))
    bins: Indices = np.clip(np.rint(np.pi * nominal / spacing), 24, 360).astype(np.intp)
    return bins


def _edges_near(
    flat: Floats, centre: Floats, nominal: Floats, bins: Indices, depth: float = 0.0
) -> tuple[Floats, Indices]:
    """Return the edge points near each nominal circle, and each point's circle.

    With ``depth`` all points up to this distance behind an edge point are returned [m].
    """
    offsets = flat - centre
    reach = distances(offsets)
    found = []
    # Where the edges of rim and bore are sought, in nominal radii
    for k, (low, high) in enumerate(((0.8, 1.1), (0.75, 1.3))[: len(nominal)]):
        inside = (reach > low * nominal[k]) & (reach < high * nominal[k])
        near, outer, count = flat.T.compress(inside, axis=1).T, k == 0, int(bins[k])
        found.append(
            near[fringe(near, centre, count, depth, outer)]
            if depth
            else near[edge_points(near, centre, count, outer)]
        )
    ring = np.repeat(np.arange(len(found)), [len(f) for f in found])
    return np.concatenate(found), ring
