"""Frames along a line: where points of a scan are along it, across it, and out of it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from flangeye.types import Floats
from flangeye_plugins.seam.planned import resampled

FRAME_SPACING = 1e-3
"""From one frame to the next [m]; four thousand at most."""
SMOOTH = 8e-3
"""Standard deviation of what rounds the corners of a rough line [m]."""


@dataclass(frozen=True, eq=False)
class Course:
    """Frames along a line.

    Attributes:
        points: (K, 3) at even steps [m].
        axes: (K, 3, 3) rows: along, to the left, out of the work.
        step: Between two of them [m].
        closed: Whether the last is beside the first.
        eyes: (P, 3) where the scanner was [m].
    """

    points: Floats
    axes: Floats
    step: float
    closed: bool
    eyes: Floats

    @property
    def length(self) -> float:
        """[m]."""
        return self.step * (len(self.points) - (not self.closed))

    @property
    def s(self) -> Floats:
        """(K,) way along the line [m]."""
        return np.asarray(self.step * np.arange(len(self.points)), dtype=np.float64)

    def local(self, points: Floats, reach: float) -> tuple[Floats, Floats]:
        """Return which of (N, 3) points are within reach [m], and (M, 5) what they are here.

        Their s, y and z [m], and y and z of the unit vectors towards the scanner.
        """
        from scipy.spatial import cKDTree

        away, at = cKDTree(self.points).query(points, distance_upper_bound=1.5 * reach)
        near = np.flatnonzero(np.isfinite(away))
        at = at[near]
        local = np.einsum("nij,nj->ni", self.axes[at], points[near] - self.points[at])
        beyond = np.abs(local[:, 0]) > self.step
        ends = (at == 0) | (at == len(self.points) - 1)
        kept = (np.abs(local[:, 1:]) < reach).all(axis=1) & ~(beyond & ends & (not self.closed))
        local[:, 0] += self.s[at]
        if self.closed:
            local[:, 0] %= self.length
        near, at = near[kept], at[kept]
        sight = _sight(points[near], self.eyes)
        seen = np.einsum("nij,nj->ni", self.axes[at, 1:], _unit(sight))
        return near, np.hstack([local[kept], seen])

    def at(self, s: Floats) -> tuple[Floats, Floats]:
        """Return points (N, 3) and axes (N, 3, 3), those of the nearest frame, at s [m]."""
        k = np.round(s / self.step).astype(int)
        k = k % len(self.points) if self.closed else np.clip(k, 0, len(self.points) - 1)
        along = (s - self.step * np.round(s / self.step))[:, None] * self.axes[k, 0]
        return self.points[k] + along, self.axes[k]

    def points_at(self, local: Floats) -> Floats:
        """Return (N, 3) points that are at s, y and z (N, 3) [m]."""
        origin, axes = self.at(local[:, 0])
        return np.asarray(origin + np.einsum("ni,nij->nj", local[:, 1:], axes[:, 1:]))

    def moved(self, y: Floats, z: Floats, roll: Floats) -> Course:
        """Return frames along a line that lies (K,) beside this one and is rolled (K,) [rad]."""
        points = self.points + y[:, None] * self.axes[:, 1] + z[:, None] * self.axes[:, 2]
        out = np.cos(roll)[:, None] * self.axes[:, 2] + np.sin(roll)[:, None] * self.axes[:, 1]
        return _with_openings(points, out, self.closed, self.eyes)


def course(line: Floats, eyes: Floats, closed: bool, beyond: float) -> Course:
    """Return frames along a rough line (N, 3), straight on by ``beyond`` [m] at its open ends.

    What is out of the work is towards the nearest of the eyes (P, 3): a scanner sees the seam.
    """
    if closed:
        line = np.vstack([line, line[:1]])
    length = float(np.linalg.norm(np.diff(line, axis=0), axis=1).sum())
    step = max(FRAME_SPACING, length / 4000)
    points = _smoothed(resampled(line, step), SMOOTH / step, closed)
    if not closed:
        more = np.arange(1, 1 + round(beyond / step))[:, None] * step
        first, last = (
            _unit(points[0] - points[min(5, len(points) - 1)]),
            _unit(points[-1] - points[-min(6, len(points))]),
        )
        points = np.vstack([points[0] + more[::-1] * first, points, points[-1] + more * last])
    return _with_openings(points, _sight(points, eyes), closed, eyes)


def _sight(points: Floats, eyes: Floats) -> Floats:
    """Return (N, 3) from points to the nearest of the eyes [m]."""
    nearest = np.linalg.norm(eyes - points[:, None], axis=2).argmin(axis=1)
    return np.asarray(eyes[nearest] - points)


def _smoothed(points: Floats, cells: float, closed: bool) -> Floats:
    from scipy.ndimage import gaussian_filter1d

    if closed:
        return np.asarray(gaussian_filter1d(points[:-1], cells, axis=0, mode="wrap"))
    # What is taken off a straight line between the ends keeps the ends where they are.
    share = np.linspace(0, 1, len(points))[:, None]
    chord = points[0] + share * (points[-1] - points[0])
    bent = np.concatenate([-(points - chord)[:0:-1], points - chord, -(points - chord)[-2::-1]])
    bent = gaussian_filter1d(bent, cells, axis=0)
    return np.asarray(chord + bent[len(points) - 1 : 2 * len(points) - 1])


def _with_openings(points: Floats, openings: Floats, closed: bool, eyes: Floats) -> Course:
    """Return the frames of a line at even steps."""
    line = np.vstack([points, points[:1]]) if closed else points
    lengths = np.linalg.norm(np.diff(line, axis=0), axis=1)
    arc = np.concatenate([[0.0], np.cumsum(lengths)])
    at = np.linspace(0.0, arc[-1], len(line))
    wrapped = np.vstack([openings, openings[:1]]) if closed else openings
    even = np.stack([np.interp(at, arc, line[:, k]) for k in range(3)], axis=1)
    out = np.stack([np.interp(at, arc, wrapped[:, k]) for k in range(3)], axis=1)
    step = float(arc[-1] / (len(line) - 1))
    if closed:
        even, out = even[:-1], out[:-1]
        along = np.roll(even, -1, axis=0) - np.roll(even, 1, axis=0)
    else:
        along = np.gradient(even, axis=0)
    x = _unit(along)
    z = _unit(out - np.einsum("ni,ni->n", out, x)[:, None] * x)
    return Course(even, np.stack([x, np.cross(z, x), z], axis=1), step, closed, eyes)


def _unit(vectors: Floats) -> Floats:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True))
