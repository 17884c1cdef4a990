"""``solve.maximum_likelihood``: the former name of ``solve.robust`` for whole configurations."""

from __future__ import annotations

from dataclasses import replace

from flangeye import stage
from flangeye.models.configuration import EVERY, Configuration
from flangeye.models.robots import RobotModel
from flangeye.models.scanners import ScannerModel
from flangeye.types import HandEye, Observations
from flangeye_plugins.solve.robust import RobustParams, solve_poses

NAME = "solve.maximum_likelihood"
RENAMED = f"{NAME} is now solve.robust, for every configuration: this name goes with version 0.3"


class MaximumLikelihoodParams(RobustParams):
    """Parameters of ``solve.maximum_likelihood``: those of ``solve.robust``."""


@stage(NAME, serves=EVERY)
def solve_maximum_likelihood(
    observations: Observations,
    params: MaximumLikelihoodParams,
    configuration: Configuration | None = None,
    robot: RobotModel | None = None,
    scanner: ScannerModel | None = None,
) -> HandEye:
    """Do what ``solve.robust`` does: the former name of it for whole configurations.

    Raises:
        StageError: As ``solve.robust``.
        CalibrationRefused: As ``solve.robust``.
    """
    found = solve_poses(list(observations), params, robot, configuration, NAME, scanner)
    return replace(found, notes=(*found.notes, RENAMED))
