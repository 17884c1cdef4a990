"""Find the ends of surfaces in a scan: of a plate across the seam, and of the seam itself."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flangeye.types import Floats, Mask
from flangeye_plugins.seam.sweep import Sweep
from flangeye_plugins.seam.template import EDGES

FEWEST_STRIPS = 5
"""Smallest number of strips from which an end is estimated."""
SEAM_WITHIN = 8e-3
"""Largest distance from the seam of the strips that define its end [m]."""


def last_in_strips(strips: Floats, way: Floats, pitch: float) -> tuple[NDArray[np.intp], Floats]:
    """Return each strip's last point, and the distance (L,) from there to the surface's end [m].

    A surface ends on average half a point spacing beyond its last point.

    Args:
        strips: (N,) positions across the strips, which are one ``pitch`` wide [m].
        way: (N,) positions along the strips [m].
        pitch: Distance between neighbouring points [m].
    """
    if not len(way):
        return np.zeros(0, dtype=np.intp), np.zeros(0)
    strip = np.floor(strips / pitch).astype(int)
    # By strip, then along it: each strip's last entry is its last point.
    order = np.lexsort((way, strip))
    last = np.append(np.diff(strip[order]) != 0, True)
    first = np.append(True, last[:-1])
    spans = way[order[last]] - way[order[first]]
    counts = np.diff(np.append(-1, np.flatnonzero(last)))
    gaps = spans / np.maximum(counts - 1, 1)
    # With fewer points a strip's spacing, and half of it, is not known.
    full = counts >= 4
    return order[last][full], gaps[full] / 2


def face_ends(
    swept: Sweep, local: Floats, pitch: float, tolerance: float
) -> tuple[Floats, NDArray[np.intp]]:
    """Return local points (K, 5) at the faces' ends at upright edges, and each one's edge (K,)."""
    joint, section = swept.section.joint, swept.section
    q = swept.in_section(local)
    away, active = section.distances(q)
    found, which = [np.zeros((0, 5))], [np.zeros(0, dtype=int)]
    for edge in joint.unseen:
        face = edge - 1
        on = np.abs(q @ section.normals[face] - section.heights[face]) < tolerance
        on &= np.abs(away) < 8 * tolerance
        on &= (active == face) | (active == edge)
        beside = q[on] @ section.normals[edge] - section.heights[edge]
        # Farther in on the plate nothing shows its edge; far beyond the edge is another part.
        near = (beside > -SEAM_WITHIN) & (beside < SEAM_WITHIN / 2)
        if near.sum() < 4 * FEWEST_STRIPS:
            continue
        at = np.flatnonzero(on)[near]
        last, more = last_in_strips(local[at, 0], beside[near], pitch)
        if not len(last):
            continue
        turned = section.angles[edge] + swept.spline.at(local[at[last], 0])[:, 2]
        out = np.zeros((len(last), 5))
        out[:, 1:3] = np.stack([np.sin(turned), np.cos(turned)], axis=1)
        found.append(local[at[last]] + more[:, None] * out)
        which.append(np.full(len(last), edge))
    return np.concatenate(found), np.concatenate(which)


@dataclass(frozen=True)
class End:
    """The position along the seam at which a surface ends.

    Attributes:
        place: Distance along the seam, increasing towards this end [m].
        deviation: Standard deviation of ``place`` [m].
        seen: Whether the scanner saw background beyond the end; otherwise the surface may continue
            unseen.
        covered: Whether the surface may continue below something that hides it.
    """

    place: float
    deviation: float
    seen: bool
    covered: bool

    @property
    def sharp(self) -> bool:
        """Whether the surface ends sharply, with nothing above its end."""
        # Largest standard deviation of a sharp end [m]
        loose = 0.5e-3
        return self.deviation < loose and not self.covered


def surface_end(way: Floats, past: Mask, covered: Mask, pitch: float) -> End | None:
    """Return a surface's end, estimated from the ends of its strips; None with too few strips.

    It is the median over strips. If enough strips end before visible background, only these
    count. If the strips' ends are spread over more than two pixels, they are not a sample of one
    position, and averaging does not reduce the standard deviation.

    Args:
        way: (L,) ends of the strips, as distances along the seam [m].
        past: (L,) whether the scanner sees background beyond each strip's end.
        covered: (L,) whether something hides what is beyond each strip's end.
        pitch: Distance between neighbouring points [m].
    """
    if len(way) < FEWEST_STRIPS:
        return None
    seen = past.sum() >= FEWEST_STRIPS
    way = way[past] if seen else way
    low, middle, high = np.quantile(way, [0.25, 0.5, 0.75])
    # The standard deviation of a median is 1.25 times that of a mean; strips spread over more than
    # two pixels end at different positions, which averaging does not improve
    share = 1.25 / np.sqrt(len(way)) if seen and high - low <= 2.0 * pitch else 1.0
    # Standard deviation of a normal distribution over its interquartile range
    sigma_of_iqr = 0.7413
    deviation = float(share * sigma_of_iqr * (high - low))
    return End(
        float(middle), deviation, bool(seen), bool(not seen and covered.sum() >= FEWEST_STRIPS)
    )


def earliest_end(ends: list[End], limit: float) -> tuple[float, float]:
    """Return a seam's end, the first of its surfaces' ends, and its standard deviation [m].

    Surfaces that reach ``limit`` do not end; if none ends, the deviation is infinite. Ends that
    coincide within three standard deviations are averaged. A hidden or blurred end that lies before
    the result adds the uncertainty of the stretch in between.
    """
    ends = [end for end in ends if end.place < limit]
    if not ends:
        return limit, np.inf
    sharp = [end for end in ends if end.sharp]
    # An end before visible background is sure; a blurred or hidden one may go on.
    certain = [end for end in sharp if end.seen] or sharp or ends
    first = min(certain, key=lambda end: end.place)
    same = [first]
    for end in certain:
        near = 3 * np.hypot(first.deviation, end.deviation)
        if end is not first and end.sharp and end.place - first.place <= near:
            same.append(end)
    # Inverse-variance weights; a floor of 1 um keeps exact ends finite.
    weights = np.array([max(end.deviation, 1e-6) ** -2 for end in same])
    place = float(weights @ [end.place for end in same] / weights.sum())
    # Uniform distribution over the hidden stretch: standard deviation length / sqrt(12)
    hidden = max([0.0, *(place - end.place for end in ends)])
    if first.covered:
        hidden = limit - first.place
    return place, float(np.hypot(weights.sum() ** -0.5, hidden / np.sqrt(12)))


class Rays:
    """The scanner's rays near a line, from one or more poses."""

    def __init__(self, eyes: Floats, clouds: tuple[Floats, ...], line: Floats) -> None:
        """Index the rays in the directions of a line.

        Args:
            eyes: (P, 3) positions of the scanner [m].
            clouds: P arrays (N, 3), the points measured from each position [m].
            line: (K, 3) points of the line [m].
        """
        from scipy.spatial import cKDTree

        self._places = []
        # Margin of directions around the line [rad]: 40 mm at 0.7 m
        around = 0.06
        for eye, cloud in zip(eyes, clouds, strict=True):
            sight, seen = _directions(line - eye)[0], cloud - eye
            rays, far = _directions(seen)
            low, high = sight.min(axis=0) - around, sight.max(axis=0) + around
            about = ((rays > low) & (rays < high)).all(axis=1)
            if about.any():
                self._places.append((eye, cKDTree(rays[about]), far[about]))

    def past(self, points: Floats, pitch: float, tolerance: float) -> tuple[Mask, Mask]:
        """Return masks (N,): the scanner sees past each point, and something hides the point.

        Args:
            points: (N, 3) points where a surface might be [m].
            pitch: Distance between neighbouring points of the scan there [m].
            tolerance: Largest difference of range at which a measurement is the point itself [m].
        """
        out, covered = np.zeros((2, len(points)), dtype=bool)
        for eye, tree, far in self._places:
            rays, away = _directions(points - eye)
            off, at = tree.query(rays, k=4)
            # The measurements within one pixel of a ray are what the scanner sees on it.
            near = off < pitch / away[:, None]
            behind = far[np.minimum(at, len(far) - 1)] - away[:, None]
            # Past only if every measurement on the ray lies behind: one nearer may be the surface
            # itself.
            out |= near.any(axis=1) & ((behind > tolerance) | ~near).all(axis=1)
            covered |= (near & (behind < -tolerance)).any(axis=1)
        return out, covered & ~out


def _directions(sight: Floats) -> tuple[Floats, Floats]:
    """Return unit vectors (N, 3) and lengths (N,) [m]."""
    lengths = np.linalg.norm(sight, axis=1)
    return sight / lengths[:, None], lengths


def surfaces(swept: Sweep, local: Floats, tolerance: float) -> dict[int, Mask]:
    """Return the masks (N,) of points on each surface that must be visible, near the seam."""
    section = swept.section
    q = swept.in_section(local)
    away, active = section.distances(q)
    near = np.linalg.norm(q, axis=1) < SEAM_WITHIN + section.shape[4:].max()
    on = near & (np.abs(away) < tolerance)
    unseen = [k for k in EDGES if k in section.joint.unseen]
    return {
        int(k): on & (active == k) for k in np.flatnonzero(section.joint.present) if k not in unseen
    }
