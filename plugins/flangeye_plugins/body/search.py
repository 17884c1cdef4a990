"""Find a body in a scan: pose hypotheses, refined and tested against the scanner's rays.

Hypotheses match pairs of points at the ends of faces. The distance of the two, and the angles
between the line that joins them, the faces' normals and their outward directions, are alike on the
body and in the scan; laying one pair on the other gives a pose. Comparing a few points of the body
rules most poses out. (Drost et al., CVPR 2010, match pairs of surface points.)
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, partial
from typing import NamedTuple

import numpy as np

from flangeye.types import Floats, Indices, Mask, Singles
from flangeye_plugins.body.dense import fitted
from flangeye_plugins.body.looks import SIMILAR, Looks
from flangeye_plugins.body.shape import GRAZING, OrientedPoints, Shape, some_of
from flangeye_plugins.body.view import CoarseImage, view_of

OUTLINE = 3
"""Width of the band beside the body that is checked for its outline [cells]."""


class BodyVerdict(NamedTuple):
    """Evidence for and against a body's pose: counts of the scanner's rays.

    Attributes:
        due: Rays that should meet the body's surface, away from its edges.
        agree: Rays of ``due`` that measured the surface where it should be.
        against: Rays that contradict: they measured something behind the body, its mounting face
            included, or too close before the surface to be an occluder.
        goes_on: Rays beside the body that show its surface continued beyond its end.
        beside: Rays beside the body with a measurement.
        ended: Rays beside the body that show something behind it.
        crossing: Rays beside the body that show something at the body's depth, beyond its end.
        outline: All rays beside the body.
        upon: Rays of ``against`` and ``crossing`` that show something outside the body, before its
            surface or above the plane of the face that ends there.
    """

    due: int
    agree: int
    against: int
    goes_on: int
    beside: int
    ended: int
    crossing: int
    outline: int
    upon: int

    @property
    def bounded(self) -> bool:
        """Whether the body's outline is seen, or nothing is seen around it."""
        ends = self.ends_seen or self.beside < self._least
        # Its surface may go on where something is fastened to it
        return self.outline > 0 and ends and self.goes_on <= 0.5 * self.beside

    @property
    def ends_seen(self) -> bool:
        """Whether the body is seen to end before something farther away."""
        return self.ended >= self._least

    @property
    def framed(self) -> bool:
        """Whether nearly all that is seen around the body is in front of it."""
        return self.outline > 0 and self.ended + self.crossing < self._least

    @property
    def _least(self) -> float:
        # Smallest share of the outline that must end before something farther: otherwise a plate
        # would fit any face of a box
        return 0.03 * self.outline

    @property
    def shown(self) -> float:
        """Share of the body's visible surface in which the scan agrees with the mesh."""
        return self.agree / max(self.due, 1)

    @property
    def trusted(self) -> float:
        """Share of the rays on and beside the body that are consistent with it.

        Consistent rays meet its surface, or pass it and end behind it.
        """
        return self._trusted(self.against + self.crossing)

    @property
    def trusted_but_for_touching(self) -> float:
        """Return ``trusted`` without the rays that another thing on the body may explain."""
        return self._trusted(self.against + self.crossing - self.upon)

    def _trusted(self, contradicting: int) -> float:
        held = self.agree + self.ended
        return held / max(held + contradicting, 1)

    @property
    def rank(self) -> float:
        """Rank of a pose before refinement: score over the square root of the number of rays.

        The score alone favours poses near the scanner, which many rays meet. The share of agreeing
        rays alone favours poses that show little of the body.
        """
        # Scores of fewer rays are unreliable
        return self.score / math.sqrt(max(self.due, 150))

    @property
    def score(self) -> float:
        """Score of a pose: number of agreeing rays, less weighted contradicting ones."""
        held = self.agree if self.bounded else 0
        # One contradicting ray outweighs ten agreeing ones: the true pose has hardly any
        return held - 10 * (self.against + self.crossing)


def judged(shape: Shape, view: CoarseImage, pose: Floats, tolerance: float) -> BodyVerdict:
    """Return the evidence for and against a pose.

    Args:
        shape: The body.
        view: Fine image of the scan.
        pose: (4, 4) ``camera_T_body``.
        tolerance: Largest distance of the scan from the body's surface that agrees [m].
    """
    from scipy import ndimage

    compared = _compared(shape, view, pose, tolerance)
    if compared is None or not compared.hit.any():
        return BodyVerdict(*[0] * len(BodyVerdict._fields))
    rays, scan, depth, normals, hit, due, agree, against, *_ = compared
    beside = ndimage.binary_dilation(hit, iterations=OUTLINE) & ~ndimage.binary_dilation(hit)
    row, column = ndimage.distance_transform_edt(~hit, return_distances=False, return_indices=True)
    ended = depth[row, column][..., None] * rays[row, column]
    foot = shape.at_foot(((ended - pose[:3, 3]) @ pose[:3, :3]).reshape(-1, 3))
    beside &= ~foot.reshape(beside.shape)
    above = np.einsum("ijk,ijk->ij", normals[row, column], scan - ended)
    # A background may cross the plane of a face, but it seldom lies along it
    along = np.einsum("ijk,ijk->ij", normals[row, column], view.normals[compared.window])
    on = (np.abs(above) < 2 * tolerance) & (along > SIMILAR)
    measured = beside & np.isfinite(scan[..., 2])
    ended_there = beside & ~on & (scan[..., 2] > depth[row, column] + 2 * tolerance)
    crossing = measured & ~ended_there & ~_hides(shape, scan, depth[row, column])
    upon = (against & ~compared.through) | (crossing & (above > 2 * tolerance))
    counts = (due, agree, against, beside & on, measured, ended_there, crossing, beside, upon)
    return BodyVerdict(*(int(count.sum()) for count in counts))


class _Compared(NamedTuple):
    """Scan and body compared ray by ray; arrays (H, W) or (H, W, 3)."""

    rays: Floats
    scan: Floats
    depth: Floats
    normals: Floats
    hit: Mask
    due: Mask
    agree: Mask
    against: Mask
    through: Mask
    facets: Indices
    window: tuple[slice, slice]


def _compared(shape: Shape, view: CoarseImage, pose: Floats, tolerance: float) -> _Compared | None:
    """Return scan and body at a pose, compared ray by ray; None if no ray is near the body."""
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
    surface = np.where(hit, depth, 0.0)[..., None] * rays
    off = np.einsum("ijk,ijk->ij", normals, scan - surface)
    facing = hit & ~_edges(np.where(hit, depth, np.inf), view.angle)
    facing &= np.einsum("ijk,ijk->ij", normals, rays) < -GRAZING * np.linalg.norm(rays, axis=-1)
    # In front of the mounting face stands the carrier, and nothing can be seen behind the face
    place = origin + surface.reshape(-1, 3) @ rotation
    due = facing & ~shape.on_carrier(place, met.normals).reshape(facing.shape)
    agree = due & (np.abs(off) < tolerance)
    before = due & (off > 2 * tolerance) & ~_hides(shape, scan, depth)
    behind = facing & (off < -2 * tolerance)
    # A single ray may be a mixed one, at an edge of the body.
    against, through = (ndimage.binary_opening(seen) for seen in (behind | before, behind))
    return _Compared(rays, scan, depth, normals, hit, due, agree, against, through, facets, window)


def _hides(shape: Shape, scan: Floats, depth: Floats) -> Mask:
    """Return the mask (H, W) of rays on which something well before the body hides it."""
    return ~(scan[..., 2] > depth - 0.1 * shape.size)


def contradicted_facets(shape: Shape, view: CoarseImage, pose: Floats) -> Mask | None:
    """Return the mask (T,) of facets in parts that the scan contradicts; None if there are none.

    A part is a connected component of the mesh. It is contradicted if a tenth of the measurements
    in its place do not show it.

    Args:
        shape: The body.
        view: Fine image of the scan.
        pose: (4, 4) ``camera_T_body``.
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


def _patch(cells: Mask) -> bool:
    """Return whether a mask of cells (H, W) contains a patch, not only isolated cells at edges."""
    from scipy import ndimage

    return bool(ndimage.binary_erosion(cells, np.ones((3, 3))).any())


def _edges(depth: Floats, angle: float) -> Mask:
    """Return the mask (H, W) of cells at a step of depth."""
    from scipy import ndimage

    far = np.where(np.isfinite(depth), depth, 1e3)
    # Widths of a cell by which neighbouring rays differ in depth where the body has an edge
    return np.asarray(
        ndimage.maximum_filter(far, 3) - ndimage.minimum_filter(far, 3) > 6.0 * angle * far
    )


def _window(shape: Shape, view: CoarseImage, pose: Floats) -> tuple[slice, slice]:
    """Return the rows and columns of the image in which a body can be seen."""
    corners = shape.vertices[shape.hull] @ pose[:3, :3].T + pose[:3, 3]
    if (corners[:, 2] <= 0).any():
        return slice(0, 0), slice(0, 0)
    at = (corners[:, 1::-1] / corners[:, 2:] - view.low[::-1]) / view.angle
    most = view.xyz.shape[:2]
    low = np.clip(np.floor(at.min(axis=0)).astype(int) - OUTLINE, 0, most)
    high = np.clip(np.ceil(at.max(axis=0)).astype(int) + OUTLINE, low, most)
    return slice(low[0], high[0]), slice(low[1], high[1])


def candidate_poses(ends: OrientedPoints, view: CoarseImage, looks: Looks, effort: float) -> Floats:
    """Return poses (K, 4, 4) ``camera_T_body`` that are consistent with a scan, 200 per effort.

    Args:
        ends: Ends of surfaces in the scan.
        view: Coarse image of the scan.
        looks: The body.
        effort: Number of rounds, each of 20,000 pairs of ends.
    """
    poses = _matched(ends, looks, int(20_000 * effort))
    # Points that are compared, and tolerance as a share of the size
    scores = _chunked(poses, partial(looks.scores, view=view, count=16, tolerance=0.05))
    # Poses are refined by a step of ICP each time before more points select the best
    for most, count, reach, tolerance in ((10_000, 16, 0.1, 0.05), (2_000, 40, 0.08, 0.04)):
        poses = poses[_best_of(scores, int(most * effort))]
        settled = partial(looks.settled, view=view, count=count, reach=reach * looks.size)
        poses = _chunked(poses, settled)
        scores = _chunked(poses, partial(looks.scores, view=view, count=40, tolerance=tolerance))
    # Hundreds of nearly equal poses lay a face on a table, and would crowd out a thin body's own
    return poses[distinct(poses, scores, looks, int(200 * effort))].astype(np.float64)


def _best_of(scores: Floats, most: int) -> Indices:
    """Return the indices of the ``most`` highest scores, unordered."""
    every = np.arange(len(scores))
    return every if len(scores) <= most else np.argpartition(-scores, most)[:most]


def _chunked(poses: Floats, work: Callable[[Floats], Floats]) -> Floats:
    """Return ``work`` applied to chunks of poses, concatenated."""
    # Poses per chunk: their points fit in a core's cache
    chunks = range(0, max(len(poses), 1), 2_000)
    return np.concatenate([work(poses[k : k + 2_000]) for k in chunks])


def _matched(scan: OrientedPoints, looks: Looks, most: int) -> Floats:
    """Return the poses (K, 4, 4) that lay a pair of the body's ends on a like pair of the scan's.

    The ends of both lie alike to each other, and the pose shows both of the body's.
    """
    from scipy.spatial import cKDTree

    rng = np.random.default_rng(2)
    scan = scan.take(np.flatnonzero(np.isfinite(scan.directions[:, 0])))
    # Number of ends, and their spacing as a share of the size
    scan = scan.take(some_of(scan, 800, looks.size * (1 / 22), rng))
    pairs = cKDTree(scan.points).query_pairs(looks.size, output_type="ndarray")
    pairs = rng.permutation(pairs[looks.pairs.apart(scan, pairs.T)])[:most].T
    own, of = looks.pairs.like(scan, pairs)
    on = pairs[:, of]
    u, _, vt = np.linalg.svd(_arrows(scan, on).transpose(0, 2, 1) @ _arrows(looks.ends, own))
    u[:, :, 2] *= np.linalg.det(u @ vt)[:, None]
    poses: Floats = np.zeros((len(of), 4, 4), np.float32)
    poses[:, :3, :3], poses[:, 3, 3] = u @ vt, 1.0
    middle, at = scan.points[on].mean(axis=0), looks.ends.points[own].mean(axis=0)
    poses[:, :3, 3] = middle - np.einsum("nij,nj->ni", poses[:, :3, :3], at)
    return poses[looks.ends_seen[looks.view_of(poses), own].all(axis=0)]


def _arrows(ends: OrientedPoints, pairs: Indices) -> Floats:
    """Return the directions (N, 5, 3) of pairs (2, N): of the line between the ends, and theirs."""
    way = ends.points[pairs[1]] - ends.points[pairs[0]]
    # Noise turns the line between two ends less than the face at either, by about this factor
    way *= 3.0 / np.linalg.norm(way, axis=1, keepdims=True)
    return np.stack([way, *ends.normals[pairs], *ends.directions[pairs]], axis=1)


FINE_ACROSS = 100
"""Cells across the body in the image used for judging; enough to show thin parts."""


class FoundPose(NamedTuple):
    """A candidate pose of a body.

    Attributes:
        pose: (4, 4) ``camera_T_body``.
        verdict: Evidence for and against the pose.
        weakest: Standard deviation of the least certain direction of pose or scale [sizes or rad].
        seen: Visible area of the body, as a share of its area seen from the broadest side.
    """

    pose: Floats
    verdict: BodyVerdict
    weakest: float
    seen: float

    @property
    def rivalled_from(self) -> float:
        """Number of agreeing rays from which another pose may explain as much."""
        # Refined, a pose may explain more than twice as many rays
        return 0.4 * self.verdict.agree

    def half_as_certain(self) -> FoundPose:
        """Return the pose with twice its standard deviation; one that still passes is clear."""
        return self._replace(weakest=2 * self.weakest)


@dataclass(frozen=True, eq=False)
class BodySearch:
    """Search of one scan for one body.

    Attributes:
        points: (N, 3) points of the scan, at least ``FEWEST``, all in front of the scanner [m].
        looks: The body's shape with its visible parts.
        passes: Whether a pose is good enough that only poses which explain as much matter beside.
    """

    points: Singles
    looks: Looks
    passes: Callable[[FoundPose], bool]

    def everywhere(self) -> list[FoundPose]:
        """Return distinct candidate poses of the body, best first."""
        found = self._searched(self._coarse, 1)
        if any(map(self.passes, found)):
            return found
        # An edge-on plate shows few ends, and in a coarse scan many poses look alike
        return self._distinct(found + self._searched(self._fine, 2))

    def quickly(self, trust: float) -> list[FoundPose]:
        """Return what ``everywhere`` does, by less effort, if a share ``trust`` of rays agree."""
        return self._searched(self._coarse, 0.5, trust)

    def _searched(self, view: CoarseImage, effort: float, trust: float = 0.0) -> list[FoundPose]:
        poses = candidate_poses(view.edges(self.looks.size), view, self.looks, effort)
        # Points of the body that settle them, how far from the body the scan is taken for
        # it, move by move, and how far off it may be where it is judged, as shares of the
        # size, and how many are kept
        for count, reaches, tolerance, left in (
            (40, (0.06, 0.05), 0.03, int(200 * effort)),
            (160, (0.04, 0.03, 0.02), 0.02, int(100 * effort)),
        ):
            poses = self._settled(view, poses, count, reaches)
            scores = self.looks.scores(poses, view, count, tolerance)
            poses = poses[distinct(poses, scores, self.looks, left)]
        found = self.near(poses, trust=trust, most=int(8 * effort))
        if not found:
            return []
        # Turned by a cube's rotations, the best may explain as much
        best = found[0]
        turned = self.near(self.looks.twins(best.pose), best.rivalled_from, trust)
        return self._distinct(found + turned)

    def _settled(
        self, view: CoarseImage, poses: Floats, count: int, reaches: tuple[float, ...]
    ) -> Floats:
        for reach in reaches:
            poses = self.looks.settled(poses, view, count, reach * self.looks.size)
        return poses

    def near(
        self, poses: Floats, least: float = 0.0, trust: float = 0.0, most: int = 8
    ) -> list[FoundPose]:
        """Return the ``most`` best of the poses (K, 4, 4), refined on the points, best first.

        Only those with which at least ``least`` rays agree, and the share ``trust`` of rays may
        agree once they are refined.
        """
        verdicts = [judged(self.looks, self._fine, pose, self._rough) for pose in poses]
        agree = np.array([one.agree for one in verdicts], int)
        ranks = np.array([one.rank for one in verdicts])
        # Of the poses that passed, in simulated scans, 97 % of the rays agreed before
        likely = np.array([one.trusted >= 0.9 * trust for one in verdicts], bool)
        kept = np.flatnonzero((agree >= least) & likely)
        if not len(kept):
            return []
        kept = kept[distinct(poses[kept], ranks[kept], self.looks, most)]
        best, others = self._laid(poses[kept[0]]), kept[1:]
        if best and self.passes(best):
            others = others[agree[others] >= best.rivalled_from]
        return self._distinct([one for one in (best, *map(self._laid, poses[others])) if one])

    def refuted(self, pose: Floats, near: Callable[[Floats], Mask]) -> float:
        """Return the share of a part of the body that the scan contradicts by seeing through it.

        Hidden points do not count.

        Args:
            pose: ``camera_T_body``.
            near: Selects the part: maps points (N, 3) in the body's frame to a mask (N,).
        """
        seen = _compared(self.looks, self._fine, pose, self._tolerance)
        if seen is None:
            return 0.0
        known = np.flatnonzero(seen.agree | seen.through)
        met = (seen.depth[..., None] * seen.rays).reshape(-1, 3)[known]
        known = known[near((met - pose[:3, 3]) @ pose[:3, :3])]
        return float(seen.through.reshape(-1)[known].sum() / max(len(known), 1))

    def images(self, found: FoundPose) -> list[FoundPose]:
        """Return left-handed poses of the mirrored body that fit the scan nearly as well."""
        poses = self._settled(
            self._coarse, self.looks.reflections(found.pose), 160, (0.06, 0.04, 0.03)
        )
        return self.near(poses, 0.9 * found.verdict.agree)

    def unrivalled(self, found: list[FoundPose], rivals: list[FoundPose]) -> list[FoundPose]:
        """Return the poses that no rival dominates: none explains their cells and a patch more."""
        own, others = ([self._agreeing(one.pose) for one in each] for each in (found, rivals))
        return [
            one for one, cells in zip(found, own, strict=True)
            if not any(_patch(more & ~cells) and not _patch(cells & ~more) for more in others)
        ]  # fmt: skip

    def twins_among(self, others: list[FoundPose], found: list[FoundPose]) -> list[FoundPose]:
        """Return those of ``others`` that explain all cells that one of ``found`` explains."""
        own, cells = ([self._agreeing(one.pose) for one in each] for each in (found, others))
        return [
            one for one, more in zip(others, cells, strict=True)
            if any(not _patch(each & ~more) for each in own)
        ]  # fmt: skip

    def _agreeing(self, pose: Floats) -> Mask:
        """Return the mask (H, W) of cells that agree with the body at a pose."""
        out = np.zeros(self._fine.xyz.shape[:2], bool)
        compared = _compared(self.looks, self._fine, pose, self._tolerance)
        if compared is not None:
            out[compared.window] = compared.agree
        return out

    @cached_property
    def _tolerance(self) -> float:
        """Largest distance between scan and fitted body that counts as agreement [m]."""
        # As a share of the size, or in standard deviations of the noise
        return max(0.003 * self.looks.size, 3.5 * self._fine.noise)

    @cached_property
    def _coarse(self) -> CoarseImage:
        """The scan in cells as wide as a pose is rough, with less noise than single points."""
        return view_of(self.points, self.looks.size / 60)

    @cached_property
    def _fine(self) -> CoarseImage:
        return view_of(self.points, self.looks.size / FINE_ACROSS)

    @cached_property
    def _rough(self) -> float:
        return self.looks.tolerance(self._fine)

    def _laid(self, pose: Floats) -> FoundPose | None:
        fit = fitted(around(self.points, self.looks, pose), self.looks, pose, 2000)
        if fit is None:
            return None
        verdict = judged(self.looks, self._fine, fit.pose, self._tolerance)
        depth = fit.pose[2, :3] @ self.looks.centre + fit.pose[2, 3]
        seen = float(verdict.agree * (self._fine.angle * depth) ** 2 / self.looks.broadest)
        return FoundPose(fit.pose, verdict, fit.weakest(self.looks.symmetry.freedoms), seen)

    def _distinct(self, found: list[FoundPose]) -> list[FoundPose]:
        poses = np.array([one.pose for one in found]).reshape(-1, 4, 4)
        scores = np.array([one.verdict.score for one in found])
        return [found[k] for k in distinct(poses, scores, self.looks, len(found))]


def around(points: Singles, shape: Shape, *poses: Floats) -> Singles:
    """Return the scan points (N, 3) around a body at any of the poses."""
    near = np.zeros(len(points), bool)
    for pose in poses:
        offset = points - (pose[:3, :3] @ shape.centre + pose[:3, 3]).astype(np.float32)
        # As a share of the size: 0.5 would just reach the body's ends
        near |= np.einsum("ni,ni->n", offset, offset) < (0.55 * shape.size) ** 2
    return np.asarray(points[near])


def distinct(poses: Floats, scores: Floats, looks: Looks, most: int) -> list[int]:
    """Return the indices of up to ``most`` poses that differ from each other, best first."""
    kept: list[int] = []
    left = np.argsort(-scores, kind="stable")
    while len(left) and len(kept) < most:
        best, left = int(left[0]), left[1:]
        kept.append(best)
        left = left[~alike(poses[best : best + 1], poses[left], looks)[0]]
    return kept


def alike(some: Floats, others: Floats, looks: Looks) -> Mask:
    """Return the mask (A, B) of pose pairs that agree within 12 deg and 6 % of the size.

    Turns that leave the body as it is do not count.
    """
    freedoms, centre, axis = looks.symmetry
    here, there = (poses[:, :3, :3] @ centre + poses[:, :3, 3] for poses in (some, others))
    # Limits for unrefined poses: distance of the centres as a share of the size, and rotation
    near = np.linalg.norm(here[:, None] - there, axis=2) < 0.06 * looks.size
    least = np.cos(float(np.radians(12.0)))
    if freedoms == 6:
        near &= np.einsum("aij,bij->ab", some[:, :3, :3], others[:, :3, :3]) > 1 + 2 * least
    elif freedoms == 5:
        near &= (some[:, :3, :3] @ axis) @ (others[:, :3, :3] @ axis).T > least
    return np.asarray(near)
