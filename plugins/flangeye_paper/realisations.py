"""Repeat the solve step on newly drawn noise; and the cost of section 3.1, which uses the truth."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from pydantic import Field

from flangeye import CalibrationRefused, Params, StageError, part, stage
from flangeye.maths.statistics import rms
from flangeye.models.targets import Flange
from flangeye.types import (
    Floats,
    HandEye,
    Observation,
    Observations,
    PoseError,
    Solver,
    Transform,
    Verification,
    Views,
)
from flangeye.types.geometry import kabsch, rigid, rpy_from_rotation
from flangeye_paper.points import (
    BASE_T_CAMERA,
    WORKSPACE,
    PointSource,
    Realisation,
    bound,
    errors_of,
    observations_of,
    rms_over_workspace,
)


class RealisationsParams(Params):
    """Parameters of ``verify.realisations``."""

    count: int = Field(100, ge=2, le=100_000)
    """Number of realisations of poses and noise."""


@dataclass(frozen=True, eq=False)
class RealisationOutcome:
    """Result of one realisation.

    Attributes:
        error: (6,) x, y, z [m], roll, pitch, yaw [rad] in ``camera``, at its origin.
        at_centre: (3,) displacement at the workspace's centre, in ``camera`` [m].
        rms: Rms error over the workspace [m].
        alone: Error of least squares on the poses that are not outliers [m].
        bound: Cramér-Rao, see :func:`bound`.
    """

    error: Floats
    at_centre: Floats
    rms: float
    alone: float
    bound: dict[str, float]


@stage("verify.realisations")
def verify_realisations(
    calibration: HandEye,
    solve: Solver,
    params: RealisationsParams,
    observations: Observations | None = None,
) -> Verification:
    """Repeat acquire.points_as_in_paper and the solve step, and compare with the truth.

    One session per realisation would spend nine tenths of its time on logs and reports. The step
    measures and does not judge: every run passes.

    Figures [m, rad]: ``x_std``, ``x_mean`` and so on for x, y, z, roll, pitch, yaw at the camera's
    origin, as the paper prints them; ``centre_x_std``, ... at the workspace's centre;
    ``workspace_rms`` over the workspace; ``inliers_alone_rms`` of least squares on the poses that
    are not outliers; ``bound_x``, ..., ``bound_workspace_rms`` (Cramér-Rao); ``realisations`` and
    how many of them were ``refused``.

    Raises:
        StageError: The observations are not from acquire.points_as_in_paper.
    """
    source = None if observations is None else observations.source
    if not isinstance(source, PointSource):
        raise StageError("verify.realisations works only with acquire.points_as_in_paper")
    outcomes = list(_outcomes(source, solve, params.count))
    if not outcomes:
        return Verification(False, f"all {params.count} realisations were refused", {})
    figures = _figures(outcomes, params.count)
    return Verification(True, _summary(figures), figures)


def _outcomes(source: PointSource, solve: Solver, count: int) -> Iterator[RealisationOutcome]:
    for index in range(count):
        drawn = source.draw(index)
        try:
            found = solve(list(observations_of(drawn, source)))
        except CalibrationRefused:
            continue
        yield outcome_of(found.base_T_camera.transform.matrix, drawn, source.noise)


def outcome_of(base_T_camera: Floats, drawn: Realisation, noise: float) -> RealisationOutcome:
    """Return the errors of an estimate."""
    error, good = errors_of(base_T_camera), ~drawn.gross
    at = BASE_T_CAMERA[:3, :3].T @ (WORKSPACE.centre - BASE_T_CAMERA[:3, 3])
    alone = rigid(*kabsch(drawn.centres[good], drawn.tcps[good]))
    return RealisationOutcome(
        error=np.array([*error[:3, 3], *rpy_from_rotation(error[:3, :3])]),
        at_centre=error[:3, :3] @ at + error[:3, 3] - at,
        rms=rms_over_workspace(base_T_camera, WORKSPACE.grid()),
        alone=rms_over_workspace(alone, WORKSPACE.grid()),
        bound=bound(drawn.tcps[good], noise, WORKSPACE.grid()),
    )


def _figures(outcomes: list[RealisationOutcome], asked: int) -> dict[str, float]:
    errors = np.array([o.error for o in outcomes])
    centre = np.array([o.at_centre for o in outcomes])
    bounds = {name: rms([o.bound[name] for o in outcomes]) for name in outcomes[0].bound}
    axes = ("x", "y", "z", "roll", "pitch", "yaw")
    return {
        **{f"{axis}_std": float(errors[:, i].std()) for i, axis in enumerate(axes)},
        **{f"{axis}_mean": float(errors[:, i].mean()) for i, axis in enumerate(axes)},
        **{f"centre_{axis}_std": float(centre[:, i].std()) for i, axis in enumerate("xyz")},
        "workspace_rms": rms([o.rms for o in outcomes]),
        "inliers_alone_rms": rms([o.alone for o in outcomes]),
        **{f"bound_{name}": value for name, value in bounds.items()},
        "realisations": float(len(outcomes)),
        "refused": float(asked - len(outcomes)),
    }


def _summary(figures: dict[str, float]) -> str:
    return (
        f"{figures['workspace_rms'] * 1e3:.3f} mm rms over the workspace in "
        f"{figures['realisations']:.0f} realisations; no estimate is better than "
        f"{figures['bound_workspace_rms'] * 1e3:.3f} mm"
    )


@part("error.oracle_as_in_paper")
def error_oracle(
    base_T_camera: Transform, kept: Sequence[Observation], views: Views, flange: Flange | None
) -> PoseError:
    """The error of a candidate against the simulation's truth (17): the cost in section 3.1.

    It emulates the paper and is no method: the paper writes ``e = H^ H_true`` for the error that
    Algorithm 1 minimises in simulation, so the algorithm selects poses by the answer. In a real
    cell the truth is unknown.
    """
    at = BASE_T_CAMERA[:3, :3].T @ (WORKSPACE.centre - BASE_T_CAMERA[:3, 3])
    return PoseError(errors_of(base_T_camera.matrix), at, base_T_camera.rotation)
