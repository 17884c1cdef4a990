"""A body laid on all points of a scan around it, and how well that is known."""

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

FEWEST = 60
"""Points that are needed."""


FACINGS = 6
"""Ways that an edge may look, each with a loss of its own."""


UNKNOWN = 1.0
"""Standard deviation of what the scan does not show at all: of a turn [rad], and of a shift in
sizes of the body. A turn that may be any has 1.8, and no estimator is linear that far."""


class _Equations(NamedTuple):
    """Linearised residuals.

    Columns: turn [rad], shift in sizes, loss at edges by facing, rounding, and the body's scale.

    Attributes:
        jacobian: (N, 14).
        residual: (N,) [m].
        place: (N, 3) on the body [m].
        facing: (N, 3) which way the face looks there, on the body.
    """

    jacobian: Floats
    residual: Floats
    place: Floats
    facing: Floats


@dataclass(frozen=True, eq=False)
class BodyFit:
    """A fitted pose.

    Attributes:
        pose: (4, 4) ``camera_T_body``.
        noise: Robust standard deviation of the points from the surface [m].
        points: How many points of surfaces count.
        edges: How many points of edges do.
        size: Size of the body [m].
        centre: (3,) of the body in ``camera`` [m].
        bread: (14, 14) change of what is estimated by the scores: of the pose and what a scanner
            does to it at the scale of the mesh, and in the last row that of the scale.
        meat: (14, 14) covariance of the scores by the scan's noise, and the prior's information.
        lost: (6,) width that the scan seems to lose at ends of faces, by the way they look: -x, +x,
            -y, ... of the body [m]; negative where its edge is inside.
        odd: How unlike a scanner's that and the rounding are: squared, over their prior's
            covariance, with seven degrees of freedom.
        patches: (P, 3) places on the body that err together, in ``camera`` [m].
        pulls: (P, 14, 3) derivative of the scores by how far each of them is off [1/m].
        oversize: By which share the scan shows the body larger than its mesh: one step, which falls
            short where much of the scan is far off the mesh and counts less.
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
        """Return the standard deviation of the least certain of so many directions and the scale.

        In sizes of the body, or radians, of the points alone: of the scale, how far it moves the
        body's ends. A corner holds a pose, and any size.
        """
        inner = self.bread @ self.meat @ self.bread.T
        pose = np.linalg.eigvalsh(inner[:6, :6])[freedoms - 1]
        return float(np.sqrt(max(pose, inner[-1, -1] / 2**2)))

    @property
    def freedoms(self) -> int:
        """Degrees of freedom of the pose, of six, that the scan determines."""
        turn = np.linalg.eigvalsh(self.bread[:3, :3])
        shift = np.linalg.eigvalsh(self.bread[3:6, 3:6])
        # A direction whose deviation is a smaller share of that counts as seen
        return int((np.r_[turn, shift] < (0.05 * UNKNOWN) ** 2).sum())

    def covariance(self, model_error: float, distortion: Callable[[Floats], Floats]) -> Floats:
        """Return (6, 6) covariance, order (rotation, translation), left perturbation in ``camera``.

        Args:
            model_error: Standard deviation of the surface against the CAD, along each axis [m]; a
                smooth field over the body.
            distortion: Scanner distortion, (P, 3, K): how each of K independent weights of unit
                variance moves (P, 3) points [m].
        """
        about_centre = self._spread(model_error, distortion)[:6, :6]
        # The turn is about the centre, and the translation is the origin's.
        carried = np.diag(np.repeat([1.0, self.size], 3))
        carried[3:, :3] = -hat(self.pose[:3, 3] - self.centre)
        moved = carried @ about_centre @ carried.T
        return np.asarray((moved + moved.T) / 2)

    def unsure(self, model_error: float, distortion: Callable[[Floats], Floats]) -> float:
        """Return the standard deviation of ``oversize``; arguments as of ``covariance``."""
        return float(np.sqrt(self._spread(model_error, distortion)[-1, -1]))

    def _spread(self, model_error: float, distortion: Callable[[Floats], Floats]) -> Floats:
        """Return (14, 14) covariance of all that is estimated, the turn about the centre."""
        apart = np.linalg.norm(self.patches[:, None] - self.patches, axis=2)
        # A body's surface is off its CAD alike over a quarter of its size: about a face
        alike = np.exp(-0.5 * (apart / ((1 / 4) * self.size)) ** 2)
        inner = self.meat + model_error**2 * np.einsum(
            "pai,pq,qbi->ab", self.pulls, alike, self.pulls, optimize=True
        )
        bent = np.einsum("pai,pik->ak", self.pulls, distortion(self.patches))
        return np.asarray(self.bread @ (inner + bent @ bent.T) @ self.bread.T)


def fitted(points: Singles, shape: Shape, start: Floats, most: int = 12_000) -> BodyFit | None:
    """Return a body laid on (N, 3) points, from a pose nearby; None where too few are on it.

    Args:
        points: Around it, all finite [m].
        shape: The body.
        start: (4, 4) ``camera_T_body``.
        most: Points that are used at most.
    """
    if len(points) < FEWEST:
        return None
    laid = _Laying.of(points, shape, most)
    rest = laid.settled(start)
    return rest and laid.fit_of(rest)


class _Settled(NamedTuple):
    """A body at rest on a scan."""

    pose: Floats
    left: _Equations
    weights: Floats
    information: Floats
    surface: int
    noise: float
    scanner: Floats


@dataclass(frozen=True, eq=False)
class _Laying:
    """A scan that a body is laid on.

    Attributes:
        points: (N, 3) that are used [m].
        edges: Edges of the scan.
        shape: The body.
        spacing: Between points at unit depth.
        raster: Standard deviation of a scan's end across its edge [m].
        usual, prior: (7,) and (7, 7) mean and information of what the scanner does at edges.
    """

    points: Floats
    edges: OrientedPoints
    shape: Shape
    spacing: float
    raster: float
    usual: Floats
    prior: Floats

    @classmethod
    def of(cls, points: Singles, shape: Shape, most: int) -> _Laying:
        some, spacing = points[:: 1 + len(points) // most].astype(np.float64), spacing_of(points)
        apart = spacing * float(np.median(some[:, 2]))
        edges, cell = _scan_edges(points, shape.size)
        # Mean and standard deviation of the width that a scanner loses along edges, in distances
        # between points, before any scan. Filters of scanners reach over a few points.
        lost = 1.0
        usual = np.r_[np.full(FACINGS, -cell / 2 - lost * apart), 0.0]
        # How much a scanner rounds, see `_rounding`; before any scan
        # Standard deviation of where an edge lies between two points, in their distance. All points
        # of a straight edge along the raster share it.
        raster = 1 / 12**0.5
        spread = np.diag(np.r_[np.full(FACINGS, (raster * apart) ** 2), 10.0**2])
        spread[:FACINGS, :FACINGS] += (lost * apart) ** 2
        return cls(some, edges, shape, spacing, raster * cell, usual, np.linalg.inv(spread))

    def settled(self, pose: Floats) -> _Settled | None:
        """Return the body moved until it rests; None where too few points are on it."""
        shape, scanner = self.shape, self.usual
        # As a share of the size, at first
        reach = beside = 0.06 * shape.size
        rounding = np.zeros(len(self.points))
        prior = np.zeros((6 + len(scanner),) * 2)
        prior[:6, :6] = UNKNOWN**-2.0 * np.eye(6)
        prior[6:, 6:] = self.prior
        # The body is moved a dozen times at most
        # How far off points count at last, in deviations.
        least_reach = 4.0
        for _ in range(12):
            surface = _surface(self.points, shape, pose, reach, rounding, scanner[-1])
            # Near its rest a body shows the same ends
            if not rounding.any():
                model = _visible_ends(shape, pose, self.spacing)
            ends = _ends(self.edges, model, shape, pose, scanner[:-1], beside)
            if len(surface.residual) < FEWEST:
                return None
            noise = _deviation(surface.residual)
            # Of so few none counts
            few = len(ends.residual) < 9
            # By the raster: what ends are off where the body is not there yet is no noise.
            spread = np.inf if few else max(self.raster, noise)
            equations, weights = _weighted(surface, ends, noise, spread)
            jacobian = equations.jacobian[:, :-1]
            information = (jacobian.T * weights) @ jacobian + prior
            gradient = (jacobian.T * weights) @ equations.residual
            gradient[6:] += self.prior @ (self.usual - scanner)
            step = np.asarray(np.linalg.solve(information, gradient), np.float64)
            pose, scanner = _moved(pose, shape, step), scanner + step[6:]
            if reach < 2 * least_reach * noise:
                # [rad] and sizes: nothing moves any more
                if rounding.any() and np.abs(step[:6]).max() < 1e-5:
                    break
                rounding = _rounding(self.points, shape, pose, self.spacing)
            reach = max(0.5 * reach, least_reach * noise)
            if not few:
                beside = max(0.5 * beside, least_reach * spread)
        left = equations._replace(residual=equations.residual - jacobian @ step)
        return _Settled(pose, left, weights, information, len(surface.residual), noise, scanner)

    def fit_of(self, rest: _Settled) -> BodyFit:
        """Return it with all that its covariance needs."""
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
    """Return (14, 14) that takes scores to pose and scanner, at the mesh's scale, and to it."""
    jacobian = rest.left.jacobian
    along = (jacobian.T * rest.weights) @ jacobian[:, -1]
    bread = np.zeros(2 * jacobian.shape[1:])
    bread[:-1, :-1] = np.linalg.inv(rest.information)
    # What the scale does to the residuals, less what the others do alike
    bread[-1] = np.r_[-bread[:-1, :-1] @ along[:-1], 1.0]
    bread[-1] /= bread[-1] @ along + UNKNOWN**-2.0
    return bread


def _surface(
    points: Floats, shape: Shape, pose: Floats, reach: float, rounding: Floats, rounded: float
) -> _Equations:
    """Return how far points are off the body along the scanner's rays, where those meet it."""
    rotation, origin = pose[:3, :3], -pose[:3, 3] @ pose[:3, :3]
    rays = points @ rotation
    met = shape.meet(origin, rays)
    length = np.linalg.norm(rays, axis=1)
    facing = -np.einsum("ni,ni->n", met.normals, rays) / length
    bent = rounding * length * facing
    away = (1 - met.depth) * length * facing - rounded * bent  # along the normal, behind: positive
    at = np.flatnonzero(np.isfinite(met.depth) & (facing > GRAZING))
    at = at[np.abs(away[at]) < reach]  # none beside a step, where it is not a number
    place = origin + met.depth[at, None] * rays[at]
    errors = np.column_stack([np.zeros((len(at), FACINGS)), -bent[at]])
    return _equations(place, met.normals[at], -away[at], pose, shape, errors)


def _rounding(points: Floats, shape: Shape, pose: Floats, spacing: float) -> Floats:
    """Return (N,) by which share of its depth each point lies before the mean of those around it.

    A scanner averages over neighbouring rays: where the surface bends, points are off by a multiple
    of this, which depends on the scanner's filter. NaN beside a step, where it averages over what
    is left; of a body that is nothing but edges, zero.
    """
    rotation, origin = pose[:3, :3], -pose[:3, 3] @ pose[:3, :3]
    own = shape.meet(origin, points @ rotation).depth
    total = np.zeros(len(points))
    sides = ((1, 0), (-1, 0), (0, 1), (0, -1))  # neighbours of a ray
    # Distances between points within which a scanner averages most: published scans of planes
    # correlate by 0.7 so far apart.
    reach = 2
    for side in sides:
        beside = points + reach * spacing * np.array([*side, 0.0]) * points[:, 2:]
        with np.errstate(invalid="ignore"):
            off = shape.meet(origin, beside @ rotation).depth - own
            # Neighbouring rays meet one surface where their depths differ by less than so many of
            # the distances between them: seen at less than 79 degrees to its normal.
            total += np.where(np.abs(off) < 5.0 * reach * spacing, off, np.nan)
    few = np.isfinite(total).sum() < FEWEST
    return np.zeros(len(points)) if few else total / len(sides)


def _ends(
    edges: OrientedPoints,
    model: OrientedPoints,
    shape: Shape,
    pose: Floats,
    lost: Floats,
    reach: float,
) -> _Equations:
    """Return how far ends of the scan's surfaces are off those of a body's faces that are seen.

    Across the ray, as a scanner sees them: on a face askew a point lost is a longer way.
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
    """Return the ends of faces that end before the background, as the scanner sees them."""
    ends, origin = shape.outline, -pose[:3, 3] @ pose[:3, :3]
    if not len(ends.points):
        return ends
    far = np.linalg.norm(origin - ends.points, axis=1)
    facing = np.einsum("ni,ni->n", ends.normals, origin - ends.points)
    seen = facing > GRAZING * far
    # Right beyond its end a chamfer goes on, and a little farther a fillet.
    for share in (2 * spacing, 0.02 * shape.size / far):
        apart = (share * far)[:, None] * ends.directions
        on, off = (ends.points + side * apart - origin for side in (-1, 1))
        seen &= np.abs(shape.meet(origin, on).depth - 1) < share
        seen &= shape.meet(origin, off).depth > 1 + 3 * share
    return ends.take(np.flatnonzero(seen))


def _scan_edges(points: Singles, size: float) -> tuple[OrientedPoints, float]:
    """Return where the scan's surfaces end, finely, and the width of the cells [m]."""
    # Width of the cells that edges are found in, as a share of the size, at least
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
) -> _Equations:
    """Return the equations of points (N, 3) on the body that are off along (N, 3) of it.

    The last (N, 7) are what losses at edges and rounding do to each.
    """
    rotation = pose[:3, :3]
    arms = (place - shape.centre) @ rotation.T
    normals = along @ rotation.T
    swells = np.einsum("ni,ni->n", arms, normals)
    jacobian = np.column_stack([np.cross(arms, normals), shape.size * normals, errors, swells])
    return _Equations(jacobian, residual, place, along)


def _weighted(
    surface: _Equations, ends: _Equations, noise: float, spread: float
) -> tuple[_Equations, Floats]:
    """Return all equations with weights (Geman and McClure) over their variances."""
    parts = []
    for part, sigma in ((surface, noise), (ends, spread)):
        # 94 % as efficient as least squares on normal noise; what is far off pulls at nothing
        scale = 3.6 * sigma
        parts.append(1 / (sigma**2 * (1 + (part.residual / scale) ** 2) ** 2))
    joined = _Equations(*(np.concatenate(both) for both in zip(surface, ends, strict=True)))
    return joined, np.concatenate(parts)


def _noise(equations: _Equations, weights: Floats, cluster: Indices, surface: int) -> Floats:
    """Return the (14, 14) covariance of the scores by noise that points of a patch share.

    How many times as much as that of independent ones is one number for surfaces and one for edges:
    a covariance by the patches' own sums would have hardly more of them than columns.
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


def _patches(equations: _Equations, shape: Shape) -> Indices:
    # Points of one err together
    place = np.floor(equations.place / (shape.size / 8)).astype(np.int64)
    keys = np.column_stack([place, _sextants(equations.facing)])
    return np.unique(keys, axis=0, return_inverse=True)[1].reshape(-1)


def _pulls(
    equations: _Equations, weights: Floats, cluster: Indices, pose: Floats
) -> tuple[Floats, Floats]:
    """Return where patches are (P, 3), and what being off there does to the scores (P, 14, 3)."""
    many = np.bincount(cluster)
    place = equations.place @ pose[:3, :3].T + pose[:3, 3]
    middles = np.stack([np.bincount(cluster, x) / many for x in place.T], axis=1)
    each = (equations.jacobian * weights[:, None])[:, :, None]
    each = each * (equations.facing @ pose[:3, :3].T)[:, None]
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
    # Exact, below [m]
    return max(float(SIGMA_OF_MAD * np.median(np.abs(residual))), 1e-6)
