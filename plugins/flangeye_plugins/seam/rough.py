"""Rough search for a joint: frames along a rough line, and line fits in short slabs of the scan."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product
from math import remainder, tau
from typing import Any, NamedTuple

import numpy as np

from flangeye.types import Floats
from flangeye.types.geometry import arc_lengths, rows_at
from flangeye_plugins.seam.planned import resampled
from flangeye_plugins.seam.template import EDGES, FACES, OFFSETS, JointShape, Section

SLAB_ERROR = 2e-3
"""Standard deviation of a rough line's error from one slab to the next [m]."""


class Line(NamedTuple):
    """A line ``n(angle) @ q = offset`` in a section; a face's has the points on it (N, 2)."""

    angle: float
    offset: float
    on: Floats


@dataclass(frozen=True, eq=False)
class JointPlace:
    """Hypothesis of a joint in a slab: position q (2,), roll and shape, with a score up to 1."""

    s: float
    q: Floats
    roll: float
    shape: Floats
    score: float
    joint: JointShape


def rough_path(
    local: Floats, normals: Floats, joints: tuple[JointShape, ...], tolerance: float, reach: float
) -> list[list[JointPlace]]:
    """Return the best paths of a joint along the line, best first.

    Args:
        local: (N, 3) scan points along, across and out of the rough line [m].
        normals: (N, 3) normals in the same axes.
        joints: The joint, and its mirror image.
        tolerance: Largest distance from a surface [m].
        reach: Largest distance of the seam from the rough line [m].
    """
    # Length of a slab [m]: a rough line that is off by 3 deg blurs an edge by half a millimetre
    slab = 10e-3
    slabs = (local[:, 0] // slab).astype(int)
    order = np.argsort(slabs, kind="stable")
    bounds = np.searchsorted(slabs[order], np.arange(slabs.max() + 2))
    spots: list[list[JointPlace]] = []
    for k in range(slabs.max() + 1):
        at = order[bounds[k] : bounds[k + 1]]
        # Some 700 points show the lines as well as all do, and bound the time for a slab.
        at = at[:: max(1, len(at) // 700)]
        q, normal = local[at, 1:3], normals[at]
        lines = list(_lines(q, normal, tolerance))
        found = [
            place
            for joint in joints
            for place in _places((k + 0.5) * slab, q, lines, joint, tolerance, reach)
        ]
        spots.append(_apart(found))
    return _ways(spots)


def _lines(q: Floats, normals: Floats, tolerance: float) -> Iterator[Line]:
    """Yield the lines with most points, each found from hypotheses of a point and its normal."""
    flat = normals[:, 1:]
    # Surfaces that face along the seam, such as clamps, show no line in a section.
    size = np.linalg.norm(flat, axis=1)
    q, flat = q[size > 0.8], flat[size > 0.8] / size[size > 0.8, None]
    alike = np.cos(np.radians(25))
    for _ in range(6):
        if len(q) < 12:
            return
        # At most 150 hypotheses for each line
        tried = slice(None, None, max(1, len(q) // 150))
        offsets = np.einsum("ni,ni->n", flat[tried], q[tried])
        on = np.abs(flat[tried] @ q.T - offsets[:, None]) < tolerance
        on &= flat[tried] @ flat.T > alike
        best = on[on.sum(axis=1).argmax()]
        middle = q[best].mean(axis=0)
        spread, axes = np.linalg.eigh(np.cov((q[best] - middle).T))
        # Shortest line in a section [m]
        shortest = 2.5e-3
        if best.sum() < 12 or 3.4 * np.sqrt(spread[1]) < shortest:
            return
        normal = axes[:, 0] * np.sign(axes[:, 0] @ flat[best].mean(axis=0))
        away = q @ normal - normal @ middle
        yield Line(float(np.arctan2(*normal)), float(normal @ middle), q[np.abs(away) < tolerance])
        left = (np.abs(away) > tolerance) | (flat @ normal < alike)
        q, flat = q[left], flat[left]


def _ends(face: Line, right: bool) -> list[Line]:
    """Return lines perpendicular to a face where its points end, with gaps of 0.5 mm or more."""
    side = 1 if right else -1
    along = np.array([np.cos(face.angle), -np.sin(face.angle)])
    at = np.sort(face.on @ along)
    bins = np.arange(at[0], at[-1] + 1e-9, 0.25e-3)
    edges = at[-1:] if right else -at[:1]
    if len(bins) > 3:
        counts = np.histogram(at, bins)[0][::side]
        full = np.pad(counts > 0.3 * np.median(counts[counts > 0]), (1, 2))
        last = np.flatnonzero(full[:-2] & ~full[1:-1] & ~full[2:])
        edges = (side * bins)[::side][last]
    return [Line(face.angle + side * np.pi / 2, float(e), face.on[:0]) for e in edges]


def _places(
    s: float, q: Floats, lines: list[Line], joint: JointShape, tolerance: float, reach: float
) -> Iterator[JointPlace]:
    """Yield the places in a slab where lines fit the joint's half-planes."""
    beside = {
        k: [_ends(line, k == 1) if k in joint.unseen else [] for line in lines]
        for k in EDGES
        if k in joint.planes
    }
    for i, j in product(range(len(lines)), repeat=2):
        faces = {0: i, 2: j}
        if not _agree(joint, [0, 2], [lines[i], lines[j]]):
            continue
        choices = [
            [lines[faces[k]]] if k in FACES else lines + beside[k][faces[k - 1]]
            for k in joint.planes
        ]
        for chosen in product(*choices):
            if _agree(joint, joint.planes, chosen):
                place = _placed(s, q, joint, chosen, tolerance, reach)
                if place is not None:
                    yield place


def _agree(joint: JointShape, which: list[int], lines: tuple[Line, ...] | list[Line]) -> bool:
    """Return whether the angles between lines agree with those between the joint's half-planes."""
    turns = [joint.turns[k] for k in which]
    off = [line.angle - nominal for line, (nominal, _) in zip(lines, turns, strict=True)]
    first = turns[0][1]
    return all(
        abs(remainder(o - off[0], tau)) <= allowed + first
        for o, (_, allowed) in zip(off, turns, strict=True)
    )


def _placed(
    s: float, q: Floats, joint: JointShape, lines: tuple[Line, ...], tolerance: float, reach: float
) -> JointPlace | None:
    """Return the joint whose half-planes are these lines; None if not plausible, or too far."""
    nominal, spread = joint.nominal
    off = np.array([line.angle for line in lines]) - nominal
    weights = 1 / spread**2
    # Weighted circular mean, because angles wrap
    roll = float(np.angle(weights @ np.exp(1j * off)))
    angles = np.full(4, 0.0)
    angles[joint.planes] = np.angle(np.exp(1j * (off - roll)))
    turned = roll + nominal + angles[joint.planes]
    heights = joint.free[4:]
    design = np.column_stack([np.sin(turned), np.cos(turned), OFFSETS[joint.planes][:, heights]])
    # The ridge sets heights that the lines do not determine to zero
    ridge = 1e-6 * np.eye(design.shape[1])
    solved = np.linalg.solve(
        design.T @ design + ridge, design.T @ np.array([line.offset for line in lines])
    )
    lengths = np.zeros(3)
    lengths[heights] = solved[2:]
    # Plates cannot overlap, and a butt joint needs a gap that is seen.
    if not (lengths >= -tolerance).all() or (joint.gap and lengths[2] < 2 * tolerance / 3):
        return None
    if np.abs(solved[:2]).max() > reach:
        return None
    section = Section(joint, np.concatenate([angles, np.maximum(lengths, 0.0)]))
    score = explained(section, turn(q - solved[:2], roll), tolerance)
    return None if score is None else JointPlace(s, solved[:2], roll, section.shape, score, joint)


def turn(q: Floats, roll: Floats | float) -> Floats:
    """Return section points (N, 2) in axes rolled by angles (N,) from z towards y."""
    c, s = np.cos(roll), np.sin(roll)
    out = np.empty((len(q), 2))
    out[:, 0], out[:, 1] = c * q[:, 0] - s * q[:, 1], s * q[:, 0] + c * q[:, 1]
    return out


def explained(section: Section, q: Floats, tolerance: float) -> float | None:
    """Return the share of points (N, 2) near a seam that a section explains, less the others'.

    None if a face, or an edge that should be visible, has too few points.
    """
    away, active = section.distances(q)
    # Points within this distance of the seam must be explained [m]
    around = 12e-3
    near = np.linalg.norm(q, axis=1) < around + section.shape[4:6].max()
    good = near & (np.abs(away) < tolerance)
    counts = np.bincount(active[good], minlength=4)
    of = int(near.sum())
    if counts[section.joint.shown].min() < max(12, 0.04 * of):
        return None
    # From -1 to 1: each unexplained point costs what an explained one gains.
    return float(2 * good.sum() / max(of, 1) - 1)


def _apart(places: list[JointPlace]) -> list[JointPlace]:
    """Return the best few distinct places."""
    kept: list[JointPlace] = []
    for place in sorted(places, key=lambda p: -p.score):
        if all(np.linalg.norm(place.q - other.q) > SLAB_ERROR for other in kept):
            kept.append(place)
        # At most six places per slab are kept
        if len(kept) == 6:
            break
    return kept


def _ways(spots: list[list[JointPlace]]) -> list[list[JointPlace]]:
    """Return paths through the slabs, by dynamic programming; they share no places."""
    nodes = [(k, place) for k, places in enumerate(spots) for place in places]
    best: list[tuple[float, int | None]] = []
    for k, place in nodes:
        skipped = 5
        score, before = max(
            (
                (best[j][0] - _jump(other, place, k - i), j)
                for j, (i, other) in enumerate(nodes[: len(best)])
                if 0 < k - i <= skipped
            ),
            default=(0.0, None),
        )
        # A path may begin anywhere: a negative past is dropped.
        best.append((place.score + max(score, 0.0), before if score > 0 else None))
    ways: list[list[JointPlace]] = []
    used: set[int] = set()
    for j in np.argsort([-score for score, _ in best], kind="stable"):
        way: list[int] = []
        at: int | None = int(j)
        while at is not None and at not in used:
            way.append(at)
            at = best[at][1]
        used.update(way)
        if len(way) >= 3:
            ways.append([nodes[k][1] for k in reversed(way)])
    return ways


def _jump(first: JointPlace, second: JointPlace, slabs: int) -> float:
    # Random walk from slab to slab: squared steps divided by the number of slabs
    away = np.linalg.norm(first.q - second.q) / SLAB_ERROR
    rolled = np.angle(np.exp(1j * (first.roll - second.roll))) / np.radians(8)
    other = np.abs(first.shape[4:] - second.shape[4:]).max() / SLAB_ERROR
    return float(
        0.3 * (away**2 + rolled**2 + other**2) / slabs + 10 * (first.joint is not second.joint)
    )


@dataclass(frozen=True, eq=False)
class Spline:
    """A vector-valued cubic B-spline over a line's arc length.

    Attributes:
        length: Length of the line [m].
        closed: Whether the line is closed.
        values: (m, k) coefficients of k numbers.
    """

    length: float
    closed: bool
    values: Floats

    @classmethod
    def through(cls, length: float, closed: bool, s: Floats, values: Floats) -> Spline:
        """Return the least-squares spline through values (N, k) at s [m]."""
        # Between the knots of the line [m]
        knots = 30e-3
        count = max(round(length / knots), 8 if closed else 1) + (0 if closed else 3)
        empty = cls(length, closed, np.zeros((count, 3)))
        design = empty.basis(s).toarray()
        # A P-spline (Eilers & Marx 1996): where there is nothing to fit, second differences keep
        # the coefficients on a straight line
        bends = empty.bends()
        normal = design.T @ design + 0.01 * bends.T @ bends + 1e-9 * np.eye(count)
        return replace(empty, values=np.linalg.solve(normal, design.T @ values))

    def basis(self, s: Floats) -> Any:
        """Return the sparse basis matrix (N, m) at s [m]."""
        from scipy import sparse
        from scipy.interpolate import BSpline

        count = len(self.values)
        pieces = count if self.closed else count - 3
        knots = np.arange(-3, pieces + 4) * (self.length / pieces)
        inside = np.clip(s, 0.0, self.length * (1 - 1e-12))
        design = BSpline.design_matrix(inside, knots, 3)
        if not self.closed:
            return design
        # On a closed line the three bases beyond the end are those at its start
        fold = sparse.eye(pieces + 3, format="lil")[:, :pieces]
        for k in range(3):
            fold[pieces + k, k] = 1.0
        return design @ fold.tocsr()

    def bends(self) -> Floats:
        """Matrix (k, m) of second differences of the coefficients."""
        count = len(self.values)
        if self.closed:
            eye = np.eye(count)
            return np.asarray(np.roll(eye, 1, 0) - 2 * eye + np.roll(eye, -1, 0))
        return np.asarray(np.diff(np.eye(count), 2, axis=0))

    def at(self, s: Floats) -> Floats:
        """Return the values (N, k) at s [m]."""
        return np.asarray(self.basis(s) @ self.values)


@dataclass(frozen=True, eq=False)
class Curve:
    """Frames along a line.

    Attributes:
        points: (K, 3) points at even steps [m].
        axes: (K, 3, 3) axes as rows: along, to the left, out of the work.
        step: Distance between two points [m].
        closed: Whether the line is closed.
        eyes: (P, 3) positions of the scanner [m].
    """

    points: Floats
    axes: Floats
    step: float
    closed: bool
    eyes: Floats

    @property
    def length(self) -> float:
        """Length of the line [m]."""
        return self.step * (len(self.points) - (not self.closed))

    @property
    def s(self) -> Floats:
        """Arc lengths (K,) of the points [m]."""
        return np.asarray(self.step * np.arange(len(self.points)), dtype=np.float64)

    def local(self, points: Floats, reach: float) -> tuple[Floats, Floats]:
        """Return the mask (N,) of points within ``reach`` [m], and their local coordinates (M, 5).

        The coordinates are s, y and z [m], and y and z of the unit vector towards the scanner.
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
        """Return points (N, 3) at s [m], and the axes (N, 3, 3) of the nearest frames."""
        k = np.round(s / self.step).astype(int)
        k = k % len(self.points) if self.closed else np.clip(k, 0, len(self.points) - 1)
        along = (s - self.step * np.round(s / self.step))[:, None] * self.axes[k, 0]
        return self.points[k] + along, self.axes[k]

    def points_at(self, local: Floats) -> Floats:
        """Return the points (N, 3) with local coordinates s, y and z (N, 3) [m]."""
        origin, axes = self.at(local[:, 0])
        return np.asarray(origin + np.einsum("ni,nij->nj", local[:, 1:], axes[:, 1:]))

    def moved(self, y: Floats, z: Floats, roll: Floats) -> Curve:
        """Return frames along this line, moved by y and z (K,) [m] and rolled (K,) [rad]."""
        points = self.points + y[:, None] * self.axes[:, 1] + z[:, None] * self.axes[:, 2]
        out = np.cos(roll)[:, None] * self.axes[:, 2] + np.sin(roll)[:, None] * self.axes[:, 1]
        return _with_openings(points, out, self.closed, self.eyes)

    def through(self, places: Sequence[JointPlace]) -> Curve:
        """Return frames along a smooth line through the places of a joint."""
        s = np.array([place.s for place in places])
        origin, axes = self.at(s)
        aside = np.array([place.q for place in places])
        roll = np.array([place.roll for place in places])[:, None]
        points = origin + np.einsum("ni,nij->nj", aside, axes[:, 1:])
        out = np.cos(roll) * axes[:, 2] + np.sin(roll) * axes[:, 1]
        smooth = np.hstack([points, out])
        led = Spline.through(self.length, self.closed, s, smooth).at(self.s)
        return _with_openings(led[:, :3], led[:, 3:], self.closed, self.eyes)


def course(line: Floats, eyes: Floats, closed: bool, beyond: float) -> Curve:
    """Return frames along a rough line (N, 3), extended straight by ``beyond`` at open ends [m].

    "Out of the work" is the direction to the nearest scanner position (P, 3), which sees the seam.
    """
    if closed:
        line = np.vstack([line, line[:1]])
    length = float(np.linalg.norm(np.diff(line, axis=0), axis=1).sum())
    # From one frame to the next [m]; four thousand at most
    frame_spacing = 1e-3
    step = max(frame_spacing, length / 4000)
    # Standard deviation of what rounds the corners of a rough line [m]
    smooth = 8e-3
    points = _smoothed(resampled(line, step), smooth / step, closed)
    if not closed:
        more = np.arange(1, 1 + round(beyond / step))[:, None] * step
        first, last = (
            _unit(points[0] - points[min(5, len(points) - 1)]),
            _unit(points[-1] - points[-min(6, len(points))]),
        )
        points = np.vstack([points[0] + more[::-1] * first, points, points[-1] + more * last])
    return _with_openings(points, _sight(points, eyes), closed, eyes)


def _sight(points: Floats, eyes: Floats) -> Floats:
    """Return the vectors (N, 3) from points to the nearest scanner position [m]."""
    if len(eyes) == 1:
        return eyes - points
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


def _with_openings(points: Floats, openings: Floats, closed: bool, eyes: Floats) -> Curve:
    """Return frames at even steps along a line with openings."""
    line = np.vstack([points, points[:1]]) if closed else points
    arc = arc_lengths(line)
    at = np.linspace(0.0, arc[-1], len(line))
    wrapped = np.vstack([openings, openings[:1]]) if closed else openings
    even, out = rows_at(at, arc, line), rows_at(at, arc, wrapped)
    step = float(arc[-1] / (len(line) - 1))
    if closed:
        even, out = even[:-1], out[:-1]
        along = np.roll(even, -1, axis=0) - np.roll(even, 1, axis=0)
    else:
        along = np.gradient(even, axis=0)
    x = _unit(along)
    z = _unit(out - np.einsum("ni,ni->n", out, x)[:, None] * x)
    return Curve(even, np.stack([x, np.cross(z, x), z], axis=1), step, closed, eyes)


def _unit(vectors: Floats) -> Floats:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True))
