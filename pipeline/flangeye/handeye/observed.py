"""What was observed of one camera and one target, and who carries them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from flangeye.handeye.arm import MovedFlange
from flangeye.handeye.nuisance import Nuisance
from flangeye.maths.geometry import rigid, rotation_log
from flangeye.maths.kinematics import Arm
from flangeye.maths.streams import PASSED_STEP, later, pose_at
from flangeye.models.configuration import Configuration
from flangeye.models.robots import RobotModel
from flangeye.models.scanners import ScannerModel
from flangeye.types import BASE, FLANGE, Motion, Observation, PoseFeature


@dataclass(frozen=True, eq=False)
class Cell:
    """What was observed, and where.

    Attributes:
        observations: N of them.
        configuration: Who carries what.
        robot: The arm's model, where it is known.
        scanner: The scanner's, where it is known.
        delay: Time by which the flange's poses were found to be too early, and are so no more [s];
            what is left of it is unknown. None where the clocks are taken to agree.
        clock_deviation: Standard deviation of that time where it is taken to be none [s].
    """

    observations: Sequence[Observation]
    configuration: Configuration
    robot: RobotModel | None
    scanner: ScannerModel | None = None
    delay: float | None = None
    clock_deviation: float = 0.0

    @cached_property
    def arm(self) -> Arm | None:
        """The arm's kinematics."""
        return Arm(self.robot) if self.robot else None

    @cached_property
    def flange(self) -> MovedFlange | None:
        """The arm whose flange carries camera or target; None where a link does, or nothing."""
        carried = self.configuration.camera, self.configuration.target
        if FLANGE not in carried:
            return None
        arm = self.arm
        known = [o.joints for o in self.observations if o.joints is not None]
        usable = arm is not None and all(len(q) == arm.n for q in known)
        return MovedFlange(
            np.array([o.base_T_flange.matrix for o in self.observations]),
            np.array(known) if usable and len(known) == len(self.observations) else None,
            self.configuration.camera == FLANGE,
            arm,
            self.robot.joint_accuracy if self.robot else 0.0,
        )

    @property
    def motions(self) -> list[Motion] | None:
        """How the flange passed each capture; None where it stood still or nobody recorded it."""
        motions = [o.motion for o in self.observations if o.motion is not None]
        one_arm = {self.configuration.camera, self.configuration.target} == {BASE, FLANGE}
        return motions if one_arm and len(motions) == len(self.observations) else None

    def delayed(self, delay: float) -> Cell | None:
        """Return the cell with the flange where it was ``delay`` later [s]; None if not known."""
        observations = []
        for o in self.observations:
            motion = o.motion and later(o.motion, delay)
            if motion is None:
                return None
            flange = replace(o.base_T_flange, matrix=pose_at(motion, 0.0))
            poses = {**o.poses, FLANGE: flange}
            observations.append(replace(o, poses=poses, joints=None, motion=motion))
        return replace(self, observations=observations, delay=(self.delay or 0.0) + delay)

    def unknown_delay(self) -> Nuisance | None:
        """Return what a time [s] does by which the flange's poses are still too early."""
        motions = self.motions
        if motions is None or self.flange is None:
            return None
        before, after = (
            np.array([pose_at(each, end) for each in motions])
            for end in (-PASSED_STEP, PASSED_STEP)
        )
        turned = rotation_log(after[:, :3, :3] @ np.swapaxes(before[:, :3, :3], 1, 2))
        moved = np.concatenate([turned, after[:, :3, 3] - before[:, :3, 3]], axis=1)
        return self.flange.nuisance(moved[..., None] / (2 * PASSED_STEP), np.inf)

    def resized(self, factor: float) -> Cell:
        """Return the cell with all poses of the target so many times as far from the camera."""
        scale = np.repeat([1.0, factor], 3)
        observations = []
        for o in self.observations:
            if isinstance(o.feature, PoseFeature):
                seen = o.feature.camera_T_target
                pose = rigid(seen.rotation, factor * seen.translation)
                covariance = o.feature.covariance * np.outer(scale, scale)
                moved = replace(o.feature, camera_T_target=replace(seen, matrix=pose),
                                covariance=covariance)  # fmt: skip
                o = replace(o, feature=moved)
            observations.append(o)
        return replace(self, observations=observations)
