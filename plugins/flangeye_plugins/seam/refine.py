"""Fit a CAD to a scan finely: point to plane, with a covariance from the residuals themselves."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from flangeye.maths.geometry import rigid, rotation_exp
from flangeye.maths.statistics import covariance_inflation
from flangeye.types import Floats
from flangeye_plugins.seam.part import CadPart
from flangeye_plugins.seam.points import Oriented

TUKEY = 4.685
"""Tukey's constant: 95 % efficient on Gaussian residuals."""


@dataclass(frozen=True, eq=False)
class CadFit:
    """A CAD fitted to a scan.

    Attributes:
        pose: (4, 4) ``camera_T_part``.
        covariance: (6, 6), order (rotation, translation), left perturbation in ``camera``, the
            translation about ``about``.
        about: (3,) middle of the part, in ``camera`` [m].
        noise: Standard deviation of the points' distances from the surface [m].
        used: Points that count.
        blocks: Blocks they come from.
    """

    pose: Floats
    covariance: Floats
    about: Floats
    noise: float
    used: int
    blocks: int


def refine(scan: Oriented, part: CadPart, pose: Floats, reach: float) -> CadFit | None:
    """Fit point to plane from a rough pose; None when too little of the scan is near the part.

    Chen and Medioni (1992) against the CAD's exact surface, with Tukey's weights at a scale taken
    from the residuals. The reach falls by halves until the noise sets it.

    Args:
        scan: In ``camera``.
        part: The CAD.
        pose: (4, 4) rough ``camera_T_part``.
        reach: How far off that may be [m].
    """
    scale = reach / TUKEY
    iterations = 40
    for _ in range(iterations):
        rows = _equations(scan, part, pose, TUKEY * scale)
        if rows is None:
            return None
        step = _step(rows, scale, part.diagonal)
        pose = moved(pose, step, rows.about)
        noise = max(1.4826 * float(np.median(np.abs(rows.distances))), 1e-6)
        way = np.abs(step[:3]).max() * part.diagonal / 2 + np.abs(step[3:]).max()
        settled = scale <= 1.05 * noise
        scale = max(noise, scale / 2) if not settled else scale
        # No point of the part moves further [m]
        if settled and way < 2e-6:
            break
    rows = _equations(scan, part, pose, TUKEY * scale)
    return None if rows is None else _result(rows, pose, scale, part)


@dataclass(frozen=True, eq=False)
class _Rows:
    """One equation for each point that belongs to the part.

    Attributes:
        jacobian: (K, 6) of the distances in (rotation, translation about ``about``).
        distances: (K,) from the surface [m].
        about: (3,) in ``camera``.
        in_part: (K, 3) where on the part.
    """

    jacobian: Floats
    distances: Floats
    about: Floats
    in_part: Floats


def _equations(scan: Oriented, part: CadPart, pose: Floats, limit: float) -> _Rows | None:
    inside = scan.moved(np.asarray(np.linalg.inv(pose), dtype=np.float64))
    half = (part.workpiece.vertices.max(axis=0) - part.workpiece.vertices.min(axis=0)) / 2 + limit
    near = (np.abs(inside.points - part.centre) < half).all(axis=1)
    inside = inside.take(near)
    if len(inside) < 100:
        return None
    surface = part.nearest(inside.points)
    distances = np.einsum("ni,ni->n", surface.normals, inside.points - surface.points)
    off = np.linalg.norm(inside.points - surface.points, axis=1)
    # Cosine of the angle between a point's normal and that of the surface it may belong to; near an
    # edge, where normals mix, no point does
    alike_normal = float(np.cos(np.radians(20)))
    alike = np.einsum("ni,ni->n", surface.normals, inside.normals) > alike_normal
    # Beyond an edge the nearest point is not across from it: that says nothing about a plane.
    good = alike & (off < limit) & (np.abs(distances) > 0.7 * off)
    if good.sum() < 100:
        return None
    normals = surface.normals[good] @ pose[:3, :3].T
    about = pose[:3, :3] @ part.centre + pose[:3, 3]
    arms = scan.points[near][good] - about
    jacobian = np.hstack([np.cross(arms, normals), normals])
    return _Rows(jacobian, distances[good], about, inside.points[good])


def _weights(distances: Floats, scale: float) -> Floats:
    return np.asarray(np.maximum(1 - (distances / (TUKEY * scale)) ** 2, 0.0) ** 2)


def _step(rows: _Rows, scale: float, size: float) -> Floats:
    """Return the (6,) motion of the part; directions that nothing determines stay."""
    weights = _weights(rows.distances, scale)
    units = np.array([2 / size] * 3 + [1.0] * 3)  # rotations as the way of the part's ends
    scaled = rows.jacobian * units
    normal = (scaled * weights[:, None]).T @ scaled
    gradient = (scaled * weights[:, None]).T @ rows.distances
    ridge = 1e-9
    normal += ridge * np.trace(normal) * np.eye(6)
    return np.asarray(np.linalg.solve(normal, gradient) * units)


def moved(pose: Floats, step: Floats, about: Floats) -> Floats:
    """Return a pose (4, 4) after a motion (6,): a rotation vector about a point, and a shift."""
    turn = rotation_exp(step[:3])
    return np.asarray(rigid(turn, about - turn @ about + step[3:]) @ pose)


def _result(rows: _Rows, pose: Floats, scale: float, part: CadPart) -> CadFit:
    weights = _weights(rows.distances, scale)
    covariance, blocks = _sandwich(rows, weights, part)
    noise = float(np.sqrt(np.average(rows.distances**2, weights=weights)))
    # A fit is not believed to better than this share of a point's noise: edges, grain, the CAD's
    # own tolerance do not average out. Monte Carlo finds 0.08 (tests/plugins/seam)
    unshared = 0.1
    covariance[3:, 3:] += (unshared * noise) ** 2 * np.eye(3)
    return CadFit(pose, covariance, rows.about, noise, int((weights > 0).sum()), blocks)


def _sandwich(rows: _Rows, weights: Floats, part: CadPart) -> tuple[Floats, int]:
    """Return the (6, 6) covariance and the number of blocks it rests on.

    ``inv(H) M inv(H)`` (Huber 1967; Liang and Zeger 1986): H from the normal equations, M from
    the sums of each block's gradients, so that errors which neighbours share count as shared,
    however the scanner makes them, and a CAD that is not quite the workpiece counts too.
    """
    # Points of one block may share their error, as those of a scanner do; blocks are taken as
    # independent
    keys = np.floor(rows.in_part / (part.diagonal / 10)).astype(int) @ [10_000, 100, 1]
    _, block = np.unique(keys, return_inverse=True)
    blocks = int(block.max()) + 1
    gradients = np.zeros((blocks, 6))
    np.add.at(gradients, block, rows.jacobian * (weights * rows.distances)[:, None])
    freedom = max(blocks - 6, 1)
    inflation = covariance_inflation(freedom) * blocks / freedom
    meat = inflation * gradients.T @ gradients
    return _with_unknown(rows, weights, meat, part.diagonal), blocks


def _with_unknown(rows: _Rows, weights: Floats, meat: Floats, size: float) -> Floats:
    """Return ``inv(H) M inv(H)``; along what nothing determines, the size of the part.

    A direction rests on as many points as share in it; a handful at an edge is no surface.
    """
    units = np.array([2 / size] * 3 + [1.0] * 3)
    scaled = rows.jacobian * units * np.sqrt(weights)[:, None]
    values, vectors = np.linalg.eigh(scaled.T @ scaled)
    shares = (scaled @ vectors) ** 2
    points = shares.sum(axis=0) ** 2 / np.maximum((shares**2).sum(axis=0), 1e-300)
    # Points that must share in determining a direction: a square of a thirtieth of the diagonal
    fewest_supporting = 40
    least = 1e-6  # information on a direction below this share of that on the best is rounding
    known = (points >= fewest_supporting) & (values > least * values[-1])
    inverse = np.where(known, 1 / np.maximum(values, least * values[-1]), 0.0)
    turned = vectors.T @ (meat * np.outer(units, units)) @ vectors
    covariance = turned * np.outer(inverse, inverse) + np.diag(np.where(known, 0.0, size**2))
    return np.asarray(vectors @ covariance @ vectors.T * np.outer(units, units))
