"""The closed forms as solvers of recipes: for comparison, and where speed is all."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from flangeye import CalibrationRefused, StageError
from flangeye.estimation.calibrate import Options, calibrate_at
from flangeye.estimation.closed.motions import Motions, motions_of, place_of
from flangeye.estimation.graph import Places, Problem
from flangeye.estimation.observability import fewest, require_enough, require_turns
from flangeye.estimation.sightings import problem_of
from flangeye.estimation.start import circle_of, start_of_circles
from flangeye.maths.geometry import invert
from flangeye.models.cell import Cell
from flangeye.models.scanners import ScannerModel
from flangeye.types import Floats, HandEye, Observation
from flangeye_plugins.solve.observations import LimitsParams

ClosedForm = Callable[[Problem], Places]
"""Gives (4, 4) of each unknown."""


class ClosedFormParams(LimitsParams):
    """Parameters of the closed forms."""


def solve_closed(
    method: str,
    solver: ClosedForm,
    given: tuple[Sequence[Observation], Cell, ScannerModel | None],
    params: ClosedFormParams,
) -> HandEye:
    """Return a closed form's calibration from all observations.

    Its covariance and expected error are those of the mixed model, at the closed form's answer.

    Args:
        method: Name of the stage.
        solver: The closed form.
        given: What was observed, where, and by which scanner.
        params: Limits of what counts as observable.

    Raises:
        StageError: Too few poses, or all the same.
        CalibrationRefused: The motion leaves something unknown: it says which motion is missing.
    """
    observations, cell, scanner = given
    problem = problem_of(observations, cell)
    require_enough(problem, fewest(problem))
    require_turns(problem)
    try:
        places = solver(problem)
    except np.linalg.LinAlgError:
        raise CalibrationRefused(f"{method}: its equations have no solution here") from None
    options = Options(params.limits)
    return calibrate_at(places, observations, cell, scanner, options, method)


def by_motions(method: Callable[[Motions], Floats]) -> ClosedForm:
    """Return AX = XB as a closed form: the other unknown is the mean over the poses."""

    def closed(problem: Problem) -> Places:
        carried, seen = _one_arm(problem)
        x = method(motions_of(carried, seen))
        return _placed(problem, x, place_of(carried, x, seen))

    return closed


def by_both(method: Callable[[Floats, Floats], tuple[Floats, Floats]]) -> ClosedForm:
    """Return AX = ZB as a closed form."""

    def closed(problem: Problem) -> Places:
        return _placed(problem, *method(*_one_arm(problem)))

    return closed


def by_three(
    method: Callable[[Floats, Floats, Floats], tuple[Floats, Floats, Floats]], needed: int
) -> ClosedForm:
    """Return AXB = YCZ as a closed form that needs so many poses."""

    def closed(problem: Problem) -> Places:
        if len(problem.unknown) != 3 or not (problem.seen.ranks == 6).all():
            raise StageError(
                "AXB = YCZ has three unknowns: it needs two arms, a marker, and place: unknown"
            )
        if len(problem.seen) < needed:
            raise StageError(f"{needed} poses needed, {len(problem.seen)} given")
        _, known = circle_of(problem)
        x, y, z = method(known[2], known[0], invert(known[1]))
        return _named(problem, [x, invert(z), invert(y)])

    return closed


def linear(problem: Problem) -> Places:
    """Return the unknowns of circles by linear least squares."""
    if (problem.seen.ranks == 6).all():
        raise StageError("takes circles, and there are whole poses: use solve.park_martin")
    return start_of_circles(problem)


def _one_arm(problem: Problem) -> tuple[Floats, Floats]:
    """Return ``G`` and ``M`` of ``G X M`` that is the same at every pose, both (N, 4, 4).

    Raises:
        StageError: The measurements are no whole poses, or the unknowns are others.
    """
    if not (problem.seen.ranks == 6).all():
        raise StageError(
            "needs whole poses of a marker, and there are circles: use solve.linear or solve.robust"
        )
    if len(problem.unknown) != 2:
        count = {1: "one", 3: "three"}.get(len(problem.unknown), str(len(problem.unknown)))
        raise StageError(
            f"has two unknowns, and the configuration leaves {count}: write place: unknown for a "
            "marker on or before one arm, or use solve.robust"
        )
    _, known = circle_of(problem)
    return known[1], known[0]


def _placed(problem: Problem, x: Floats, other: Floats) -> Places:
    return _named(problem, [x, invert(other)])


def _named(problem: Problem, found: Sequence[Floats]) -> Places:
    names, _ = circle_of(problem)
    return {
        name: invert(place) if back else place
        for (name, back), place in zip(names, found, strict=True)
    }
