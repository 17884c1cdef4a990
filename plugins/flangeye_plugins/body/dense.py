"""Fit a body's pose to all scan points around it, with covariance.

The fit minimises distances along the surface normals, with robust weights. Besides the pose it
estimates two systematic effects of a scanner: the width lost at edges (six values, by the edge's
direction) and the rounding of curved surfaces. The body's scale is estimated by one step at the
end. The covariance is a sandwich estimate: bread times meat times bread.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from flangeye.maths.statistics import SIGMA_OF_MAD
from flangeye.types import Floats, Indices, Singles
from flangeye.types.geometry import hat, rigid, rotation_exp
from flangeye_plugins.body.shape import GRAZING, OrientedPoints, Shape
from flangeye_plugins.body.view import spacing_of, view_of

FEWEST_ON_BODY = 60
"""Smallest number of points for a fit."""


FACINGS = 6
"""Number of edge directions (-x, +x, -y, ...), each with its own lost width."""


UNKNOWN = 1.0
"""Prior standard deviation of rotation [rad], and of translation and scale in sizes of the body. A
completely unknown rotation has 1.8, but the linearisation does not reach that far.
"""


class _Linearised(NamedTuple):
    """Linearised residuals of the fit.

    The 14 columns are rotation [rad], translation [sizes of the body], lost width by direction of
    the edge [m], rounding, and the body's scale.

    Attributes:
        jacobian: (N, 14) derivatives of the body's surface along the residual.
        residual: (N,) distances of scan points from the body [m].
        place: (N, 3) points on the body, in its frame [m].
        directions: (N, 3) directions of the residuals, in the body's frame.
    """

    jacobian: Floats
    residual: Floats
    place: Floats
    directions: Floats


@dataclass(frozen=True, eq=False)
class BodyFit:
    """A fitted pose of a body, with what its covariance needs.

    Attributes:
        pose: (4, 4) ``camera_T_body``.
        noise: Robust standard deviation of the points from the surface [m].
        points: Number of surface points used.
        edges: Number of edge points used.
        size: Diagonal of the body's bounding box [m].
        centre: (3,) centre of the body in ``camera`` [m].
        bread: (14, 14) derivative of the estimates by the scores. Pose and scanner effects are
            estimated at the mesh's scale; the last row is the scale's.
        meat: (14, 14) covariance of the scores from the scan's noise, plus the prior's information.
        lost: (6,) displacement of the scan's edges, by direction -x, +x, -y, ... of the body [m];
            negative where they lie inside the body's edges.
        odd: Squared Mahalanobis distance of ``lost`` and the rounding from their prior (7 degrees
            of freedom); large values are implausible for a scanner.
        patches: (P, 3) centres of patches whose errors are correlated, in ``camera`` [m].
        pulls: (P, 14, 3) derivative of the scores by a displacement of each patch [1/m].
        oversize: Relative excess of the body's size over its mesh's; from one step, so it is too
            small where much of the scan is far off the mesh and has little weight.
    """

    pose: Floats
    noise: float
    points: int
    edges: int
    size: float
    centre: Floats
    bread: Floats
    meat: Floats
    lost: Floats
    odd: float
    patches: Floats
    pulls: Floats
    oversize: float

    def weakest(self, freedoms: int) -> float:
        """Return the standard deviation of the least certain direction of pose or scale.

        Only the scan's noise counts. Units are sizes of the body, or radians; the scale counts by
        the displacement of the body's ends. The scale is included because a corner alone fixes a
        pose for a body of any size.

        Args:
            freedoms: Number of the pose's directions that the body's shape determines.
        """
        inner = self.bread @ self.meat @ self.bread.T
        pose = np.linalg.eigvalsh(inner[:6, :6])[freedoms - 1]
        return float(np.sqrt(max(pose, inner[-1, -1] / 2**2)))

    def covariance(self, model_error: float, distortion: Callable[[Floats], Floats]) -> Floats:
        """Return the (6, 6) covariance (rotation, translation), left perturbation in ``camera``.

        Args:
            model_error: Standard deviation of the real surface from the CAD along each axis [m], as
                a smooth field over the body.
            distortion: Scanner distortion: maps points (P, 3) to their displacements (P, 3, K) by
                each of K independent unit-variance weights [m].
        """
        about_centre = self._spread(model_error, distortion)[:6, :6]
        # The fit rotates about the body's centre; the result's translation is that of its origin.
        carried = np.diag(np.repeat([1.0, self.size], 3))
        carried[3:, :3] = -hat(self.pose[:3, 3] - self.centre)
        moved = carried @ about_centre @ carried.T
        return np.asarray((moved + moved.T) / 2)

    def unsure(self, model_error: float, distortion: Callable[[Floats], Floats]) -> float:
        """Return the standard deviation of ``oversize``; arguments as for ``covariance``."""
        return float(np.sqrt(self._spread(model_error, distortion)[-1, -1]))

    def _spread(self, model_error: float, distortion: Callable[[Floats], Floats]) -> Floats:
        """Return the (14, 14) covariance of all estimates; rotation is about the body's centre."""
        apart = np.linalg.norm(self.patches[:, None] - self.patches, axis=2)
        # The surface's deviation from the CAD is correlated over about a face: a quarter of the
        # size
        alike = np.exp(-0.5 * (apart / ((1 / 4) * self.size)) ** 2)
        inner = self.meat + model_error**2 * np.einsum(
            "pai,pq,qbi->ab", self.pulls, alike, self.pulls, optimize=True
        )
        bent = np.einsum("pai,pik->ak", self.pulls, distortion(self.patches))
        return np.asarray(self.bread @ (inner + bent @ bent.T) @ self.bread.T)


def fitted(points: Singles, shape: Shape, start: Floats, most: int = 12_000) -> BodyFit | None:
    """Return a body's pose fitted to scan points (N, 3); None if too few points are on it.

    Args:
        points: Points around the body, all finite [m].
        shape: The body.
        start: (4, 4) start pose ``camera_T_body``, close to the solution.
        most: Largest number of points to use.
    """
    if len(points) < FEWEST_ON_BODY:
        return None
    laid = _PreparedScan.of(points, shape, most)
    rest = laid.settled(start)
    return rest and laid.fit_of(rest)


class _Settled(NamedTuple):
    """Converged state of the fit."""

    pose: Floats
    left: _Linearised
    weights: Floats
    information: Floats
    surface: int
    noise: float
    scanner: Floats


@dataclass(frozen=True, eq=False)
class _PreparedScan:
    """A scan, prepared for fitting a body to it.

    Attributes:
        points: (N, 3) points that are used [m].
        edges: Edges of the scan.
        shape: The body.
        spacing: Distance between neighbouring points at unit depth.
        raster: Standard deviation of a scan's end across its edge [m].
        usual: (7,) prior mean of the lost widths and the rounding.
        prior: (7, 7) prior information matrix of these.
    """

    points: Floats
    edges: OrientedPoints
    shape: Shape
    spacing: float
    raster: float
    usual: Floats
    prior: Floats

    @classmethod
    def of(cls, points: Singles, shape: Shape, most: int) -> _PreparedScan:
        some, spacing = points[:: 1 + len(points) // most].astype(np.float64), spacing_of(points)
        apart = spacing * float(np.median(some[:, 2]))
        edges, cell = _scan_edges(points, shape.size)
        # Prior mean and standard deviation of the width lost at edges, in point distances: the
        # filters of scanners reach over a few points
        lost = 1.0
        usual = np.r_[np.full(FACINGS, -cell / 2 - lost * apart), 0.0]
        # Standard deviation of an edge's position between two points, in their distance (uniform).
        # All points of a straight edge along the raster share it.
        raster = 1 / 12**0.5
        spread = np.diag(np.r_[np.full(FACINGS, (raster * apart) ** 2), 10.0**2])
        spread[:FACINGS, :FACINGS] += (lost * apart) ** 2
        return cls(some, edges, shape, spacing, raster * cell, usual, np.linalg.inv(spread))

    def settled(self, pose: Floats) -> _Settled | None:
        """Return the converged fit from a start pose; None if too few points are on the body."""
        shape, scanner = self.shape, self.usual
        # As a share of the size, at first
        reach = beside = 0.06 * shape.size
        rounding = np.zeros(len(self.points))
        prior = np.zeros((6 + len(scanner),) * 2)
        prior[:6, :6] = UNKNOWN**-2.0 * np.eye(6)
        prior[6:, 6:] = self.prior
        # Final cut-off of residuals, in standard deviations
        least_reach = 4.0
        for _ in range(12):
            surface = _surface(self.points, shape, pose, reach, rounding, scanner[-1])
            # Close to convergence the same ends stay visible, so they are no longer recomputed
            if not rounding.any():
                model = _visible_ends(shape, pose, self.spacing)
            ends = _ends(self.edges, model, shape, pose, scanner[:-1], beside)
            if len(surface.residual) < FEWEST_ON_BODY:
                return None
            noise = _deviation(surface.residual)
            # So few edge points are not used at all
            few = len(ends.residual) < 9
            # Weighted by the raster, not by the residuals: before convergence these are not noise
            spread = np.inf if few else max(self.raster, noise)
            equations, weights = _weighted(surface, ends, noise, spread)
            jacobian = equations.jacobian[:, :-1]
            information = (jacobian.T * weights) @ jacobian + prior
            gradient = (jacobian.T * weights) @ equations.residual
            gradient[6:] += self.prior @ (self.usual - scanner)
            step = np.asarray(np.linalg.solve(information, gradient), np.float64)
            pose, scanner = _moved(pose, shape, step), scanner + step[6:]
            if reach < 2 * least_reach * noise:
                # Converged: step in [rad] and sizes of the body
                if rounding.any() and np.abs(step[:6]).max() < 1e-5:
                    break
                rounding = _rounding(self.points, shape, pose, self.spacing)
            reach = max(0.5 * reach, least_reach * noise)
            if not few:
                beside = max(0.5 * beside, least_reach * spread)
        left = equations._replace(residual=equations.residual - jacobian @ step)
        return _Settled(pose, left, weights, information, len(surface.residual), noise, scanner)

    def fit_of(self, rest: _Settled) -> BodyFit:
        """Return the result of a converged fit, with the terms of its covariance."""
        shape, pose = self.shape, rest.pose
        centre = pose[:3, :3] @ shape.centre + pose[:3, 3]
        bread = _bread(rest)
        cluster = _patches(rest.left, shape)
        meat = _noise(rest.left, rest.weights, cluster, rest.surface)
        meat[[*range(6), -1], [*range(6), -1]] += UNKNOWN**-2.0
        meat[6:-1, 6:-1] += self.prior
        patches, pulls = _pulls(rest.left, rest.weights, cluster, pose)
        edges, off = len(rest.left.residual) - rest.surface, rest.scanner - self.usual
        return BodyFit(
            pose, rest.noise, rest.surface, edges, shape.size, centre, bread, meat,
            rest.scanner[:FACINGS], float(off @ self.prior @ off), patches, pulls,
            float(bread[-1] @ (rest.left.jacobian.T * rest.weights) @ rest.left.residual),
        )  # fmt: skip


def _bread(rest: _Settled) -> Floats:
    """Return the derivative (14, 14) of the estimates by the scores; see :class:`BodyFit`."""
    jacobian = rest.left.jacobian
    along = (jacobian.T * rest.weights) @ jacobian[:, -1]
    bread = np.zeros(2 * jacobian.shape[1:])
    bread[:-1, :-1] = np.linalg.inv(rest.information)
    # The scale's own effect on the residuals, with the part explained by the others removed
    bread[-1] = np.r_[-bread[:-1, :-1] @ along[:-1], 1.0]
    bread[-1] /= bread[-1] @ along + UNKNOWN**-2.0
    return bread


def _surface(
    points: Floats, shape: Shape, pose: Floats, reach: float, rounding: Floats, rounded: float
) -> _Linearised:
    """Return the equations of scan points whose rays meet the body.

    A residual is the distance along the ray, projected on the surface normal, corrected for the
    scanner's rounding.
    """
    rotation, origin = pose[:3, :3], -pose[:3, 3] @ pose[:3, :3]
    rays = points @ rotation
    met = shape.meet(origin, rays)
    length = np.linalg.norm(rays, axis=1)
    facing = -np.einsum("ni,ni->n", met.normals, rays) / length
    bent = rounding * length * facing
    away = (
        1 - met.depth
    ) * length * facing - rounded * bent  # along the normal; behind is positive
    at = np.flatnonzero(np.isfinite(met.depth) & (facing > GRAZING))
    at = at[np.abs(away[at]) < reach]  # excludes NaN, next to a step of depth
    # Through the mounting face the scan shows the carrier, which may lie close behind it
    place = origin + met.depth[at, None] * rays[at]
    own = ~shape.on_carrier(place, met.normals[at])
    at, place = at[own], place[own]
    errors = np.column_stack([np.zeros((len(at), FACINGS)), -bent[at]])
    return _equations(place, met.normals[at], -away[at], pose, shape, errors)


def _rounding(points: Floats, shape: Shape, pose: Floats, spacing: float) -> Floats:
    """Return the second difference of depth at each ray (N,), relative to the ray's depth.

    A scanner averages over neighbouring rays, so on curved surfaces its points are off by a
    multiple of this; the factor depends on the scanner's filter and is estimated. NaN next to a
    step of depth; all zero for a body that is mostly edges.
    """
    rotation, origin = pose[:3, :3], -pose[:3, 3] @ pose[:3, :3]
    own = shape.meet(origin, points @ rotation).depth
    total = np.zeros(len(points))
    sides = ((1, 0), (-1, 0), (0, 1), (0, -1))  # directions to neighbouring rays
    # Typical reach of a scanner's averaging, in point distances: in published scans of planes,
    # points this far apart correlate by 0.7
    reach = 2
    for side in sides:
        beside = points + reach * spacing * np.array([*side, 0.0]) * points[:, 2:]
        with np.errstate(invalid="ignore"):
            off = shape.meet(origin, beside @ rotation).depth - own
            # Neighbouring rays meet the same surface if their depths differ by less than 5 times
            # their distance: an incidence below 79 degrees
            total += np.where(np.abs(off) < 5.0 * reach * spacing, off, np.nan)
    few = np.isfinite(total).sum() < FEWEST_ON_BODY
    return np.zeros(len(points)) if few else total / len(sides)


def _ends(
    edges: OrientedPoints,
    model: OrientedPoints,
    shape: Shape,
    pose: Floats,
    lost: Floats,
    reach: float,
) -> _Linearised:
    """Return the equations of the scan's edges, matched to the visible ends of the body's faces.

    Offsets are measured perpendicular to the ray, because the scanner loses a fixed number of
    pixels, which is a longer distance on an oblique face.
    """
    from scipy.spatial import cKDTree

    placed = model.points @ pose[:3, :3].T + pose[:3, 3]
    outwards = model.directions @ pose[:3, :3].T
    nothing = np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0)
    empty = _equations(*nothing, pose, shape, np.zeros((0, FACINGS + 1)))
    if not len(placed) or not len(edges.points):
        return empty
    gap, nearest = cKDTree(edges.points).query(placed, distance_upper_bound=2 * reach)
    at = np.flatnonzero(np.isfinite(gap))
    number = nearest[at]
    # The largest angle between the ends of a face in body and scan is 40 deg
    cosine = np.einsum("ni,ni->n", edges.directions[number], outwards[at])
    straight = cosine > np.cos(np.radians(40.0))
    at, number = at[straight], number[straight]
    rays = placed[at] / np.linalg.norm(placed[at], axis=1, keepdims=True)
    across = np.linalg.norm(np.cross(outwards[at], rays), axis=1)
    offset = np.einsum("ni,ni->n", edges.points[number] - placed[at], outwards[at])
    facing = _sextants(model.directions[at])
    residual = across * offset - lost[facing]
    near = np.abs(residual) < reach
    at, residual, across, facing = at[near], residual[near], across[near], facing[near]
    if not len(at):
        return empty
    along = across[:, None] * model.directions[at]
    errors = np.eye(FACINGS, FACINGS + 1)[facing]
    return _equations(model.points[at], along, residual, pose, shape, errors)


def _visible_ends(shape: Shape, pose: Floats, spacing: float) -> OrientedPoints:
    """Return the visible ends of the body's faces behind which the scanner sees background."""
    ends, origin = shape.outline, -pose[:3, 3] @ pose[:3, :3]
    if not len(ends.points):
        return ends
    far = np.linalg.norm(origin - ends.points, axis=1)
    facing = np.einsum("ni,ni->n", ends.normals, origin - ends.points)
    seen = facing > GRAZING * far
    # A chamfer continues right beyond a face's end, a fillet a little farther: test both distances
    for share in (2 * spacing, 0.02 * shape.size / far):
        apart = (share * far)[:, None] * ends.directions
        on, off = (ends.points + side * apart - origin for side in (-1, 1))
        seen &= np.abs(shape.meet(origin, on).depth - 1) < share
        seen &= shape.meet(origin, off).depth > 1 + 3 * share
    return ends.take(np.flatnonzero(seen))


def _scan_edges(points: Singles, size: float) -> tuple[OrientedPoints, float]:
    """Return the edges of the scan's surfaces, and the cell width of their image [m]."""
    # Smallest cell width of the image, as a share of the body's size
    view = view_of(points, (1 / 200) * size)
    found, directions = view.ends
    found = found & np.isfinite(view.normals[..., 0])
    cell = view.angle * float(np.median(points[:, 2]))
    return OrientedPoints(view.xyz[found], directions[found], view.normals[found]), cell


def _equations(
    place: Floats,
    along: Floats,
    residual: Floats,
    pose: Floats,
    shape: Shape,
    errors: Floats,
) -> _Linearised:
    """Return the equations of residuals at points ``place`` (N, 3) along ``along`` (N, 3).

    ``errors`` (N, 7) are the derivatives by lost widths and rounding.
    """
    rotation = pose[:3, :3]
    arms = (place - shape.centre) @ rotation.T
    normals = along @ rotation.T
    swells = np.einsum("ni,ni->n", arms, normals)
    jacobian = np.column_stack([np.cross(arms, normals), shape.size * normals, errors, swells])
    return _Linearised(jacobian, residual, place, along)


def _weighted(
    surface: _Linearised, ends: _Linearised, noise: float, spread: float
) -> tuple[_Linearised, Floats]:
    """Return all equations, and their Geman-McClure weights over their variances."""
    parts = []
    for part, sigma in ((surface, noise), (ends, spread)):
        # This scale is 94 % efficient for normal noise; the influence of outliers goes to zero
        scale = 3.6 * sigma
        parts.append(1 / (sigma**2 * (1 + (part.residual / scale) ** 2) ** 2))
    joined = _Linearised(*(np.concatenate(both) for both in zip(surface, ends, strict=True)))
    return joined, np.concatenate(parts)


def _noise(equations: _Linearised, weights: Floats, cluster: Indices, surface: int) -> Floats:
    """Return the (14, 14) covariance of the scores from noise that is correlated within patches.

    The covariance for independent points is scaled by one inflation factor for surfaces and one for
    edges. A cluster-robust estimate from the patches' sums would have hardly more patches than its
    14 columns.
    """
    each = weights * equations.residual
    out = np.zeros(2 * equations.jacobian.shape[1:])
    for part in (slice(0, surface), slice(surface, None)):
        own, total = each[part] ** 2, np.bincount(cluster[part], each[part])
        if len(own):
            shared = max(float((total**2).sum() / max(own.sum(), 1e-300)), 1.0)
            jacobian = equations.jacobian[part]
            out += shared * (jacobian.T * own) @ jacobian
    return out


def _patches(equations: _Linearised, shape: Shape) -> Indices:
    # Points of one cell (an eighth of the size) and facing form a patch
    place = np.floor(equations.place / (shape.size / 8)).astype(np.int64)
    keys = np.column_stack([place, _sextants(equations.directions)])
    return np.unique(keys, axis=0, return_inverse=True)[1].reshape(-1)


def _pulls(
    equations: _Linearised, weights: Floats, cluster: Indices, pose: Floats
) -> tuple[Floats, Floats]:
    """Return the patches' centres (P, 3) and their effect on the scores (P, 14, 3)."""
    many = np.bincount(cluster)
    place = equations.place @ pose[:3, :3].T + pose[:3, 3]
    middles = np.stack([np.bincount(cluster, x) / many for x in place.T], axis=1)
    each = (equations.jacobian * weights[:, None])[:, :, None]
    each = each * (equations.directions @ pose[:3, :3].T)[:, None]
    pulls = np.zeros((len(many), *each.shape[1:]))
    np.add.at(pulls, cluster, each)
    return middles, pulls


def _sextants(directions: Floats) -> Indices:
    main = np.argmax(np.abs(directions), axis=1)
    up = np.take_along_axis(directions, main[:, None], axis=1)[:, 0] > 0
    return np.asarray(2 * main + up)


def _moved(pose: Floats, shape: Shape, step: Floats) -> Floats:
    rotation = rotation_exp(step[:3]) @ pose[:3, :3]
    centre = pose[:3, :3] @ shape.centre + pose[:3, 3] + shape.size * step[3:6]
    return rigid(rotation, centre - rotation @ shape.centre)


def _deviation(residual: Floats) -> float:
    # Floor against exact synthetic data [m]
    return max(float(SIGMA_OF_MAD * np.median(np.abs(residual))), 1e-6)
