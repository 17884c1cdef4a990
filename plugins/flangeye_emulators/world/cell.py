"""The simulated cell: an arm on a table, a wall, and a stand with a disc as a distractor."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from flangeye.models.bodies import ArmBody, TargetBody
from flangeye.models.robots import RobotModel
from flangeye.models.targets import Flange, Sphere
from flangeye.motion.clearance import ArmVolume
from flangeye.types import Floats
from flangeye.types.geometry import rigid, rotation_from_rpy
from flangeye_emulators.world.mesh import (
    COARSE,
    MATERIALS,
    Mesh,
    box,
    capsule,
    circle,
    flange_mesh,
    lathe,
    merged,
    region,
    wrist_mesh,
)
from flangeye_emulators.world.raycast import SolidBody


@lru_cache(maxsize=8)
def sphere_mesh(sphere: Sphere) -> Mesh:
    """Return the mesh of a calibration sphere."""
    segments = 360  # at a radius of 20 mm its facets are within 1 um of its surface
    latitude = np.linspace(-np.pi / 2, np.pi / 2, segments // 2 + 1)
    radius, height = sphere.radius * np.cos(latitude), sphere.radius * np.sin(latitude)
    profile = list(zip(radius.tolist(), height.tolist(), strict=True))
    return lathe(profile, segments).moved(rigid(np.eye(3), np.array(sphere.centre_in_flange)))


@lru_cache(maxsize=8)
def stub_mesh(sphere: Sphere) -> Mesh:
    """Return the mesh of the rod along z from the flange's face into the sphere."""
    x, y, z = sphere.centre_in_flange
    # Radius of the stub over that of the sphere
    return capsule(np.array([x, y, 0.0]), np.array([x, y, z]), 0.25 * sphere.radius, COARSE)


@dataclass(frozen=True, eq=False)
class SimulatedCell:
    """The simulated cell: surroundings in ``base``, and the arm.

    Attributes:
        robot: The arm.
        flange: The flange on the arm.
        centre: (3,) centre of the workspace [m].
        size: (3,) size of the workspace [m].
        sphere: Calibration sphere on the flange; None without one.
        body: Tool on the flange, in the flange's frame; None without one.
    """

    robot: RobotModel
    flange: Flange
    centre: Floats
    size: Floats
    sphere: Sphere | None = None
    body: TargetBody | None = None

    def around(self) -> list[SolidBody]:
        """Return the static bodies of the cell."""
        x, y = self.centre[:2]
        far = x + self.size[0] / 2 + 0.13
        return [
            SolidBody(box([-0.4, y - 0.9, -0.04], [far + 0.3, y + 0.9, 0.0]), MATERIALS["table"]),
            SolidBody(box([far, y - 0.9, 0.0], [far + 0.02, y + 0.9, 0.7]), MATERIALS["matt"]),
            *self._stand(),
        ]

    def arm(self, frames: Floats, base_T_flange: Floats) -> list[SolidBody]:
        """Return the bodies of the arm and its flange.

        Args:
            frames: (n + 1, 4, 4) ``base_T_link``.
            base_T_flange: (4, 4) true flange pose.
        """
        volume = ArmVolume(self.robot)
        links = [
            capsule(start, end, radius)
            for (start, end), radius in zip(volume.axes(frames), volume.radii, strict=True)
        ]
        if isinstance(self.body, ArmBody):
            own = self.body.by_link.items()
            links = [Mesh(one.vertices, one.triangles).moved(frames[k]) for k, one in own]
        return [
            *([SolidBody(merged(links), MATERIALS["painted"])] if links else []),
            *(body.moved(base_T_flange) for body in self._at_flange()),
        ]

    def _at_flange(self) -> list[SolidBody]:
        """Return the bodies fixed to the flange, in ``flange``."""
        finish = MATERIALS[self.flange.details.finish]
        plate = SolidBody(flange_mesh(self.flange), finish)
        wrist = SolidBody(wrist_mesh(self.flange), MATERIALS["painted"])
        if self.body is not None and not isinstance(self.body, ArmBody):
            tool = Mesh(self.body.vertices, self.body.triangles)
            return [plate, wrist, SolidBody(tool, MATERIALS["metal"])]
        if self.sphere is None:
            return [plate, wrist]
        ball = SolidBody(sphere_mesh(self.sphere), MATERIALS["matt"])
        return [plate, wrist, ball, SolidBody(stub_mesh(self.sphere), finish)]

    def board(self, base_T_flange: Floats) -> SolidBody:
        """Return a board that covers the flange completely."""
        half, away = 4 * self.flange.outer, 0.06
        if self.sphere is not None:
            away += self.sphere.centre_in_flange[2] + self.sphere.radius
        if self.body is not None and not isinstance(self.body, ArmBody):
            away += float(self.body.vertices[:, 2].max())
        sheet = SolidBody(box([-half, -half, away], [half, half, away + 0.003]), MATERIALS["matt"])
        return sheet.moved(base_T_flange)

    def _stand(self) -> list[SolidBody]:
        """Return a post with a ring of nearly the flange's size, as a distractor."""
        foot = self.centre + np.array([0.05, self.size[1] / 2 + 0.1, 0.0])
        top = max(float(self.centre[2] - self.size[2] / 2 - 0.03), 0.05)
        pose = np.eye(4)
        pose[:3, :3] = rotation_from_rpy(0.12, -0.1, 0.0)
        pose[:3, 3] = [foot[0], foot[1], top]
        ring = SolidBody(_ring(self.flange), MATERIALS["polished"]).moved(pose)
        low = np.array([foot[0], foot[1], 0.0])
        post = capsule(low, np.array([foot[0], foot[1], top - 0.03]), 0.015)
        return [ring, SolidBody(post, MATERIALS["rubber"])]


def _ring(flange: Flange) -> Mesh:
    larger = 1.15  # near, and not to be taken for it
    outer = larger * flange.outer
    inner = larger * (flange.bore or flange.outer / 2)
    face = region(circle(outer, COARSE), [circle(inner, COARSE)], 0.0)
    sides = [(inner, 0.0), (inner, -0.01), (outer, -0.01), (outer, 0.0)]
    return merged([face, lathe(sides, COARSE)])
