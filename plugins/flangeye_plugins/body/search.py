"""Where a body is in a scan: guesses, settled and held against all that the scanner saw."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from flangeye.types import Floats, Indices, Singles
from flangeye_plugins.body.dense import fitted
from flangeye_plugins.body.guesses import guesses
from flangeye_plugins.body.judge import BodyVerdict, judged
from flangeye_plugins.body.looks import Looks
from flangeye_plugins.body.shape import Shape
from flangeye_plugins.body.view import CoarseImage, view_of

FINE_ACROSS = 100
"""Cells across the body in the view that it is judged in: fine ones show thin parts."""

FINE = 0.003
"""How far off a cell of the view may be after the body is laid on the scan, as a share of the
size."""


class FoundPose(NamedTuple):
    """A pose that a body may have.

    Attributes:
        pose: (4, 4) ``camera_T_body``.
        verdict: What speaks for it and against.
        weakest: Standard deviation of what the scan shows least of it, in sizes or radians.
    """

    pose: Floats
    verdict: BodyVerdict
    weakest: float


@dataclass(frozen=True, eq=False)
class BodySearch:
    """One scan that is searched for one body.

    Attributes:
        points: (N, 3) of the scan, N at least ``FEWEST``, all before the scanner [m].
        looks: The body, and what of it is seen from where.
    """

    points: Singles
    looks: Looks

    @property
    def shape(self) -> Shape:
        """The body."""
        return self.looks.shape

    def everywhere(self) -> list[FoundPose]:
        """Return distinct poses that the body may have, the best first."""
        # Coarse cells have less noise
        view = view_of(self.points, self.shape.size / 60)
        poses = guesses(view, self.looks, 1500)
        # Points of the body that settle them, how far from the body the scan is taken for
        # it, move by move, and how far off it may be where it is judged, as shares of the
        # size, and how many are kept
        for count, reaches, tolerance, left in (
            (40, (0.08, 0.06, 0.05), 0.03, 300),
            (160, (0.04, 0.03, 0.02), 0.02, 80),
        ):
            for reach in reaches:
                poses = self.looks.settled(poses, view, count, reach * self.shape.size)
            scores = self.looks.scores(poses, view, count, tolerance)
            poses = poses[distinct(poses, scores, self.looks)[:left]]
        found = self.near(poses)
        return self._distinct(found + self.near(self._twins(found[0]))) if found else []

    def near(self, poses: Floats) -> list[FoundPose]:
        """Return the best of (K, 4, 4) poses, laid on the scan's own points, the best first."""
        if not len(poses):
            return []
        scores = [judged(self.shape, self._fine, pose, self._rough).score for pose in poses]
        # Laid on the scan's own points
        poses = poses[distinct(poses, np.array(scores), self.looks)[:8]]
        return self._distinct([one for one in map(self._laid, poses) if one])

    @cached_property
    def _fine(self) -> CoarseImage:
        return view_of(self.points, self.shape.size / FINE_ACROSS)

    @cached_property
    def _rough(self) -> float:
        return self.looks.tolerance(self._fine)

    def _laid(self, pose: Floats) -> FoundPose | None:
        fit = fitted(around(self.points, self.shape, pose), self.shape, pose, 2000)
        if fit is None:
            return None
        tolerance = max(FINE * self.shape.size, 3.5 * self._fine.noise)
        verdict = judged(self.shape, self._fine, fit.pose, tolerance)
        return FoundPose(fit.pose, verdict, fit.weakest(self.looks.freedoms))

    def _twins(self, best: FoundPose) -> Floats:
        """Return quarter turns of a pose that explain the scan nearly as well."""
        # Share of the rays that a turned pose explains as well, to be laid on the scan too
        twins, least = self.looks.twins(best.pose), 0.4 * best.verdict.agree
        agree = [judged(self.shape, self._fine, pose, self._rough).agree for pose in twins]
        return np.asarray(twins[np.array(agree) > least])

    def _distinct(self, found: list[FoundPose]) -> list[FoundPose]:
        poses = np.array([one.pose for one in found]).reshape(-1, 4, 4)
        scores = np.array([one.verdict.score for one in found])
        return [found[k] for k in distinct(poses, scores, self.looks)]


def around(points: Singles, shape: Shape, pose: Floats) -> Singles:
    """Return the points of (N, 3) around a body at a pose."""
    offset = points - (pose[:3, :3] @ shape.centre + pose[:3, 3]).astype(np.float32)
    # As a share of the size: half reaches the body's ends
    return np.asarray(points[np.einsum("ni,ni->n", offset, offset) < (0.55 * shape.size) ** 2])


def distinct(poses: Floats, scores: Floats, looks: Looks) -> Indices:
    """Return the indices of poses of which none is nearly another, the best first."""
    order = np.argsort(-scores, kind="stable")
    centres = poses[order, :3, :3] @ looks.centre + poses[order, :3, 3]
    # One pose, where they differ by less in place, as a share of the size, and in turn
    near = np.linalg.norm(centres[:, None] - centres, axis=2) < 0.06 * looks.size
    trace = np.einsum("aij,bij->ab", poses[order, :3, :3], poses[order, :3, :3])
    near &= trace > 1 + 2 * np.cos(float(np.radians(12.0)))
    free = np.ones(len(order), bool)
    for k in range(len(order)):
        if free[k]:
            free[k + 1 :] &= ~near[k, k + 1 :]
    return order[free]
