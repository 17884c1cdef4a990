"""Clearance of an arm from the table, itself, and the scanner's view of its target."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from flangeye.maths.kinematics import Arm
from flangeye.models.bodies import ArmBody, TargetBody
from flangeye.models.robots import RobotModel
from flangeye.types import Floats, Indices, Mask
from flangeye.types.geometry import each_applied, invert


class ArmVolume:
    """The capsules that bound an arm."""

    def __init__(self, robot: RobotModel) -> None:
        """Take the capsules from the arm's model.

        Raises:
            StageError: The space that the arm fills is not known, so no clearance can be checked.
        """
        volumes = robot.known_volumes()
        self.links = np.array([volume.link for volume in volumes], dtype=np.intp)
        self.radii = np.array([volume.radius for volume in volumes])
        self._ends = np.array([[v.start, v.end] for v in volumes]).reshape(len(volumes), 2, 3)
        first, second = np.triu_indices(len(volumes))
        # Nearer links are joined where they meet
        far = np.abs(self.links[first] - self.links[second]) >= 3
        self._pairs = first[far], second[far]
        # The last link carries the flange and lies behind its face
        self._before = self.links < len(robot.joints)

    def axes(self, frames: Floats) -> Floats:
        """Return the capsules' axes in ``base``, (V, 2, 3), given (n + 1, 4, 4) link frames."""
        poses = frames[self.links]
        return np.asarray(
            np.einsum("vij,vkj->vki", poses[:, :3, :3], self._ends) + poses[:, None, :3, 3]
        )

    def above(self, axes: Floats, height: float) -> bool:
        """Return whether all that can move stays above a horizontal plane at this z [m]."""
        # The base and the first link stand on the table
        moving = self.links >= 2
        return bool((axes[moving, :, 2].min(axis=1) - self.radii[moving] > height).all())

    def apart(self, axes: Floats) -> bool:
        """Return whether no two links touch that are not neighbours."""
        first, second = self._pairs
        gaps = segment_distance(axes[first], axes[second])
        return bool((gaps > self.radii[first] + self.radii[second]).all())

    def away(self, axes: Floats, segment: Floats, room: float) -> bool:
        """Return whether the arm keeps ``room`` [m] from a segment (2, 3)."""
        # A capsule is all within its radius of its axis, so axes and radii suffice
        return bool((segment_distance(axes, segment) > self.radii + room).all())

    def hides(self, axes: Floats, sight: Floats) -> Mask:
        """Return the mask (S,) of lines of sight (S, 2, 3) that a link before the last crosses."""
        before = self._before
        gaps = segment_distance(axes[before, None], sight[None])
        return np.asarray((gaps < self.radii[before, None]).any(axis=0))

    def leaves_free(self, axes: Floats, sight: Floats, width: float) -> bool:
        """Return whether no link comes within ``width`` [m] of lines of sight (S, 2, 3).

        The link that the flange is the end of lies behind its face and does not count.
        """
        before = self._before
        gaps = segment_distance(axes[before, None], sight[None])
        return bool((gaps > self.radii[before, None] + width).all())


class BodyView:
    """Visibility of a body on an arm, or of the arm itself, at given joint angles.

    Attributes:
        is_arm: Whether it is the arm itself.
    """

    def __init__(self, body: TargetBody, arm: Arm) -> None:
        """Spread points over the body's surface, and prepare the occluding parts."""
        import open3d as o3d
        import trimesh

        self.is_arm, self._arm = isinstance(body, ArmBody), arm
        parts = body.by_link if isinstance(body, ArmBody) else {arm.n + 1: body}
        # Points on the whole surface: their share in view is known to a fiftieth
        number = 600
        whole = trimesh.Trimesh(body.vertices, body.triangles, process=False)
        self._points, facets = trimesh.sample.sample_surface(whole, number, seed=0)
        self._normals = whole.face_normals[facets]
        of_vertex = (
            body.links if isinstance(body, ArmBody) else np.full(len(whole.vertices), arm.n + 1)
        )
        self._frame: Indices = of_vertex[body.triangles[facets, 0]]
        self._scenes = dict[int, Any]()
        for frame, part in parts.items():
            self._scenes[frame] = scene = o3d.t.geometry.RaycastingScene(nthreads=1)
            scene.add_triangles(
                o3d.core.Tensor.from_numpy(np.ascontiguousarray(part.vertices, np.float32)),
                o3d.core.Tensor.from_numpy(np.ascontiguousarray(part.triangles, np.uint32)),
            )

    def placed(self, joints: Floats) -> PlacedBody:
        """Return the body where joint angles (n,) [rad] put it."""
        frames = self._arm.frames(joints)
        frames = np.concatenate([frames, self._arm.flange_of(frames)[None]])
        own = frames[self._frame]
        turned = (own[:, :3, :3] @ self._normals[:, :, None])[..., 0]
        return PlacedBody(each_applied(own, self._points), turned, self._scenes, frames)


class PlacedBody(NamedTuple):
    """Points (N, 3) on a body's surface and normals (N, 3) in ``base`` [m], and its parts."""

    points: Floats
    normals: Floats
    scenes: dict[int, Any]
    frames: Floats

    def faces(self, eye: Floats) -> Floats:
        """Return (N,) the solid angle of each point's surface from an eye (3,); 0 where hidden."""
        import open3d as o3d

        rays = self.points - eye
        hidden = np.zeros(len(rays), dtype=bool)
        for number, scene in self.scenes.items():
            inverse = invert(self.frames[number])
            start = np.broadcast_to(each_applied(inverse[None], eye[None]), rays.shape)
            lines = np.hstack([start, rays @ inverse[:3, :3].T]).astype(np.float32)
            # A ray's direction is not normalised: t_hit = 1 is the point itself
            met = scene.cast_rays(o3d.core.Tensor.from_numpy(lines), nthreads=1)["t_hit"].numpy()
            # A point's own surface is met at one, as exactly as single precision has it
            hidden |= met < 1 - 1e-3
        # Points stand for equal areas: the cosine of incidence over the squared distance
        away = np.linalg.norm(rays, axis=1)
        return np.where(hidden, 0.0, np.abs(np.einsum("ni,ni->n", self.normals, rays)) / away**3)


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
