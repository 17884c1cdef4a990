"""Simulated sessions of every configuration: of a marker as poses, of circles as scans."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from flangeye.catalogue import Flange, RobotModel, ScannerModel, SecondRobot
from flangeye.configuration import Configuration
from flangeye.errors import StageError
from flangeye.geometry import invert, rigid, rotation_exp, rotation_from_rpy
from flangeye.kinematics import Arm
from flangeye.stage import Params, stage
from flangeye.types import (
    BASE,
    BASE2,
    CAMERA,
    FLANGE,
    FLANGE2,
    TARGET,
    Capture,
    Captures,
    Observation,
    Observations,
    PointCloud,
    PoseFeature,
    Seed,
    Source,
    Transform,
    Truth,
)  # fmt: skip
from flangeye.units import Angle, Length, param
from flangeye_plugins.simulation import materials
from flangeye_plugins.simulation.cell import Cell
from flangeye_plugins.simulation.eye import before_camera, eye_of
from flangeye_plugins.simulation.flange_mesh import flange_mesh
from flangeye_plugins.simulation.raycast import Body
from flangeye_plugins.simulation.session import (
    Cast,
    Places,
    Stands,
    View,
    close_loop,
    draw_stands,
    home_of,
    really,
    seen_from,
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


class MarkerParams(SessionParams):
    """Parameters of ``acquire.simulated_marker``."""

    field: tuple[Angle, Angle] = param(("50 deg", "40 deg"), description="Angles of view.")
    marker_rotation: Angle = param("0.05 deg", gt=0, description="Noise of the marker's pose.")
    marker_position: Length = param("0.1 mm", gt=0, description="And of its place.")
    outliers: float = Field(0.0, ge=0, lt=1, description="Share of captures that see it wrongly.")


class ScanParams(SessionParams):
    """Parameters of ``acquire.simulated_session``."""

    noise: float = Field(1.0, ge=0, description="Scale of the scanner's noise and distortion.")
    resolution: float = Field(
        1.0, gt=0, le=1, description="Scale of the scanner's columns and rows."
    )


@dataclass(frozen=True, eq=False)
class _Session:
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


@stage("acquire.simulated_marker")
def acquire_simulated_marker(
    robot: RobotModel,
    configuration: Configuration,
    seed: Seed,
    params: MarkerParams,
    second: SecondRobot | None = None,
) -> Observations:
    """Measure a marker's pose in any configuration: poses with noise, no images.

    Raises:
        StageError: The camera does not see the marker at enough poses.
    """
    rng = np.random.default_rng([VERSION, seed])
    view = View(params.distance, 0.3, 2.0, params.field, params.facing)
    session = _plan(robot, second, configuration, (params, view), rng)
    seen = seen_from(session.actual, session.places)
    noise = np.repeat([params.marker_rotation, params.marker_position], 3)
    errors = noise * rng.standard_normal((len(seen), 6))
    wrong = rng.permutation(len(seen))[: round(params.outliers * len(seen))]
    errors[wrong] += np.repeat([0.5, 0.1], 3) * rng.standard_normal((len(wrong), 6))
    seen[:, :3, :3] = rotation_exp(errors[:, :3]) @ seen[:, :3, :3]
    seen[:, :3, 3] += errors[:, 3:]
    features = [PoseFeature(Transform(CAMERA, TARGET, m), np.diag(noise**2)) for m in seen]
    found = [Observation(f"{i:04d}", f, *session.poses(i)) for i, f in enumerate(features)]
    return Observations(found, _source(session, robot, seed, params), len(found))


@stage("acquire.simulated_session")
def acquire_simulated_session(  # noqa: PLR0913  what it asks the runner for
    robot: RobotModel,
    scanner: ScannerModel,
    flange: Flange,
    configuration: Configuration,
    seed: Seed,
    params: ScanParams,
    second: SecondRobot | None = None,
) -> Captures:
    """Scan a circle in any configuration: the flange's own, or one like it on the base.

    Raises:
        StageError: The camera does not see it at enough poses.
    """
    rng = np.random.default_rng([VERSION, seed])
    view = View(params.distance, scanner.near, scanner.far, scanner.field_of_view, params.facing)
    session = _plan(robot, second, configuration, (params, view), rng)
    eye = eye_of(scanner, params.resolution, params.noise, rng)
    stage_set = _Set(robot, second.model if second else None, flange, session)

    def captures() -> Iterator[Capture]:
        for i in range(params.poses):
            camera = session.actual.camera[i] @ session.places.x
            cloud = PointCloud(CAMERA, eye.scan(before_camera(stage_set.bodies(i), camera), rng))
            pose, joints, other = session.poses(i)
            yield Capture(f"{i:04d}", cloud, pose, joints, base2_T_flange2=other)

    return Captures(captures(), _source(session, robot, seed, params, flange), params.poses)


@dataclass(frozen=True, eq=False)
class _Set:
    """The bodies of a session."""

    robot: RobotModel
    second: RobotModel | None
    flange: Flange
    session: _Session

    def bodies(self, i: int) -> list[Body]:
        """Return what there is to see at a pose, in ``base``."""
        actual, places = self.session.actual, self.session.places
        if self.second is not None and actual.second is not None:
            other = self._arm(self.second, actual.second[i], actual.target[i])
            return [body.moved(places.y) for body in other]
        if self.session.configuration.target == FLANGE and actual.joints is not None:
            return self._arm(self.robot, actual.joints[i], actual.flange[i])
        finish = materials.FINISHES[self.flange.details.finish]
        return [Body(flange_mesh(self.flange), finish).moved(actual.target[i] @ places.z)]

    def _arm(self, robot: RobotModel, joints: Floats, flange: Floats) -> list[Body]:
        nowhere = np.zeros(3)
        return Cell(robot, self.flange, nowhere, nowhere).arm(Arm(robot).frames(joints), flange)


def _plan(
    robot: RobotModel,
    second: SecondRobot | None,
    configuration: Configuration,
    given: tuple[SessionParams, View],
    rng: np.random.Generator,
) -> _Session:
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
    return _Session(configuration, reported, really(reported, configuration, noise, rng), places)


def _source(session: _Session, robot: RobotModel, seed: int, *models: Params | Flange) -> Source:
    configuration = session.configuration
    made_of = [robot.model, configuration.describe(), *(m.model_dump(mode="json") for m in models)]
    text = json.dumps([VERSION, seed, made_of], sort_keys=True)
    note = f"simulated: {configuration.name}, {len(session.reported.camera)} poses"
    return Source(hashlib.sha256(text.encode()).hexdigest(), (note,), truth=session.truth)
