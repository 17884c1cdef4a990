"""``fit.sphere_profile``: centre of a calibration sphere from one profile of a line scanner."""

from typing import ClassVar, Literal, NamedTuple

import numpy as np

from flangeye import Params, stage
from flangeye.maths.circles import sectors
from flangeye.maths.statistics import SIGMA_OF_MAD
from flangeye.models.targets import Sphere
from flangeye.types import Capture, CircleFeature, Floats, Rejected, Seed
from flangeye_plugins.fit.circles import (
    Circles,
    cauchy_curvature,
    cauchy_weights,
    circle_jacobian,
    circle_residuals,
    fit_concentric,
)
from flangeye_plugins.fit.ransac import circles_through
from flangeye_plugins.fit.uncertainty import STRETCHES, clustered_covariance

PROFILE_POINTS = 20


class SphereProfileParams(Params):
    """Parameters of ``fit.sphere_profile``."""

    side: Literal["+y", "-y"]
    """On which side of the laser's plane, in the scanner's frame, the centre of the sphere is. One
    profile cannot show it; keep all poses of a session on one side."""
    # Least and largest distance of the centre from the plane, in radii. Near the middle the
    # distance follows badly from the circle's size, near the edge the circle is small; the best
    # is 0.7 to 0.97
    offset: ClassVar[tuple[float, float]] = (0.4, 0.97)
    # Largest distance of a point from the circle it belongs to [m]
    tolerance: ClassVar[float] = 0.3e-3
    # Smallest share of the circle to be seen; half is the most
    min_coverage: ClassVar[float] = 0.15
    # Standard deviation of the sphere's radius as it is seen [m]
    radius_error: ClassVar[float] = 0.02e-3
    # Standard deviation along each axis of the scanner's own distortion, which a single profile
    # cannot show; added to the covariance [m]
    scanner_error: ClassVar[float] = 0.03e-3


class PlanarCircle(NamedTuple):
    """A circle in the laser's plane, and the points on it.

    Attributes:
        circles: The circle in (x, z); there is only one.
        points: (N, 2) points on it [m].
        scale: Distance at which a point's weight is a half [m].
    """

    circles: Circles
    points: Floats
    scale: float

    @property
    def radius(self) -> float:
        """Radius of the circle [m]."""
        return float(self.circles.radii[0])


@stage("fit.sphere_profile")
def fit_sphere_profile(
    capture: Capture, sphere: Sphere, params: SphereProfileParams, seed: Seed
) -> CircleFeature | Rejected:
    """Find the centre of a sphere of known size from one profile of it.

    The laser's plane (y = 0 of the scanner) cuts the sphere in a circle. Its centre gives x and z;
    its radius r gives the distance of the sphere's centre from the plane, ``y = sqrt(R^2 - r^2)``,
    on the side stated in the recipe. An error of r is multiplied by r / y.
    """
    xyz = capture.cloud.points().astype(np.float64)
    xyz = xyz[np.isfinite(xyz).all(axis=1)]
    problem = _why_no_profile(xyz)
    if problem:
        return Rejected(problem)
    arc = find_arc(xyz[:, [0, 2]], sphere.radius, params, seed)
    if isinstance(arc, Rejected):
        return arc
    away = np.sqrt(max(sphere.radius**2 - arc.radius**2, 0.0))
    count = 72  # of 5 degrees each
    coverage = len(np.unique(sectors(arc.points - arc.circles.centre, count))) / count
    problem = _why_not(away / sphere.radius, coverage, params)
    if problem:
        return Rejected(problem)
    x, z = arc.circles.centre
    y = float(away if params.side == "+y" else -away)
    return CircleFeature(
        centre=np.array([x, y, z]),
        normal=None,
        radii={"profile": arc.radius},
        covariance=_covariance(arc, y, sphere.radius, params),
        normal_covariance=None,
        arc_coverage=coverage,
        centre_in_flange=np.array(sphere.centre_in_flange),
    )


def _why_no_profile(xyz: Floats) -> str | None:
    if len(xyz) < PROFILE_POINTS:
        return f"{len(xyz)} points, at least {PROFILE_POINTS} are needed"
    off = float(np.abs(xyz[:, 1]).max())
    # How far from its plane a profile's points may be written [m]
    if off > 1e-4:
        return (
            f"no profile: points lie up to {off * 1e3:.3g} mm off the plane y = 0; a profile has "
            "x along the line and z away from the scanner (a whole scan needs fit.sphere)"
        )
    return None


def find_arc(
    points: Floats, radius: float, params: SphereProfileParams, seed: int
) -> PlanarCircle | Rejected:
    """Return the circle with most points of a profile, seen from outside.

    Candidates are circles through random triples that are not larger than the sphere and whose
    centre is farther from the scanner than their points. The one with most inliers is fitted to
    them by robust least squares.

    Args:
        points: (N, 2) points of the profile, x and z [m].
        radius: Radius of the sphere [m].
        params: Tolerance, and limits of the centre's distance from the plane.
        seed: Seed of the random triples.
    """
    centres, radii = _candidates(points, radius, params, seed)
    if not len(radii):
        return Rejected(_no_arc(radius))
    gaps = np.linalg.norm(points[None] - centres[:, None], axis=2) - radii[:, None]
    near = (np.abs(gaps) < params.tolerance) & (points[None, :, 1] < centres[:, None, 1])
    best = int(np.argmax(near.sum(axis=1)))
    if near[best].sum() < PROFILE_POINTS:
        return Rejected(_no_arc(radius))
    return _refined(points, centres[best], float(radii[best]), params.tolerance)


def _candidates(
    points: Floats, radius: float, params: SphereProfileParams, seed: int
) -> tuple[Floats, Floats]:
    """Return centres (M, 2) and radii (M,) of circles through triples that can be the sphere's."""
    rng = np.random.default_rng(seed)
    flat = np.insert(points[np.argsort(points[:, 0])], 1, 0.0, axis=1)
    near = np.searchsorted(flat[:, 0], flat[:, 0] + radius)  # beyond it nothing is on the circle
    samples = 2000  # triples of points that are tried
    first = rng.integers(len(flat), size=samples)
    reach = np.maximum(near[first] - first, 1)[:, None]
    others = first[:, None] + (rng.random((samples, 2)) * reach).astype(np.intp)
    centres, radii = circles_through(flat[np.column_stack([first, others])])
    least = radius * np.sqrt(1 - params.offset[1] ** 2)
    fitting = (radii > 0.5 * least) & (radii < radius + params.tolerance)
    return centres[fitting][:, [0, 2]], radii[fitting]


def _refined(points: Floats, centre: Floats, radius: float, tolerance: float) -> PlanarCircle:
    circles = Circles(centre, np.array([radius]))
    scale = tolerance
    for _ in range(5):
        gaps = np.linalg.norm(points - circles.centre, axis=1) - circles.radii[0]
        on_arc = points[(np.abs(gaps) < tolerance) & (points[:, 1] < circles.centre[1])]
        ring = np.zeros(len(on_arc), dtype=np.intp)
        circles = fit_concentric(on_arc, ring, circles, scale)
        residuals = circle_residuals(circles, on_arc, ring)
        # Noise below which points are exact [m]
        scale = max(2 * SIGMA_OF_MAD * float(np.median(np.abs(residuals))), 1e-6)
    return PlanarCircle(circles, on_arc, scale)


def _no_arc(radius: float) -> str:
    return (
        f"the profile shows no arc of a sphere {2e3 * radius:g} mm across whose centre lies behind "
        "the surface"
    )


def _why_not(offset: float, coverage: float, params: SphereProfileParams) -> str | None:
    least, most = params.offset
    if not least <= offset <= most:
        return (
            f"the laser passes {offset:.2f} radii beside the sphere's centre, {least:g} to "
            f"{most:g} are allowed; move the scanner across its line"
        )
    if coverage < params.min_coverage:
        return f"{coverage:.0%} of the circle is seen, at least {params.min_coverage:.0%} is needed"
    return None


def _covariance(arc: PlanarCircle, y: float, radius: float, params: SphereProfileParams) -> Floats:
    """Return the centre's covariance (3, 3) [m^2] from circle, sphere radius and scanner."""
    ring = np.zeros(len(arc.points), dtype=np.intp)
    residual = circle_residuals(arc.circles, arc.points, ring)
    cluster = sectors(arc.points - arc.circles.centre, 2 * STRETCHES)
    found = clustered_covariance(
        circle_jacobian(arc.circles, arc.points, ring),
        residual,
        cauchy_weights(residual, arc.scale),
        cluster,
        cauchy_curvature(residual, arc.scale),
    )
    centre_from_circle = np.array([[1.0, 0, 0], [0, 0, -arc.radius / y], [0, 1.0, 0]])
    out = centre_from_circle @ found @ centre_from_circle.T
    out[1, 1] += (radius / y * params.radius_error) ** 2
    return np.asarray(out + params.scanner_error**2 * np.eye(3))
