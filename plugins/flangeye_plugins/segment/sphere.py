"""``segment.sphere``: find a calibration sphere in a scan of the whole cell."""

from typing import ClassVar, NamedTuple

import numpy as np

from flangeye import stage
from flangeye.models.targets import Sphere
from flangeye.types import Capture, FlangeCloud, Floats, Indices, PointCloud, Rejected, Singles
from flangeye_plugins.segment.discs import in_box
from flangeye_plugins.segment.grid import Grid, coarse_view, nothing_before_scanner
from flangeye_plugins.segment.scale import RangeParams, check_scale

CANDIDATES = 6
"""Places with the most votes that are looked at more closely."""


UNKNOWN_SIZES = np.geomspace(75e-3, 8e-3, 14)
"""Radii that are looked for where the size is unknown; each finds spheres up to 10 % off [m]."""

SIZE_STEP = 0.1
"""How far a sphere may be from such a radius, as a share of it."""


class SegmentSphereParams(RangeParams):
    """Parameters of ``segment.sphere``."""

    # Smallest share of the face it turns to be seen
    min_coverage: ClassVar[float] = 0.4
    # Largest distance of a coarse point from the sphere's surface [m]
    tolerance: ClassVar[float] = 1e-3
    # Distance from the surface up to which points are kept [m]
    margin: ClassVar[float] = 2e-3


class Candidate(NamedTuple):
    """A candidate position of the sphere.

    Attributes:
        centre: (3,) centre [m].
        seen: Measured share of the sphere's face towards the scanner.
        radius: Radius [m].
    """

    centre: Floats
    seen: float
    radius: float


@stage("segment.sphere")
def segment_sphere(
    capture: Capture, sphere: Sphere, params: SegmentSphereParams
) -> FlangeCloud | Rejected:
    """Find a calibration sphere, by its size if that is known, and cut it out.

    Every surface point votes for the point one radius behind it; points on the sphere all vote for
    its centre (a Hough transform). The positions with most votes are compared with a sphere on a
    coarse view of the scan. Only the points around the best one are read at full resolution.

    Raises:
        StageError: The cloud's unit is wrong, for example millimetres.
    """
    radii = UNKNOWN_SIZES if sphere.size is None else [sphere.size]
    found: list[Candidate] = []
    for radius in radii:
        # Coarse points across the sphere.
        view = coarse_view(capture.cloud.xyz, 2 * radius / 16)
        if view is None:
            return Rejected(nothing_before_scanner(capture.cloud.xyz))
        check_scale(view.xyz, capture.id)
        view = _between(view, params.near, params.far)
        found += find_spheres(view, radius, params.tolerance, sized=sphere.size is not None)
    found = _apart(sorted(found, key=lambda c: -c.seen))
    fitting = [candidate for candidate in found if candidate.seen >= params.min_coverage]
    if len(fitting) != 1:
        return Rejected(_why_not(found, fitting, sphere, params))
    centre, radius = fitting[0].centre, fitting[0].radius
    points = _shell(capture.cloud.xyz, centre, radius, params.margin)
    towards = -centre / np.linalg.norm(centre)
    return FlangeCloud(PointCloud(capture.cloud.frame, points), centre, towards)


def find_spheres(
    view: Grid, radius: float, tolerance: float, sized: bool = True
) -> list[Candidate]:
    """Return non-overlapping candidate positions of a sphere, best first.

    Args:
        view: Coarse view of the scene; missing points are NaN.
        radius: Radius of the sphere [m].
        tolerance: Largest distance of a point from the surface [m].
        sized: Whether the radius is known; otherwise it is estimated, within ``SIZE_STEP`` of
            ``radius``.
    """
    points = view.xyz.reshape(-1, 3).astype(np.float64)
    votes = points - radius * surface_normals(view.xyz).reshape(-1, 3)
    votes = votes[np.isfinite(votes[:, 0])]
    if not len(votes):
        return []
    # Width of a voting cell, in radii: several times what noise does to a proposed centre
    starts = most_voted(votes, 0.15 * radius, 2 * radius)
    points = points[np.isfinite(points[:, 2])]
    found = [_settled(start, points, view.angle, radius, tolerance, sized) for start in starts]
    return _apart(sorted(found, key=lambda c: -c.seen))


def surface_normals(xyz: Singles) -> Floats:
    """Return unit normals (H, W, 3) of a grid of points, towards the scanner; NaN if unknown.

    They are computed from the central differences of the neighbours.
    """
    points = xyz.astype(np.float64)
    out = np.full(points.shape, np.nan)
    down = points[2:, 1:-1] - points[:-2, 1:-1]
    across = points[1:-1, 2:] - points[1:-1, :-2]
    normals = np.cross(down, across)
    length = np.linalg.norm(normals, axis=-1, keepdims=True)
    normals = normals / np.where(length > 0, length, np.nan)
    away = np.einsum("ijk,ijk->ij", normals, points[1:-1, 1:-1]) > 0
    out[1:-1, 1:-1] = np.where(away[..., None], -normals, normals)
    return out


def most_voted(votes: Floats, cell: float, apart: float) -> list[Floats]:
    """Return the positions with most votes, at most ``CANDIDATES``.

    Args:
        votes: (N, 3) voted positions [m].
        cell: Edge length of the counting cells [m]; a position covers three cells in each
            direction.
        apart: Smallest distance between returned positions [m].
    """
    index = np.floor(votes / cell).astype(np.intp)
    low = index.min(axis=0) - 1  # one empty layer to each side, so that neighbours stay neighbours
    shape = tuple((index.max(axis=0) - low + 2).tolist())
    keys, which, counts = np.unique(
        np.ravel_multi_index(tuple((index - low).T), shape),
        return_inverse=True,
        return_counts=True,
    )
    cells = np.stack(np.unravel_index(keys, shape), axis=1)
    total = _with_neighbours(keys, counts, shape)
    middles = (cells + low + 0.5) * cell
    places: list[Floats] = []
    while len(places) < CANDIDATES and total.any():
        near = (np.abs(cells - cells[np.argmax(total)]) <= 1).all(axis=1)
        places.append(votes[near[which]].mean(axis=0))
        total[np.linalg.norm(middles - places[-1], axis=1) < apart] = 0
    return places


def _with_neighbours(keys: Indices, counts: Indices, shape: tuple[int, ...]) -> Indices:
    """Return each occupied cell's votes, summed with those of its 26 neighbours."""
    steps = np.array([shape[1] * shape[2], shape[2], 1])
    around = np.stack(np.meshgrid([-1, 0, 1], [-1, 0, 1], [-1, 0, 1]), axis=-1).reshape(-1, 3)
    total = np.zeros_like(counts)
    for step in around @ steps:
        at = np.minimum(np.searchsorted(keys, keys + step), len(keys) - 1)
        total += np.where(keys[at] == keys + step, counts[at], 0)
    return total


def _settled(
    start: Floats, points: Floats, angle: float, radius: float, tolerance: float, sized: bool
) -> Candidate:
    """Return a candidate fitted to the points near its surface, with its visible share."""
    centre, size, near = (
        start,
        radius,
        points[np.linalg.norm(points - start, axis=1) < 1.5 * radius],
    )
    # Times that a candidate is moved to fit the points near its surface
    for gate in np.geomspace(max(0.3 * radius, tolerance), tolerance, 10):
        offsets = near - centre
        distance = np.maximum(np.linalg.norm(offsets, axis=1), 1e-9)
        on_surface = np.abs(distance - size) < gate
        if on_surface.sum() < 6:
            return Candidate(start, 0.0, radius)
        outwards = offsets[on_surface] / distance[on_surface, None]
        misfit = distance[on_surface] - size
        if not sized:
            outwards = np.insert(outwards, 3, 1.0, axis=1)
        step = np.linalg.lstsq(outwards, misfit, rcond=None)[0]
        centre, size = centre + step[:3], size + step[3:].sum()
        if abs(size / radius - 1) > 1.5 * SIZE_STEP:
            return Candidate(start, 0.0, radius)
    return Candidate(centre, _share_seen(centre, near, angle, size, tolerance), float(size))


def _share_seen(
    centre: Floats, near: Floats, angle: float, radius: float, tolerance: float
) -> float:
    """Return the measured share of the sphere's face towards the scanner.

    Points before or behind that face count against the sphere as much as points on it count for it:
    a plane or another round part of the arm can touch half of it within a millimetre.
    """
    offsets = near - centre
    along = offsets @ (centre / np.linalg.norm(centre))
    squared = (offsets**2).sum(axis=1)
    # Share of the radius within which, across the view, a scanner sees a sphere well.
    seen_to = np.sin(np.radians(60.0))
    facing = squared - along**2 < (seen_to * radius) ** 2
    on_face = (np.abs(np.sqrt(squared) - radius) < tolerance) & (along < 0)
    for_it, against = (facing & on_face).sum(), (facing & ~on_face).sum()
    due = np.pi * (seen_to * radius) ** 2 / (angle * np.linalg.norm(centre)) ** 2
    return float(max(0.0, (for_it - against) / due))


def _apart(candidates: list[Candidate]) -> list[Candidate]:
    """Return the candidates that do not overlap a better one, best first."""
    kept: list[Candidate] = []
    for one in candidates:
        if all(np.linalg.norm(one.centre - k.centre) > one.radius + k.radius for k in kept):
            kept.append(one)
    return kept


def _between(view: Grid, near: float, far: float) -> Grid:
    depth = view.xyz[..., 2]
    between = (depth >= near) & (depth <= far)
    return view._replace(xyz=np.where(between[..., None], view.xyz, np.float32(np.nan)))


def _why_not(
    found: list[Candidate], fitting: list[Candidate], sphere: Sphere, params: SegmentSphereParams
) -> str:
    size = "of any size" if sphere.size is None else f"{2e3 * sphere.size:g} mm across"
    if fitting:
        places = " and ".join(
            "(" + ", ".join(f"{c * 1e3:.0f}" for c in candidate.centre) + ") mm"
            for candidate in fitting
        )
        return (
            f"{len(fitting)} spheres {size}: at {places}; hide all but one, or narrow near and far"
        )
    best = found[0].seen if found else 0.0
    return (
        f"no sphere {size}: of the best candidate's face {best:.0%} is there, at least "
        f"{params.min_coverage:.0%} is needed"
    )


def _shell(xyz: Singles, centre: Floats, radius: float, margin: float) -> Singles:
    """Return the scan's points (n, 3) within ``margin`` of the sphere's surface [m]."""
    near = in_box(xyz.reshape(-1, 3), centre, radius + margin)
    distance = np.linalg.norm(near - centre, axis=1)
    return np.asarray(near[np.abs(distance - radius) < margin])
