"""The default solver: outliers found, every centre and normal weighed by what it is worth."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from flangeye import FlangeyeError, Params, stage
from flangeye.catalogue import RobotModel
from flangeye.kinematics import Arm
from flangeye.statistics import corners_of, covariance_inflation, largest_error_quantile
from flangeye.types import (
    Box,
    HandEye,
    Journal,
    Observation,
    Observations,
    Pair,
    Progress,
    Solver,
    Source,
    TransformEstimate,
)
from flangeye.units import Angle, Length, param
from flangeye.workspace import workspace_of
from flangeye_plugins.solving.arm import (
    unknown_zeros,
    with_joint_offsets,
    with_tool_offset,
    zeros_of,
)
from flangeye_plugins.solving.arrays import estimate_of
from flangeye_plugins.solving.clocking import clocking_note
from flangeye_plugins.solving.consensus import find_consensus
from flangeye_plugins.solving.equations import Fit
from flangeye_plugins.solving.evidence import Evidence, Nuisance, common_tilt, evidence_of
from flangeye_plugins.solving.model import Model
from flangeye_plugins.solving.svd import check_poses

Floats = NDArray[np.float64]

FEWEST_ONLINE = 6
"""Poses before an online run may stop: fewer tell too little of the noise."""


class RobustParams(Params):
    """Parameters of ``solve.robust``."""

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
        description="Estimate the arm's joint offsets too, if that helps on poses held out. The "
        "matrix then holds for the arm with these offsets corrected.",
    )
    joint_zeros: Literal["consider", "ignore"] = Field(
        "consider",
        description="Whether the covariance includes what the zeros of the joints may be off by, "
        "as the robot's file has it (joint_accuracy).",
    )
    joint_prior: Angle = param(
        "0.5 deg", gt=0, description="Standard deviation of a joint's offset to expect."
    )
    required: Length | None = param(
        None,
        gt=0,
        description="Stop acquiring once no point of the workspace is off by more, with 95 % "
        "probability; by default every pose is used.",
    )


@stage("solve.robust")
def solve_robust(
    observations: Observations,
    params: RobustParams,
    workspace: Box | None = None,
    robot: RobotModel | None = None,
    journal: Journal | None = None,
) -> HandEye:
    """Find the poses that agree, then fit them by generalised least squares.

    Inliers by graduated non-convexity on truncated least squares (Yang et al. 2020); then each
    centre and normal counts with its own covariance, and noise beyond those (the arm's) is
    estimated. Poses that do not agree are set aside with their residual. The covariance includes
    what few poses leave unknown of the noise and what the zeros of the arm's joints may be off
    by, so that its 95 % region holds its share.

    Raises:
        StageError: Fewer than three poses, all at one place, or not in one unit.
        CalibrationRefused: Fewer than half of the poses agree, or a rotation stays unknown: it
            says which motion is missing.
    """

    def solve(pulled: Sequence[Observation]) -> HandEye:
        return solve_poses(pulled, params, robot)

    if params.required is None:
        return solve(list(observations))
    return solve(pull(observations, solve, params.required, workspace, journal))


def pull(
    observations: Observations,
    solve: Solver,
    required: float,
    workspace: Box | None,
    journal: Journal | None = None,
) -> list[Observation]:
    """Take observations until no point of the workspace is off by more than ``required`` [m]."""
    pulled: list[Observation] = []
    for observation in observations:
        pulled.append(observation)
        if len(pulled) < FEWEST_ONLINE:
            continue
        error = _error_at_work(pulled, solve, workspace, observations.source)
        if journal:
            told = error if np.isfinite(error) else None
            journal("progress", Progress(len(pulled), told, required))
        if error <= required:
            break
    return pulled


def _error_at_work(
    pulled: Sequence[Observation], solve: Solver, workspace: Box | None, source: Source
) -> float:
    """Return what no point of the workspace is off by more than, with 95 % probability [m]."""
    try:
        found = solve(pulled)
    except FlangeyeError:
        return float("inf")
    box = workspace_of(source, workspace, found.pairs)
    known = found.base_T_camera
    corners = corners_of(box.centre, box.size) if box else known.about[None]
    return largest_error_quantile(known.covariance, known.about, corners)


def solve_poses(
    pulled: Sequence[Observation], params: RobustParams, robot: RobotModel | None = None
) -> HandEye:
    """Solve observations that are all there; see :func:`solve_robust`."""
    check_poses(pulled)
    evidence = evidence_of(pulled)
    if params.normals == "off":
        evidence = evidence.without_normals(evidence.has_normal)
    agree = partial(
        find_consensus, rotation_limit=params.rotation_limit, pose_noise=params.pose_noise
    )
    common = common_tilt(evidence.flanges, params.normal_bias)
    model = Model(evidence, common, agree(evidence, common))
    considered = robot if params.joint_zeros == "consider" else None
    if params.tool_offset == "auto":
        model = with_tool_offset(model, agree, _expected_zeros(evidence, pulled, considered))
    if robot is not None and params.joint_offsets == "auto":
        model = with_joint_offsets(model, agree, pulled, Arm(robot), params.joint_prior)
    of_zeros, note = _of_zeros(model, pulled, None if model.corrects_joints else considered)
    notes = (*model.found.notes, *_noise_notes(model), *note, _clocking(pulled, model))
    known = estimate(model.found.fit, of_zeros)
    return HandEye(
        known, _pairs(pulled, model), "solve.robust", notes + model.notes, model.correction
    )


def _expected_zeros(
    evidence: Evidence, pulled: Sequence[Observation], robot: RobotModel | None
) -> Nuisance | None:
    if robot is None:
        return None
    return zeros_of(evidence, pulled, Arm(robot), robot.joint_accuracy)


def _of_zeros(
    model: Model, pulled: Sequence[Observation], robot: RobotModel | None
) -> tuple[Floats, list[str]]:
    """Return what unknown joint zeros add to the covariance, and a note of it."""
    if robot is None:
        return np.zeros((6, 6)), []
    added = unknown_zeros(model, pulled, Arm(robot), robot.joint_accuracy)
    each = f"unknown joint zeros ({robot.joint_accuracy * 1e3:g} mrad each)"
    if added is None:
        return np.zeros((6, 6)), [f"{each} not considered: the arm's model misses these poses"]
    return added, [
        f"{each} are in the covariance: they move all poses alike, "
        "which held-out errors do not show"
    ]


def _pairs(pulled: Sequence[Observation], model: Model) -> tuple[Pair, ...]:
    residuals, found = model.residuals(), model.found
    return tuple(
        Pair(o, residuals[i], True)
        if found.inliers[i]
        else Pair(o, residuals[i], False, _reason(residuals[i], found.distances[i]))
        for i, o in enumerate(pulled)
    )


def estimate(fit: Fit, of_zeros: Floats) -> TransformEstimate:
    """Return the pose of a fit with its covariance.

    That of the fit is widened for what is unknown of the noise; the joint zeros' is added.
    """
    inflation = covariance_inflation(min(fit.freedom, fit.tilt_freedom))
    covariance = fit.covariance[:6, :6] * inflation + of_zeros
    return estimate_of(fit.rotation, fit.translation, covariance, fit.about)


def _reason(residual: Floats, distance: float) -> str:
    return f"residual {np.linalg.norm(residual) * 1e3:.1f} mm, {distance:.0f} sigma"


def _clocking(pulled: Sequence[Observation], model: Model) -> str:
    found = model.found
    agreeing = [o for o, used in zip(pulled, found.inliers, strict=True) if used]
    return clocking_note(agreeing, found.fit)


def _noise_notes(model: Model) -> list[str]:
    noise = model.found.fit.noise
    beyond, tilt = np.sqrt(noise.pose) * 1e3, np.degrees(np.sqrt(noise.tilt))
    notes = [f"noise beyond the centres' own: {beyond:.3f} mm per axis"]
    if model.found.evidence.has_normal.any():
        notes.append(f"noise beyond the normals' own: {tilt:.3f} deg per axis")
    return notes
