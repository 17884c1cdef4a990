"""Simulated sessions of every configuration: noisy poses of a marker, or scans of a circle."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from flangeye.maths.kinematics import Arm
from flangeye.models.configuration import Configuration
from flangeye.models.robots import RobotModel, SecondRobot
from flangeye.models.scanners import ScannerModel
from flangeye.models.targets import Flange
from flangeye.plugin.stage import stage
from flangeye.types import (
    CAMERA,
    FLANGE,
    TARGET,
    Capture,
    Captures,
    Floats,
    Observation,
    Observations,
    PointCloud,
    PoseFeature,
    Seed,
    Transform,
)  # fmt: skip
from flangeye.types.geometry import rotation_exp
from flangeye_emulators.acquire.planned_session import (
    FACING,
    FIELD,
    VERSION,
    OutlierParams,
    PlannedSession,
    ViewParams,
    plan_session,
    source_of,
)
from flangeye_emulators.world.cell import SimulatedCell
from flangeye_emulators.world.mesh import MATERIALS, flange_mesh
from flangeye_emulators.world.raycast import SolidBody
from flangeye_emulators.world.scanner import ScannerQuality, before_camera, scanner_of
from flangeye_emulators.world.session import CameraView, seen_from


class SimulatedMarkerParams(OutlierParams, ViewParams):
    """Parameters of ``acquire.simulated_marker``."""


class ScanParams(ScannerQuality, ViewParams):
    """Parameters of ``acquire.simulated_session``."""


@stage("acquire.simulated_marker")
def acquire_simulated_marker(
    robot: RobotModel,
    configuration: Configuration,
    seed: Seed,
    params: SimulatedMarkerParams,
    second: SecondRobot | None = None,
) -> Observations:
    """Simulate measured poses of a marker in any configuration, without images.

    Raises:
        StageError: The camera does not see the marker at enough poses.
    """
    rng = np.random.default_rng([VERSION, seed])
    view = CameraView(params.distance, 0.3, 2.0, FIELD, FACING)
    session = plan_session(robot, second, configuration, (params, view), rng)
    seen = seen_from(session.actual, session.places)
    # Of a marker's measured pose, about and along each axis [rad, m].
    noise = np.repeat([np.radians(0.05), 0.1e-3], 3)
    errors = noise * rng.standard_normal((len(seen), 6))
    wrong = rng.permutation(len(seen))[: round(params.outliers * len(seen))]
    errors[wrong] += np.repeat([0.5, 0.1], 3) * rng.standard_normal((len(wrong), 6))
    seen[:, :3, :3] = rotation_exp(errors[:, :3]) @ seen[:, :3, :3]
    seen[:, :3, 3] += errors[:, 3:]
    features = [PoseFeature(Transform(CAMERA, TARGET, m), np.diag(noise**2)) for m in seen]
    found = [Observation(f"{i:04d}", f, *session.poses(i)) for i, f in enumerate(features)]
    return Observations(found, source_of(session, robot, seed, params), len(found))


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
    """Simulate scans of a circle in any configuration: the flange's, or a plate's on the base.

    Raises:
        StageError: The circle is in view at too few poses.
    """
    rng = np.random.default_rng([VERSION, seed])
    view = CameraView(params.distance, scanner.near, scanner.far, scanner.field_of_view, FACING)
    session = plan_session(robot, second, configuration, (params, view), rng)
    eye = scanner_of(scanner, params.resolution, params.noise, rng)
    stage_set = _Set(robot, second.model if second else None, flange, session)

    def captures() -> Iterator[Capture]:
        for i in range(params.poses):
            camera = session.actual.camera[i] @ session.places.x
            cloud = PointCloud(CAMERA, eye.scan(before_camera(stage_set.bodies(i), camera), rng))
            poses, joints = session.poses(i)
            yield Capture(f"{i:04d}", cloud, poses, joints)

    return Captures(captures(), source_of(session, robot, seed, params, flange), params.poses)


@dataclass(frozen=True, eq=False)
class _Set:
    """The bodies of a session."""

    robot: RobotModel
    second: RobotModel | None
    flange: Flange
    session: PlannedSession

    def bodies(self, i: int) -> list[SolidBody]:
        """Return the bodies in view at a pose, in ``base``."""
        actual, places = self.session.actual, self.session.places
        if self.second is not None and actual.second is not None:
            other = self._arm(self.second, actual.second[i], actual.target[i])
            return [body.moved(places.y) for body in other]
        if self.session.configuration.target == FLANGE and actual.joints is not None:
            return self._arm(self.robot, actual.joints[i], actual.flange[i])
        finish = MATERIALS[self.flange.details.finish]
        return [SolidBody(flange_mesh(self.flange), finish).moved(actual.target[i] @ places.z)]

    def _arm(self, robot: RobotModel, joints: Floats, flange: Floats) -> list[SolidBody]:
        nowhere = np.zeros(3)
        return SimulatedCell(robot, self.flange, nowhere, nowhere).arm(
            Arm(robot).frames(joints), flange
        )
