"""``segment`` and ``fit`` stages: one scan in, one feature out.

The tests' scans show a flange or a ball before a wall, through a pinhole camera, with known truth.
They are computed in closed form without a simulator, so that only the plugin is tested.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray

from flangeye.models.targets import Flange, Sphere
from flangeye.testing.base import (
    Conformance,
    require,
    require_close,
    require_covariance,
    require_refusal,
    require_repeats,
    require_round_trip,
    require_type,
)
from flangeye.types import (
    BASE,
    CAMERA,
    FLANGE,
    Capture,
    CircleFeature,
    FlangeCloud,
    Floats,
    PointCloud,
    PoseFeature,
    Rejected,
    Transform,
    by_frame,
)
from flangeye.types.geometry import rigid, rotation_exp

DEPTH = 0.7
"""Position of the flange's centre in ``camera`` [m]."""

WALL = 1.1
"""Depth of the wall behind it [m]."""


FLANGE_POSE = rigid(
    rotation_exp(np.array([np.pi - 0.25, 0.15, 0.3])), np.array([0.01, -0.02, DEPTH])
)
"""``camera_T_flange``: towards the camera, tilted."""


@dataclass(frozen=True)
class Change:
    """A similarity transform of a whole scene: x' = scale * matrix @ x + shift.

    Attributes:
        matrix: (3, 3) rotation or reflection.
        shift: (3,) shift after rotation and scaling [m].
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


UNCHANGED = Change()
MOVED = Change(rotation_exp(np.array([0.02, -0.03, 0.6])), np.array([0.03, 0.02, 0.05]))


@dataclass(frozen=True, eq=False)
class Scene:
    """A scan and its truth, in ``camera``.

    Attributes:
        xyz: (H, W, 3) organised points [m]; missing ones are NaN.
        centre: (3,) centre of the flange's face, or of the ball [m].
        normal: (3,) normal of the face, towards the camera.
        radius: Radius of the rim, or of the ball [m].
    """

    xyz: Floats
    centre: Floats
    normal: Floats
    radius: float

    def changed(self, change: Change) -> Scene:
        """Return the scene with the change applied to its points, centre, normal and radius."""
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
        """Return the output of a segment stage: points near the feature, with a rough centre."""
        points = self.xyz.reshape(-1, 3)
        points = points[np.isfinite(points).all(axis=1)]
        near = np.linalg.norm(points - self.centre, axis=1) < 1.15 * self.radius
        rough = self.centre + 0.01 * self.radius * np.array([1.0, -0.5, 0.3])
        return FlangeCloud(PointCloud(CAMERA, points[near].astype(np.float32)), rough, self.normal)


def flange_scene(flange: Flange) -> Scene:
    """Return a flange's face with its holes, on a wrist of its rim's size, before a wall."""
    rays = _rays()
    centre, normal = FLANGE_POSE[:3, 3], FLANGE_POSE[:3, 2]
    xyz = rays * (centre @ normal / (rays @ normal))[..., None]
    local = (xyz - centre) @ FLANGE_POSE[:3, :3]
    wall = rays * WALL
    return Scene(
        np.where(_on_face(flange, local)[..., None], xyz, wall), centre, normal, flange.rim
    )


def sphere_scene(sphere: Sphere) -> Scene:
    """Return a ball before a wall."""
    rays = _rays()
    centre = FLANGE_POSE[:3, 3]
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


BALL = Sphere(size=0.03, centre_in_flange=(0.0, 0.0, 0.1))


class PerCaptureConformance(Conformance):
    """Base of the conformance classes of segment and fit stages.

    Attributes:
        feature: The stage's target: the flange, or a ball on it.
        tolerance: Largest error of the centre on scans without noise [m].
    """

    feature: ClassVar[Literal["flange", "sphere"]] = "flange"
    tolerance: ClassVar[float] = 0.1e-3

    def scene(self) -> Scene:
        """Return the scan that all checks start from."""
        return sphere_scene(BALL) if self.feature == "sphere" else flange_scene(self.flange)

    def given(self, scene: Scene) -> dict[Any, Any]:
        """Return the stage's input."""
        raise NotImplementedError

    def answer(self, change: Change = UNCHANGED) -> tuple[Any, Scene]:
        """Return the stage's output on the changed scene, and the scene."""
        scene = self.scene().changed(change)
        known: Mapping[Any, Any] = {
            Flange: scaled_flange(self.flange, change.scale),
            Sphere: scaled_sphere(BALL, change.scale),
        }
        return self.call({**known, **self.given(scene)}), scene

    def _require_centre(self, change: Change, what: str) -> None:
        value, scene = self.answer(change)
        require(
            not isinstance(value, Rejected),
            f"{what}: set aside: {value.reason if isinstance(value, Rejected) else ''}",
        )
        within = self.tolerance * change.scale
        require_close(value.centre, scene.centre, within, f"{what}: the centre [m]")
        if value.normal is not None:
            towards = np.asarray(value.normal) @ -np.asarray(value.centre)
            require(towards > 0, f"{what}: the normal points away from the scanner")

    def test_it_gives_the_same_twice(self) -> None:
        """Two calls with equal input and seed give equal output, to the last bit."""
        require_repeats(lambda: self.answer()[0])

    def test_it_is_right_in_metres_and_in_the_cameras_frame(self) -> None:
        """The centre found in a scan without noise is within tolerance."""
        self._require_centre(UNCHANGED, "a plain scan")

    def test_it_moves_with_the_scene(self) -> None:
        """If the scene is rotated and shifted, the answer moves with it."""
        self._require_centre(MOVED, "a scan that was moved")

    def test_it_scales_with_the_scene(self) -> None:
        """A flange that is a quarter larger and farther away gives a centre scaled likewise."""
        self._require_centre(Change(scale=1.25), "a scan that was scaled")

    def test_it_follows_a_mirror(self) -> None:
        """A mirrored scan gives a mirrored answer."""
        mirror = Change(np.diag([-1.0, 1.0, 1.0]))
        self._require_centre(mirror, "a scan that was mirrored")

    def test_its_answer_survives_the_log(self) -> None:
        """The answer is unchanged after it is written to MCAP and read back."""
        require_round_trip(self.answer()[0])


class SegmentConformance(PerCaptureConformance):
    """A ``segment`` stage: takes a Capture, returns a FlangeCloud or Rejected."""

    kind = "segment"
    tolerance = 5e-3

    def given(self, scene: Scene) -> dict[Any, Any]:
        """Return the whole scan."""
        return {Capture: scene.capture()}

    def test_its_cloud_is_cut_from_the_scan(self) -> None:
        """Every point of the segmented cloud is a finite point of the scan, near the feature."""
        value, scene = self.answer()
        cloud = require_type(value, FlangeCloud).cloud
        require(cloud.frame == CAMERA, f"the cloud is in '{cloud.frame}', not in '{CAMERA}'")
        require(
            cloud.xyz.ndim == 2 and np.isfinite(cloud.xyz).all(), "the cloud is (N, 3), all finite"
        )
        scan = {point.tobytes() for point in scene.capture().cloud.points()}
        foreign = sum(point.tobytes() not in scan for point in cloud.xyz)
        require(foreign == 0, f"{foreign} of {len(cloud.xyz)} points are not the scan's")
        far = np.linalg.norm(cloud.xyz - scene.centre, axis=1).max()
        require(far < 3 * scene.radius, f"the cloud reaches {far:.3f} m from the centre")

    def test_nothing_to_see_is_refused(self) -> None:
        """A scan without points and a bare wall are refused."""
        scene = self.scene()
        for what, xyz in (
            ("a scan of nothing", np.full_like(scene.xyz, np.nan)),
            ("a scan of a bare wall", scene.xyz / scene.xyz[..., 2:]),
        ):
            capture = Scene(xyz, scene.centre, scene.normal, scene.radius).capture()
            given = {Sphere: BALL, Capture: capture}
            require_refusal(lambda given=given: self.call(given), Rejected, what)  # type: ignore[misc]


class FitConformance(PerCaptureConformance):
    """A ``fit`` stage for a FlangeCloud; a stage for markers overrides :meth:`given`."""

    kind = "fit"

    def given(self, scene: Scene) -> dict[Any, Any]:
        """Return the segmented points."""
        return {FlangeCloud: scene.flange_cloud(), Capture: scene.capture()}

    def test_its_covariances_are_covariances(self) -> None:
        """Covariances are symmetric, not zero, and have no negative variance."""
        value, _ = self.answer()
        require(
            isinstance(value, (CircleFeature, PoseFeature)),
            f"gave {type(value).__name__}, not a feature",
        )
        require_covariance(value.centre_covariance, "the centre's covariance")
        require(np.trace(value.centre_covariance) > 0, "no centre is known exactly")
        if isinstance(value, CircleFeature) and value.normal_covariance is not None:
            require_covariance(value.normal_covariance, "the normal's covariance")

    def test_its_radius_is_the_scenes(self) -> None:
        """Radii are radii, not diameters, in metres."""
        value, scene = self.answer()
        radii = dict(value.radii) if isinstance(value, CircleFeature) else {}
        for name in ("rim", "sphere"):
            if name in radii:
                require_close(
                    radii[name], scene.radius, 0.05 * scene.radius, f"radius '{name}' [m]"
                )

    def test_too_little_is_refused(self) -> None:
        """Two points, points on a line and one repeated point are refused."""
        scene = self.scene()
        line = scene.centre + np.linspace(-1, 1, 200)[:, None] * [scene.radius, 0.0, 0.0]
        for what, points in (
            ("two points", line[:2]),
            ("points on a line", line),
            ("one point 200 times", np.repeat(line[:1], 200, axis=0)),
        ):
            cloud = PointCloud(CAMERA, points.astype(np.float32))
            little = FlangeCloud(cloud, scene.centre, scene.normal)
            given = {Sphere: BALL, FlangeCloud: little}
            require_refusal(lambda given=given: self.call(given), Rejected, what)  # type: ignore[misc]
