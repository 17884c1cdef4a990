"""The closed forms as solvers of recipes: for comparison, and where speed is all."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from flangeye import CalibrationRefused, Params, StageError
from flangeye.handeye.arm_errors import are_unknown, note_of_errors, with_arm_errors
from flangeye.handeye.calibration import (
    TYPICAL_ARM,
    distortion_seen,
    note_of_distortion,
    note_of_unknown_arm,
)
from flangeye.handeye.candidates import Model, considered
from flangeye.handeye.closed.motions import Motions, motions_of, place_of
from flangeye.handeye.components import Noise
from flangeye.handeye.consensus import Consensus
from flangeye.handeye.estimates import (
    columns_of,
    estimate_at,
    hand_eye_of,
    pairs_of,
    points_of_interest,
    transforms_of,
)
from flangeye.handeye.likelihood import Solution, weigh, with_noise
from flangeye.handeye.loop import LoopProblem, meaningless_turns
from flangeye.handeye.measurements import Loop, Measurements, loop_of, measurements_of
from flangeye.handeye.observability import (
    ObservabilityLimits,
    require_enough,
    require_turns,
    unobservable,
)
from flangeye.handeye.observed import Cell
from flangeye.handeye.unknowns import Unknowns
from flangeye.maths.geometry import invert
from flangeye.maths.statistics import covariance_inflation
from flangeye.types import Floats, HandEye
from flangeye.units import Angle, Length, param

ClosedForm = Callable[[Measurements, Loop], tuple[Floats, Floats, Floats]]
"""Gives X, Y and Z (4, 4)."""


class ClosedFormParams(Params):
    """Parameters of the closed forms."""

    rotation_limit: Angle = param(
        "2 deg", gt=0, description="A rotation known less well is not observable."
    )
    translation_limit: Length = param(
        "20 mm", gt=0, description="A translation known less well is not observable."
    )


def solve_closed(method: str, solver: ClosedForm, cell: Cell, params: ClosedFormParams) -> HandEye:
    """Return a closed form's calibration; every observation takes part.

    Its covariance is about the closed form's answer, and holds what the likeliest one is away from
    it: the noise that residuals show, and where arm and scanner are known what these do wrong.

    Args:
        method: Name of the stage.
        solver: The closed form.
        cell: What was observed.
        params: Limits of what counts as observable.

    Raises:
        StageError: Too few poses, or all the same.
        CalibrationRefused: The motion leaves something unknown: it says which motion is missing.
    """
    configuration, arm, pulled = cell.configuration, cell.arm, cell.observations
    loop, measurements = loop_of(configuration), measurements_of(pulled, configuration, arm)
    typical = TYPICAL_ARM if loop.y or loop.z or measurements.are_poses else None
    problem = LoopProblem(measurements=measurements, loop=loop, arms=typical)
    require_enough(problem)
    require_turns(problem)
    try:
        values = solver(measurements, loop)
    except np.linalg.LinAlgError:
        raise CalibrationRefused(f"{method}: its equations have no solution here") from None
    at = Unknowns.of_loop(*values)
    found = _weighed(problem, at)
    unobservable(
        problem, found, ObservabilityLimits(params.rotation_limit, params.translation_limit, False)
    )
    covariance, notes = _stated(problem, found, cell)
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
    return replace(hand_eye_of(estimates, pairs, method), notes=notes)


def _weighed(problem: LoopProblem, at: Unknowns) -> Solution:
    """Return an answer weighed by the noise that the likeliest one near it leaves."""
    everyone = np.ones(len(problem.measurements))
    likeliest = with_noise(problem, weigh(problem, at, Noise(0.0, 0.0), everyone))
    return replace(weigh(problem, at, likeliest.noise, everyone), freedom=likeliest.freedom)


def _stated(problem: LoopProblem, found: Solution, cell: Cell) -> tuple[Floats, tuple[str, ...]]:
    """Return the (18, 18) covariance of X, Y, Z about an answer, and what is to be said of it."""
    model = Model(Consensus(problem, found))
    covariance, notes = _by_arms(model, cell)
    distortion = distortion_seen(model, cell)
    if cell.scanner is None or distortion is None:
        return covariance, notes
    return covariance + considered(model, distortion), (*notes, note_of_distortion(cell.scanner))


def _by_arms(model: Model, cell: Cell) -> tuple[Floats, tuple[str, ...]]:
    """Return the same with what the arms do wrong, if they are known, and with noise."""
    found = model.found
    inflation = covariance_inflation(found.freedom, found.basis.shape[1])
    if cell.arms and not are_unknown(cell.arms):
        covariance, sizes = with_arm_errors(model, cell.arms, inflation)
        return covariance, (note_of_errors(cell.arms, sizes),)
    notes = (note_of_unknown_arm(cell),) if cell.arms else ()
    to_likeliest = found.basis[:18] @ found.known @ found.slope
    off = np.outer(to_likeliest, to_likeliest)
    return inflation * found.covariance[:18, :18] + off, notes


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
