"""Whether a scan shows a body at a pose: ray by ray, everything the scanner saw there."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from flangeye.types import Floats, Indices, Mask
from flangeye_plugins.body.shape import GRAZING, Shape
from flangeye_plugins.body.view import CoarseImage

OUTLINE = 3
"""Cells beside the body in which its surface should have ended."""


class BodyVerdict(NamedTuple):
    """Evidence for and against a body's pose: counts of the scanner's rays.

    Attributes:
        due: Rays that should meet the body, away from its edges.
        agree: Of these, how many do.
        against: How many show something that cannot be there: behind the body, or right before it.
        goes_on: Rays beside it that show its surface where it has ended.
        beside: Rays beside it that show anything.
        ended: Rays beside it that show something behind it.
        outline: All rays beside it.
    """

    due: int
    agree: int
    against: int
    goes_on: int
    beside: int
    ended: int
    outline: int

    @property
    def bounded(self) -> bool:
        """Whether the body is seen to end, or nothing at all is seen around it."""
        # Least share of the body's outline that is seen to end before something farther:
        # without, any face of a box is a plate
        ended = 0.03
        return (
            self.ended >= ended * self.outline or self.beside < ended * self.outline
        ) and self.outline > 0

    @property
    def shown(self) -> float:
        """Share of the body's visible surface in which the scan agrees with the mesh."""
        return self.agree / max(self.due, 1)

    @property
    def trusted(self) -> float:
        """Share of what was seen in its place that is the body."""
        return self.agree / max(self.agree + self.against, 1)

    @property
    def score(self) -> float:
        """What poses are ranked by: rays for it, less those against it."""
        held = self.agree if self.bounded else 0
        # Rays in favour that one against outweighs: of the true pose there are hardly any
        return held - 10 * self.against - self.goes_on


def judged(shape: Shape, view: CoarseImage, pose: Floats, tolerance: float) -> BodyVerdict:
    """Return the evidence for and against ``camera_T_body``.

    Args:
        shape: The body.
        view: What the scanner saw, finely.
        pose: (4, 4).
        tolerance: How far off the body's surface the scan may be [m].
    """
    from scipy import ndimage

    compared = _compared(shape, view, pose, tolerance)
    if compared is None:
        return BodyVerdict(*[0] * 7)
    rays, scan, depth, normals, hit, due, agree, against, _ = compared
    beside = ndimage.binary_dilation(hit, iterations=OUTLINE) & ~ndimage.binary_dilation(hit)
    row, column = ndimage.distance_transform_edt(~hit, return_distances=False, return_indices=True)
    ended = depth[row, column][..., None] * rays[row, column]
    on = np.abs(np.einsum("ijk,ijk->ij", normals[row, column], scan - ended)) < 2 * tolerance
    measured = beside & np.isfinite(scan[..., 2])
    # How far behind the outline that is, as a share of the size
    ended_there = beside & (scan[..., 2] > depth[row, column] + 0.05 * shape.size)
    counts = (due, agree, against, beside & on, measured, ended_there, beside)
    return BodyVerdict(*(int(count.sum()) for count in counts))


class _Compared(NamedTuple):
    """Rays towards a body, all (H, W) or (H, W, 3): as scanned and as the body would be met."""

    rays: Floats
    scan: Floats
    depth: Floats
    normals: Floats
    hit: Mask
    due: Mask
    agree: Mask
    against: Mask
    facets: Indices


def _compared(shape: Shape, view: CoarseImage, pose: Floats, tolerance: float) -> _Compared | None:
    """Return the scan beside the body at a pose, ray by ray; None where no ray is near."""
    from scipy import ndimage

    window = _window(shape, view, pose)
    rays, scan = view.directions[window], view.xyz[window]
    if not rays.size:
        return None
    rotation, origin = pose[:3, :3], -pose[:3, 3] @ pose[:3, :3]
    met = shape.meet(origin, rays.reshape(-1, 3) @ rotation)
    depth, facets = met.depth.reshape(rays.shape[:2]), met.facets.reshape(rays.shape[:2])
    normals = (met.normals @ rotation.T).reshape(rays.shape)
    hit = np.isfinite(depth)
    off = np.einsum("ijk,ijk->ij", normals, scan - np.where(hit, depth, 0.0)[..., None] * rays)
    due = hit & ~_edges(np.where(hit, depth, np.inf), view.angle)
    due &= np.einsum("ijk,ijk->ij", normals, rays) < -GRAZING * np.linalg.norm(rays, axis=-1)
    agree = due & (np.abs(off) < tolerance)
    # What is nearer to the scanner hides the body
    before = (off > 2 * tolerance) & (scan[..., 2] > depth - 0.1 * shape.size)
    # A single ray may be a mixed one, at an edge of the body.
    against = ndimage.binary_opening(due & ((off < -2 * tolerance) | before))
    return _Compared(rays, scan, depth, normals, hit, due, agree, against, facets)


def opposed(shape: Shape, view: CoarseImage, pose: Floats) -> Mask | None:
    """Return (T,) which facets belong to parts that contradict a scan at a pose; None without any.

    A part is what hangs together in the mesh; a tenth of what is seen in its place is not it.

    Args:
        shape: The body.
        view: What the scanner saw, finely.
        pose: ``camera_T_body``.
    """
    parts, of_facet = shape.parts
    # How far off a part's surface a ray may be
    seen = _compared(shape, view, pose, 0.01 * shape.size) if parts > 1 else None
    if seen is None:
        return None
    agree, against = (
        np.bincount(of_facet[seen.facets[rays]], minlength=parts)
        for rays in (seen.agree, seen.against)
    )
    # With so many rays against it, the part stands elsewhere
    gone = against > 0.1 * (agree + against)
    return gone[of_facet] if gone.any() and not gone.all() else None


def _edges(depth: Floats, angle: float) -> Mask:
    """Return (H, W) where neighbouring rays end at different depths."""
    from scipy import ndimage

    far = np.where(np.isfinite(depth), depth, 1e3)
    # Widths of a cell by which neighbouring rays differ in depth where the body has an edge
    return np.asarray(
        ndimage.maximum_filter(far, 3) - ndimage.minimum_filter(far, 3) > 6.0 * angle * far
    )


def _window(shape: Shape, view: CoarseImage, pose: Floats) -> tuple[slice, slice]:
    """Return the rows and columns that a body may be seen in."""
    corners = shape.vertices[shape.hull] @ pose[:3, :3].T + pose[:3, 3]
    if (corners[:, 2] <= 0).any():
        return slice(0, 0), slice(0, 0)
    at = (corners[:, 1::-1] / corners[:, 2:] - view.low[::-1]) / view.angle
    most = view.xyz.shape[:2]
    low = np.clip(np.floor(at.min(axis=0)).astype(int) - OUTLINE, 0, most)
    high = np.clip(np.ceil(at.max(axis=0)).astype(int) + OUTLINE, low, most)
    return slice(low[0], high[0]), slice(low[1], high[1])
