"""What simulated sessions of any configuration have in common: parameters, and the plan."""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from flangeye.catalogue import Flange, RobotModel, SecondRobot
from flangeye.configuration import Configuration
from flangeye.errors import StageError
from flangeye.geometry import invert, rigid, rotation_from_rpy
from flangeye.kinematics import Arm
from flangeye.stage import Params
from flangeye.types import BASE, BASE2, FLANGE, FLANGE2, Source, Transform, Truth
from flangeye.units import Angle, Length, param
from flangeye_plugins.simulation.session import (
    Cast,
    Places,
    Stands,
    View,
    close_loop,
    draw_stands,
    home_of,
    really,
    visible,
)

Floats = NDArray[np.float64]

VERSION = 1
"""Raised whenever the same parameters would give other captures."""
HOME = ("0 deg", "-90 deg", "90 deg", "-90 deg", "-90 deg", "0 deg")


class PlaceParams(Params):
    """A pose, in the frame of what carries it."""

    position: tuple[Length, Length, Length] = param(("0 mm", "0 mm", "0 mm"))
    rpy: tuple[Angle, Angle, Angle] = param(
        ("0 deg", "0 deg", "0 deg"), description="Roll, pitch, yaw."
    )

    @property
    def matrix(self) -> Floats:
        """(4, 4)."""
        return rigid(rotation_from_rpy(*self.rpy), np.asarray(self.position))


class SessionParams(Params):
    """What simulated sessions have in common."""

    poses: int = Field(20, ge=3, description="How many captures.")
    home: tuple[Angle, ...] = param(HOME, description="Joints of the first arm at the first pose.")
    second_home: tuple[Angle, ...] = param(HOME, description="Those of the second arm.")
    spread: Angle = param("17 deg", gt=0, description="Largest change of a joint from there.")
    distance: Length = param("650 mm", gt=0, description="Camera to target at the first pose.")
    camera: PlaceParams | None = Field(
        None,
        description="The camera's true place in what carries it; by default wherever it has to be "
        "to see the target at the first pose.",
    )
    place: PlaceParams = Field(
        default_factory=PlaceParams,
        description="The target's true place in what carries it, where the recipe does not know "
        "it; with camera it follows from the first pose.",
    )
    facing: Angle = param(
        "50 deg", gt=0, description="Largest angle between the target's z and the view."
    )
    robot_rotation: Angle = param(
        "0.0115 deg", ge=0, description="Noise of a reported pose about each axis; 0.2 mrad."
    )
    robot_position: Length = param("0.05 mm", ge=0, description="And along each axis.")
    four_axes: bool = Field(
        False, description="The first arm's flange only moves, and turns about the vertical."
    )
    in_turns: bool = Field(
        False, description="Of two arms, one rests at its first pose while the other moves."
    )


@dataclass(frozen=True, eq=False)
class PlannedSession:
    """A session that was planned: what the arms report, where they are, where all is."""

    configuration: Configuration
    reported: Stands
    actual: Stands
    places: Places

    @property
    def truth(self) -> Truth:
        """The unknowns as they are."""
        places = self.places
        values = [places.x, *([places.y] if self.configuration.other_base else []), places.z]
        camera, *others = (
            Transform.named(name, value)
            for name, value in zip(self.configuration.unknowns, values, strict=False)
        )
        return Truth(camera, tuple(others))

    def poses(self, i: int) -> tuple[Transform, Floats | None, Transform | None]:
        """Return base_T_flange, joints and base2_T_flange2 as reported at a pose."""
        stands = self.reported
        second = None
        if self.configuration.other_base:
            second = Transform(BASE2, FLANGE2, stands.target[i])
        joints = None if stands.joints is None else stands.joints[i]
        return Transform(BASE, FLANGE, stands.flange[i]), joints, second


def plan_session(
    robot: RobotModel,
    second: SecondRobot | None,
    configuration: Configuration,
    given: tuple[SessionParams, View],
    rng: np.random.Generator,
) -> PlannedSession:
    """Draw the arms' poses, and put camera and target where the loop closes.

    Args:
        robot: The first arm.
        second: The second one, where the configuration has two.
        configuration: Who carries what.
        given: What the recipe says, and what the camera can see.
        rng: Draws poses and their noise.

    Raises:
        StageError: A second arm is missing, or the camera does not see the target at enough poses.
    """
    params, view = given
    if configuration.other_base and second is None:
        raise StageError("two arms need the recipe's 'second_robot' section: {model: …}")
    other = Arm(second.model) if second and configuration.other_base else None
    cast = Cast(configuration, Arm(robot), other, params.four_axes, params.in_turns)
    known = configuration.place
    place = params.place.matrix if known is None else np.asarray(known)
    camera = params.camera.matrix if params.camera else None
    home = np.asarray(params.home)
    closed_by_arm = camera is not None and known is not None and other is None
    if closed_by_arm and camera is not None:
        home = home_of(cast.first, place @ invert(camera @ view.first()))
    stands = draw_stands(cast, (home, np.asarray(params.second_home)), params.spread, rng)
    places = close_loop(stands, view, configuration, camera, place)
    if closed_by_arm and camera is not None:
        places = Places(camera, np.eye(4), place)
    reported = visible(stands, places, view, params.poses)
    noise = params.robot_rotation, params.robot_position
    return PlannedSession(
        configuration, reported, really(reported, configuration, noise, rng), places
    )


def source_of(
    session: PlannedSession, robot: RobotModel, seed: int, *models: Params | Flange
) -> Source:
    """Return where a session's captures come from: made of the models and parameters alone."""
    configuration = session.configuration
    made_of = [robot.model, configuration.describe(), *(m.model_dump(mode="json") for m in models)]
    text = json.dumps([VERSION, seed, made_of], sort_keys=True)
    note = f"simulated: {configuration.name}, {len(session.reported.camera)} poses"
    return Source(hashlib.sha256(text.encode()).hexdigest(), (note,), truth=session.truth)
