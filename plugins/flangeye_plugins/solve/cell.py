"""``solve.cell``: several cameras, arms, rails and targets, all at once."""

from __future__ import annotations

from flangeye import Params, stage
from flangeye.handeye.cell import calibrate_cell
from flangeye.models.cell import Cell
from flangeye.models.configuration import CELL
from flangeye.types import HandEye, Observations
from flangeye.units import Angle, Length, param


class CellParams(Params):
    """Parameters of ``solve.cell``."""

    rotation_limit: Angle = param(
        "2 deg", gt=0, description="Refuse when a rotation has a larger standard deviation."
    )
    translation_limit: Length = param(
        "20 mm", gt=0, description="Refuse when a place has a larger standard deviation."
    )


@stage("solve.cell", serves=(CELL,))
def solve_cell(observations: Observations, cell: Cell, params: CellParams) -> HandEye:
    """Find every place that the recipe's cell leaves unknown, from all sightings at once.

    Takes whole poses, centres with normals, or centres alone, of any target by any camera, each
    with its covariance. The noise of what moves is found from the residuals; sightings beyond it
    are set aside with their residual. Needs no first guess.

    Raises:
        StageError: No sighting, or one without the pose of something that moves.
        CalibrationRefused: The sightings leave something unknown (it says what), or fewer than half
            of them agree.
    """
    limits = params.rotation_limit, params.translation_limit
    return calibrate_cell(list(observations), cell, limits, "solve.cell")
