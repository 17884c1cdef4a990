"""A body laid on all points of a scan around it, and how well that is known."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from flangeye.maths.geometry import rigid, rotation_exp
from flangeye.maths.statistics import SIGMA_OF_MAD
from flangeye.types import Floats, Indices, Singles
from flangeye_plugins.body.shape import GRAZING, Oriented, Shape
from flangeye_plugins.body.view import view_of

MOST, FEWEST = 12_000, 60
"""Points that are used at most, and needed."""

ROUNDS = 12
"""Times that the body is moved."""

STILL = 1e-5
"""Steps in turn [rad] and shift, in sizes, below which nothing moves any more."""

REACH, LEAST_REACH = 0.06, 4.0
"""How far off points count at first, as a share of the size, and at last, in deviations."""

PATCHES = 8
"""Patches along the body's size: points of one err together."""

STRAIGHT = float(np.cos(np.radians(40.0)))
"""Cosine of the largest angle between the ends of a face in body and scan."""

LEAST_NOISE = 1e-6
"""Deviation below which points are exact [m]."""

UNKNOWN = 1.0
"""Standard deviation of what the scan does not show at all: of a turn [rad], and of a shift in
sizes of the body. A turn that may be any has 1.8, and no estimator is linear that far."""

KNOWN = 0.05
"""A direction whose deviation is a smaller share of that counts as seen."""


class _Equations(NamedTuple):
    """Linearised residuals. The columns: turn [rad], shift in sizes, and the loss at edges.

    Attributes:
        jacobian: (N, 7).
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
        size: Of the body [m].
        centre: (3,) of the body in ``camera`` [m].
        bread: (7, 7) inverse of the information, with the prior's.
        meat: (7, 7) covariance of the scores, and the prior's information.
        faces: (F, 7) derivative of the scores by how far each face is off [1/m].
    """

    pose: Floats
    noise: float
    points: int
    edges: int
    size: float
    centre: Floats
    bread: Floats
    meat: Floats
    faces: Floats

    def weakest(self, freedoms: int) -> float:
        """Return the standard deviation of what the scan shows least, of so many directions.

        In sizes of the body, or radians, of the points alone.
        """
        inner = (self.bread @ self.meat @ self.bread)[:6, :6]
        return float(np.sqrt(np.linalg.eigvalsh(inner)[freedoms - 1]))

    @property
    def freedoms(self) -> int:
        """How many of the six the scan shows."""
        turn = np.linalg.eigvalsh(self.bread[:3, :3])
        shift = np.linalg.eigvalsh(self.bread[3:6, 3:6])
        return int((np.r_[turn, shift] < (KNOWN * UNKNOWN) ** 2).sum())

    def covariance(self, model_error: float, scanner_error: float) -> Floats:
        """Return (6, 6), order (rotation, translation), left perturbation in ``camera``.

        Args:
            model_error: Standard deviation of each face against the CAD [m].
            scanner_error: Standard deviation of the scanner's distortion along each axis [m].
        """
        inner = self.meat + model_error**2 * self.faces.T @ self.faces
        about_centre = (self.bread @ inner @ self.bread)[:6, :6]
        scale = np.repeat([1.0, self.size], 3)
        about_centre = scale[:, None] * about_centre * scale
        about_centre += np.diag(np.repeat([scanner_error / self.size, scanner_error], 3) ** 2)
        # The turn is about the centre, and the translation is the origin's.
        arm = self.pose[:3, 3] - self.centre
        carried = np.eye(6)
        carried[3:, :3] = -_cross_matrix(arm)
        moved = carried @ about_centre @ carried.T
        return np.asarray((moved + moved.T) / 2)


def fitted(points: Singles, shape: Shape, start: Floats, most: int = MOST) -> BodyFit | None:
    """Return a body laid on (N, 3) points, from a pose nearby; None where too few are on it.

    Args:
        points: Around it, all finite [m].
        shape: The body.
        start: (4, 4) ``camera_T_body``.
        most: Points that are used at most.
    """
    if len(points) < FEWEST:
        return None
    some = points[:: 1 + len(points) // most].astype(np.float64)
    edges = _scan_edges(points, shape.size)
    pose, lost, noise, reach = start, 0.0, np.inf, REACH * shape.size
    for _ in range(ROUNDS):
        surface = _surface(some, shape, pose, reach)
        ends = _ends(edges, shape, pose, lost, max(reach, 0.02 * shape.size))
        if len(surface.residual) < FEWEST:
            return None
        noise = _deviation(surface.residual)
        spread = max(_deviation(ends.residual), noise) if len(ends.residual) > 8 else np.inf
        equations, weights = _weighted(surface, ends, noise, spread)
        information = (equations.jacobian.T * weights) @ equations.jacobian + _prior(shape.size)
        gradient = (equations.jacobian.T * weights) @ equations.residual
        step = np.asarray(np.linalg.solve(information, gradient), np.float64)
        pose, lost = _moved(pose, shape, step), lost + float(step[6])
        closest = LEAST_REACH * noise
        if reach <= closest and np.abs(step).max() < STILL:
            break
        reach = max(0.5 * reach, closest)
    centre = pose[:3, :3] @ shape.centre + pose[:3, 3]
    residual = equations.residual - equations.jacobian @ step
    bread, meat = _sandwich(equations, weights, residual, shape)
    return BodyFit(
        pose, noise, len(surface.residual), len(ends.residual), shape.size, centre, bread, meat,
        _faces(equations, weights),
    )  # fmt: skip


def _surface(points: Floats, shape: Shape, pose: Floats, reach: float) -> _Equations:
    """Return how far points are off the body along the scanner's rays, where those meet it."""
    rotation, origin = pose[:3, :3], -pose[:3, 3] @ pose[:3, :3]
    rays = points @ rotation
    met = shape.meet(origin, rays)
    length = np.linalg.norm(rays, axis=1)
    facing = -np.einsum("ni,ni->n", met.normals, rays) / length
    away = (1 - met.depth) * length * facing  # along the normal, behind is positive
    at = np.flatnonzero(np.isfinite(met.depth) & (facing > GRAZING))
    at = at[np.abs(away[at]) < reach]
    place = origin + met.depth[at, None] * rays[at]
    normals = met.normals[at]
    return _equations(place, normals, -away[at], pose, shape, edge=False)


def _ends(edges: Oriented, shape: Shape, pose: Floats, lost: float, reach: float) -> _Equations:
    """Return how far ends of the scan's surfaces are off those of the body's faces."""
    from scipy.spatial import cKDTree

    model = _visible_ends(shape, pose)
    placed = model.points @ pose[:3, :3].T + pose[:3, 3]
    outwards = model.directions @ pose[:3, :3].T
    empty = _equations(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0), pose, shape, edge=True)
    if not len(placed) or not len(edges.points):
        return empty
    gap, nearest = cKDTree(edges.points).query(placed, distance_upper_bound=2 * reach)
    at = np.flatnonzero(np.isfinite(gap))
    number = nearest[at]
    straight = np.einsum("ni,ni->n", edges.directions[number], outwards[at]) > STRAIGHT
    at, number = at[straight], number[straight]
    residual = np.einsum("ni,ni->n", edges.points[number] - placed[at], outwards[at]) - lost
    near = np.abs(residual) < reach
    at, residual = at[near], residual[near]
    if not len(at):
        return empty
    return _equations(model.points[at], model.directions[at], residual, pose, shape, edge=True)


def _visible_ends(shape: Shape, pose: Floats) -> Oriented:
    """Return the ends of faces that end before the background, as the scanner sees them."""
    ends, origin = shape.ends, -pose[:3, 3] @ pose[:3, :3]
    if not len(ends.points):
        return ends
    apart = 0.02 * shape.size
    facing = np.einsum("ni,ni->n", ends.normals, origin - ends.points)
    far = np.linalg.norm(origin - ends.points, axis=1)
    on, off = (ends.points + side * apart * ends.directions - origin for side in (-1, 1))
    on_depth, off_depth = shape.meet(origin, on).depth, shape.meet(origin, off).depth
    share = apart / far
    seen = (facing > GRAZING * far) & (np.abs(on_depth - 1) < share) & (off_depth > 1 + 3 * share)
    return ends.take(np.flatnonzero(seen))


def _scan_edges(points: Singles, size: float) -> Oriented:
    """Return where the scan's surfaces end, finely."""
    view = view_of(points, size / 200)
    found, directions = view.ends
    found = found & np.isfinite(view.normals[..., 0])
    return Oriented(view.xyz[found], directions[found], view.normals[found])


def _equations(
    place: Floats, along: Floats, residual: Floats, pose: Floats, shape: Shape, edge: bool
) -> _Equations:
    """Return the equations of points (N, 3) on the body that are off along (N, 3) of it."""
    rotation = pose[:3, :3]
    arms = (place - shape.centre) @ rotation.T
    normals = along @ rotation.T
    lost = np.full((len(place), 1), float(edge))
    jacobian = np.hstack([np.cross(arms, normals), shape.size * normals, lost])
    return _Equations(jacobian, residual, place, along)


def _weighted(
    surface: _Equations, ends: _Equations, noise: float, spread: float
) -> tuple[_Equations, Floats]:
    """Return all equations with Cauchy weights over their variances."""
    parts = []
    for part, sigma in ((surface, noise), (ends, spread)):
        scale = 2.4 * sigma  # 95 % as efficient as least squares where the noise is normal
        parts.append(1 / (sigma**2 * (1 + (part.residual / scale) ** 2)))
    joined = _Equations(*(np.concatenate(both) for both in zip(surface, ends, strict=True)))
    return joined, np.concatenate(parts)


def _prior(size: float) -> Floats:
    """Return the (7, 7) information of what is known without a scan; of a loss at edges, 1 mm."""
    return np.diag(np.r_[np.repeat(1 / UNKNOWN**2, 6), 1 / 1e-3**2])


def _sandwich(
    equations: _Equations, weights: Floats, residual: Floats, shape: Shape
) -> tuple[Floats, Floats]:
    """Return bread and meat of a fit in which the points of a patch err together."""
    prior = _prior(shape.size)
    information = (equations.jacobian.T * weights) @ equations.jacobian + prior
    bread: Floats = np.linalg.inv(information).astype(np.float64)
    cluster = _patches(equations, shape)
    each = equations.jacobian.T * (weights * residual)
    scores = np.stack([np.bincount(cluster, column) for column in each], axis=1)
    occupied = len(scores)
    small_sample = occupied / max(occupied - 7, 1)
    return bread, small_sample * scores.T @ scores + prior


def _patches(equations: _Equations, shape: Shape) -> Indices:
    place = np.floor(equations.place / (shape.size / PATCHES)).astype(np.int64)
    keys = np.column_stack([place, _sextants(equations.facing)])
    return np.unique(keys, axis=0, return_inverse=True)[1].reshape(-1)


def _faces(equations: _Equations, weights: Floats) -> Floats:
    """Return (F, 7) what each face does to the scores where it is off by one metre."""
    _, face = np.unique(_sextants(equations.facing), return_inverse=True)
    each = equations.jacobian.T * weights
    return np.stack([np.bincount(face.reshape(-1), column) for column in each], axis=1)


def _sextants(directions: Floats) -> Indices:
    main = np.argmax(np.abs(directions), axis=1)
    up = np.take_along_axis(directions, main[:, None], axis=1)[:, 0] > 0
    return np.asarray(2 * main + up)


def _moved(pose: Floats, shape: Shape, step: Floats) -> Floats:
    rotation = rotation_exp(step[:3]) @ pose[:3, :3]
    centre = pose[:3, :3] @ shape.centre + pose[:3, 3] + shape.size * step[3:6]
    return rigid(rotation, centre - rotation @ shape.centre)


def _deviation(residual: Floats) -> float:
    return max(float(SIGMA_OF_MAD * np.median(np.abs(residual))), LEAST_NOISE)


def _cross_matrix(vector: Floats) -> Floats:
    x, y, z = vector
    return np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
