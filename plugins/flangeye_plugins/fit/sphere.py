"""``fit.sphere``: centre of a calibration sphere from its visible cap."""

from typing import ClassVar, Literal, NamedTuple

import numpy as np

from flangeye import stage
from flangeye.maths.circles import sectors
from flangeye.maths.statistics import SIGMA_OF_MAD
from flangeye.models.targets import Sphere
from flangeye.types import CircleFeature, FlangeCloud, Floats, Indices, Rejected
from flangeye.types.geometry import basis_of_plane
from flangeye_plugins.fit.circles import cauchy_curvature, cauchy_weights
from flangeye_plugins.fit.uncertainty import STRETCHES, ScannerErrorParams, clustered_covariance

RINGS = 3
"""Rings about the line of sight in which, with the sectors, neighbouring points err together."""


LEAST_SCALE = 1e-6
"""Noise below which points are exact [m]."""


class SphereParams(ScannerErrorParams):
    """Parameters of ``fit.sphere``."""

    radius: Literal["known", "free"] = "known"
    """Hold the radius at that of the recipe's sphere, or fit it, as where the diameter is unknown.
    On a cap a free radius costs the depth of the centre most of its accuracy."""
    # Points seen more obliquely than this are left out [rad]
    max_incidence: ClassVar[float] = float(np.radians(60))
    # Smallest share of the cap within that angle to be seen
    min_coverage: ClassVar[float] = 0.4
    # Largest difference of the fitted radius from the sphere's [m]
    radius_tolerance: ClassVar[float] = 0.5e-3
    # Standard deviation of the sphere's radius as the scanner sees it (make, coating, penetration
    # of light), when it is held; added to the covariance along the view [m]
    radius_error: ClassVar[float] = 0.02e-3


class SphereFit(NamedTuple):
    """A sphere fitted to points.

    Attributes:
        centre: (3,) centre [m].
        radius: Radius [m].
        points: (N, 3) points within the incidence limit [m].
        scale: Distance at which a point's weight is a half [m].
    """

    centre: Floats
    radius: float
    points: Floats
    scale: float = LEAST_SCALE

    @property
    def residuals(self) -> Floats:
        """Signed distances (N,) of the points from the sphere, positive outside [m]."""
        return np.asarray(np.linalg.norm(self.points - self.centre, axis=1) - self.radius)

    @property
    def weights(self) -> Floats:
        """Weights (N,) of the points."""
        return cauchy_weights(self.residuals, self.scale)

    @property
    def jacobian(self) -> Floats:
        """Derivatives (N, 4) of the residuals by centre and radius."""
        return sphere_jacobian(self.points, self.centre)


@stage("fit.sphere")
def fit_sphere(
    cloud: FlangeCloud, sphere: Sphere, params: SphereParams
) -> CircleFeature | Rejected:
    """Fit a calibration sphere of known size to the cap that the scanner sees.

    Robust least squares on the distances from the surface, over points within the incidence limit,
    beyond which scanners blur and lose points. The radius is fitted as well, to test whether it is
    the sphere; the centre is that for the known radius, unless the recipe leaves it free. The fit
    is deterministic.
    """
    points = cloud.cloud.xyz.astype(np.float64)
    fewest = 50
    if len(points) < fewest:
        return Rejected(f"{len(points)} points, at least {fewest} are needed")
    start = float(np.median(np.linalg.norm(points - cloud.centre, axis=1)))
    size = start if sphere.size is None else sphere.size
    known = fit_cap(points, cloud.centre, size, params.max_incidence, free=False)
    free = fit_cap(known.points, known.centre, size, params.max_incidence, free=True)
    held = params.radius == "known" and sphere.size is not None
    coverage = cap_coverage(known, params.max_incidence)
    problem = _why_not(free, coverage, sphere, params)
    if problem:
        return Rejected(problem)
    chosen = known if held else free
    return CircleFeature(
        centre=chosen.centre,
        normal=None,
        radii={"sphere": free.radius},
        covariance=_covariance(chosen, held, params),
        normal_covariance=None,
        arc_coverage=coverage,
        centre_in_flange=np.array(sphere.centre_in_flange),
    )


def fit_cap(
    points: Floats, start: Floats, radius: float, max_incidence: float, free: bool
) -> SphereFit:
    """Return the sphere that minimises the Cauchy loss of the points' distances.

    Gauss-Newton with Cauchy weights, whose scale is twice the residuals' scatter. The points within
    the incidence limit depend on the centre and are updated with it.

    Args:
        points: (N, 3) points in ``camera`` [m].
        start: (3,) rough centre [m].
        radius: Radius of the sphere, or its start value [m].
        max_incidence: Largest angle of the surface's normal to the line of sight [rad].
        free: Whether the radius is fitted.
    """
    fit = SphereFit(start, radius, points)
    for _ in range(30):
        seen = points[incidence_cosine(points, fit.centre) > np.cos(max_incidence)]
        if len(seen) < 4:
            break
        fit = _scaled(fit._replace(points=seen))
        jacobian = fit.jacobian if free else fit.jacobian[:, :3]
        weighted = jacobian * fit.weights[:, None]
        step = np.linalg.lstsq(weighted.T @ jacobian, -weighted.T @ fit.residuals, rcond=None)[0]
        change = float(step[3]) if free else 0.0
        fit = fit._replace(centre=fit.centre + step[:3], radius=fit.radius + change)
        if np.abs(step).max() < 1e-9:
            break
    return _scaled(fit)


def _scaled(fit: SphereFit) -> SphereFit:
    sigma = SIGMA_OF_MAD * float(np.median(np.abs(fit.residuals)))
    return fit._replace(scale=max(2 * sigma, LEAST_SCALE))


def sphere_jacobian(points: Floats, centre: Floats) -> Floats:
    """Return the derivatives (N, 4) of distances from a sphere by centre and radius."""
    offsets = points - centre
    distance = np.maximum(np.linalg.norm(offsets, axis=1, keepdims=True), 1e-9)
    return np.hstack([-offsets / distance, -np.ones((len(points), 1))])


def incidence_cosine(points: Floats, centre: Floats) -> Floats:
    """Return the cosines (N,) of the incidence angle at points on a sphere."""
    offsets = points - centre
    lengths = np.linalg.norm(offsets, axis=1) * np.linalg.norm(points, axis=1)
    return np.asarray(-np.einsum("ni,ni->n", offsets, points) / np.maximum(lengths, 1e-12))


def cap_coverage(fit: SphereFit, max_incidence: float) -> float:
    """Return the share of the cap's patches within the incidence limit that have points."""
    patches = 2 * STRETCHES * RINGS
    return len(np.unique(_patch(fit, 2 * STRETCHES, np.sin(max_incidence)))) / patches


def _patch(fit: SphereFit, count: int, widest: float) -> Indices:
    """Return each point's patch: a sector of a ring about the line of sight."""
    flat = fit.points @ basis_of_plane(fit.centre)[:2].T  # across the line to the centre
    share = (np.hypot(flat[:, 0], flat[:, 1]) / (widest * fit.radius)) ** 2
    ring = np.minimum((RINGS * share).astype(np.intp), RINGS - 1)
    return np.asarray(count * ring + sectors(flat, count))


def _why_not(free: SphereFit, coverage: float, sphere: Sphere, params: SphereParams) -> str | None:
    """Return the reason why the fit is not the sphere; None if it is."""
    if coverage < params.min_coverage:
        return (
            f"{coverage:.0%} of the cap seen within {np.degrees(params.max_incidence):g} deg, at "
            f"least {params.min_coverage:.0%} is needed"
        )
    if sphere.size is not None and abs(free.radius - sphere.size) > params.radius_tolerance:
        return (
            f"sphere radius {free.radius * 1e3:.2f} mm, expected {sphere.size * 1e3:.2f} mm "
            f"within {params.radius_tolerance * 1e3:g} mm"
        )
    return None


def _covariance(fit: SphereFit, held: bool, params: SphereParams) -> Floats:
    """Return the covariance (3, 3) of the centre [m^2], for a held or a fitted radius."""
    jacobian = fit.jacobian[:, :3] if held else fit.jacobian
    cluster = _patch(fit, STRETCHES, np.sin(params.max_incidence))
    curvature = cauchy_curvature(fit.residuals, fit.scale)
    found = clustered_covariance(jacobian, fit.residuals, fit.weights, cluster, curvature)[:3, :3]
    along = fit.centre / np.linalg.norm(fit.centre)
    if held:
        # What a larger sphere does: every residual smaller by the same amount.
        weighted = jacobian * curvature[:, None]
        moved = np.linalg.lstsq(weighted.T @ jacobian, weighted.sum(axis=0), rcond=None)[0]
        found = found + params.radius_error**2 * np.outer(moved, moved)
    else:
        # By how much more than the distortion a free radius moves the centre along the view: a cap
        # seen to 60 degrees is half a radius deep, so what bends its edge against its middle counts
        # twice
        found = found + (2.0 * params.scanner_error) ** 2 * np.outer(along, along)
    return np.asarray(found + params.scanner_error**2 * np.eye(3))
