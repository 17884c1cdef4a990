"""Scans whose truth is known: a flange or a ball before a wall, seen by a pinhole camera.

No simulator: rays meet planes and spheres in closed form, so that only the plugin is tested.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from flangeye.maths.geometry import rigid, rotation_exp
from flangeye.models.targets import Flange, Sphere
from flangeye.types import (
    BASE,
    CAMERA,
    FLANGE,
    Capture,
    FlangeCloud,
    Floats,
    PointCloud,
    Transform,
    by_frame,
)

DEPTH = 0.7
"""Of the flange's centre in ``camera`` [m]."""

WALL = 1.1
"""Depth of the wall behind it [m]."""


FACING = rigid(rotation_exp(np.array([np.pi - 0.25, 0.15, 0.3])), np.array([0.01, -0.02, DEPTH]))
"""``camera_T_flange``: towards the camera, tilted."""


@dataclass(frozen=True)
class Change:
    """Something done to a whole scene: x' = scale * matrix @ x + shift.

    Attributes:
        matrix: (3, 3) rotation or reflection.
        shift: (3,) [m].
        scale: Factor of every length.
    """

    matrix: Floats = field(default_factory=lambda: np.eye(3))
    shift: Floats = field(default_factory=lambda: np.zeros(3))
    scale: float = 1.0

    def point(self, xyz: Floats) -> Floats:
        """Return (..., 3) points after the change."""
        return np.asarray(self.scale * (xyz @ self.matrix.T) + self.shift)

    def direction(self, xyz: Floats) -> Floats:
        """Return (..., 3) directions after the change."""
        return np.asarray(xyz @ self.matrix.T)


SAME = Change()
MOVED = Change(rotation_exp(np.array([0.02, -0.03, 0.6])), np.array([0.03, 0.02, 0.05]))
SCALED = Change(scale=1.25)
MIRRORED = Change(np.diag([-1.0, 1.0, 1.0]))


@dataclass(frozen=True, eq=False)
class Scene:
    """A scan and what is true of it, in ``camera``.

    Attributes:
        xyz: (H, W, 3) organised points [m], NaN where there is none.
        centre: (3,) of the flange's face, or of the ball [m].
        normal: (3,) of the face, towards the camera.
        radius: Radius of the rim, or of the ball [m].
    """

    xyz: Floats
    centre: Floats
    normal: Floats
    radius: float

    def changed(self, change: Change) -> Scene:
        """Return the scene after something was done to all of it."""
        return Scene(
            change.point(self.xyz),
            change.point(self.centre),
            change.direction(self.normal),
            change.scale * self.radius,
        )

    def capture(self) -> Capture:
        """Return the whole scan, as a scanner gives it."""
        cloud = PointCloud(CAMERA, self.xyz.astype(np.float32))
        return Capture("0", cloud, by_frame(Transform(BASE, FLANGE, np.eye(4))))

    def flange_cloud(self) -> FlangeCloud:
        """Return what a segment stage cuts out: the points near the feature, with a rough start."""
        points = self.xyz.reshape(-1, 3)
        points = points[np.isfinite(points).all(axis=1)]
        near = np.linalg.norm(points - self.centre, axis=1) < 1.15 * self.radius
        rough = self.centre + 0.01 * self.radius * np.array([1.0, -0.5, 0.3])
        return FlangeCloud(PointCloud(CAMERA, points[near].astype(np.float32)), rough, self.normal)


def flange_scene(flange: Flange) -> Scene:
    """Return a flange's face with its holes, on a wrist of its rim's size, before a wall."""
    rays = _rays()
    centre, normal = FACING[:3, 3], FACING[:3, 2]
    xyz = rays * (centre @ normal / (rays @ normal))[..., None]
    local = (xyz - centre) @ FACING[:3, :3]
    wall = rays * WALL
    return Scene(
        np.where(_on_face(flange, local)[..., None], xyz, wall), centre, normal, flange.rim
    )


def sphere_scene(sphere: Sphere) -> Scene:
    """Return a ball before a wall."""
    rays = _rays()
    centre = FACING[:3, 3]
    along, square = rays @ centre, (rays**2).sum(axis=-1)
    inside = along**2 - square * (centre @ centre - sphere.radius**2)
    near = (along - np.sqrt(np.maximum(inside, 0.0))) / square
    depth = np.where(inside > 0, near, WALL)
    towards = -centre / np.linalg.norm(centre)
    return Scene(rays * depth[..., None], centre, towards, sphere.radius)


def _rays() -> Floats:
    """Return (H, W, 3) directions with z = 1."""
    # Distance of neighbouring points on the flange [m]
    half = 160  # rows and columns on either side of the middle
    steps = np.arange(-half, half + 1) * 0.5e-3 / DEPTH
    x, y = np.meshgrid(steps, steps)
    return np.stack([x, y, np.ones_like(x)], axis=-1)


def _on_face(flange: Flange, local: Floats) -> NDArray[np.bool_]:
    x, y = local[..., 0], local[..., 1]
    radius = np.hypot(x, y)
    face = (radius <= flange.rim) & (radius >= (flange.bore or 0.0))
    holes = [(angle, flange.hole) for angle in flange.holes]
    if flange.pin is not None:
        holes.append((flange.pin, flange.pin_hole))
    for angle, size in holes:
        at = flange.pitch * np.array([np.cos(angle), np.sin(angle)])
        face &= np.hypot(x - at[0], y - at[1]) > size
    return np.asarray(face)


def scaled_flange(flange: Flange, scale: float) -> Flange:
    """Return a flange with every length scaled."""
    lengths = ("rim", "outer", "bore", "pitch", "hole", "pin_hole")
    values = {name: getattr(flange, name) for name in lengths}
    return flange.model_copy(update={n: v and scale * v for n, v in values.items()})


def scaled_sphere(sphere: Sphere, scale: float) -> Sphere:
    """Return a sphere with every length scaled."""
    x, y, z = (scale * v for v in sphere.centre_in_flange)
    return Sphere(size=scale * sphere.radius, centre_in_flange=(x, y, z))
