"""Where surfaces of a scan end: a plate across the seam, a seam along it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from flangeye.types import Floats, Mask
from flangeye_plugins.seam.sweep import Swept
from flangeye_plugins.seam.template import EDGES, Section

FEWEST = 5
"""Lanes that an end is known from."""
NEAR = 8e-3
"""Lanes this near to the seam say where it ends [m]."""


def last_in_lanes(lanes: Floats, way: Floats, pitch: float) -> tuple[NDArray[np.intp], Floats]:
    """Return the last point of every lane, and how far beyond it (L,) the surface goes on [m].

    A surface ends on average half a spacing beyond the last pixel that is on it.

    Args:
        lanes: (N,) place across the lanes, which are a pitch wide [m].
        way: (N,) place along them [m].
        pitch: Distance between neighbouring points [m].
    """
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
        near = (beside > -NEAR) & (beside < NEAR / 2)
        if near.sum() < 4 * FEWEST:
            continue
        at = np.flatnonzero(on)[near]
        last, more = last_in_lanes(local[at, 0], beside[near], pitch)
        turned = section.angles[edge] + swept.spline.at(local[at[last], 0])[:, 2]
        out = np.zeros((len(last), 5))
        out[:, 1:3] = np.stack([np.sin(turned), np.cos(turned)], axis=1)
        found.append(local[at[last]] + more[:, None] * out)
        which.append(np.full(len(last), edge))
    return np.concatenate(found), np.concatenate(which)


def _on_face(section: Section, q: Floats, face: int, tolerance: float) -> Mask:
    return np.asarray(np.abs(q @ section.normals[face] - section.heights[face]) < tolerance)


def seam_end(s: Floats, across: Floats, pitch: float, sign: int) -> tuple[float, float]:
    """Return where along the seam a surface ends, and its standard deviation [m].

    The median over lanes; half of them may have lost their last points.

    Args:
        s: (N,) of its points [m].
        across: (N,) their distance from the seam [m].
        pitch: Distance between neighbouring points [m].
        sign: 1 for the end, -1 for the start.
    """
    last, more = last_in_lanes(across, sign * s, pitch)
    if len(last) < FEWEST:
        return float(sign * np.inf), np.inf
    found = sign * s[last] + more
    low, middle, high = np.quantile(found, [0.25, 0.5, 0.75])
    scatter = (high - low) / 1.35
    # Lanes that end at two places are no sample of one.
    share = 1.0 if high - low > 5 * pitch else 1.25 / np.sqrt(len(last))
    return float(sign * middle), float(np.hypot(share * scatter, pitch / 6))


def surfaces(swept: Swept, local: Floats, tolerance: float) -> dict[int, Mask]:
    """Return which of (N, 3) local points are on each surface that must be seen, near the seam."""
    section = swept.section
    q = swept.in_section(local)
    away, active = section.distances(q)
    near = np.linalg.norm(q, axis=1) < NEAR + section.shape[4:].max()
    on = near & (np.abs(away) < tolerance)
    unseen = [k for k in EDGES if k in section.joint.unseen]
    return {
        int(k): on & (active == k) for k in np.flatnonzero(section.joint.present) if k not in unseen
    }
