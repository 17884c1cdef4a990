"""Clearance of an arm from the table, itself, and the scanner's view of the flange."""

from __future__ import annotations

import numpy as np

from flangeye.models.robots import RobotModel
from flangeye.types import Floats


class ArmVolume:
    """The capsules that bound an arm."""

    def __init__(self, robot: RobotModel) -> None:
        """Take them from the catalogue.

        Raises:
            StageError: What the arm fills is not known, so nothing can be said to be clear of it.
        """
        volumes = robot.known_volumes()
        self.links = np.array([volume.link for volume in volumes], dtype=np.intp)
        self.radii = np.array([volume.radius for volume in volumes])
        self._ends = np.array([[v.start, v.end] for v in volumes]).reshape(len(volumes), 2, 3)
        first, second = np.triu_indices(len(volumes))
        # Nearer links are joined where they meet
        far = np.abs(self.links[first] - self.links[second]) >= 3
        self._pairs = first[far], second[far]

    def axes(self, frames: Floats) -> Floats:
        """Return the capsules' axes in ``base``, (V, 2, 3), given (n + 1, 4, 4) link frames."""
        poses = frames[self.links]
        return np.asarray(
            np.einsum("vij,vkj->vki", poses[:, :3, :3], self._ends) + poses[:, None, :3, 3]
        )

    def above(self, axes: Floats, height: float) -> bool:
        """Return whether all that can move stays above a horizontal plane at this z [m]."""
        moving = self.links >= 2
        return bool((axes[moving, :, 2].min(axis=1) - self.radii[moving] > height).all())

    def apart(self, axes: Floats) -> bool:
        """Return whether no two links touch that are not neighbours."""
        first, second = self._pairs
        gaps = segment_distance(axes[first], axes[second])
        return bool((gaps > self.radii[first] + self.radii[second]).all())

    def leaves_free(self, axes: Floats, sight: Floats, width: float) -> bool:
        """Return whether nothing comes within ``width`` [m] of lines of sight (S, 2, 3)."""
        gaps = segment_distance(axes[:, None], sight[None])
        return bool((gaps > self.radii[:, None] + width).all())


def segment_distance(first: Floats, second: Floats) -> Floats:
    """Return the distance of segments, (..., 2, 3) and (..., 2, 3) -> (...).

    The closest points of the two lines are clamped to the segments in turn (Ericson 2005, 5.1.9).
    """
    start1, start2 = first[..., 0, :], second[..., 0, :]
    along1, along2 = first[..., 1, :] - start1, second[..., 1, :] - start2
    between = start1 - start2
    a, e = _dot(along1, along1), _dot(along2, along2)
    b, c, f = _dot(along1, along2), _dot(along1, between), _dot(along2, between)
    s = np.clip(_ratio(b * f - c * e, a * e - b * b), 0, 1)
    t = np.clip(_ratio(b * s + f, e), 0, 1)
    s = np.clip(_ratio(b * t - c, a), 0, 1)
    gap = between + s[..., None] * along1 - t[..., None] * along2
    return np.asarray(np.linalg.norm(gap, axis=-1))


def _dot(first: Floats, second: Floats) -> Floats:
    return np.asarray((first * second).sum(axis=-1))


def _ratio(over: Floats, under: Floats) -> Floats:
    """Divide; zero where parallel lines or points leave the quotient open."""
    return np.divide(over, under, out=np.zeros_like(over), where=under > 1e-12)
