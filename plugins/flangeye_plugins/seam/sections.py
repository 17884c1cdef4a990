"""The root of a V-groove from its cross-sections: two walls each, and a smooth line through all."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from flangeye.types import Floats
from flangeye_plugins.seam.plates import FLAT, Hollow

SLAB = 3e-3
"""Thickness of a section, and the step from one to the next [m]."""
TRIM, OVER = 6e-3, 15e-3
"""What a hollow's line is not believed at its ends, and how far it is followed beyond them [m]."""
KNOTS = 40e-3
"""Between the knots of the smooth line [m]."""
FEWEST = 8
"""Points a wall of a section must have."""
ROUNDS = 6
RIDGE = 1e-9
STEEPEST, FLATTEST = np.radians(12), np.radians(78)
"""Half angles between which a hollow is a V."""
NEAR_ROOT, NEAR_SHOULDER = 0.12, 0.85
"""Where the walls are taken, as shares of the way from root to face: edges are rounded."""


@dataclass(frozen=True, eq=False)
class Root:
    """The root of a groove, in the face's frame.

    Attributes:
        points: (N, 3) along it [m].
        covariance: (N, 3, 3); nothing along it, which is no error of a line [m^2].
        half_angle: Between a wall and the face's normal [rad].
        half_width: At the face [m].
        residual: Distance of the sections from the smooth line, rms [m].
        share: Share of the sections that showed two walls.
    """

    points: Floats
    covariance: Floats
    half_angle: float
    half_width: float
    residual: float
    share: float


@dataclass(frozen=True)
class _Section:
    """One cross-section: y across, z along the face's normal."""

    s: float
    y: float
    z: float
    var_y: float
    var_z: float
    slopes: tuple[float, float]


def trace(hollow: Hollow, points: Floats, widest: float, spacing: float) -> Root | None:
    """Return the root of a hollow, or None where it is no V-groove.

    Args:
        hollow: Where to look.
        points: (N, 3) the scan around it, in the face's frame.
        widest: Across the groove [m].
        spacing: Between the points that are returned [m].
    """
    line, trim, root = hollow.line, TRIM, None
    for _ in range(2):  # the second time across the line that the first has found
        stations, tangents = _stations(line, trim)
        found = [
            section
            for k, (station, tangent) in enumerate(zip(stations, tangents, strict=True))
            if (section := _section(k * SLAB, station, tangent, points, widest)) is not None
        ]
        if len(found) < FEWEST:
            return None
        share = min(len(found) * SLAB / hollow.length, 1.0)
        root = _smooth(found, stations, tangents, spacing, share)
        line, trim = root.points[:, :2], 0.0
    return root


def _stations(line: Floats, trim: float) -> tuple[Floats, Floats]:
    """Return (S, 2) places along a smoothed line and straight on beyond its ends, and tangents.

    Args:
        line: (M, 2) [m].
        trim: Left off at either end, where a grid's line is no longer in the middle [m].
    """
    arc = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])
    kept = (arc >= trim) & (arc <= arc[-1] - trim)
    if kept.sum() < 6:
        kept[:] = True
    s = arc[kept]
    at = np.arange(s[0], s[-1], SLAB)
    even = np.full(len(s), FLAT**2)
    smooth = np.stack([_spline(s, line[kept, k], even, at)[0] for k in range(2)], axis=1)
    beyond = np.arange(1, 1 + round((OVER + trim) / SLAB))[:, None] * SLAB
    first, last = _unit(smooth[0] - smooth[2]), _unit(smooth[-1] - smooth[-3])
    stations = np.vstack([smooth[0] + beyond[::-1] * first, smooth, smooth[-1] + beyond * last])
    tangents = np.gradient(stations, axis=0)
    return stations, tangents / np.linalg.norm(tangents, axis=1, keepdims=True)


def _unit(vector: Floats) -> Floats:
    return np.asarray(vector / np.linalg.norm(vector))


def _section(
    s: float, station: Floats, tangent: Floats, points: Floats, widest: float
) -> _Section | None:
    """Fit the two walls in one slab; None where there are not two that meet below the face."""
    away = points[:, :2] - station
    along = away @ tangent
    across = away @ np.array([-tangent[1], tangent[0]])
    inside = (np.abs(along) < SLAB / 2) & (np.abs(across) < 0.75 * widest)
    y, z = across[inside], points[inside, 2]
    low = z < -0.5e-3
    ahead = along[inside][low] > 0
    if min(ahead.sum(), (~ahead).sum()) < FEWEST:
        return None  # the groove ends amid the slab
    bottom = float(np.quantile(z[low], 0.05))
    root = np.array([float(np.median(y[z <= bottom + 0.1 * abs(bottom)])), bottom])
    walls: tuple[_Wall, _Wall] | None = None
    for _ in range(ROUNDS):
        walls = _walls(y, z, root)
        if walls is None:
            return None
        root = _meet(*walls)
    if walls is None or not -widest < root[1] < -0.5e-3 or abs(root[0]) > widest / 2:
        return None
    return _with_variance(s, root, walls)


@dataclass(frozen=True, eq=False)
class _Wall:
    """A line z = offset + slope (y - middle), and the (2, 2) covariance of offset and slope."""

    offset: float
    slope: float
    middle: float
    covariance: Floats


def _walls(y: Floats, z: Floats, root: Floats) -> tuple[_Wall, _Wall] | None:
    height = -root[1]
    up = (z - root[1]) / height
    on_walls = (up > NEAR_ROOT) & (up < NEAR_SHOULDER)
    left, right = on_walls & (y < root[0]), on_walls & (y > root[0])
    if min(left.sum(), right.sum()) < FEWEST:
        return None
    walls = _line(y[left], z[left]), _line(y[right], z[right])
    lean = [np.arctan2(1.0, abs(wall.slope)) for wall in walls]
    falling, rising = (
        walls[0].slope < 0 < walls[1].slope,
        all(STEEPEST < a < FLATTEST for a in lean),
    )
    return walls if falling and rising else None


def _line(y: Floats, z: Floats) -> _Wall:
    """Fit a line, with Tukey's weights after the first round."""
    middle = float(np.median(y))
    design = np.stack([np.ones(len(y)), y - middle], axis=1)
    weights = np.ones(len(y))
    for _ in range(4):
        normal = (design * weights[:, None]).T @ design
        solved = np.linalg.lstsq(normal, (design * weights[:, None]).T @ z, rcond=None)[0]
        residual = z - design @ solved
        scale = max(1.4826 * float(np.median(np.abs(residual))), 1e-6)
        weights = np.maximum(1 - (residual / (4.685 * scale)) ** 2, 0.0) ** 2
    covariance = np.asarray(scale**2 * np.linalg.pinv(normal), dtype=np.float64)
    return _Wall(float(solved[0]), float(solved[1]), middle, covariance)


def _meet(left: _Wall, right: _Wall) -> Floats:
    y = (right.offset - right.slope * right.middle - left.offset + left.slope * left.middle) / (
        left.slope - right.slope
    )
    return np.array([y, left.offset + left.slope * (y - left.middle)])


def _with_variance(s: float, root: Floats, walls: tuple[_Wall, _Wall]) -> _Section:
    """Propagate both lines' covariances to where they meet."""
    left, right = walls
    opening = left.slope - right.slope
    heights = [
        np.array([1.0, root[0] - wall.middle]) @ wall.covariance @ [1.0, root[0] - wall.middle]
        for wall in walls
    ]
    var_y = (heights[0] + heights[1]) / opening**2
    var_z = (right.slope**2 * heights[0] + left.slope**2 * heights[1]) / opening**2
    return _Section(s, root[0], root[1], var_y, var_z, (left.slope, right.slope))


def _smooth(
    found: list[_Section], stations: Floats, tangents: Floats, spacing: float, share: float
) -> Root:
    """Lay a cubic spline through the sections' roots, with its covariance."""
    s = np.array([x.s for x in found])
    at = np.linspace(s[0], s[-1], max(2, round((s[-1] - s[0]) / spacing) + 1))
    y, var_y, rms_y = _spline(
        s, np.array([x.y for x in found]), np.array([x.var_y for x in found]), at
    )
    z, var_z, rms_z = _spline(
        s, np.array([x.z for x in found]), np.array([x.var_z for x in found]), at
    )
    steps = np.arange(len(stations)) * SLAB
    place = np.stack([np.interp(at, steps, stations[:, k]) for k in range(2)], axis=1)
    tangent = np.stack([np.interp(at, steps, tangents[:, k]) for k in range(2)], axis=1)
    aside = np.stack([-tangent[:, 1], tangent[:, 0]], axis=1)
    points = np.column_stack([place + y[:, None] * aside, z])
    covariance = np.zeros((len(at), 3, 3))
    covariance[:, :2, :2] = var_y[:, None, None] * aside[:, :, None] * aside[:, None, :]
    covariance[:, 2, 2] = var_z
    slopes = np.abs([x.slopes for x in found])
    half_angle = float(np.median(np.arctan2(1.0, slopes)))
    half_width = float(np.median(-z) * np.tan(half_angle))
    return Root(points, covariance, half_angle, half_width, float(np.hypot(rms_y, rms_z)), share)


def _spline(
    s: Floats, values: Floats, variances: Floats, at: Floats
) -> tuple[Floats, Floats, float]:
    """Fit a cubic spline robustly; return it and its variance at places, and the residuals' rms."""
    from scipy.interpolate import BSpline

    pieces = max(1, round((s[-1] - s[0]) / KNOTS))
    inner = np.linspace(s[0], s[-1], pieces + 1)
    knots = np.concatenate([[s[0]] * 3, inner, [s[-1]] * 3])
    design = BSpline.design_matrix(s, knots, 3).toarray()
    base = 1 / np.maximum(variances, np.median(variances) / 4)
    weights = base
    for _ in range(8):
        normal = (design * weights[:, None]).T @ design
        normal += RIDGE * np.trace(normal) * np.eye(len(normal))
        solved = np.linalg.solve(normal, (design * weights[:, None]).T @ values)
        pull = (values - design @ solved) * np.sqrt(base)
        scale = max(1.4826 * float(np.median(np.abs(pull))), 1e-3)
        weights = base * np.maximum(1 - (pull / (4.685 * scale)) ** 2, 0.0) ** 2
    there = BSpline.design_matrix(at, knots, 3).toarray()
    # The scatter of the sections, where it is more than their lines' own, is their noise.
    freedom = max(len(s) - design.shape[1], 1) / len(s)
    factor = max(scale**2 / freedom, 1.0)
    variance = factor * np.einsum("ni,ij,nj->n", there, np.linalg.inv(normal), there)
    kept = weights > 0
    rms = float(np.sqrt(np.mean((values - design @ solved)[kept] ** 2)))
    return there @ solved, variance, rms
