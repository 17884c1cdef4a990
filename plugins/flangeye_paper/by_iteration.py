"""``verify.algorithm_1_by_iteration``: what Algorithm 1 would have said after each pose."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated

import numpy as np
from pydantic import Field

from flangeye import BoundPart, Choose, Params, stage
from flangeye.models.targets import Flange
from flangeye.types import HandEye, Observation, PoseError, Transform, Verification, Views
from flangeye.units import param
from flangeye_paper.icp_as_in_paper import figures_of
from flangeye_plugins.solve.iterative import Search, improve_pool, solve_pool
from flangeye_plugins.solve.observations import residuals_of


class ByIterationParams(Params):
    """Parameters of ``verify.algorithm_1_by_iteration``: those of ``solve.iterative``."""

    pool: int = Field(4, ge=3, description="Number of poses in the pool.")
    error: Annotated[BoundPart, Choose("error")] = param(
        {"icp_as_in_paper": {}}, description="Measure of a candidate's error."
    )
    cost: Annotated[BoundPart, Choose("cost")] = param(
        {"translation": {"at": "camera"}}, description="Cost of that error, to be minimised."
    )


@stage("verify.algorithm_1_by_iteration")
def verify_by_iteration(
    calibration: HandEye, views: Views | None, flange: Flange | None, params: ByIterationParams
) -> Verification:
    """Run Algorithm 1 over the calibration's poses in order and report its error by pose.

    It measures and does not judge: every run passes. The calibration itself stays as it is.

    Figures [m, rad]: ``x_05``, ``yaw_05``, ... the measured error once five poses have been seen,
    in ``camera`` at its origin; ``x``, ..., ``yaw`` after the last; ``others_rms``: residual of
    the last answer on the poses outside its pool, which its cost never saw.
    """
    poses = [pair.observation for pair in calibration.pairs]
    measured: dict[float, PoseError] = {}

    def evaluate(candidate: Transform) -> float:
        error = params.error(candidate, [], views or Views(), flange)
        if error is None:
            return float("inf")
        cost = float(params.cost(error))
        measured[cost] = error
        return cost

    first, rest = poses[: params.pool], iter(poses[params.pool :])
    search = improve_pool(first, rest, evaluate, required=0.0, k_max=len(poses))
    figures = _figures(search, measured, len(first))
    figures["others_rms"] = _rms_outside(search, poses)
    last = search.cost * 1e3
    return Verification(True, f"Algorithm 1 ends at a cost of {last:.3f} mm", figures)


def _figures(search: Search, measured: dict[float, PoseError], first: int) -> dict[str, float]:
    """Return the error after each pose; poses before the first finite cost have none."""
    figures: dict[str, float] = {}
    for seen, cost in enumerate(search.history, first):
        if np.isfinite(cost):
            figures |= {f"{k}_{seen:02d}": v for k, v in figures_of(measured[cost]).items()}
    return figures | (figures_of(measured[search.cost]) if np.isfinite(search.cost) else {})


def _rms_outside(search: Search, poses: Sequence[Observation]) -> float:
    inside = {o.id for o in search.pool}
    answer = solve_pool(search.pool)
    others = [o for o in poses if o.id not in inside]
    residuals = residuals_of(others, answer.rotation, answer.translation)
    return float(np.sqrt((residuals**2).sum(axis=1).mean()))
