"""Plan of a simulated session in any configuration: parameters, poses and true transforms."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from flangeye.errors import StageError
from flangeye.maths.kinematics import Arm
from flangeye.models.configuration import Configuration
from flangeye.models.robots import RobotModel, SecondRobot
from flangeye.models.targets import Flange
from flangeye.plugin.stage import Params, PlaceParams
from flangeye.types import (
    BASE,
    BASE2,
    CAMERA,
    FLANGE,
    FLANGE2,
    TARGET,
    Floats,
    Observation,
    PoseFeature,
    Poses,
    Source,
    Transform,
    Truth,
    by_frame,
)
from flangeye.types.geometry import invert
from flangeye.units import Angle, Length, param
from flangeye_emulators.world.arm import ArmErrors, ImperfectArm
from flangeye_emulators.world.session import (
    ArmPoses,
    CameraView,
    Cast,
    Places,
    as_built,
    close_loop,
    draw_arm_poses,
    home_of,
    seen_from,
    visible,
    with_noise,
)

VERSION = 1
"""Raised whenever the same parameters would give other captures or sessions."""
REPORTED = float(np.radians(0.0115)), 0.05e-3
"""Standard deviation of a reported pose about and along each axis [rad, m]: half of what the data
sheet of a UR5 gives for repeatability, 0.1 mm."""
UNSEEN = 60
"""Poses that take no part and show what a calibration is worth, where the arm has errors."""
UPRIGHT = np.radians([0, -90, 90, -90, -90, 0])
"""Joints of an arm at its first pose."""
FACING = float(np.radians(50.0))
"""A camera sees a target whose z is this far from the view at most [rad]."""
FIELD = float(np.radians(50.0)), float(np.radians(40.0))
"""Horizontal and vertical field of view of a camera that is not a scanner [rad]."""


class ArmsParams(Params):
    """Common parameters of simulated arms."""

    arm: ArmErrors = Field(default_factory=ArmErrors)
    """How far the arms are from what their controllers report; by default by the noise of the pose
    alone."""


class SessionParams(ArmsParams):
    """Common parameters of simulated sessions."""

    poses: int = Field(20, ge=3, le=100_000)
    """Number of captures."""
    spread: Angle = param("17 deg", gt=0)
    """Largest change of a joint from there."""
    camera: PlaceParams | None = None
    """The camera's true place in what carries it; by default wherever it has to be to see the
    target at the first pose."""
    place: PlaceParams = Field(default_factory=PlaceParams)
    """The target's true place in what carries it, where the recipe does not know it; with camera it
    follows from the first pose."""
    motion: Literal["together", "in_turns", "four_axes"] = "together"
    """together: two arms move at once; in_turns: only one of them moves at a time, and the other
    rests at its first pose; four_axes: the first arm is a SCARA, whose flange turns about the
    vertical."""


class ViewParams(SessionParams):
    """Common parameters of simulated sessions with area cameras."""

    distance: Length = param("650 mm", gt=0)
    """Distance from camera to target at the first pose."""


class OutlierParams(Params):
    """Rate and size of outliers of simulated cameras."""

    outliers: float = Field(0.0, ge=0, lt=0.5)
    """Share of sightings that are outliers."""


def noise_free(
    camera_T_target: Floats, index: int, poses: Poses, joints: Floats | None
) -> Observation:
    """Return a camera's noise-free observation at a pose, with the reported robot poses."""
    seen = PoseFeature(Transform(CAMERA, TARGET, camera_T_target), np.zeros((6, 6)))
    return Observation(f"exact-{index}", seen, poses, joints)


@dataclass(frozen=True, eq=False)
class PlannedSession:
    """A planned session: reported poses, true poses, and the true transforms."""

    configuration: Configuration
    reported: ArmPoses
    actual: ArmPoses
    places: Places
    unseen: tuple[Observation, ...] = ()

    @property
    def truth(self) -> Truth:
        """True values of the unknowns."""
        places = self.places
        values = [places.x, *([places.y] if self.configuration.other_base else []), places.z]
        camera, *others = (
            Transform.named(name, value)
            for name, value in zip(self.configuration.unknowns, values, strict=False)
        )
        return Truth(camera, tuple(others), self.unseen)

    def where(self, chosen: NDArray[np.intp]) -> PlannedSession:
        """Return the session with the chosen poses only."""
        return replace(self, reported=self.reported.where(chosen), actual=self.actual.where(chosen))

    def noise_free(self) -> tuple[Observation, ...]:
        """Return the camera's noise-free observation at each pose, with reported robot poses."""
        seen = seen_from(self.actual, self.places)
        return tuple(noise_free(pose, i, *self.poses(i)) for i, pose in enumerate(seen))

    def poses(self, i: int) -> tuple[Poses, Floats | None]:
        """Return the reported poses and joints at a pose of the plan."""
        reported = self.reported
        second = None
        if self.configuration.other_base:
            second = Transform(BASE2, FLANGE2, reported.target[i])
        joints = None if reported.joints is None else reported.joints[i]
        return by_frame(Transform(BASE, FLANGE, reported.flange[i]), second), joints


def plan_session(
    robot: RobotModel,
    second: SecondRobot | None,
    configuration: Configuration,
    given: tuple[SessionParams, CameraView],
    rng: np.random.Generator,
) -> PlannedSession:
    """Return a session with random arm poses, and camera and target placed to close the loop.

    Args:
        robot: The first arm.
        second: The second arm; None for a configuration with one.
        configuration: What carries camera and target.
        given: Parameters of the recipe, and the camera's field of view.
        rng: Random generator of poses and noise.

    Raises:
        StageError: A second arm is missing, or the target is in view at too few poses.
    """
    params, view = given
    if configuration.other_base and second is None:
        raise StageError("two arms need the recipe's 'second_robot' section: {model: …}")
    other = Arm(second.model) if second and configuration.other_base else None
    four_axes, in_turns = params.motion == "four_axes", params.motion == "in_turns"
    cast = Cast(configuration, Arm(robot), other, four_axes, in_turns, view.draws)
    known = configuration.place
    place = params.place.matrix if known is None else np.asarray(known)
    camera = params.camera.matrix if params.camera else None
    home = UPRIGHT
    closed_by_arm = camera is not None and known is not None and other is None
    if closed_by_arm and camera is not None:
        home = home_of(cast.first, place @ invert(camera @ view.first()))
    poses = draw_arm_poses(cast, (home, UPRIGHT), params.spread, rng)
    places = close_loop(poses, view, configuration, camera, place)
    if closed_by_arm and camera is not None:
        places = Places(camera, np.eye(4), place)
    found = visible(poses, places, view, params.poses)
    planned = PlannedSession(configuration, found, found, places)
    if not params.arm.is_default:
        drawn = ImperfectArm(robot, 1.0, rng.spawn(1)[0], params.arm)
        draw = rng.spawn(1)[0]
        other_drawn = ImperfectArm(second.model, 1.0, draw, params.arm) if second else None
        return _as_built(planned, (drawn, other_drawn), params, rng)
    session = planned.where(np.arange(params.poses))
    return replace(session, actual=with_noise(session.actual, configuration, REPORTED, rng))


def _as_built(
    planned: PlannedSession,
    arms: tuple[ImperfectArm, ImperfectArm | None],
    params: SessionParams,
    rng: np.random.Generator,
) -> PlannedSession:
    """Return the session with the arms' true poses, and with additional unused poses."""
    configuration, count = planned.configuration, params.poses
    every = planned.where(np.arange(min(count + UNSEEN, len(planned.reported.camera))))
    built = replace(every, actual=as_built(every.reported, configuration, arms))
    session = built.where(np.arange(count))
    shaken = with_noise(session.actual, configuration, REPORTED, rng)
    return replace(session, actual=shaken, unseen=built.noise_free()[count:])


def source_of(
    session: PlannedSession, robot: RobotModel, seed: int, *models: Params | Flange
) -> Source:
    """Return the provenance of a session's captures, from its models and parameters."""
    configuration = session.configuration
    made_of = [robot.model, configuration.describe(), *(m.model_dump(mode="json") for m in models)]
    note = f"simulated: {configuration.name}, {len(session.reported.camera)} poses"
    return Source(fingerprint_of(seed, made_of), (note,), truth=session.truth, simulated=True)


def fingerprint_of(seed: int, made_of: Sequence[Any]) -> str:
    """Return the hash of a simulation, computed from its seed and its models' plain data."""
    text = json.dumps([VERSION, seed, made_of], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()
