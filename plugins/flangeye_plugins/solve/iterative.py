"""``solve.iterative``: the paper's Algorithm 1, which improves a small pool of poses one by one."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import islice
from typing import Annotated, ClassVar

import numpy as np
from pydantic import Field

from flangeye import BoundPart, CalibrationRefused, Choose, Params, stage
from flangeye.estimation.observability import spread_of
from flangeye.maths.statistics import covariance_inflation
from flangeye.models.targets import Flange
from flangeye.types import (
    BASE,
    CAMERA,
    HandEye,
    Observation,
    Observations,
    PoseError,
    Transform,
    TransformEstimate,
    Views,
)
from flangeye.types.geometry import kabsch, rigid
from flangeye.units import Length, param
from flangeye_plugins.solve.observations import (
    centres_of,
    estimate_of,
    hand_eye,
    noise_of,
    require_poses,
    residuals_of,
    tcps_of,
)


class IterativeParams(Params):
    """Parameters of ``solve.iterative``."""

    pool: int = Field(4, ge=3, le=1000)
    """Number of poses in the pool."""
    required: Length = param("0.3 mm", ge=0)
    """Stop acquiring once the cost is this small."""
    # Largest number of poses tried after the initial pool
    k_max: ClassVar[int] = 100
    reserve: int = Field(0, ge=0)
    """First poses kept from the pool, for error.holdout to measure on."""
    error: Annotated[BoundPart, Choose("error")] = param({"icp": {}})
    """Measure of a candidate's error."""
    cost: Annotated[BoundPart, Choose("cost")] = param({"translation": {}})
    """Cost of that error, to be minimised."""


Evaluate = Callable[[Transform], float]
"""The cost [m] of a candidate ``base_T_camera``; infinite when it cannot be measured."""


@dataclass
class SearchState:
    """The state of the search.

    Attributes:
        pool: Poses of the best result so far, the oldest first.
        cost: Cost of that result [m]; infinite until one could be measured.
        history: Cost after the first pool and after each further pose.
        losers: Reason why a pose is not in the pool, by pose id.
    """

    pool: list[Observation]
    cost: float
    history: list[float] = field(default_factory=list)
    losers: dict[str, str] = field(default_factory=dict)


@stage("solve.iterative")
def solve_iterative(
    observations: Observations,
    views: Views | None,
    flange: Flange | None,
    params: IterativeParams,
) -> HandEye:
    """Keep a pool of poses; each new pose replaces the one whose removal reduces the cost most.

    This is the paper's Algorithm 1 with its errors corrected: k is incremented; a pose enters the
    pool only once; while no pool can be measured (infinite cost) the oldest pose is replaced. The
    stage stops reading observations, and so the arm stops, once the cost is below the required one.

    The pool is selected by its cost on the verification data, so this cost is no estimate of the
    error elsewhere; ``verify.holdout`` gives one. The covariance is that of the pool's poses, with
    the noise estimated from all poses.

    Raises:
        StageError: There are fewer poses than the pool needs, or no verification data.
        CalibrationRefused: No pool could be measured.
    """
    # Pulling an observation drives a live arm to its next pose: none is pulled ahead of need
    stream = iter(observations)
    kept = list(islice(stream, params.reserve))
    first = list(islice(stream, params.pool))
    require_poses(len(kept) + len(first), params.reserve + params.pool)

    def measure(base_T_camera: Transform) -> PoseError | None:
        found: PoseError | None = params.error(base_T_camera, kept, views or Views(), flange)
        return found

    def evaluate(base_T_camera: Transform) -> float:
        error = measure(base_T_camera)
        return float("inf") if error is None else float(params.cost(error))

    search = improve_pool(first, stream, evaluate, params.required, params.k_max)
    _require_finite(search, len(observations.seen))
    answer, notes = solve_pool(search.pool), [_stopped(search, params)]
    losers = {**search.losers, **{o.id: "kept out of the pool to measure the error" for o in kept}}
    estimate = _with_covariance(answer, search.pool, observations.seen)
    return hand_eye(observations.seen, estimate, "solve.iterative", losers, notes)


def improve_pool(
    first: Sequence[Observation],
    stream: Iterator[Observation],
    evaluate: Evaluate,
    required: float,
    k_max: int,
) -> SearchState:
    """Run Algorithm 1 from a first pool; read ``stream`` only while the cost is too high."""
    search = SearchState(list(first), _cost(first, evaluate))
    search.history.append(search.cost)
    # Lines 4 and 5; k, which is never advanced as printed, is the length of the history
    while search.cost > required and len(search.history) <= k_max:
        newcomer = next(stream, None)
        if newcomer is None:
            break
        _try(newcomer, search, evaluate)
        search.history.append(search.cost)
    return search


def _try(newcomer: Observation, search: SearchState, evaluate: Evaluate) -> None:
    """Replace the pose whose exchange for the newcomer reduces the cost most (lines 6 to 15)."""
    # The newcomer in place of each pose in turn: N candidate pools
    pools = [[*search.pool[:i], *search.pool[i + 1 :], newcomer] for i in range(len(search.pool))]
    costs = [_cost(pool, evaluate) for pool in pools]
    best = int(np.argmin(costs))
    # While nothing can be measured all costs are infinite and `best` is 0, the oldest: replacing it
    # anyway leads out of a pool that no view suits
    if costs[best] < search.cost or np.isinf(search.cost):
        change = f"{_mm(search.cost)} became {_mm(costs[best])}"
        search.losers[search.pool[best].id] = f"replaced in the pool by {newcomer.id}: {change}"
        search.pool, search.cost = pools[best], costs[best]
    else:
        search.losers[newcomer.id] = (
            f"did not improve the pool: {_mm(costs[best])} at best instead of {_mm(search.cost)}"
        )


def _cost(pool: Sequence[Observation], evaluate: Evaluate) -> float:
    """Return the cost of a pool's result; infinite for collinear poses, which have none."""
    # The rotation about a line through all centres [m] is free: the SVD would return any
    in_line = spread_of(tcps_of(pool)).width < 1e-3
    return float("inf") if in_line else evaluate(solve_pool(pool))


def solve_pool(pool: Sequence[Observation]) -> Transform:
    """Return ``base_T_camera`` from a pool by equations (8) to (10)."""
    # A rigid registration of camera points to base points is base_T_camera itself.
    return Transform(BASE, CAMERA, rigid(*kabsch(centres_of(pool), tcps_of(pool))))


def _require_finite(search: SearchState, seen: int) -> None:
    if not np.isfinite(search.cost):
        raise CalibrationRefused(
            f"no pool of {len(search.pool)} out of {seen} poses gives a finite error",
            "check the verification view and the flange's model, or set error: holdout",
        )


def _stopped(search: SearchState, params: IterativeParams) -> str:
    tried = len(search.history) - 1
    if search.cost <= params.required:
        why = "as required"
    elif tried >= params.k_max:
        why = f"k_max reached before the required {_mm(params.required)}"
    else:
        why = f"no more poses before the required {_mm(params.required)}"
    return f"cost {_mm(search.cost)} after {tried} poses beyond the first pool: {why}"


def _with_covariance(
    answer: Transform, pool: Sequence[Observation], seen: Sequence[Observation]
) -> TransformEstimate:
    # A pool of four leaves six degrees of freedom, and was chosen for small residuals: the noise is
    # taken from all poses seen, by a median, which a few bad ones do not move
    residuals = residuals_of(seen, answer.rotation, answer.translation)
    inflation = covariance_inflation(max(3 * len(seen) - 6, 3))
    sigma = noise_of(residuals) * float(np.sqrt(inflation))
    return estimate_of(answer.rotation, answer.translation, tcps_of(pool), sigma)


def _mm(metres: float) -> str:
    return f"{metres * 1e3:.3f} mm" if np.isfinite(metres) else "infinity"
