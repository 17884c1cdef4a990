"""One stage for each closed-form method of the literature, for comparison and for speed."""

from collections.abc import Callable, Sequence

import numpy as np

from flangeye import CalibrationRefused, StageError, stage
from flangeye.estimation.calibrate import Options, calibrate_at
from flangeye.estimation.graph import Places, Problem
from flangeye.estimation.observability import fewest_sightings, require_enough, require_turns
from flangeye.estimation.start.closed import Motions, motions_of, park_martin, place_of, shah
from flangeye.estimation.start.loops import by_name, loop_of, start_of_circles
from flangeye.estimation.start.sightings import problem_of
from flangeye.models.cell import Cell, cell_of
from flangeye.models.configuration import DEFAULT, EVERY, Configuration
from flangeye.models.robots import RobotModel, SecondRobot
from flangeye.models.scanners import ScannerModel
from flangeye.plugin.stage import Stage
from flangeye.types import Floats, HandEye, Observation, Observations
from flangeye.types.geometry import invert
from flangeye_plugins.solve.literature import (
    FEWEST_KRONECKER,
    andreff,
    daniilidis,
    horaud_dornaika,
    kronecker,
    li,
    tsai_lenz,
    two_steps,
)
from flangeye_plugins.solve.observations import LimitsParams

ClosedForm = Callable[[Problem], Places]
"""Gives (4, 4) of each unknown."""


class ClosedFormParams(LimitsParams):
    """Parameters of the closed-form methods."""


def solve_closed(
    method: str,
    solver: ClosedForm,
    given: tuple[Sequence[Observation], Cell, ScannerModel | None],
    params: ClosedFormParams,
) -> HandEye:
    """Return a closed-form method's calibration from all observations.

    Covariance and expected error are those of the mixed model, evaluated at the closed-form result.

    Args:
        method: Name of the stage.
        solver: The closed-form method.
        given: Observations, cell and scanner.
        params: Limits of observability.

    Raises:
        StageError: There are too few poses, or all are the same.
        CalibrationRefused: An unknown is not observable; the message names the missing motion.
    """
    observations, cell, scanner = given
    problem = problem_of(observations, cell)
    require_enough(problem, fewest_sightings(problem))
    require_turns(problem)
    try:
        places = solver(problem)
    except np.linalg.LinAlgError:  # as where all turns are about one axis
        raise CalibrationRefused(
            f"{method}: its equations have no solution here", "turn the arm about two axes at least"
        ) from None
    # A closed form has no noise model: the covariance of its answer is from the mixed model
    options = Options(params.limits)
    return calibrate_at(places, observations, cell, scanner, options, method)


def by_motions(method: Callable[[Motions], Floats]) -> ClosedForm:
    """Return a method for AX = XB as a closed form; the other unknown is a mean over poses."""

    def closed(problem: Problem) -> Places:
        carried, seen = _one_arm(problem)
        # Equation (2) of the paper, or (4) at two poses: the target's place drops out
        x = method(motions_of(carried, seen))
        return _placed(problem, x, place_of(carried, x, seen))

    return closed


def by_both(method: Callable[[Floats, Floats], tuple[Floats, Floats]]) -> ClosedForm:
    """Return a method for AX = ZB as a closed form."""

    def closed(problem: Problem) -> Places:
        return _placed(problem, *method(*_one_arm(problem)))

    return closed


def by_three(
    method: Callable[[Floats, Floats, Floats], tuple[Floats, Floats, Floats]], needed: int
) -> ClosedForm:
    """Return a method for AXB = YCZ as a closed form that needs ``needed`` poses."""

    def closed(problem: Problem) -> Places:
        if len(problem.unknown) != 3 or not (problem.seen.ranks == 6).all():
            raise StageError(
                "AXB = YCZ has three unknowns: it needs two arms, a marker, and place: unknown"
            )
        if len(problem.seen) < needed:
            raise StageError(f"{needed} poses needed, {len(problem.seen)} given")
        # Equation (5) of the paper: X K0 Z^-1 K1 Y^-1 K2 = 1 round the circle is A X B = Y C Z with
        # A = K2, B = K0 and C = K1^-1
        names, known = loop_of(problem)
        x, y, z = method(known[2], known[0], invert(known[1]))
        return by_name(names, [x, invert(z), invert(y)])

    return closed


def linear(problem: Problem) -> Places:
    """Return the unknowns for circles by linear least squares."""
    if (problem.seen.ranks == 6).all():
        raise StageError("takes circles, but the features are poses: use solve.park_martin")
    return start_of_circles(problem)


def _one_arm(problem: Problem) -> tuple[Floats, Floats]:
    """Return ``G`` and ``M`` (N, 4, 4) such that ``G X M`` is the same at every pose.

    Raises:
        StageError: The measurements are not full poses, or the unknowns do not have this form.
    """
    if not (problem.seen.ranks == 6).all():
        raise StageError(
            "needs a marker's full poses, but these are circles: use solve.linear or solve.robust"
        )
    if len(problem.unknown) != 2:
        count = {1: "one", 3: "three"}.get(len(problem.unknown), str(len(problem.unknown)))
        raise StageError(
            f"has two unknowns, and the configuration leaves {count}: write place: unknown for a "
            "marker on or in front of one arm, or use solve.robust"
        )
    # Round the circle X M Z^-1 G = 1, with the carriers' pose G after the target's place
    _, known = loop_of(problem)
    return known[1], known[0]


def _placed(problem: Problem, x: Floats, other: Floats) -> Places:
    names, _ = loop_of(problem)
    return by_name(names, [x, invert(other)])


def _named(name: str, solver: ClosedForm, documentation: str) -> Stage:
    def solve(
        observations: Observations,
        params: ClosedFormParams,
        configuration: Configuration | None = None,
        robot: RobotModel | None = None,
        scanner: ScannerModel | None = None,
        second: SecondRobot | None = None,
    ) -> HandEye:
        seen, other = list(observations), second.model if second else None
        cell = cell_of(configuration or DEFAULT, robot, other)
        try:
            return solve_closed(name, solver, (seen, cell, scanner), params)
        except StageError as error:
            raise StageError(f"{name}: {error}") from None

    solve.__doc__ = documentation
    return stage(name, serves=EVERY)(solve)


CLOSED_FORMS = (
    _named(
        "solve.tsai_lenz",
        by_motions(tsai_lenz),
        "AX = XB by Tsai & Lenz (1989): rotation by the tangent of half its angle.",
    ),
    _named(
        "solve.park_martin",
        by_motions(park_martin),
        "AX = XB by Park & Martin (1994): rotation vectors onto each other.",
    ),
    _named(
        "solve.horaud_dornaika",
        by_motions(horaud_dornaika),
        "AX = XB by Horaud & Dornaika (1995): the unit quaternion.",
    ),
    _named(
        "solve.andreff",
        by_motions(andreff),
        "AX = XB by Andreff, Horaud & Espiau (1999): linear, with Kronecker products.",
    ),
    _named(
        "solve.daniilidis",
        by_motions(daniilidis),
        "AX = XB by Daniilidis (1999): rotation and translation at once, by dual quaternions.",
    ),
    _named(
        "solve.shah",
        by_both(shah),
        "AX = ZB by Shah (2013): both rotations by singular vectors, then both translations.",
    ),
    _named(
        "solve.li",
        by_both(li),
        "AX = ZB by Li, Wang & Wu (2010): one linear system for both transforms.",
    ),
    _named(
        "solve.kronecker",
        by_three(kronecker, FEWEST_KRONECKER),
        "AXB = YCZ of two arms, linear in products of the rotations' entries; 12 poses or more.",
    ),
    _named(
        "solve.two_steps",
        by_three(two_steps, needed=6),
        "AXB = YCZ of two arms by the paper's (6): one rests while the other moves.",
    ),
    _named(
        "solve.linear",
        linear,
        "Circles in any configuration, by linear least squares: no noise model, no outliers.",
    ),
)
"""The stages."""
