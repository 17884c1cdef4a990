"""``segment.flange``: find the flange in a scan of the whole cell."""

from collections.abc import Callable, Iterator
from functools import partial
from typing import ClassVar

import numpy as np

from flangeye import stage
from flangeye.maths.planes import robust_planes, thinned
from flangeye.maths.statistics import SIGMA_OF_MAD, median
from flangeye.models.targets import Flange, match_holes
from flangeye.types import Capture, FlangeCloud, Indices, Mask, PointCloud, Rejected, Singles
from flangeye_plugins.segment.discs import (
    Disc,
    DiscLimits,
    PlanarPiece,
    SurfacePiece,
    compare,
    crop,
    flat_parts,
    in_box,
    of_size,
)
from flangeye_plugins.segment.grid import Grid, cells, coarse_view, nothing_before_scanner
from flangeye_plugins.segment.scale import RangeParams, check_scale

NOISE_GATE = 5.0
"""Robust standard deviations of the grid's own bending above which a point is not smooth."""


BLANK = 0.2
"""A face without holes scores near 0, the published faces with five holes 0.77 and more, one
with large recesses besides its holes 0.35."""


def find_discs(view: Grid, flange: Flange, limits: DiscLimits) -> list[Disc]:
    """Return every flat part of the scene as a disc; all but possible flanges have a flaw."""
    smooth, noise = smooth_surface(view, limits.crease)
    some = view.xyz.reshape(-1, 3)[:, 2].take(np.flatnonzero(smooth)[::7])
    pitch = view.angle * float(median(some)) if len(some) else np.inf
    fewest = max(25, int(0.02 * np.pi * flange.rim**2 / pitch**2))
    pieces = [_piece(view, index, flange) for index in connected_pieces(smooth, fewest)]
    parts = flat_parts(pieces, 2.5 * flange.outer, _scatter(flange, noise), fewest)
    discs = [_disc(part, view, flange) for part in parts]
    return _compared(discs, view, flange, limits)


def _piece(view: Grid, index: Indices, flange: Flange) -> SurfacePiece:
    points = view.xyz.reshape(-1, 3).take(index, axis=0)
    side = 0.5 * flange.rim / (view.angle * points[0, 2])
    return SurfacePiece(points, index, view.xyz.shape[1], max(3, round(side)))


def _disc(part: PlanarPiece, view: Grid, flange: Flange) -> Disc:
    pitch = view.angle * float(part.plane.point[2])
    rows, columns = cells(thinned(part.at), view.xyz.shape[1])
    middle = int(median(rows.astype(float))), int(median(columns.astype(float)))
    return of_size(part, middle, pitch, flange)


def _scatter(flange: Flange, noise: float) -> float:
    """Return the largest standard deviation of a flat part about its plane [m].

    A wrist circle has the tool plate in front of it. If the step between them is too small to be
    detected as a crease, plate and circle are one piece with a roughness of that step.
    """
    hidden = flange.bore is None and flange.details.thickness < NOISE_GATE * np.sqrt(6) * noise
    # Scatter about a plane that a scanner's distortion may add to noise on something flat [m]
    return max(3 * noise, 3e-4) + (flange.details.thickness if hidden else 0.0)


def _compared(discs: list[Disc], view: Grid, flange: Flange, limits: DiscLimits) -> list[Disc]:
    """Return the discs after testing those of the right size against the flange.

    A piece may be only an arc of a face that holes and missing points have cut up, so the plane is
    fitted again to all points in it.
    """
    right = [disc for disc in discs if disc.flaw is None]
    nearby = [_near(disc, view, 2.5 * flange.outer) for disc in right]
    gates = np.array([max(limits.crease, 3 * disc.plane.sigma) for disc in right])
    samples = [thinned(points) for points in nearby]
    planes = robust_planes(samples, [disc.plane for disc in right], gates)
    compared = []
    for disc, near, plane in zip(right, nearby, planes, strict=True):
        if plane is not None:
            points = near.astype(np.float64)
            # Half thickness of a face: scanners round its edges by more than their noise [m]
            near_it = np.abs(plane.heights(points)) < max(3 * plane.sigma, 3e-4)
            around = points.compress(near_it, axis=0)
            pitch = view.angle * float(disc.plane.point[2])
            disc = compare(disc._replace(plane=plane), around, points, pitch, flange, limits)
        compared.append(disc)
    return [disc for disc in discs if disc.flaw is not None] + compared


def _near(disc: Disc, view: Grid, reach: float) -> Singles:
    """Return the view's points (n, 3) within ``reach`` of a disc along every axis."""
    about = view.about(disc.cell, disc.centre, reach)
    return in_box(about, disc.centre, reach)


def smooth_surface(grid: Grid, bend: float) -> tuple[Mask, float]:
    """Return the mask (H, W) of smooth surface, and the standard deviation of depth [m].

    The second difference of depth is small on a plane, however tilted. It is large at steps,
    creases, mixed pixels and stray points.

    Args:
        grid: Points in the order of the scanner's view.
        bend: Smallest second difference of depth at a crease [m].
    """
    depth = np.ascontiguousarray(grid.xyz[..., 2])
    # The second difference of independent values has six times their variance.
    bent = [_bending(depth, axis, 1) for axis in (0, 1)]
    noise = max(_typical(near) for near in bent) / np.sqrt(6)
    if NOISE_GATE * np.sqrt(6) * noise > bend:
        depth = _averaged(depth)
        bent = [_bending(depth, axis, 1) for axis in (0, 1)]
    smooth = np.isfinite(depth)
    for axis, near in enumerate(bent):
        wide = _bending(depth, axis, 2)
        limit = max(bend, NOISE_GATE * _typical(wide))
        # A crease of little slope, or one softened by the scanner, shows over two points.
        for bending in (near, wide):
            smooth &= ~(np.abs(bending, out=bending) > limit)
        # Beside a missing point only the step to the other neighbour can be judged.
        lone = np.flatnonzero(smooth & np.isnan(near))
        here, step = depth.ravel().take(lone), _step(depth, lone, axis)
        # Tangent of the steepest incidence at which a surface is still followed, 60 degrees
        smooth.ravel()[lone] = step <= limit + 1.7 * grid.angle * here
    return smooth, noise


def _averaged(depth: Singles) -> Singles:
    """Return depth averaged over each point and its valid neighbours; missing points stay."""
    import cv2

    there = np.isfinite(depth)
    total = cv2.blur(np.where(there, depth, np.float32(0)), (3, 3), borderType=cv2.BORDER_CONSTANT)
    share = cv2.blur(there.astype(np.float32), (3, 3), borderType=cv2.BORDER_CONSTANT)
    return np.where(there, total / np.maximum(share, np.float32(0.1)), np.float32(np.nan))


def _bending(depth: Singles, axis: int, reach: int) -> Singles:
    """Return the second difference of depth over ``reach`` points; NaN where one is missing."""
    out = np.full_like(depth, np.nan)
    view, target = np.moveaxis(depth, axis, 0), np.moveaxis(out, axis, 0)
    inner = target[reach:-reach]
    np.add(view[2 * reach :], view[: -2 * reach], out=inner)
    inner -= 2 * view[reach:-reach]
    return out


def _step(depth: Singles, at: Indices, axis: int) -> Singles:
    """Return the larger step of depth to the two neighbours along an axis; 0 for missing ones."""
    flat, along = depth.ravel(), cells(at, depth.shape[1])[axis]
    to_next = (depth.shape[1], 1)[axis]
    before, after = at - to_next * (along > 0), at + to_next * (along < depth.shape[axis] - 1)
    steps = [np.abs(flat.take(beside) - flat.take(at)) for beside in (before, after)]
    return np.asarray(np.fmax(np.fmax(*steps), np.float32(0)))


def _typical(values: Singles) -> float:
    """Return the robust standard deviation of depth from its second differences."""
    # Second differences that settle what is typical, to one percent.
    sample = np.abs(values.ravel()[:: 1 + values.size // 40_000])
    sample = sample[np.isfinite(sample)]
    return SIGMA_OF_MAD * float(median(sample)) if sample.size else 0.0


def connected_pieces(mask: Mask, fewest: int) -> Iterator[Indices]:
    """Yield the flat indices of each connected piece of a mask, the largest first.

    Connectivity is by sides only, so that a diagonal crease still separates two pieces.
    """
    import cv2

    # OpenCV's own statistics take three times as long as the components.
    count, image = cv2.connectedComponents(mask.view(np.uint8), connectivity=4)
    labels = image.ravel()
    sizes = np.bincount(labels, minlength=count)
    large = [k for k in range(1, count) if sizes[k] >= fewest]
    for piece in sorted(large, key=lambda k: (-sizes[k], k)):
        yield np.flatnonzero(labels == piece)


def choose(
    discs: list[Disc], cut: Callable[[Disc], Singles], flange: Flange
) -> tuple[Disc, Singles] | str:
    """Return the flange's disc with its points, or the reason why none was found.

    Args:
        discs: All flat parts of the scene.
        cut: Returns a disc's points at full resolution; called for possible flanges only.
        flange: The flange to find.
    """
    fitting = _distinct([disc for disc in discs if disc.flaw is None], flange.rim)
    if not fitting:
        return _why_none(discs, flange)
    # A wrist circle has no holes to recognise; the visible share of its rim has to do.
    cuts = [cut(disc) for disc in fitting]
    scores = [
        _hole_score(disc, points, flange) if flange.holes else disc.seen
        for disc, points in zip(fitting, cuts, strict=True)
    ]
    # A disc that scores less than this share of another's is not mistaken for it
    enough = max(BLANK, 0.6 * max(scores))
    marked = [k for k, score in enumerate(scores) if score >= enough]
    if not marked:
        return f"a disc {fitting[0].across * 1e3:.0f} mm across with a bore has no threaded holes"
    if len(marked) > 1:
        return _ambiguous([fitting[k] for k in marked])
    return fitting[marked[0]], cuts[marked[0]]


def _distinct(discs: list[Disc], apart: float) -> list[Disc]:
    """Return one disc for each place: the one with the best visibility."""
    kept: list[Disc] = []
    for disc in sorted(discs, key=lambda d: -d.seen):
        if all(np.linalg.norm(disc.centre - other.centre) > apart for other in kept):
            kept.append(disc)
    return kept


def _hole_score(disc: Disc, cut: Singles, flange: Flange) -> float:
    """Return the score of a disc's holes against the flange's; BLANK if undecidable."""
    points = cut.astype(np.float64)
    on_face = np.abs(disc.plane.heights(points)) < 3 * disc.plane.sigma + 1e-6
    face = points.compress(on_face, axis=0)
    flat = disc.plane.flatten(face) - disc.plane.flatten(disc.centre[None])
    match = match_holes(flat, flange)
    return BLANK if match is None else match.score


def _ambiguous(discs: list[Disc]) -> str:
    places = " and ".join(
        "(" + ", ".join(f"{c * 1e3:.0f}" for c in disc.centre) + ") mm" for disc in discs
    )
    return (
        f"{len(discs)} discs look like the flange: at {places}; "
        "hide all but one, or narrow near and far"
    )


def _why_none(discs: list[Disc], flange: Flange) -> str:
    """Return the flaw of the disc that passed most tests."""
    if not discs:
        return "no flat surface in sight"
    best = max(discs, key=lambda d: (d.rank, d.seen))
    if best.rank > 0:
        return str(best.flaw)
    nearest = min(discs, key=lambda d: abs(np.log(d.across / (2 * flange.rim))))
    return (
        f"no plane of the flange's size: nearest candidate {nearest.flaw}, "
        f"flange {2e3 * flange.rim:.0f} mm"
    )


class SegmentParams(RangeParams):
    """Parameters of ``segment.flange``."""

    # Largest angle between the flange's normal and the view [rad]
    max_incidence: ClassVar[float] = float(np.radians(55))
    # Smallest share of the rim, and of the bore, to be seen
    min_coverage: ClassVar[float] = 0.3
    # How much depth bends from one coarse point to the next where a surface ends; five times the
    # scan's noise if that is more [m]
    crease: ClassVar[float] = 0.8e-3
    # Distance from the face, and beyond its circle, up to which points are kept [m]
    margin: ClassVar[float] = 2e-3


@stage("segment.flange")
def segment_flange(
    capture: Capture, flange: Flange, params: SegmentParams
) -> FlangeCloud | Rejected:
    """Find the flange by its size, flatness, rim, bore and holes, and cut it out.

    The steps of the paper's section 2.1.4 run on a coarse view of the scan: pass-through filter,
    removal of stray points, clustering into smooth connected pieces, plane fit, size, incidence.
    The remaining discs are compared with the flange's rim and bore, by likelihood against a disc of
    another size. If two discs, or one without holes, are left, the holes decide. Only the points
    around the chosen disc are read at full resolution.

    Raises:
        StageError: The cloud's unit is wrong, for example millimetres.
    """
    view = coarse_view(capture.cloud.xyz, flange.rim / 15)
    if view is None:
        return Rejected(nothing_before_scanner(capture.cloud.xyz))
    check_scale(view.xyz, capture.id)
    inside = _pass_through(view, params)
    if inside is None:
        return Rejected(_nothing_inside(view, params))
    limits = DiscLimits(params.max_incidence, params.min_coverage, params.crease)
    discs = find_discs(inside, flange, limits)
    cut = partial(crop, capture.cloud.xyz, inside, radius=flange.outer, margin=params.margin)
    found = choose(discs, cut, flange)
    if isinstance(found, str):
        return Rejected(found)
    disc, points = found
    cloud = PointCloud(capture.cloud.frame, points)
    return FlangeCloud(cloud, disc.centre, disc.plane.normal, ratio=disc.ratio)


def _pass_through(view: Grid, params: SegmentParams) -> Grid | None:
    """Return the view without points too near or too far; None if no point is left."""
    depth = view.xyz[..., 2]
    outside = (depth < params.near) | (depth > params.far)
    if not outside.any():
        return view
    xyz = np.where(outside[..., None], np.float32(np.nan), view.xyz)
    return view._replace(xyz=xyz) if np.isfinite(xyz[..., 2]).any() else None


def _nothing_inside(view: Grid, params: SegmentParams) -> str:
    depth = view.xyz[..., 2]
    return (
        f"no point between near {params.near * 1e3:g} mm and far {params.far * 1e3:g} mm: "
        f"depths from {np.nanmin(depth) * 1e3:.0f} to {np.nanmax(depth) * 1e3:.0f} mm"
    )
