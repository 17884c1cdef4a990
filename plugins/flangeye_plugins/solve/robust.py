"""The default solver of every configuration: outliers found, the arm's own error in the model."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Literal

import numpy as np
from pydantic import Field

from flangeye import FlangeyeError, Params, stage
from flangeye.models.configuration import DEFAULT, EVERY, Configuration
from flangeye.models.robots import RobotModel, SecondRobot
from flangeye.models.scanners import ScannerModel
from flangeye.types import (
    Box,
    CircleFeature,
    HandEye,
    Observation,
    Observations,
    Progress,
    Solver,
    Source,
    StageLog,
)
from flangeye.units import Angle, Length, param

if TYPE_CHECKING:
    from flangeye.handeye.calibration import Options
    from flangeye.handeye.observed import Cell

FEWEST_ONLINE = 6
"""Poses before an online run may stop: fewer tell too little of the noise."""


class RobotNoise(Params):
    """Noise of the poses an arm reports; of both arms where there are two."""

    rotation: Angle = param("0.01 deg", gt=0, description="Standard deviation about each axis.")
    position: Length = param("0.05 mm", gt=0, description="Standard deviation along each axis.")


class RobustParams(Params):
    """Parameters of ``solve.robust``."""

    robot_noise: RobotNoise | None = Field(
        None,
        description="All the noise of the poses the arm reports, where it is known; by default "
        "what noise the residuals show beyond the features' own, and the arm's smooth error.",
    )
    normals: Literal["auto", "off"] = Field(
        "auto", description="Use the flange's measured normals where there are any."
    )
    normal_bias: Angle = param(
        "0.05 deg",
        gt=0,
        description="Standard deviation of a tilt common to all normals: flatness of the plate, "
        "zeros of the last joints, scanner.",
    )
    pose_noise: Length | None = param(
        None, gt=0, description="Noise of the arm's position per axis; by default estimated."
    )
    rotation_limit: Angle = param(
        "2 deg",
        gt=0,
        description="Refuse when rotation about some axis has a larger standard deviation.",
    )
    tool_offset: Literal["auto", "off"] = Field(
        "auto",
        description="Estimate a constant offset of the seen circle in the flange frame, if the "
        "poses show one and it helps on poses held out.",
    )
    joint_offsets: Literal["auto", "off"] = Field(
        "off",
        description="Estimate the arm's joint offsets too, if that helps on poses held out: the "
        "result then has a second pose, for the arm with these offsets corrected.",
    )
    joint_zeros: Literal["consider", "ignore"] = Field(
        "consider",
        description="Whether the covariance includes what the arm does wrong alike at all poses: "
        "zeros, encoders, sag, lengths, twists, and what is smooth over the workspace, as large as "
        "the residuals show them.",
    )
    joint_prior: Angle = param(
        "0.5 deg", gt=0, description="Expected standard deviation of a joint's offset."
    )
    smooth_error: Literal["auto", "off"] = Field(
        "auto",
        description="Estimate a smooth error of the arm over the workspace, if that helps on poses "
        "held out. The matrix stays the best for the arm as reported.",
    )
    scanner_distortion: Literal["consider", "ignore"] = Field(
        "consider",
        description="Whether the scanner's smooth distortion is part of the model, as large as the "
        "scanner's file has it (calibration_error): found as far as the poses show it, and in the "
        "covariance. With it, where a circle's place is unknown, how it rounds the edges of a "
        "tilted face.",
    )
    translation_limit: Length = param(
        "20 mm", gt=0, description="A translation known less well is not observable."
    )
    unobservable: Literal["refuse", "mark"] = Field(
        "refuse",
        description="What to do about translations that the motion cannot show, as the height "
        "with an arm of four joints: refuse, or solve for the rest and mark them.",
    )
    size_limit: float = Field(
        0.005,
        gt=0,
        description="Share by which a marker may be larger or smaller than its fit was told, as "
        "the arm's motion shows it; beyond, the calibration is refused.",
    )
    target_size: Literal["known", "unknown"] = Field(
        "known",
        description="Whether a marker's size was said where it was fitted, or its poses are right "
        "but for one factor on all distances, as those of a single moving camera: then the arm's "
        "own motion tells it.",
    )
    certify: bool = Field(
        False,
        description="Say whether the answer is certified as globally optimal, by a dual "
        "certificate, or not; where that leads to a better answer, that is given.",
    )
    required: Length | None = param(
        None,
        gt=0,
        description="Stop acquiring once no point of the workspace is off by more, with 95 % "
        "probability, but for what the arm does wrong alike at all poses: more poses do not mend "
        "that. By default every pose is used.",
    )

    def requires(self) -> Mapping[type, str]:
        """Return the arm's kinematics, where its joint offsets are to be found."""
        return {RobotModel: "to correct its joints"} if self.joint_offsets == "auto" else {}

    @property
    def corrects_arm(self) -> bool:
        """Whether the arm's own error may be found; read where a step asks for that answer."""
        return "auto" in (self.joint_offsets, self.smooth_error)


@stage("solve.robust", serves=EVERY)
def solve_robust(  # noqa: PLR0913  what it asks the runner for
    observations: Observations,
    params: RobustParams,
    workspace: Box | None = None,
    robot: RobotModel | None = None,
    stage_log: StageLog | None = None,
    configuration: Configuration | None = None,
    scanner: ScannerModel | None = None,
    second: SecondRobot | None = None,
) -> HandEye:
    """Robust maximum likelihood: reject outlier poses and estimate every unknown transform.

    Takes whole poses, centres with normals, or centres alone, each with its covariance. Gross
    outliers are found by graduated non-convexity on truncated least squares (Yang et al. 2020) and
    set aside with their residual; noise beyond the features' own is estimated. What is wrong with
    the arm (tool offset, joints, a smooth error over the workspace) is part of the model where it
    helps on poses held out. Every unknown gets its covariance, about the place where the camera
    looks: with what few poses leave unknown of the noise and what the zeros of the arm's joints
    may be off by, so that its 95 % region holds its share.

    Raises:
        StageError: Too few poses, all the same, not in one unit, those of a mirrored camera, or
            a carrier's pose is missing.
        CalibrationRefused: Fewer than half of the poses agree, the motion leaves something unknown
            (it says which motion is missing), or a marker has another size than its fit was told.
    """
    from flangeye.handeye.observed import Cell

    def solve(pulled: Sequence[Observation]) -> HandEye:
        other = second.model if second else None
        cell = Cell(pulled, configuration or DEFAULT, robot, scanner, second_robot=other)
        return solve_cell(cell, params)

    if params.required is None:
        return solve(list(observations))
    return solve(pull(observations, solve, params.required, workspace, stage_log))


def pull(
    observations: Observations,
    solve: Solver,
    required: float,
    workspace: Box | None,
    stage_log: StageLog | None = None,
) -> list[Observation]:
    """Take observations until no point of the workspace is off by more than ``required`` [m]."""
    pulled: list[Observation] = []
    for observation in observations:
        pulled.append(observation)
        if len(pulled) < FEWEST_ONLINE:
            continue
        error = _error_at_work(pulled, solve, workspace, observations.source)
        if stage_log:
            told = error if np.isfinite(error) else None
            stage_log("progress", Progress(len(pulled), told, required))
        if error <= required:
            break
    return pulled


def _error_at_work(
    pulled: Sequence[Observation], solve: Solver, workspace: Box | None, source: Source
) -> float:
    """Return what no point of the workspace is off by more than, with 95 % probability [m]."""
    from flangeye.maths.statistics import corners_of, largest_error_quantile
    from flangeye.models.workspace import workspace_of

    try:
        found = solve(pulled)
    except FlangeyeError:
        return float("inf")
    box = workspace_of(source, workspace, found.pairs)
    known = found.camera
    corners = corners_of(box.centre, box.size) if box else known.about[None]
    return largest_error_quantile(found.scatter_covariance, known.about, corners)


def solve_poses(
    pulled: Sequence[Observation],
    params: RobustParams,
    robot: RobotModel | None = None,
    configuration: Configuration | None = None,
    method: str = "solve.robust",
    scanner: ScannerModel | None = None,
) -> HandEye:
    """Solve observations that are all there; see :func:`solve_robust`."""
    from flangeye.handeye.observed import Cell

    return solve_cell(Cell(pulled, configuration or DEFAULT, robot, scanner), params, method)


def solve_cell(cell: Cell, params: RobustParams, method: str = "solve.robust") -> HandEye:
    """Solve what was observed, where; see :func:`solve_robust`."""
    from flangeye.handeye.calibration import calibrate
    from flangeye_plugins.solve.svd import check_poses

    circles = all(isinstance(o.feature, CircleFeature) for o in cell.observations)
    if cell.configuration.is_default and circles:
        check_poses(cell.observations)
    return calibrate(cell, _options(params), method)


def _options(params: RobustParams) -> Options:
    from flangeye.handeye.calibration import Options
    from flangeye.handeye.loop import ArmNoise
    from flangeye.handeye.observability import ObservabilityLimits

    noise = params.robot_noise
    return Options(
        normals=params.normals == "auto",
        normal_bias=params.normal_bias,
        robot_noise=ArmNoise(noise.rotation, noise.position) if noise else None,
        pose_noise=params.pose_noise,
        limits=ObservabilityLimits(
            params.rotation_limit, params.translation_limit, params.unobservable == "mark"
        ),
        tool_offset=params.tool_offset == "auto",
        joint_offsets=params.joint_offsets == "auto",
        joint_prior=params.joint_prior,
        joint_zeros=params.joint_zeros == "consider",
        smooth_error=params.smooth_error == "auto",
        scanner_distortion=params.scanner_distortion == "consider",
        size_limit=params.size_limit,
        finds_size=params.target_size == "unknown",
        certify=params.certify,
    )
