"""A seam in the plane of the work, parametrised by arc length; all lengths in [m]."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from flangeye.types import Floats
from flangeye.types.geometry import arc_lengths, rows_at

PATH_SPACING = 0.5e-3
"""Spacing to which a path is resampled [m]; at a radius of 50 mm the chord error is 0.6 um."""

CHORD = 5e-3
"""Chord length for computing a path's direction and curvature [m]."""


class PathPlace(NamedTuple):
    """One place on a path.

    Attributes:
        point: (2,) position in the plane.
        tangent: (2,) unit vector, forwards.
        normal: (2,) unit vector, to the left of the tangent.
        height: Height above the plane.
    """

    point: Floats
    tangent: Floats
    normal: Floats
    height: float

    @property
    def heading(self) -> float:
        """Angle of the tangent from the plane's x [rad]."""
        return math.atan2(float(self.tangent[1]), float(self.tangent[0]))


class Path:
    """A curve with arc length zero at the seam's start, continued straight beyond both ends.

    Attributes:
        length: Length of the seam in the plane [m].
        first: Arc length of the curve's first point; negative for a closed seam, which is continued
            around beyond both ends.
        last: Arc length of the curve's last point.
        points: (M, 3) the resampled curve: two coordinates in the plane, and the height.
        tangents: (M, 2) unit tangents in the plane.
        step: Arc length between two resampled points [m].
    """

    def __init__(self, points: Floats, wraps: float = 0.0) -> None:
        """Resample a curve.

        Args:
            points: (N, 3) two coordinates in the plane, and the height above it.
            wraps: Length by which a closed seam's points extend beyond both ends; 0 for an open
                one.
        """
        along = arc_lengths(points[:, :2])
        known = float(along[-1])
        self.length, self.first, self.last = known - 2 * wraps, -wraps, known - wraps
        ticks = np.linspace(0.0, known, max(2, round(known / PATH_SPACING)) + 1)
        self.points = rows_at(ticks, along, points)
        self.step = float(ticks[1])
        slopes = np.gradient(self.points, self.step, axis=0)
        norms = np.linalg.norm(slopes[:, :2], axis=1, keepdims=True)
        # Arc length is measured in the plane, so the height's slope is left out of the norm.
        self.tangents = slopes[:, :2] / norms
        self._climb = slopes[:, 2]
        self._curvature = self._curvatures()
        self._places = np.column_stack([self.points, self.tangents])
        self._rows = self._places.tolist()
        self._last = len(self._rows) - 2

    @property
    def closed(self) -> bool:
        """Whether the seam is closed."""
        return self.first < 0.0

    def _curvatures(self) -> Floats:
        """Return the curvature (M,) [1/m], positive to the left.

        It is computed over chords, so that noise of the plan does not look like curvature.
        """
        span = max(1, min(round(CHORD / self.step), (len(self.points) - 1) // 2))
        chords = self.points[span:, :2] - self.points[:-span, :2]
        angles = np.unwrap(np.arctan2(chords[:, 1], chords[:, 0]))
        inner = (angles[span:] - angles[:-span]) / (span * self.step)
        return np.pad(inner, (span, len(self.points) - span - len(inner)), mode="edge")

    def at(self, s: float) -> PathPlace:
        """Return the place at arc length ``s``, which may lie beyond either end."""
        x, y, tx, ty, z = self._at(s)
        return PathPlace(np.array([x, y]), np.array([tx, ty]), np.array([-ty, tx]), z)

    def _at(self, s: float) -> tuple[float, float, float, float, float]:
        """Return point (2), unit tangent (2) and height at an arc length."""
        # Called several times a cycle: plain floats are ten times faster than arrays of one.
        inside = self.first if s < self.first else self.last if s > self.last else s
        share = (inside - self.first) / self.step
        index = int(share)
        if index > self._last:
            index = self._last
        share -= index
        (x, y, z, tx, ty), (x1, y1, z1, tx1, ty1) = self._rows[index], self._rows[index + 1]
        x, y, z = x + share * (x1 - x), y + share * (y1 - y), z + share * (z1 - z)
        tx, ty = tx + share * (tx1 - tx), ty + share * (ty1 - ty)
        norm, beyond = math.hypot(tx, ty), s - inside
        tx, ty = tx / norm, ty / norm
        return x + beyond * tx, y + beyond * ty, tx, ty, z

    def evaluate(self, s: Floats) -> tuple[Floats, Floats]:
        """Return points (K, 3) and unit tangents (K, 2) at arc lengths (K,)."""
        # Called several times a cycle: NumPy's clip is ten times slower than these.
        inside = np.minimum(np.maximum(s, self.first), self.last)
        ticks = (inside - self.first) / self.step
        index = np.minimum(ticks.astype(int), self._last)
        share = (ticks - index)[:, None]
        row = (1.0 - share) * self._places[index] + share * self._places[index + 1]
        point, tangent = row[:, :3], row[:, 3:]
        tangent /= np.sqrt(np.einsum("ki,ki->k", tangent, tangent))[:, None]
        point[:, :2] += (s - inside)[:, None] * tangent
        return point, tangent

    def other_end(self, s: Floats, distance: float) -> Floats:
        """Return the arc lengths (K,) of the tool's other end, with both ends on the curve.

        A positive distance gives the tip for torches at ``s``; a negative one the torch for tips.
        """
        here, _ = self.evaluate(s)
        other = s + distance
        # Each round halves what is missing where the tool stands at 60 degrees to the curve.
        for _ in range(20):
            there, _ = self.evaluate(other)
            away = np.linalg.norm((there - here)[:, :2], axis=1)
            # Moves the other end along the curve by what the straight distance lacks.
            other = other + np.sign(distance) * (abs(distance) - away)
        return other

    def climb(self, s: float) -> float:
        """Return the slope of the height along the path, zero beyond its ends."""
        return float(self._climb[self._tick(s)]) if self.first <= s <= self.last else 0.0

    def sharpest(self, start: float, end: float) -> float:
        """Return the largest curvature between two arc lengths [1/m]; 0 beyond the ends."""
        low, high = (int((s - self.first) / self.step) for s in (start, end))
        curvature = self._curvature[max(low, 0) : max(high + 1, 0)]
        return float(np.abs(curvature).max(initial=0.0))

    def bend(self, s: float) -> float:
        """Return the curvature at an arc length [1/m], positive to the left; 0 beyond the ends."""
        return float(self._curvature[self._tick(s)]) if self.first <= s <= self.last else 0.0

    def _tick(self, s: float) -> int:
        return round((s - self.first) / self.step)

    def advance(self, point: Floats, s: float, reach: float) -> float:
        """Return the arc length of the foot of ``point`` (2,), between ``s`` and ``s + reach``.

        It never decreases, and never jumps to another branch of a path that crosses itself.
        """
        # Noise of the pose must not take progress back, and a crossing seam must not be jumped to.
        return s + min(max(self._ahead(point, s), 0.0), reach)

    def foot(self, point: Floats, s: float) -> float:
        """Return the arc length of the foot of ``point`` (2,) near ``s``, in either direction."""
        for _ in range(2):
            s += self._ahead(point, s)
        return s

    def _ahead(self, point: Floats, s: float) -> float:
        """Return a point's (2,) distance ahead of the place at ``s``, along the tangent there."""
        x, y, tx, ty, _ = self._at(s)
        px, py = point.tolist()
        return float((px - x) * tx + (py - y) * ty)
