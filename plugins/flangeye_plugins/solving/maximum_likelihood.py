"""The default solver of every configuration but the flange's own: most likely, over SE(3)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from flangeye import Params, stage
from flangeye.catalogue import RobotModel
from flangeye.configuration import DEFAULT, Configuration
from flangeye.kinematics import Arm
from flangeye.statistics import covariance_inflation
from flangeye.types import HandEye, Observation, Observations
from flangeye.units import Angle, Length, param
from flangeye_plugins.solving.agreement import find_agreement
from flangeye_plugins.solving.degeneracy import Limits, require_enough, require_turns, unobservable
from flangeye_plugins.solving.estimates import (
    columns_of,
    estimate_at,
    hand_eye_of,
    pairs_of,
    points_of_interest,
    transforms_of,
)
from flangeye_plugins.solving.likelihood import Problem, Solution
from flangeye_plugins.solving.loop import ArmNoise, meaningless_turns
from flangeye_plugins.solving.sightings import loop_of, sightings_of
from flangeye_plugins.solving.target_size import require_size

Floats = NDArray[np.float64]


class RobotNoise(Params):
    """Noise of the poses an arm reports; of both arms where there are two."""

    rotation: Angle = param("0.01 deg", gt=0, description="Standard deviation about each axis.")
    position: Length = param("0.05 mm", gt=0, description="Standard deviation along each axis.")


class MaximumLikelihoodParams(Params):
    """Parameters of ``solve.maximum_likelihood``."""

    robot_noise: RobotNoise | None = Field(
        None,
        description="Noise of the poses the arm reports, where it is known; by default a typical "
        "arm's, and what noise the residuals show beyond that and the features' own.",
    )
    normals: Literal["auto", "off"] = Field(
        "auto", description="Use the circles' measured normals where there are any."
    )
    normal_bias: Angle = param(
        "0.05 deg", gt=0, description="Standard deviation of a tilt common to all normals."
    )
    rotation_limit: Angle = param(
        "2 deg", gt=0, description="A rotation known less well is not observable."
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


@stage("solve.maximum_likelihood")
def solve_maximum_likelihood(
    observations: Observations,
    params: MaximumLikelihoodParams,
    configuration: Configuration | None = None,
    robot: RobotModel | None = None,
) -> HandEye:
    """Find the most likely values of whatever the configuration leaves unknown.

    Takes whole poses, centres with normals, or centres alone, each with its covariance, and the
    noise of the arms' poses. Starts from a closed form; gross outliers are found by graduated
    non-convexity on truncated least squares (Yang et al. 2020) and set aside. Every unknown gets
    its covariance, about the place where the camera looks.

    Raises:
        StageError: Too few poses, all the same, those of a mirrored camera, or a carrier's pose
            is missing.
        CalibrationRefused: Fewer than half of the poses agree, the motion leaves something unknown:
            it says which motion is missing; or a marker has another size than its fit was told.
    """
    pulled, configuration = list(observations), configuration or DEFAULT
    arm = Arm(robot) if robot else None
    problem = _problem(pulled, configuration, arm, params)
    require_enough(problem)
    require_turns(problem)
    found = find_agreement(problem)
    limits = Limits(params.rotation_limit, params.translation_limit, params.unobservable == "mark")
    weak = unobservable(problem, found, limits)
    require_size(problem, found, params.size_limit)
    found = _without(found, weak)
    at = found.at
    transforms = transforms_of(configuration, at.x, at.y, at.z)
    points = points_of_interest(configuration, transforms, pulled, arm)
    covariance = found.covariance * covariance_inflation(found.freedom, found.basis.shape[1])
    arbitrary = np.hstack([weak, meaningless_turns(problem.sightings, problem.loop, at)])
    columns = {name: columns_of(name, configuration) for name in transforms}
    estimates = [
        estimate_at(
            transform,
            covariance[columns[name], columns[name]],
            points[name],
            arbitrary[columns[name]],
        )
        for name, transform in transforms.items()
    ]
    reasons = _reasons(found)
    pairs = pairs_of(configuration, transforms, pulled, arm, reasons)
    return hand_eye_of(estimates, pairs, "solve.maximum_likelihood", _notes(found, problem, weak))


def _problem(
    pulled: Sequence[Observation],
    configuration: Configuration,
    arm: Arm | None,
    params: MaximumLikelihoodParams,
) -> Problem:
    noise = params.robot_noise or RobotNoise()
    return Problem(
        sightings_of(pulled, configuration, arm, normals=params.normals == "auto"),
        loop_of(configuration),
        ArmNoise(noise.rotation, noise.position),
        params.normal_bias,
        stated=params.robot_noise is not None,
    )


def _without(found: Solution, weak: Floats) -> Solution:
    """Return the fit moved to where the camera has no part along unobservable moves."""
    if not weak.shape[1]:
        return found
    along = weak[3:6]
    steps = np.linalg.lstsq(along.T @ along, -along.T @ found.at.x[:3, 3], rcond=None)[0]
    # What is left of the basis is what the poses tell: the covariance is of that.
    kept = found.basis - weak @ (weak.T @ found.basis)
    u, sizes, _ = np.linalg.svd(kept, full_matrices=False)
    basis = u[:, sizes > 1e-6]
    change = np.linalg.pinv(found.basis) @ basis
    information = change.T @ found.information @ change
    return replace(found, at=found.at.moved(weak @ steps), basis=basis, information=information)


def _reasons(found: Solution) -> list[str | None]:
    distances = np.sqrt(found.squares)
    sizes = np.linalg.norm(found.linear.residuals[:, 3:], axis=1) * 1e3
    turns = np.degrees(np.linalg.norm(found.linear.residuals[:, :3], axis=1))
    return [
        None if kept else f"residual {mm:.1f} mm and {deg:.1f} deg, {distance:.0f} sigma"
        for kept, mm, deg, distance in zip(found.inliers, sizes, turns, distances, strict=True)
    ]


def _notes(found: Solution, problem: Problem, weak: Floats) -> list[str]:
    notes = []
    if not problem.stated:
        pose, tilt = np.sqrt(_beyond(found))
        told = f"{pose * 1e3:.3f} mm and {np.degrees(tilt):.3f} deg per axis"
        notes.append(f"noise beyond the features' own: {told}")
    if weak.shape[1]:
        notes.append(
            f"not observable from these poses, and set to zero: {weak.shape[1]} translation"
            f"{'s' if weak.shape[1] > 1 else ''} along which the arm's axes do not tilt"
        )
    return notes


def _beyond(found: Solution) -> tuple[float, float]:
    """Return the variances beyond the features' own, of position and of angle [m^2, rad^2]."""
    of_arms = np.diagonal(found.linear.of_arms, axis1=1, axis2=2).mean(axis=0) * found.noise.arms
    return (
        float(of_arms[3:].mean() + found.noise.pose),
        float(of_arms[:3].mean() + found.noise.tilt),
    )
