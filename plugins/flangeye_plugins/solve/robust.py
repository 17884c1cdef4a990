"""``solve.robust``: calibrate any configuration or cell by one linear mixed model."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Literal

from pydantic import Field

from flangeye import FlangeyeError, stage
from flangeye.models.cell import Cell, cell_of
from flangeye.models.configuration import CELL, DEFAULT, EVERY, Configuration
from flangeye.models.robots import RobotModel, SecondRobot
from flangeye.models.scanners import ScannerModel
from flangeye.types import Box, HandEye, Observation, Observations, Progress, Solver, StageLog
from flangeye.units import Length, param
from flangeye_plugins.solve.observations import LimitsParams

if TYPE_CHECKING:
    from flangeye.estimation.calibrate import Options


class RobustParams(LimitsParams):
    """Parameters of ``solve.robust``."""

    normals: Literal["auto", "off"] = "auto"
    """Use the flange's measured normals where there are any."""
    unobservable: Literal["refuse", "mark"] = "refuse"
    """What to do about translations that are not observable, such as the height with an arm of four
    joints: refuse, or solve for the rest and mark them."""
    size_limit: float = Field(0.005, gt=0)
    """Largest relative error of a marker's size, as estimated from the arm's motion; beyond it the
    calibration is refused."""
    target_size: Literal["known", "unknown"] = "known"
    """Whether the fit step states a marker's size, or all its distances have one unknown factor, as
    those of a single moving camera; the arm's motion then determines it."""
    certify: bool = False
    """Try to certify the answer as globally optimal, by a dual certificate; if that finds a better
    answer, it is given."""
    required: Length | None = param(None, gt=0)
    """Stop acquiring once the predicted 95 % error at the work is below this. By default every pose
    is used."""

    @property
    def corrects_arm(self) -> bool:
        """Whether the arm's errors may be estimated; read by steps that need the corrected arm."""
        return True


@stage("solve.robust", serves=(*EVERY, CELL))
def solve_robust(  # noqa: PLR0913  what it asks the runner for
    observations: Observations,
    params: RobustParams,
    workspace: Box | None = None,
    robot: RobotModel | None = None,
    stage_log: StageLog | None = None,
    configuration: Configuration | None = None,
    cell: Cell | None = None,
    scanner: ScannerModel | None = None,
    second: SecondRobot | None = None,
) -> HandEye:
    """Estimate all unknown transforms, with random effects for errors of arms, targets and sensors.

    Observations may be full poses, centres with normals, or centres alone, each with its
    covariance, of any number of cameras and targets. No initial guess is needed. An observation is
    an outlier if the model, fitted to all others with all error effects, does not predict it; it is
    left out and reported with its residual.

    The result is the best one for the arms as their controllers report them, with the expected
    error at the work. If correcting the arms improves it enough, there is a second result for the
    corrected arms.

    Raises:
        StageError: There are too few poses, all are the same, the camera is mirrored, or a
            carrier's pose is missing.
        CalibrationRefused: Fewer than half of the poses agree, an unknown is not observable (the
            message names the missing motion), or a marker's size differs from the configured one.
    """
    standing = cell or cell_of(configuration or DEFAULT, robot, second.model if second else None)

    def solve(pulled: Sequence[Observation]) -> HandEye:
        return solve_cell(pulled, standing, params, scanner, workspace)

    # With everything recorded already there is nothing to save by stopping early
    if params.required is None or observations.whole:
        return solve(list(observations))
    return solve(pull(observations, solve, params.required, stage_log))


def solve_cell(
    pulled: Sequence[Observation],
    cell: Cell,
    params: RobustParams,
    scanner: ScannerModel | None = None,
    workspace: Box | None = None,
) -> HandEye:
    """Return the calibration from a complete list of observations; see :func:`solve_robust`."""
    from flangeye.estimation.calibrate import calibrate

    return calibrate(pulled, cell, scanner, _options(params, workspace), "solve.robust")


def _options(params: RobustParams, workspace: Box | None) -> Options:
    from flangeye.estimation.calibrate import Options
    from flangeye.estimation.session.session import ModelOptions

    return Options(
        params.limits,
        params.unobservable == "mark",
        params.certify,
        workspace,
        ModelOptions(params.normals == "auto", params.target_size == "unknown", params.size_limit),
    )


def pull(
    observations: Observations,
    solve: Solver,
    required: float,
    stage_log: StageLog | None = None,
) -> list[Observation]:
    """Return observations, read until the predicted 95 % error at the work is low enough."""
    pulled: list[Observation] = []
    for observation in observations:
        pulled.append(observation)
        # Poses before an online run may stop: fewer leave the noise too uncertain.
        if len(pulled) < 6:
            continue
        # Solved anew from all poses so far: outliers among the first may show only now
        error = _expected(pulled, solve)
        if stage_log:
            stage_log("progress", Progress(len(pulled), error, required))
        if error is not None and error <= required:
            break
    return pulled


def _expected(pulled: Sequence[Observation], solve: Solver) -> float | None:
    """Return the 95 % quantile of the predicted error at the work [m]; None if unknown."""
    try:
        expected = solve(pulled).expected
    except FlangeyeError:
        return None
    return expected.p95 if expected else None
