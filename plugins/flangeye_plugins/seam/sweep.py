"""Fit one cross-section, swept along a smooth line, to all points near a seam at once.

Gauss-Newton with Tukey's weights minimises ``sum rho(f_i / sigma)`` of the signed distances f. The
unknowns are cubic B-splines y(s), z(s) and roll(s), and the section's shape. Weak priors on shape
and splines bridge stretches without points, where the covariance grows.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from flangeye.maths.statistics import SIGMA_OF_MAD
from flangeye.types import Floats, Indices
from flangeye_plugins.seam.rough import JointPlace, Spline, turn
from flangeye_plugins.seam.template import OFFSETS, Section

WIDE = 18e-3
"""Width of a face, from its end, whose points are fitted [m]; plates are flat over this width."""


@dataclass(frozen=True, eq=False)
class Sweep:
    """A cross-section, swept along a line.

    Attributes:
        spline: The line's y and z, and the section's roll, along the course.
        section: The cross-section.
        sigma: Robust standard deviation of the points on it [m].
        covariance: (3m + k, 3m + k) covariance of the coefficients and the shape's free numbers.
    """

    spline: Spline
    section: Section
    sigma: float
    covariance: Floats

    def in_section(self, local: Floats) -> Floats:
        """Return local points (N, 3) in the section's own axes (N, 2)."""
        line = self.spline.at(local[:, 0])
        return turn(local[:, 1:3] - line[:, :2], line[:, 2])

    def line_covariance(self, s: Floats) -> Floats:
        """Return the covariance (N, 2, 2) of the seam's y and z at s [m^2]."""
        basis, m = self.spline.basis(s).toarray(), len(self.spline.values)
        blocks = self.covariance[: 2 * m, : 2 * m].reshape(2, m, 2, m)
        return np.asarray(np.einsum("ni,aibj,nj->nab", basis, blocks, basis))


def swept_from(places: list[JointPlace], length: float, closed: bool) -> Sweep:
    """Return the start of the fit from places along the line."""
    s = np.array([p.s for p in places])
    # Unwrapped, or a roll near half a turn would make the spline swing through zero.
    values = np.column_stack([[p.q for p in places], np.unwrap([p.roll for p in places])])
    shape = np.median([p.shape for p in places], axis=0)
    spline = Spline.through(length, closed, s, values)
    return Sweep(spline, Section(places[0].joint, shape), np.nan, np.zeros((0, 0)))


def fitted(
    start: Sweep, local: Floats, pitch: float, tolerance: float, edges: tuple[Floats, Indices]
) -> Sweep:
    """Return the fitted cross-section and line.

    Args:
        start: Start value, near the solution.
        local: (N, 3) points near the seam [m].
        pitch: Distance between neighbouring points [m]; points closer than this to a corner of the
            section are left out, as their pixels see both sides.
        tolerance: Initial largest distance from a surface [m].
        edges: Points (K, 3) at the ends of faces, and the edge (K,) on which each lies.
    """
    swept, sigma = start, tolerance / 2
    points = np.vstack([local, edges[0]])
    basis = start.spline.basis(points[:, 0])
    rounds = 12
    for k in range(rounds):
        swept, spread = _step(swept, points, edges[1], basis, pitch, sigma)
        if k > 1:
            done, sigma = spread > 0.99 * sigma, max(min(spread, sigma), 1e-5)
            if done:
                break
    return swept


def _step(
    swept: Sweep, points: Floats, edges: Any, basis: Any, pitch: float, sigma: float
) -> tuple[Sweep, float]:
    """Return the result of one Gauss-Newton step, and the spread of points on the surface [m].

    The last points belong to the given edges, all others to the nearest surface.
    """
    line = basis @ swept.spline.values
    q = turn(points[:, 1:3] - line[:, :2], line[:, 2])
    residual, which = swept.section.distances(q)
    first = len(points) - len(edges)
    which[first:] = edges
    normals = swept.section.normals[edges]
    residual[first:] = np.einsum("ni,ni->n", normals, q[first:]) - swept.section.heights[edges]
    # An end lies anywhere within a spacing: half of it bounds the error, whatever the scan's noise.
    size = np.where(np.arange(len(points)) < first, sigma, 0.5 * pitch)
    tukey = 4.685  # Tukey's constant: 95 % efficiency for normal noise
    weight = np.maximum(1 - (residual / (tukey * size)) ** 2, 0.0) ** 2
    sight = np.einsum("ni,ni->n", swept.section.normals[which], turn(points[:, 3:], line[:, 2]))
    # Mixed pixels at a depth step look like a surface nearly along the line of sight: below 8 deg
    usable = _usable(swept.section, q, pitch) & (sight > 0.14)
    weight[:first][~usable[:first]] = 0.0
    used = weight > 0
    on = np.abs(residual[:first][used[:first]])
    spread = SIGMA_OF_MAD * float(np.median(on)) if len(on) else np.inf
    rows = _design(swept, basis[used], line[used], q[used], which[used])
    residual, weight = residual[used], (weight / size**2)[used]
    prior, pull = _prior(swept)
    told = (rows.T @ rows.multiply(weight[:, None])).toarray()
    inverse = np.linalg.inv(told + prior)
    step = inverse @ (-(rows.T @ (weight * residual)) - pull)
    shared = _shared(points[used, 0], which[used], weight * residual * size[used])
    # Sandwich covariance: neighbouring points have correlated errors, the prior does not
    covariance = inverse @ (shared * told + prior) @ inverse
    return replace(_moved(swept, step), sigma=spread, covariance=covariance), spread


def _usable(section: Section, q: Floats, pitch: float) -> Any:
    """Return the mask of points near the seam, but not at a corner of the section."""
    far = np.linalg.norm(q, axis=1) < WIDE + section.shape[4:].max()
    for vertex in section.vertices:
        far &= np.linalg.norm(q - vertex, axis=1) > pitch
    return far


def _design(swept: Sweep, basis: Any, line: Floats, q: Floats, which: Any) -> Any:
    """Return the sparse (N, 3m + k) derivatives of the signed distances."""
    from scipy import sparse

    # Derivatives of the distance n(angle) . q - h by y and z of the line and by its roll. A
    # half-plane's angle has the same lever as the roll
    angle = swept.section.angles[which]
    turned = angle + line[:, 2]
    lever = np.cos(angle) * q[:, 0] - np.sin(angle) * q[:, 1]
    ways = (-np.sin(turned), -np.cos(turned), lever)
    shape = np.zeros((len(q), 7))
    shape[np.arange(len(q)), which] = lever
    # Heights of faces and the gap move a half-plane along its own normal.
    shape[:, 4:] = -OFFSETS[which]
    free = swept.section.joint.free
    return sparse.hstack(
        [basis.multiply(way[:, None]) for way in ways] + [sparse.csr_matrix(shape[:, free])],
        format="csr",
    )


def _prior(swept: Sweep) -> tuple[Floats, Floats]:
    """Return the priors' normal matrix, and their gradient at the present values."""
    joint, values = swept.section.joint, swept.spline.values
    bends = swept.spline.bends()
    m, free = len(values), joint.free
    size = 3 * m + int(free.sum())
    normal, present = np.zeros((size, size)), np.zeros(size)
    # Standard deviations of the coefficients' second differences: y, z [m] and roll [rad]
    bend = np.array([1e-3, 1e-3, 0.05])
    for k in range(3):
        at = slice(k * m, (k + 1) * m)
        # Second differences: a straight line costs nothing. The tiny identity keeps stretches
        # without points solvable.
        normal[at, at] = bends.T @ bends / bend[k] ** 2 + 1e-6 * np.eye(m)
        present[at] = values[:, k]
    spread = np.concatenate([np.radians(joint.spread), np.ones(3)])[free]
    normal[3 * m :, 3 * m :] = np.diag(spread**-2.0)
    present[3 * m :] = swept.section.shape[free]
    return normal, normal @ present


def _moved(swept: Sweep, step: Floats) -> Sweep:
    values, joint = swept.spline.values, swept.section.joint
    m = len(values)
    shape = swept.section.shape.copy()
    shape[joint.free] += step[3 * m :]
    # A negative gap or height would turn the joint inside out.
    shape[4:] = np.maximum(shape[4:], 0.0)
    spline = replace(swept.spline, values=values + step[: 3 * m].reshape(3, m).T)
    return replace(swept, spline=spline, section=Section(joint, shape))


def _shared(s: Floats, which: Any, scores: Floats) -> float:
    """Return the factor by which correlated errors of neighbouring points raise the variance."""
    # Length along the seam within which errors may be correlated [m]
    blocks = (s / 5e-3).astype(int) * 4 + which
    # If errors were independent, the squared sums would equal the sum of squares.
    sums = np.bincount(blocks, scores)
    return max(float((sums**2).sum() / max((scores**2).sum(), 1e-300)), 1.0)
