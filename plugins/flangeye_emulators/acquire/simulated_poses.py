"""Simulated sessions of markers: noisy poses, in any configuration or in a cell."""

from collections.abc import Iterator
from dataclasses import replace
from typing import ClassVar

import numpy as np
from pydantic import Field

from flangeye.models.cell import Cell
from flangeye.models.configuration import Configuration
from flangeye.models.robots import RobotModel, SecondRobot
from flangeye.plugin.stage import Params, stage
from flangeye.types import (
    CAMERA,
    TARGET,
    Floats,
    Indices,
    Observation,
    Observations,
    PoseFeature,
    Seed,
    Transform,
)
from flangeye.types.geometry import rigid, rotation_exp
from flangeye_emulators.acquire.moments import (
    FIELD,
    MOST_OBLIQUE,
    VERSION,
    CameraView,
    Moments,
    Sighting,
)
from flangeye_emulators.acquire.planned_cell import CellSessionParams, plan_cell
from flangeye_emulators.acquire.planned_session import ViewParams, plan_session, source_of


class OutlierParams(Params):
    """Rate and size of outliers of simulated cameras."""

    outliers: float = Field(0.0, ge=0, lt=0.5)
    """Share of sightings that are outliers."""
    # Of a marker's measured pose, about and along each axis [rad, m]
    noise: ClassVar[Floats] = np.repeat([np.radians(0.05), 0.1e-3], 3)
    # Of an outlier's [rad, m]
    gross: ClassVar[Floats] = np.repeat([0.5, 0.1], 3)

    def wrong(self, count: int, rng: np.random.Generator) -> Indices:
        """Return which of ``count`` sightings are outliers, drawn at random."""
        return rng.permutation(count)[: round(self.outliers * count)]

    def measured(
        self, moments: Moments, sighting: Sighting, error: tuple[Floats, Floats]
    ) -> Observation:
        """Return the observation of a marker with an error, (3, 3) and (3,) [m]."""
        seen, (turn, shift) = moments.pose(*sighting), error
        noisy = rigid(turn @ seen[:3, :3], seen[:3, 3] + shift)
        feature = PoseFeature(Transform(CAMERA, TARGET, noisy), np.diag(self.noise**2))
        return replace(moments.exact(*sighting), feature=feature)


class SimulatedMarkerParams(OutlierParams, ViewParams):
    """Parameters of ``acquire.simulated_marker``."""


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
    view = CameraView(params.distance, 0.3, 2.0, FIELD, MOST_OBLIQUE)
    moments = plan_session(robot, second, configuration, (params, view), rng)
    errors = params.noise * rng.standard_normal((len(moments), 6))
    wrong = params.wrong(len(moments), rng)
    errors[wrong] += params.gross * rng.standard_normal((len(wrong), 6))
    each = enumerate(zip(rotation_exp(errors[:, :3]), errors[:, 3:], strict=True))
    found = [params.measured(moments, (i, CAMERA, TARGET), error) for i, error in each]
    source = source_of(moments, (robot, configuration), seed, params)
    return Observations(found, source, len(found))


class SimulatedCellParams(OutlierParams, CellSessionParams):
    """Parameters of ``acquire.simulated_cell``."""

    wide: bool = False
    """The cameras see 60 x 50 deg, to 2.5 m, and targets turned away by up to 65 deg; else 50 x 40
    deg, to 2 m and 50 deg."""

    @property
    def view(self) -> CameraView:
        """The field of view of the cameras."""
        near = 0.3  # nearest that cameras see [m]
        if self.wide:
            return CameraView(
                0.0, near, 2.5, (np.radians(60.0), np.radians(50.0)), np.radians(65.0)
            )
        return CameraView(0.0, near, 2.0, FIELD, MOST_OBLIQUE)


@stage("acquire.simulated_cell")
def acquire_simulated_cell(cell: Cell, seed: Seed, params: SimulatedCellParams) -> Observations:
    """Simulate observations of every target by every camera of a cell, at random arm poses.

    Each observation has its own moment, and noise like that of a marker's pose.

    Raises:
        StageError: The true pose of an unknown is not given, or a camera or target has too few
            sightings.
    """
    rng = np.random.default_rng([VERSION, seed])
    planned = plan_cell(cell, seed, params, params.view, rng)
    count, seen = len(planned.scheduled), list[Observation]()
    wrong = np.isin(np.arange(count), params.wrong(count, rng))
    usual, gross = np.swapaxes(rng.standard_normal((count, 2, 6)), 0, 1)
    errors = params.noise * usual + wrong[:, None] * params.gross * gross

    def observed() -> Iterator[Observation]:
        for error, sighting in zip(errors, planned.sightings(lambda: seen), strict=False):
            wrongly = rotation_exp(error[:3]), error[3:]
            seen.append(params.measured(planned.moments, sighting, wrongly))
            yield seen[-1]

    return Observations(observed(), planned.source, count)
