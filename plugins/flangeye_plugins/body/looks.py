"""The visible parts of a body from each direction, and a pose's score against a scan."""

from __future__ import annotations

from functools import cached_property, lru_cache
from itertools import permutations, product
from typing import ClassVar, NamedTuple

import numpy as np

from flangeye.models.bodies import TargetBody
from flangeye.types import Floats, Indices, Mask
from flangeye.types.geometry import rotation_exp
from flangeye_plugins.body.shape import GRAZING, OrientedPoints, Shape, some_of, spread_directions
from flangeye_plugins.body.view import CoarseImage

ALIKE, SIMILAR = 0.5, 0.7
"""Smallest cosine between normals of body and scan: while a candidate is refined, and when it is
judged.
"""


QUARTERS = np.array([
    m for m in (np.array(signs)[:, None] * np.eye(3)[list(order)]
                for order in permutations(range(3)) for signs in product((1, -1), repeat=3))
    if np.linalg.det(m) > 0 and np.trace(m) < 3
])  # fmt: skip
"""The 23 non-trivial rotations of a cube onto itself."""

LISTED = 160
"""Number of sample points that represent the body's visible part from one direction."""


class Symmetry(NamedTuple):
    """Directions of a body's pose that its shape determines, and its axis of symmetry.

    Attributes:
        freedoms: Number of the pose's directions that the shape determines: 6, of a body of
            revolution 5, of a ball 3.
        centre: (3,) point of the axis nearest to the body's centre; of a ball its centre [m].
        axis: (3,) unit vector along the axis; of a ball without meaning.
    """

    freedoms: int
    centre: Floats
    axis: Floats


class EndPairs:
    """Pairs of ends of a body's faces, found by the two ends' distance and angles."""

    def __init__(self, ends: OrientedPoints, seen: Mask, size: float) -> None:
        """Take the ends of a body of a ``size`` [m]; ``seen`` (V, N) are those visible at once."""
        from scipy.spatial import cKDTree

        self._size = size
        # Number of ends, and their spacing as a share of the size
        some = some_of(ends, 400, size * (1 / 18), np.random.default_rng(2))
        visible = seen[:, some].astype(np.float32)
        pairs = some[np.array(np.nonzero(visible.T @ visible))]
        self._pairs = pairs[:, self.apart(ends, pairs)]
        self._tree = cKDTree(self._relation(ends, self._pairs))

    def apart(self, ends: OrientedPoints, pairs: Indices) -> Mask:
        """Return the mask (N,) of pairs (2, N) that are so far apart that they determine a pose."""
        way = ends.points[pairs[1]] - ends.points[pairs[0]]
        return np.asarray(np.linalg.norm(way, axis=1) > 0.2 * self._size)

    def like(self, ends: OrientedPoints, pairs: Indices) -> tuple[Indices, Indices]:
        """Return the body's pairs (2, M) that are like one of ``pairs`` (2, N), and which (M,)."""
        # The likest ones, found within a factor of two; three tolerances at most
        off, at = self._tree.query(
            self._relation(ends, pairs), k=12, eps=1.0, distance_upper_bound=3.0
        )
        of, rank = np.nonzero(np.isfinite(off))
        return self._pairs[:, at[of, rank]], of

    def _relation(self, ends: OrientedPoints, pairs: Indices) -> Floats:
        """Return distances and cosines (N, 9) unchanged by rigid motion, over their tolerances."""
        way = ends.points[pairs[1]] - ends.points[pairs[0]]
        apart = np.linalg.norm(way, axis=1)
        normals, outwards = ends.normals[pairs], ends.directions[pairs]
        frames = np.concatenate([normals, outwards, np.cross(normals, outwards)])
        cosines = [
            *np.einsum("kni,ni->kn", frames, way / apart[:, None]),
            *(np.einsum("ni,ni->n", *both) for both in (normals, outwards)),
        ]
        # As far off as ends are apart, and as a coarse view's normals turn a cosine
        return np.column_stack([apart / (0.06 * self._size), *np.array(cosines) / 0.2])


class Looks(Shape):
    """A body's shape with its visible part from each of 128 directions."""

    # Points for it that outweigh one that is seen through, or a face that goes on beyond its
    # end.
    against: ClassVar[float] = 4.0

    # Distance beyond a face's end at which no surface should be seen, as a share of the size
    beyond: ClassVar[float] = 0.05

    @cached_property
    def views(self) -> Floats:
        """Viewing directions (V, 3), from the scanner to the body."""
        # 128 directions, about 20 degrees apart, are enough for occlusions
        return spread_directions(128)

    @cached_property
    def _seen(self) -> tuple[Mask, Mask]:
        """Masks (V, N) of surface points and of edge points visible from each direction.

        Only ends with free space or distant background behind them count.
        """
        ends, away = self.ends, self.beyond * self.size
        beyond = ends._replace(points=ends.points + away * ends.directions)
        free = ~_before(self, beyond.points, self.views, away)
        on, off = (_seen(self, part, self.views) for part in (self.surface, beyond))
        return on, off & free

    @property
    def ends_seen(self) -> Mask:
        """Mask (V, N) of the edge points visible from each direction."""
        return self._seen[1]

    @cached_property
    def pairs(self) -> EndPairs:
        """Pairs of ends that are visible together."""
        return EndPairs(self.ends, self.ends_seen, self.size)

    @cached_property
    def _listed(self) -> tuple[Indices, Indices]:
        """Indices (V, LISTED) of sampled visible surface points, and of sampled edge points."""
        # -0.4: a coarse view often misses surfaces at larger incidence than 66 degrees
        on, ends = (
            _apart(part.points, seen & (self.views @ part.normals.T < -0.4))
            for part, seen in zip((self.surface, self.ends), self._seen, strict=True)
        )
        return on, ends

    def scores(self, poses: Floats, view: CoarseImage, count: int, tolerance: float) -> Floats:
        """Return scores (K,) of poses: the share of visible points that agree, less contradictions.

        Args:
            poses: (K, 4, 4) ``camera_T_body``.
            view: The scan.
            count: Number of surface points, and of ends, to compare.
            tolerance: Largest distance from the scan that agrees, as a share of the size.
        """
        number, reach = self.view_of(poses), tolerance * self.size
        # The listed points are sorted: the first ones are farthest apart
        on, off = (listed[number, :count] for listed in self._listed)
        return self._surface_score(poses, view, on, reach) + self._ends_score(
            poses, view, off, reach
        )

    def _surface_score(self, poses: Floats, view: CoarseImage, at: Indices, reach: float) -> Floats:
        placed, facing = _placed(poses, *self._singles[0], at)
        off, behind, cosine = view.compared(placed, facing)
        there = (np.abs(off) < reach) & (cosine > SIMILAR) & (np.abs(behind) < 3 * reach)
        through, wrong = behind > 2 * reach, (np.abs(behind) < 2 * reach) & ~there
        worth = there - self.against * through - 0.5 * wrong
        return _mean(worth, _turned_here(placed, facing))

    def _ends_score(self, poses: Floats, view: CoarseImage, at: Indices, reach: float) -> Floats:
        placed, outwards = _placed(poses, *self._singles[1], at)
        offset, cosine = view.to_end(placed, outwards)
        there = (np.einsum("kni,kni->kn", offset, offset) < reach**2) & (cosine > SIMILAR)
        facing = self._end_normals[at] @ poses[:, :3, :3].transpose(0, 2, 1)
        here = _turned_here(placed, facing)
        placed = placed + self.beyond * self.size * outwards
        off, behind, cosine = view.compared(placed, facing)
        on = (np.abs(off) < reach / 2) & (cosine > SIMILAR) & (np.abs(behind) < reach)
        return _mean(there - self.against * on, here)

    @cached_property
    def _end_normals(self) -> Floats:
        return self.ends.normals.astype(np.float32)

    @cached_property
    def _singles(self) -> list[tuple[Floats, Floats]]:
        """Points and directions of the surface and of the ends, in single precision."""
        return [
            (part.points.astype(np.float32), part.directions.astype(np.float32))
            for part in (self.surface, self.ends)
        ]

    @cached_property
    def symmetry(self) -> Symmetry:
        """Rotations that leave the body unchanged: a cylinder's about its axis, all of a ball's."""
        points = np.concatenate([self.surface.points, self.ends.points])
        values, _ = self._held(points, np.concatenate([self.surface.normals, self.ends.directions]))
        # Share of the body's points that show a direction: of facets of a cylinder fewer
        # do
        if not (free := int((values <= 1e-4).sum())):
            return Symmetry(6, self.centre, np.array([0.0, 0.0, 1.0]))
        # The corners of facets lie on the round surface itself, the points between them within it.
        vertices, triangles = self.facets
        areas = np.repeat(self._mesh.area_faces, 3)
        _, moves = self._held(vertices[triangles.ravel()], self.smooth.reshape(-1, 3), areas)
        turns, shifts = np.split(moves[:, :free].T, 2, axis=1)
        # A turn w about a point q moves the centre c by the shift -w x (q - c), in sizes
        rows = np.cross(turns[:, None], np.eye(3)).transpose(0, 2, 1).reshape(-1, 3)
        to_point = np.linalg.lstsq(rows, -self.size * shifts.ravel(), rcond=None)[0]
        axis = turns[0] / np.linalg.norm(turns[0])
        axis *= np.sign(axis[np.abs(axis).argmax()])
        return Symmetry(5 if free == 1 else 3, self.centre + to_point, axis)

    def _held(
        self, points: Floats, directions: Floats, weights: Floats | float = 1.0
    ) -> tuple[Floats, Floats]:
        """Return eigenvalues (6,) and eigenvectors (6, 6) of the information about a pose."""
        place = (points - self.centre) / self.size
        jacobian = np.hstack([np.cross(place, directions), directions])
        weighted = jacobian * np.reshape(weights, (-1, 1))
        return np.linalg.eigh(weighted.T @ jacobian / len(points))

    def twins(self, pose: Floats) -> Floats:
        """Return the pose after each rotation of a cube (K, 4, 4): they often look alike."""
        return self._turned(pose, QUARTERS)

    def reflections(self, pose: Floats) -> Floats:
        """Return left-handed poses (24, 4, 4) of the mirrored body in a cube's rotations."""
        flips = np.concatenate([np.eye(3)[None], QUARTERS]) @ np.diag([-1.0, 1.0, 1.0])
        return self._turned(pose, flips)

    def _turned(self, pose: Floats, turns: Floats) -> Floats:
        """Return the pose after each of the turns (K, 3, 3) about the surface's middle."""
        # A small detail hardly moves it, unlike the centre of the bounding box
        middle = self.surface.points.mean(axis=0)
        out = np.tile(np.eye(4), (len(turns), 1, 1))
        out[:, :3, :3] = turns
        out[:, :3, 3] = middle - turns @ middle
        return np.asarray(pose @ out)

    def tolerance(self, view: CoarseImage) -> float:
        """Return the largest distance from the scan that counts as agreement [m]."""
        # As a share of the size; three sigma of the scanner's noise at least
        return max(0.01 * self.size, 3 * view.noise)

    def settled(self, poses: Floats, view: CoarseImage, count: int, reach: float) -> Floats:
        """Return poses (K, 4, 4) after one step of ICP to the scan's surfaces and edges."""
        number = self.view_of(poses)
        on, off = (listed[number, :count] for listed in self._listed)
        placed, facing = _placed(poses, *self._singles[0], on)
        offset, normals = view.planes(placed)
        use = np.einsum("kni,kni->kn", offset, offset) < reach**2
        use &= np.einsum("kni,kni->kn", facing, normals) > ALIKE
        ends, outwards = _placed(poses, *self._singles[1], off)
        to_end, cosine = view.to_end(ends, outwards)
        use_end = (np.einsum("kni,kni->kn", to_end, to_end) < reach**2) & (cosine > ALIKE)
        parts = (placed, normals, offset, use), (ends, outwards, to_end, use_end)
        placed, along, offset, use = (
            np.concatenate(columns, axis=1) for columns in zip(*parts, strict=True)
        )
        along = np.where(use[..., None], along, 0.0)
        offset = np.where(use[..., None], offset, 0.0)
        return self._stepped(poses, placed, along, (along * offset).sum(axis=-1))

    def _stepped(self, poses: Floats, points: Floats, along: Floats, misfit: Floats) -> Floats:
        centres = poses[:, :3, :3] @ self.centre + poses[:, :3, 3]
        arms = (points - centres[:, None]) / self.size
        jacobian = np.concatenate([np.cross(arms, along), along], axis=2)
        normal = jacobian.transpose(0, 2, 1) @ jacobian
        count = (along**2).sum(axis=(1, 2))
        # Share of a point's information that holds a candidate where it is
        normal += (1e-3 * (count + 1))[:, None, None] * np.eye(6)
        step = np.linalg.solve(normal, jacobian.transpose(0, 2, 1) @ misfit[..., None])[..., 0]
        out = poses.copy()
        out[:, :3, :3] = rotation_exp(step[:, :3] / self.size) @ poses[:, :3, :3]
        out[:, :3, 3] = centres + step[:, 3:] - np.einsum("kij,j->ki", out[:, :3, :3], self.centre)
        return out

    def view_of(self, poses: Floats) -> Indices:
        """Return the index (K,) of the viewing direction closest to each pose's."""
        centres = poses[:, :3, :3] @ self.centre.astype(poses.dtype) + poses[:, :3, 3]
        towards = np.einsum("kji,kj->ki", poses[:, :3, :3], centres)
        return np.asarray(np.argmax(towards @ self.views.T.astype(poses.dtype), axis=1))


@lru_cache(maxsize=8)  # a session's body, and how its mesh may be drawn wrongly
def prepared(body: TargetBody) -> Looks:
    """Return a body's shape with visible parts; cached for each shape."""
    return Looks(body.vertices, body.triangles, mounted=True)


def _apart(points: Floats, seen: Mask) -> Indices:
    """Return indices (V, LISTED) of visible points from each direction, by farthest-point sampling.

    Each point is the farthest from all before it. If fewer than LISTED are visible, they repeat.
    """
    rows, first = np.arange(len(seen)), np.argmax(seen, axis=1)
    out, gap = np.empty((len(seen), LISTED), np.int64), np.where(seen, np.inf, -1.0)
    many, squares = seen.sum(axis=1), (points**2).sum(axis=1)
    for k in range(LISTED):
        last = np.argmax(gap, axis=1) if k else first
        out[:, k] = last
        off = squares[last, None] + squares - 2 * points[last] @ points.T
        gap = np.minimum(gap, np.where(seen, off, -1.0))
        gap[rows, last] = -1.0
    again = np.arange(LISTED) % np.maximum(many, 1)[:, None]
    return np.take_along_axis(out, again, axis=1)


def _turned_here(placed: Floats, facing: Floats) -> Mask:
    """Return the mask (K, N) of points whose face (K, N, 3) is turned to the scanner."""
    # The points are those seen from a direction up to 10 degrees aside, from which a plate that is
    # seen edge on shows another face
    towards = np.einsum("kni,kni->kn", placed, facing)
    return np.asarray(towards < -GRAZING * np.linalg.norm(placed, axis=2))


def _mean(worth: Floats, here: Mask) -> Floats:
    """Return the mean (K,) of the scores (K, N) of the points that a pose shows, ``here``."""
    # Divided by a quarter of all points at least: a few would score high by chance
    count = np.maximum(here.sum(axis=1), here.shape[1] / 4)
    return np.asarray((worth * here).sum(axis=1) / count)


def _placed(
    poses: Floats, points: Floats, directions: Floats, at: Indices | None = None
) -> tuple[Floats, Floats]:
    """Return points and directions (K, N, 3) of the body moved to K poses.

    ``at`` (K, N) are the indices to use for each pose; None uses all.
    """
    turned = poses[:, :3, :3].transpose(0, 2, 1)
    if at is not None:
        points, directions = points[at], directions[at]
    return points @ turned + poses[:, None, :3, 3], directions @ turned


def _seen(shape: Shape, at: OrientedPoints, views: Floats) -> Mask:
    """Return the mask (V, N) of points that face the scanner and are not occluded by the body."""
    out = at.normals @ views.T < -GRAZING
    for view, column in zip(views, out.T, strict=True):
        lifted = at.points - 1e-3 * shape.size * view
        column &= ~np.isfinite(shape.meet(lifted, np.broadcast_to(-view, lifted.shape)).depth)
    return out.T


def _before(shape: Shape, points: Floats, views: Floats, reach: float) -> Mask:
    """Return the mask (V, N) of points with the body within ``reach`` behind them, by direction."""
    return np.array([
        shape.meet(points, np.broadcast_to(view, points.shape)).depth < reach for view in views
    ]).reshape(len(views), -1)  # fmt: skip
