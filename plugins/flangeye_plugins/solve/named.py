"""One stage for each closed form of the literature."""

from __future__ import annotations

from flangeye import StageError, stage
from flangeye.estimation.closed.at_once import daniilidis, li, shah
from flangeye.estimation.closed.comanipulation import (
    FEWEST_KRONECKER,
    kronecker,
    two_steps,
)
from flangeye.estimation.closed.separable import (
    andreff,
    horaud_dornaika,
    park_martin,
    tsai_lenz,
)
from flangeye.models.cell import cell_of
from flangeye.models.configuration import DEFAULT, EVERY, Configuration
from flangeye.models.robots import RobotModel, SecondRobot
from flangeye.models.scanners import ScannerModel
from flangeye.plugin.stage import Stage
from flangeye.types import HandEye, Observations
from flangeye_plugins.solve.closed_forms import (
    ClosedForm,
    ClosedFormParams,
    by_both,
    by_motions,
    by_three,
    linear,
    solve_closed,
)


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
