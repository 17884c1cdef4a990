"""Which flange poses a cell allows: in view, in reach, and with the arm out of the way."""

from __future__ import annotations

from collections import Counter

import numpy as np
from numpy.typing import NDArray

from flangeye.catalogue import RobotModel, ScannerModel
from flangeye.geometry import rotation_from_rpy
from flangeye.kinematics import Arm
from flangeye_plugins.simulation.clearance import ArmVolume

Floats = NDArray[np.float64]

MARGIN = 0.95
"""Share of the field of view, to either side, that a planned flange keeps to."""

CLOCKINGS = 8
"""How many directions of the flange's x axis are tried for the one the arm likes best."""

TABLE = 0.0
"""Height of the table the arm stands on, in ``base`` [m]."""


class Reach:
    """What an arm can show a scanner.

    Attributes:
        arm: Its kinematics.
        refused: Why poses were impossible, and how often.
    """

    def __init__(
        self, robot: RobotModel, scanner: ScannerModel, base_T_camera: Floats, radius: float
    ) -> None:
        """Set up.

        Args:
            robot: The arm.
            scanner: What looks at it.
            base_T_camera: (4, 4) where that stands.
            radius: Of the disc that has to be in view [m].
        """
        self.arm = Arm(robot)
        self._volume = ArmVolume(robot)
        self._scanner, self._radius = scanner, radius
        self._base_T_camera = base_T_camera
        lean = scanner.convergence
        projector = scanner.baseline * np.array([np.cos(lean), 0.0, np.sin(lean)])
        self._eyes = np.stack([np.zeros(3), projector]) @ base_T_camera[:3, :3].T
        self._eyes += base_T_camera[:3, 3]
        self._home: Floats | None = None
        self.refused: Counter[str] = Counter()

    def facing(self, centre: Floats) -> Floats | None:
        """Return the rotation (3, 3) of a flange at ``centre`` that faces along the view.

        Its z is against the camera's; about z the flange turns to where the arm moves best. The
        joints of that pose become the home that later poses stay near to.
        """
        best = 0.0
        found = None
        for step in range(CLOCKINGS):
            turn = rotation_from_rpy(np.pi, 0.0, 2 * np.pi * step / CLOCKINGS)
            pose = np.eye(4)
            pose[:3, :3], pose[:3, 3] = self._base_T_camera[:3, :3] @ turn, centre
            for joints in self._possible(pose):
                score = float(self.arm.manipulability(joints))
                if score > best * (1 + 1e-9):
                    best, found, self._home = score, pose[:3, :3], joints
        return found

    def joints(self, base_T_flange: Floats) -> Floats | None:
        """Return joint angles for a pose (4, 4), those nearest to home, or None if there are none.

        None means: out of view or range, out of reach or limits, touching the table or itself, or
        with a link between scanner and flange.
        """
        if not self.in_view(base_T_flange):
            self.refused["out of the scanner's view"] += 1
            return None
        possible = self._possible(base_T_flange)
        if not possible:
            return None
        home = self._home if self._home is not None else np.zeros(self.arm.n)
        return min(possible, key=lambda joints: float(np.abs(joints - home).max().round(6)))

    def in_view(self, base_T_flange: Floats) -> bool:
        """Return whether camera and projector see the whole disc, within the scanner's range."""
        angle = 2 * np.pi * np.arange(16) / 16
        rim = self._radius * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
        in_base = rim @ base_T_flange[:3, :3].T + base_T_flange[:3, 3]
        in_camera = (in_base - self._base_T_camera[:3, 3]) @ self._base_T_camera[:3, :3]
        scanner, depth = self._scanner, in_camera[:, 2]
        if not ((depth >= scanner.near) & (depth <= scanner.far)).all():
            return False
        turn = rotation_from_rpy(0.0, -2 * scanner.convergence, 0.0)
        from_projector = (in_base - self._eyes[1]) @ self._base_T_camera[:3, :3] @ turn
        lit = scanner.projection is None or _within(from_projector, scanner.projection)
        return lit and _within(in_camera, scanner.field_of_view)

    def _possible(self, base_T_flange: Floats) -> list[Floats]:
        reachable = self.arm.inverse(base_T_flange)
        possible = [joints for joints in reachable if self._clear(joints)]
        if not possible:
            why = "with the arm in the way" if len(reachable) else "out of the arm's reach"
            self.refused[why] += 1
        return possible

    def _clear(self, joints: Floats) -> bool:
        frames, volume = self.arm.frames(joints), self._volume
        axes = volume.axes(frames)
        target = self.arm.flange(joints)[:3, 3]
        sight = np.stack([self._eyes, np.broadcast_to(target, self._eyes.shape)], axis=1)
        return (
            volume.above(axes, TABLE)
            and volume.apart(axes)
            and volume.leaves_free(axes, sight, self._radius)
        )


def _within(points: Floats, field: tuple[float, float]) -> bool:
    """Return whether (N, 3) points before a pinhole lie in its field of view, with a margin."""
    half = np.tan(np.asarray(field) / 2) * MARGIN
    return bool((points[:, 2] > 0).all() and (np.abs(points[:, :2] / points[:, 2:]) <= half).all())
