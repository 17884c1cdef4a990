"""Find where surfaces of a scan end: a plate across the seam, a seam along it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flangeye.types import Floats, Mask
from flangeye_plugins.seam.sweep import Swept
from flangeye_plugins.seam.template import EDGES, Section

FEWEST_LANES = 5
"""Lanes that an end is known from."""
SEAM_WITHIN = 8e-3
"""Lanes this near to the seam say where it ends [m]."""


def last_in_lanes(lanes: Floats, way: Floats, pitch: float) -> tuple[NDArray[np.intp], Floats]:
    """Return each lane's last point, and the distance (L,) from there to the surface's end [m].

    A surface ends on average half a spacing beyond the last pixel that is on it.

    Args:
        lanes: (N,) place across the lanes, which are a pitch wide [m].
        way: (N,) place along them [m].
        pitch: Distance between neighbouring points [m].
    """
    if not len(way):
        return np.zeros(0, dtype=np.intp), np.zeros(0)
    lane = np.floor(lanes / pitch).astype(int)
    order = np.lexsort((way, lane))
    last = np.append(np.diff(lane[order]) != 0, True)
    first = np.append(True, last[:-1])
    spans = way[order[last]] - way[order[first]]
    counts = np.diff(np.append(-1, np.flatnonzero(last)))
    gaps = spans / np.maximum(counts - 1, 1)
    full = counts >= 4
    return order[last][full], gaps[full] / 2


def face_ends(
    swept: Swept, local: Floats, pitch: float, tolerance: float
) -> tuple[Floats, NDArray[np.intp]]:
    """Return (K, 5) local points where faces end at upright edges, and which edge each is on."""
    joint, section = swept.section.joint, swept.section
    q = swept.in_section(local)
    away, active = section.distances(q)
    found, which = [np.zeros((0, 5))], [np.zeros(0, dtype=int)]
    for edge in joint.unseen:
        face = edge - 1
        on = _on_face(section, q, face, tolerance) & (np.abs(away) < 8 * tolerance)
        on &= (active == face) | (active == edge)
        beside = q[on] @ section.normals[edge] - section.heights[edge]
        near = (beside > -SEAM_WITHIN) & (beside < SEAM_WITHIN / 2)
        if near.sum() < 4 * FEWEST_LANES:
            continue
        at = np.flatnonzero(on)[near]
        last, more = last_in_lanes(local[at, 0], beside[near], pitch)
        if not len(last):
            continue
        turned = section.angles[edge] + swept.spline.at(local[at[last], 0])[:, 2]
        out = np.zeros((len(last), 5))
        out[:, 1:3] = np.stack([np.sin(turned), np.cos(turned)], axis=1)
        found.append(local[at[last]] + more[:, None] * out)
        which.append(np.full(len(last), edge))
    return np.concatenate(found), np.concatenate(which)


def _on_face(section: Section, q: Floats, face: int, tolerance: float) -> Mask:
    return np.asarray(np.abs(q @ section.normals[face] - section.heights[face]) < tolerance)


@dataclass(frozen=True)
class End:
    """Where along the seam a surface ends [m].

    Attributes:
        place: Along the way to the end: less is sooner.
        deviation: Its standard deviation.
        seen: Whether the scanner looked past it there; otherwise it may go on unseen.
        covered: Whether it goes on below something else, for all that is known.
    """

    place: float
    deviation: float
    seen: bool
    covered: bool

    @property
    def sharp(self) -> bool:
        """Whether the surface ends sharply, with nothing above its end."""
        # An end that is known less well is not sharp [m]
        loose = 0.5e-3
        return self.deviation < loose and not self.covered


def surface_end(way: Floats, past: Mask, covered: Mask, pitch: float) -> End | None:
    """Return where a surface ends, from the ends of its lanes; None with too few lanes.

    The median over lanes, of those behind which the scanner sees something farther away where
    there are enough. Lanes that end at two places are not a sample of one place.

    Args:
        way: (L,) ends of lanes along the way to the end [m].
        past: (L,) where the scanner looks past them.
        covered: (L,) where something else is before what is behind them.
        pitch: Distance between neighbouring points [m].
    """
    if len(way) < FEWEST_LANES:
        return None
    seen = past.sum() >= FEWEST_LANES
    way = way[past] if seen else way
    low, middle, high = np.quantile(way, [0.25, 0.5, 0.75])
    # Lanes whose middle half is spread over more pixels end at two places; else it is the standard
    # deviation of a median, 1.25 times that of a mean
    share = 1.25 / np.sqrt(len(way)) if seen and high - low <= 2.0 * pitch else 1.0
    # Of a normal distribution, from its quartiles' distance
    sigma_of_iqr = 0.7413
    deviation = float(share * sigma_of_iqr * (high - low))
    return End(
        float(middle), deviation, bool(seen), bool(not seen and covered.sum() >= FEWEST_LANES)
    )


def soonest(ends: list[End], limit: float) -> tuple[float, float]:
    """Return the end that a seam reaches first, from those of its surfaces, with its deviation [m].

    Surfaces that go on to the limit of what is looked at do not end; where none ends the deviation
    is infinite.
    Surfaces that may end at the same place, within their errors, are averaged. One whose end
    is hidden or blurred, and is not seen so far, may end anywhere in between.
    """
    ends = [end for end in ends if end.place < limit]
    if not ends:
        return limit, np.inf
    sharp = [end for end in ends if end.sharp]
    certain = [end for end in sharp if end.seen] or sharp or ends
    first = min(certain, key=lambda end: end.place)
    same = [first]
    for end in certain:
        near = 3 * np.hypot(first.deviation, end.deviation)
        if end is not first and end.sharp and end.place - first.place <= near:
            same.append(end)
    weights = np.array([max(end.deviation, 1e-6) ** -2 for end in same])
    place = float(weights @ [end.place for end in same] / weights.sum())
    # Anywhere within the hidden stretch alike: a uniform distribution, of length / sqrt(12)
    hidden = max([0.0, *(place - end.place for end in ends)])
    if first.covered:
        hidden = limit - first.place
    return place, float(np.hypot(weights.sum() ** -0.5, hidden / np.sqrt(12)))


class Rays:
    """The scanner's rays about a line, from one or more poses."""

    def __init__(self, eyes: Floats, clouds: tuple[Floats, ...], line: Floats) -> None:
        """Keep what lies in the directions of a line.

        Args:
            eyes: (P, 3) where it was [m].
            clouds: P of (N, 3), what it saw from there [m].
            line: (K, 3) [m].
        """
        from scipy.spatial import cKDTree

        self._places = []
        # Directions about a line in which the scanner may look past it: 40 mm at 0.7 m
        # [rad]
        around = 0.06
        for eye, cloud in zip(eyes, clouds, strict=True):
            sight, seen = _directions(line - eye)[0], cloud - eye
            rays, far = _directions(seen)
            low, high = sight.min(axis=0) - around, sight.max(axis=0) + around
            about = ((rays > low) & (rays < high)).all(axis=1)
            if about.any():
                self._places.append((eye, cKDTree(rays[about]), far[about]))

    def past(self, points: Floats, pitch: float, tolerance: float) -> tuple[Mask, Mask]:
        """Return for points (N, 3) whether the scan is only behind them, and if before them.

        Args:
            points: Where something might be [m].
            pitch: Distance between neighbouring points of the scan there [m].
            tolerance: What is farther away or nearer by less is there [m].
        """
        out, covered = np.zeros((2, len(points)), dtype=bool)
        for eye, tree, far in self._places:
            rays, away = _directions(points - eye)
            off, at = tree.query(rays, k=4)
            # A ray is seen by what lies within a pixel of it.
            near = off < pitch / away[:, None]
            behind = far[np.minimum(at, len(far) - 1)] - away[:, None]
            out |= near.any(axis=1) & ((behind > tolerance) | ~near).all(axis=1)
            covered |= (near & (behind < -tolerance)).any(axis=1)
        return out, covered & ~out


def _directions(sight: Floats) -> tuple[Floats, Floats]:
    """Return unit vectors (N, 3), and the lengths (N,) [m]."""
    lengths = np.linalg.norm(sight, axis=1)
    return sight / lengths[:, None], lengths


def surfaces(swept: Swept, local: Floats, tolerance: float) -> dict[int, Mask]:
    """Return which of (N, 3) local points are on each surface that must be seen, near the seam."""
    section = swept.section
    q = swept.in_section(local)
    away, active = section.distances(q)
    near = np.linalg.norm(q, axis=1) < SEAM_WITHIN + section.shape[4:].max()
    on = near & (np.abs(away) < tolerance)
    unseen = [k for k in EDGES if k in section.joint.unseen]
    return {
        int(k): on & (active == k) for k in np.flatnonzero(section.joint.present) if k not in unseen
    }
