"""``fit.ransac_circle``: the paper's fit, RANSAC with circles through three points."""

from typing import ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from flangeye import Params, stage
from flangeye.maths.circles import sectors
from flangeye.maths.planes import Plane
from flangeye.models.targets import Flange
from flangeye.types import CircleFeature, FlangeCloud, Floats, Rejected, Seed
from flangeye.types.geometry import basis_of_plane
from flangeye.units import Length, param
from flangeye_plugins.fit.circles import disc_face
from flangeye_plugins.fit.uncertainty import plane_covariance


class RansacCircleParams(Params):
    """Parameters of ``fit.ransac_circle``; the defaults are the paper's (section 3.2.2)."""

    radius: Length | None = param(None, gt=0)
    """R, the largest radius a circle may have; the flange's if not given."""
    # Largest difference of a radius below R [m]
    e_r: ClassVar[float] = 1e-3
    # Largest distance of a point from the sphere about the centre [m]
    e_d: ClassVar[float] = 0.3e-3
    # Number of three-point samples
    k_max: ClassVar[int] = 10_000
    # Largest distance of a point from the face's plane [m]
    plane: ClassVar[float] = 1e-3
    # Fewest points near the best circle for it to be believed
    min_points: ClassVar[int] = 100


class CircleHypotheses(NamedTuple):
    """Circles through three points each, with their numbers of inliers.

    Attributes:
        centres: (M, 3) centres [m].
        radii: (M,) radii [m].
        scores: (M,) numbers of points within e_d of the sphere about the centre.
    """

    centres: Floats
    radii: Floats
    scores: NDArray[np.intp]


@stage("fit.ransac_circle")
def fit_ransac_circle(
    cloud: FlangeCloud, flange: Flange, params: RansacCircleParams, seed: Seed
) -> CircleFeature | Rejected:
    """Fit the rim as the paper does: RANSAC on three points, no refinement (section 2.1.4).

    All ``k_max`` samples are drawn at once. Circles with a radius from R - e_r to R are scored by
    the number of points within e_d of the sphere about the centre, and the best one is the result.
    Its covariance is the scatter of the circles that score nearly as well, as the seed decides
    which of them wins.
    """
    points = cloud.cloud.xyz.astype(np.float64)
    rough = Plane(cloud.centre, cloud.normal)
    plane = disc_face(points, rough, (0.0, 1.5 * flange.outer), 3 * params.plane)
    if plane is None:
        return Rejected(f"fewer than 3 of {len(points)} points lie on a common plane")
    points = points[np.abs(plane.heights(points)) <= params.plane]
    if len(points) < params.min_points:
        return Rejected(
            f"{len(points)} points on the face, at least {params.min_points} are needed"
        )
    largest = params.radius or flange.rim
    hypotheses = draw_circles(points, (largest - params.e_r, largest), params, seed)
    if len(hypotheses.radii) == 0:
        return Rejected(
            f"none of {params.k_max} samples gives a radius from "
            f"{(largest - params.e_r) * 1e3:g} to {largest * 1e3:g} mm"
        )
    best = int(np.argmax(hypotheses.scores))
    if hypotheses.scores[best] < params.min_points:
        return Rejected(
            f"{hypotheses.scores[best]} points within {params.e_d * 1e3:g} mm of the best circle, "
            f"at least {params.min_points} are needed"
        )
    return _feature(points, plane, hypotheses, best, params)


def draw_circles(
    points: Floats, radii: tuple[float, float], params: RansacCircleParams, seed: int
) -> CircleHypotheses:
    """Return scored circles through random triples of points, with radii in an interval."""
    rng = np.random.default_rng(seed)
    triples = points[rng.integers(len(points), size=(params.k_max, 3))]
    centres, found = circles_through(triples)
    fitting = (found >= radii[0]) & (found <= radii[1])
    centres, found = centres[fitting], found[fitting]
    return CircleHypotheses(centres, found, sphere_scores(points, centres, found, params.e_d))


def circles_through(triples: Floats) -> tuple[Floats, Floats]:
    """Return centres (N, 3) and radii (N,) of the circles through triples of points (N, 3, 3).

    With a = p1 - p3 and b = p2 - p3 the circumcentre is p3 + ((|a|^2 b - |b|^2 a) x (a x b)) / (2
    |a x b|^2). Collinear triples give infinity.
    """
    a, b = triples[:, 0] - triples[:, 2], triples[:, 1] - triples[:, 2]
    normal = np.cross(a, b)
    squared = (normal**2).sum(axis=1)
    collinear = squared == 0
    squared[collinear] = np.inf
    longer = (a**2).sum(axis=1)[:, None] * b - (b**2).sum(axis=1)[:, None] * a
    offset = np.cross(longer, normal) / (2 * squared[:, None])
    radius = np.linalg.norm(offset, axis=1)
    radius[collinear] = np.inf
    return triples[:, 2] + offset, radius


def sphere_scores(points: Floats, centres: Floats, radii: Floats, e_d: float) -> NDArray[np.intp]:
    """Return the number of points within e_d of each circle's sphere (M,)."""
    # Differences of single-precision coordinates about their mean are exact to 10 nm here, and
    # twice as fast to score as doubles.
    middle = points.mean(axis=0)
    local = (points - middle).T.astype(np.float32)
    scores = np.zeros(len(centres), dtype=np.intp)
    for k, centre in enumerate((centres - middle).astype(np.float32)):
        distance = np.sqrt(((local - centre[:, None]) ** 2).sum(axis=0))
        scores[k] = np.count_nonzero(np.abs(distance - np.float32(radii[k])) < e_d)
    return scores


def _feature(
    points: Floats,
    plane: Plane,
    hypotheses: CircleHypotheses,
    best: int,
    params: RansacCircleParams,
) -> CircleFeature:
    centre, radius = hypotheses.centres[best], float(hypotheses.radii[best])
    axes = basis_of_plane(plane.normal)[:2]
    offsets = (points - centre) @ axes.T
    slopes = plane_covariance(offsets, plane.heights(points))[:2, :2]
    return CircleFeature(
        centre=centre,
        normal=plane.normal,
        radii={"rim": radius},
        covariance=scatter_of_rivals(hypotheses, best, params.e_d),
        normal_covariance=axes.T @ slopes @ axes,
        arc_coverage=_coverage(offsets, radius, params.e_d),
    )


def scatter_of_rivals(hypotheses: CircleHypotheses, best: int, e_d: float) -> Floats:
    """Return the scatter (3, 3) of good circles' centres about the best one's [m^2].

    A good circle has at least 70 % of the best score. On the published clouds the normalised
    squared difference from ``fit.rim`` is then 2.5 on average (3 is expected); with 90 % a third of
    the true scatter is missed, sometimes all of it. As points up to e_d away score equally, a tenth
    of e_d is the smallest standard deviation in any direction.
    """
    good = hypotheses.scores >= 0.7 * hypotheses.scores[best]
    offsets = hypotheses.centres[good] - hypotheses.centres[best]
    return np.asarray(offsets.T @ offsets / len(offsets) + (0.1 * e_d) ** 2 * np.eye(3))


def _coverage(offsets: Floats, radius: float, e_d: float) -> float:
    """Return the share of the circle's 5-degree sectors that have points within e_d of it."""
    on_circle = np.abs(np.hypot(offsets[:, 0], offsets[:, 1]) - radius) <= e_d
    return len(np.unique(sectors(offsets[on_circle], 72))) / 72
