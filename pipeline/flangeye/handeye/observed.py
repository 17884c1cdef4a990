"""What was observed of one camera and one target, and who carries them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, reduce
from itertools import chain

import numpy as np

from flangeye.handeye.arm import MovedFlange
from flangeye.handeye.nuisance import Nuisance
from flangeye.maths.geometry import rigid
from flangeye.maths.kinematics import Arm
from flangeye.maths.streams import joints_at, later, pose_at, rates_of
from flangeye.models.configuration import LINK, Configuration
from flangeye.models.robots import RobotModel
from flangeye.models.scanners import ScannerModel
from flangeye.types import BASE, FLANGE, FLANGE2, Floats, Motion, Observation, PoseFeature


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
        second_robot: The model of the arm that carries the target before another's camera.
    """

    observations: Sequence[Observation]
    configuration: Configuration
    robot: RobotModel | None
    scanner: ScannerModel | None = None
    delay: float | None = None
    clock_deviation: float = 0.0
    second_robot: RobotModel | None = None

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
            self._poses(FLANGE),
            np.array(known) if usable and len(known) == len(self.observations) else None,
            self.configuration.camera == FLANGE,
            arm,
            self.robot.joint_accuracy if self.robot else 0.0,
        )

    @cached_property
    def arms(self) -> list[list[MovedFlange]]:
        """What each arm moves that carries camera or target: its flange, a link, or both."""
        first = [self.flange] if self.flange else []
        return [arm for arm in (first + self._link, self._second) if arm]

    @property
    def _link(self) -> list[MovedFlange]:
        """The first arm, where a link of its carries the camera: then its joints are known."""
        carrier, arm = self.configuration.camera, self.arm
        if arm is None or self.robot is None or not carrier.startswith(LINK):
            return []
        link = int(carrier.removeprefix(LINK))
        joints = np.array([o.joints for o in self.observations], dtype=np.float64)
        poses, deviation = arm.pose(joints, link), self.robot.joint_accuracy
        return [MovedFlange(poses, joints, True, arm, deviation, link)]

    @property
    def _second(self) -> list[MovedFlange]:
        if self.configuration.target != FLANGE2:
            return []
        poses, robot = self._poses(FLANGE2), self.second_robot
        if robot is None:
            return [MovedFlange(poses, None, False)]
        return [MovedFlange(poses, None, False, Arm(robot), robot.joint_accuracy)]

    def _poses(self, flange: str) -> Floats:
        return np.array([o.poses[flange].matrix for o in self.observations])

    @property
    def motions(self) -> list[Motion] | None:
        """How what carries camera and target passed each capture; None where it stood still.

        Or where nobody recorded it, as of a link the joints.
        """
        others = {self.configuration.camera, self.configuration.target} - {BASE, FLANGE}
        motions = [self._with_link(o.motion) for o in self.observations if o.motion]
        told = [motion for motion in motions if others <= {*motion.others}]
        return told if len(told) == len(self.observations) else None

    def _with_link(self, motion: Motion) -> Motion:
        """Return a motion with that of the link that carries the camera, by the arm's joints."""
        camera, joints = self.configuration.camera, motion.joints.get(FLANGE)
        if self.arm is None or joints is None or not camera.startswith(LINK):
            return motion
        poses = self.arm.pose(joints, int(camera.removeprefix(LINK)))
        return replace(motion, others={**motion.others, camera: poses})

    def delayed(self, delay: float) -> Cell | None:
        """Return the cell with its arms where they were ``delay`` later [s]; None if not known."""
        observations = []
        for o in self.observations:
            motion = o.motion and later(o.motion, delay)
            if motion is None:
                return None
            moved = {FLANGE: pose_at(motion, 0.0)}
            moved |= {name: pose_at(motion, 0.0, name) for name in motion.others}
            poses = {name: replace(o.poses[name], matrix=x) for name, x in moved.items()}
            poses = {**o.poses, **poses}
            joints = joints_at(motion, 0.0, FLANGE)
            observations.append(replace(o, poses=poses, joints=joints, motion=motion))
        return replace(self, observations=observations, delay=(self.delay or 0.0) + delay)

    def unknown_delay(self) -> Nuisance | None:
        """Return what a time [s] does by which the arms' poses are still too early."""
        motions = self.motions
        if motions is None:
            return None
        late = []
        for moved in chain(*self.arms):
            ends = self.configuration
            frame = ends.camera if moved.carries_camera else ends.target
            rates = rates_of(motions, None if frame == FLANGE else frame)
            late.append(moved.nuisance(rates[..., None], np.inf))
        return reduce(Nuisance.joined, late) if late else None

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
