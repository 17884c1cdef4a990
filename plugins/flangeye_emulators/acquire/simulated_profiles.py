"""``acquire.simulated_profiles``: profiles of a sphere by a line scanner on the flange."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from flangeye.models.configuration import Configuration
from flangeye.models.robots import RobotModel
from flangeye.models.targets import Sphere
from flangeye.plugin.stage import stage
from flangeye.types import CAMERA, Capture, Captures, Floats, PointCloud, Seed
from flangeye_emulators.acquire.moments import MOST_OBLIQUE, VERSION, CameraView
from flangeye_emulators.acquire.planned_session import SessionParams, plan_session, source_of

FAN = float(np.radians(28.0))
"""Full angle of the laser's fan [rad]."""


class ProfilesParams(SessionParams):
    """Parameters of ``acquire.simulated_profiles``."""

    # Nearest that the scanner sees [m]
    near: ClassVar[float] = 0.19
    # Farthest that the scanner sees [m]
    far: ClassVar[float] = 0.29
    # Number of points in a profile
    points: ClassVar[int] = 1280
    # Standard deviation of a point along its ray [m]
    noise: ClassVar[float] = 0.03e-3
    # Height of the sphere's centre above the table [m]
    table: ClassVar[float] = 0.04


@dataclass(frozen=True)
class ProfileView(CameraView):
    """The view of a line scanner: poses at which the laser meets the sphere beside its centre."""

    radius: float = 0.0

    def first(self) -> Floats:
        """Return ``camera_T_target`` (4, 4) at the first pose, the laser 0.7 radii off centre."""
        pose = super().first()
        pose[1, 3] = 0.7 * self.radius
        return pose

    def sees(self, poses: Floats) -> NDArray[np.bool_]:
        """Return the mask (N,) of poses at which the laser cuts a large enough circle."""
        x, y, z = poses[:, :3, 3].T
        across = np.abs(x) + self.radius < np.tan(self.field[0] / 2) * z
        # How far beside the sphere's centre the laser passes
        beside = (y > 0.5 * self.radius) & (y < 0.95 * self.radius)
        return np.asarray(across & beside & (z > self.near + self.radius) & (z < self.far))


@stage("acquire.simulated_profiles")
def acquire_simulated_profiles(
    robot: RobotModel,
    configuration: Configuration,
    sphere: Sphere,
    seed: Seed,
    params: ProfilesParams,
) -> Captures:
    """Take profiles of a sphere by a line scanner, with the centre on the +y side of its plane.

    Raises:
        StageError: The laser cuts the sphere at too few poses.
    """
    rng = np.random.default_rng([VERSION, seed])
    seen = (params.near + params.far) / 2, params.near, params.far, (FAN, 0.0), MOST_OBLIQUE
    # Joint vectors tried: a laser passes a small sphere at few of them
    view = ProfileView(*seen, 60_000, sphere.radius)
    moments = plan_session(robot, None, configuration, (params, view), rng)
    up = moments.each(CAMERA)[:, :3, :3]

    def captures() -> Iterator[Capture]:
        for i, target in enumerate(moments.seen()):
            table = up[i].T @ np.array([0.0, 0.0, 1.0])
            xyz = profile_of(target[:3, 3], sphere.radius, table, params, rng)
            yield Capture(f"{i:04d}", PointCloud(CAMERA, xyz), **moments.recorded(i))

    source = source_of(moments, (robot, configuration), seed, params)
    return Captures(captures(), source, params.poses)


def profile_of(
    centre: Floats, radius: float, up: Floats, params: ProfilesParams, rng: np.random.Generator
) -> NDArray[np.float32]:
    """Return the (N, 3) points of a profile of a sphere over a table, y = 0 [m].

    Args:
        centre: (3,) centre of the sphere in ``camera`` [m].
        radius: Radius of the sphere [m].
        up: (3,) normal of the table, in ``camera``.
        params: Parameters of the scanner.
        rng: Random generator of the noise.
    """
    x = np.linspace(-1, 1, params.points) * np.tan(FAN / 2)
    rays = np.stack([x, np.zeros_like(x), np.ones_like(x)], axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        table = ((centre - params.table * up) @ up) / (rays @ up)
    depth = np.fmin(_sphere_depth(rays, centre, radius), np.where(table > 0, table, np.nan))
    points = rays * depth[:, None]
    # The receiver stands beside the laser's plane; the sphere hides from it what is behind.
    eye = np.array([0.0, -90e-3, 0.0])
    seen = (depth > params.near) & (depth < params.far) & ~_hidden(points, eye, centre, radius)
    noisy = points + rays * (params.noise * rng.standard_normal(len(x)))[:, None]
    return noisy[seen].astype(np.float32)


def _sphere_depth(rays: Floats, centre: Floats, radius: float) -> Floats:
    """Return the first intersection of rays (N, 3) from the origin with a sphere; NaN without."""
    a, b = (rays**2).sum(axis=1), rays @ centre
    inside = b**2 - a * (centre @ centre - radius**2)
    return np.asarray((b - np.sqrt(np.where(inside > 0, inside, np.nan))) / a)


def _hidden(points: Floats, eye: Floats, centre: Floats, radius: float) -> NDArray[np.bool_]:
    """Return the mask of points (N, 3) hidden from ``eye`` by the sphere, its far side included."""
    rays = points - eye
    with np.errstate(invalid="ignore"):
        first = _sphere_depth(rays, centre - eye, radius)
        return np.asarray(first < 1 - 1e-6)
