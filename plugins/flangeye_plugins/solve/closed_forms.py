"""The closed forms as solvers of recipes: for comparison, and where speed is all."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from flangeye import CalibrationRefused, Params, StageError
from flangeye.handeye.closed.motions import Motions, motions_of, place_of
from flangeye.handeye.components import Noise
from flangeye.handeye.estimates import (
    columns_of,
    estimate_at,
    hand_eye_of,
    pairs_of,
    points_of_interest,
    transforms_of,
)
from flangeye.handeye.likelihood import weigh, with_noise
from flangeye.handeye.loop import LoopProblem, meaningless_turns
from flangeye.handeye.measurements import Loop, Measurements, loop_of, measurements_of
from flangeye.handeye.observability import (
    ObservabilityLimits,
    require_enough,
    require_turns,
    unobservable,
)
from flangeye.handeye.unknowns import Unknowns
from flangeye.maths.geometry import invert, rotation_exp, rotation_log
from flangeye.maths.kinematics import Arm
from flangeye.maths.statistics import covariance_inflation
from flangeye.models.configuration import DEFAULT, Configuration
from flangeye.types import Floats, HandEye, Observation
from flangeye.units import Angle, Length, param

ClosedForm = Callable[[Measurements, Loop], tuple[Floats, Floats, Floats]]
"""Gives X, Y and Z (4, 4)."""

STEP = 1e-6
"""Of the numerical derivatives [rad, m]."""


class ClosedFormParams(Params):
    """Parameters of the closed forms."""

    rotation_limit: Angle = param(
        "2 deg", gt=0, description="A rotation known less well is not observable."
    )
    translation_limit: Length = param(
        "20 mm", gt=0, description="A translation known less well is not observable."
    )


def solve_closed(
    method: str,
    solver: ClosedForm,
    pulled: Sequence[Observation],
    params: ClosedFormParams,
    cell: tuple[Configuration | None, Arm | None],
) -> HandEye:
    """Return a closed form's calibration; every observation takes part.

    Its covariance is the noise that the residuals show, taken through the closed form itself by
    numerical derivatives.

    Args:
        method: Name of the stage.
        solver: The closed form.
        pulled: The observations.
        params: Limits of what counts as observable.
        cell: The configuration, and the arm's kinematics where there are any.

    Raises:
        StageError: Too few poses, or all the same.
        CalibrationRefused: The motion leaves something unknown: it says which motion is missing.
    """
    configuration, arm = cell[0] or DEFAULT, cell[1]
    loop, measurements = loop_of(configuration), measurements_of(pulled, configuration, arm)
    problem = LoopProblem(measurements=measurements, loop=loop, arms=None)
    require_enough(problem)
    require_turns(problem)
    try:
        values = solver(measurements, loop)
    except np.linalg.LinAlgError:
        raise CalibrationRefused(f"{method}: its equations have no solution here") from None
    at, everyone = Unknowns.of_loop(*values), np.ones(len(pulled))
    found = with_noise(problem, weigh(problem, at, Noise(0.0, 0.0), everyone), refit=False)
    unobservable(
        problem, found, ObservabilityLimits(params.rotation_limit, params.translation_limit, False)
    )
    covariance = _propagated(solver, measurements, loop, found.weights)
    covariance *= covariance_inflation(found.freedom, found.basis.shape[1])
    transforms = transforms_of(configuration, *values)
    points = points_of_interest(configuration, transforms, pulled, arm)
    arbitrary = meaningless_turns(measurements, loop, at)
    at_columns = {name: columns_of(name, configuration) for name in transforms}
    estimates = [
        estimate_at(
            t, covariance[at_columns[n], at_columns[n]], points[n], arbitrary[at_columns[n]]
        )
        for n, t in transforms.items()
    ]
    pairs = pairs_of(configuration, transforms, pulled, arm, [None] * len(pulled))
    return hand_eye_of(estimates, pairs, method)


def _propagated(solver: ClosedForm, s: Measurements, loop: Loop, weights: Floats) -> Floats:
    """Return the (18, 18) covariance of X, Y, Z by the noise of every measurement."""
    nominal = solver(s, loop)
    noise = np.linalg.pinv(weights, rcond=1e-12, hermitian=True)
    out = np.zeros((18, 18))
    for i in range(len(s)):
        moved = [solver(_disturbed(s, i, step), loop) for step in STEP * np.eye(6)]
        slope = np.array([_moves(nominal, values) for values in moved]).T / STEP
        out += slope @ noise[i] @ slope.T
    return out


def _disturbed(s: Measurements, i: int, step: Floats) -> Measurements:
    rotations, centres = s.rotations.copy(), s.centres.copy()
    rotations[i] = rotation_exp(step[:3]) @ rotations[i]
    centres[i] += step[3:]
    return replace(s, rotations=rotations, centres=centres)


def _moves(before: Sequence[Floats], after: Sequence[Floats]) -> Floats:
    """Return the (18,) rotations and translations from some values to others."""
    first, second = np.array(before), np.array(after)
    turns = rotation_log(second[:, :3, :3] @ np.swapaxes(first[:, :3, :3], 1, 2))
    return np.concatenate([turns, second[:, :3, 3] - first[:, :3, 3]], axis=1).ravel()


def by_motions(method: Callable[[Motions], Floats]) -> ClosedForm:
    """Return AX = XB as a closed form: the other unknown is the mean over the poses."""

    def closed(s: Measurements, loop: Loop) -> tuple[Floats, Floats, Floats]:
        carried, seen = one_arm(s, loop)
        x = method(motions_of(carried, seen))
        return _placed(x, place_of(carried, x, seen), loop)

    return closed


def by_both(method: Callable[[Floats, Floats], tuple[Floats, Floats]]) -> ClosedForm:
    """Return AX = ZB as a closed form."""

    def closed(s: Measurements, loop: Loop) -> tuple[Floats, Floats, Floats]:
        return _placed(*method(*one_arm(s, loop)), loop)

    return closed


def by_three(
    method: Callable[[Floats, Floats, Floats], tuple[Floats, Floats, Floats]], needed: int
) -> ClosedForm:
    """Return AXB = YCZ as a closed form that needs so many poses."""

    def closed(s: Measurements, loop: Loop) -> tuple[Floats, Floats, Floats]:
        if not (loop.y and loop.z and s.are_poses):
            raise StageError(
                "AXB = YCZ has three unknowns: it needs two arms, a marker, and place: unknown"
            )
        if len(s) < needed:
            raise StageError(f"{needed} poses needed, {len(s)} given")
        return method(s.a, s.poses, s.b)

    return closed


def one_arm(s: Measurements, loop: Loop) -> tuple[Floats, Floats]:
    """Return ``G`` and ``M`` of ``G X M`` that is the same at every pose, both (N, 4, 4).

    It is the target's place, or the second arm's base where it is that one's known place.

    Raises:
        StageError: The measurements are no whole poses, or the unknowns are others.
    """
    if not s.are_poses:
        raise StageError(
            "needs whole poses of a marker, and there are circles: use solve.linear or "
            "solve.maximum_likelihood"
        )
    if loop.y == loop.z:
        other = "one" if not loop.y else "three"
        raise StageError(
            f"has two unknowns, and the configuration leaves {other}: write place: unknown for a "
            "marker on or before one arm, or use solve.maximum_likelihood"
        )
    if loop.y:
        return s.a, s.poses @ invert(s.b @ loop.place)
    return invert(s.b) @ s.a, s.poses


def _placed(x: Floats, other: Floats, loop: Loop) -> tuple[Floats, Floats, Floats]:
    return (x, other, loop.place) if loop.y else (x, np.eye(4), other)
