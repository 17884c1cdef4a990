"""``solve.cell``: several cameras, arms, rails and targets, all at once."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from flangeye import Params, stage
from flangeye.handeye.cell import calibrate_cell, solve_so_far
from flangeye.handeye.cell_plan import errors_at_work, is_foretold
from flangeye.models.cell import Cell
from flangeye.models.configuration import CELL
from flangeye.types import HandEye, Observation, Observations, Progress, StageLog
from flangeye.units import Angle, Length, param

CONFIRMED = 3
"""Sightings in a row that were foretold, before an online run may stop."""


class CellParams(Params):
    """Parameters of ``solve.cell``."""

    rotation_limit: Angle = param(
        "2 deg", gt=0, description="Refuse when a rotation has a larger standard deviation."
    )
    translation_limit: Length = param(
        "20 mm", gt=0, description="Refuse when a position has a larger standard deviation."
    )
    joint_offsets: Literal["auto", "off"] = Field(
        "auto",
        description="Estimate the offsets of the arms' joints too, if that helps on sightings held "
        "out: the result then has a second answer, for arms with these offsets corrected.",
    )
    certify: bool = Field(
        False,
        description="Say whether the answer is certified as globally optimal, by a dual "
        "certificate, or not; where that leads to a better answer, that is given.",
    )
    required: Length | None = param(
        None,
        gt=0,
        description="Stop acquiring once nothing that is to be found is off by more at its work, "
        "with 95 % probability, and the last sightings lay where they were foretold; what joint "
        "zeros may be off by is not counted, for no sighting lessens it. By default every sighting "
        "is used.",
    )

    @property
    def limits(self) -> tuple[float, float]:
        """Of a rotation [rad] and of a translation [m]."""
        return self.rotation_limit, self.translation_limit


@stage("solve.cell", serves=(CELL,))
def solve_cell(
    observations: Observations, cell: Cell, params: CellParams, stage_log: StageLog | None = None
) -> HandEye:
    """Estimate every unknown transform of the recipe's cell from all sightings at once.

    Takes whole poses, centres with normals, or centres alone, of any target by any camera, each
    with its covariance. The noise of what moves is found from the residuals; sightings beyond it
    are set aside with their residual. Needs no first guess. Where the zeros of the arms' joints
    explain sightings held out, there is a second answer: for the arms with these corrected.

    Raises:
        StageError: No sighting, or one without the pose of something that moves.
        CalibrationRefused: The sightings leave something unknown (it says what), or fewer than half
            of them agree.
    """
    if params.required is None or observations.whole:
        pulled = list(observations)
    else:
        pulled = _pull(observations, cell, params, params.required, stage_log)
    corrects, certify = params.joint_offsets == "auto", params.certify
    return calibrate_cell(pulled, cell, params.limits, "solve.cell", corrects, certify)


def _pull(
    observations: Observations,
    cell: Cell,
    params: CellParams,
    required: float,
    stage_log: StageLog | None,
) -> list[Observation]:
    """Take sightings until nothing is off by more than ``required`` [m] at its work.

    Each is first held against what those before it foretell: it verifies them at no cost.
    """
    pulled: list[Observation] = []
    foretold, found = 0, None
    for observation in observations:
        if found is not None:
            foretold = foretold + 1 if is_foretold(observation, found, cell) else 0
        pulled.append(observation)
        found = solve_so_far(pulled, cell, params.limits, found)
        error = None if found is None else max(errors_at_work(found, cell, pulled).values())
        if stage_log:
            stage_log("progress", Progress(len(pulled), error, required))
        if error is not None and error <= required and foretold >= CONFIRMED:
            break
    return pulled
