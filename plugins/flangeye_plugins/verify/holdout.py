"""Errors on poses that took no part: the step's own solver is run again without them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from pydantic import Field

from flangeye import CalibrationRefused, Params, StageError, stage
from flangeye.maths.geometry import angle_between, covariance_at
from flangeye.models.cell import Cell
from flangeye.models.configuration import (
    CELL,
    DEFAULT,
    EVERY,
    Configuration,
    Layout,
    mapped_and_expected,
)
from flangeye.models.robots import RobotModel
from flangeye.types import (
    Box,
    Floats,
    HandEye,
    Indices,
    Mask,
    Observation,
    Observations,
    Seed,
    Solver,
    Source,
    Verification,
)
from flangeye.units import Angle, Length, param

if TYPE_CHECKING:
    from flangeye.maths.kinematics import Arm


class HoldoutParams(Params):
    """Parameters of ``verify.holdout``."""

    folds: int = Field(5, ge=2, description="Number of folds; each is held out once.")
    max_rms: Length = param("1 mm", gt=0, description="Largest held-out error that passes, rms.")
    max_tilt: Angle = param(
        "2 deg",
        gt=0,
        description="Largest held-out angle between measured and expected faces that passes, rms. "
        "Positions alone can fit while every angle was read wrongly.",
    )
    max_outliers: float = Field(
        0.3, ge=0, lt=1, description="Largest share of poses the solver may set aside as wrong."
    )
    gate: float = Field(
        0.99,
        gt=0.5,
        lt=1,
        description="Probability that a good pose the solver set aside is not confirmed as wrong.",
    )


@dataclass(frozen=True)
class HeldOut:
    """Errors of the poses, each from a calibration that did not know it.

    Attributes:
        errors: (N, 3) mapped centre minus the flange's, as the calibration corrects it [m].
        covariances: (N, 3, 3) known of each error: the centre's and the calibration's [m^2].
        tilts: (N,) angle between mapped and reported flange normal [rad], NaN without a normal.
    """

    errors: Floats
    covariances: Floats
    tilts: Floats


@stage("verify.holdout", serves=(*EVERY, CELL))
def verify_holdout(  # noqa: PLR0913  what it asks the runner for
    calibration: HandEye,
    solve: Solver,
    params: HoldoutParams,
    workspace: Box | None = None,
    observations: Observations | None = None,
    robot: RobotModel | None = None,
    configuration: Configuration | None = None,
    cell: Cell | None = None,
    seed: Seed = Seed(0),  # noqa: B008  a NewType is the int itself
) -> Verification:
    """k-fold cross-validation over poses: solve without each fold and measure the error on it.

    ``rms``, ``median``, ``p95`` and ``max`` are over all poses, of the pose for the arm as its
    controller reports it. Poses that the solver itself set aside and whose held-out error lies
    beyond the gate are counted as ``outliers``; ``rms_inliers`` is without them, and what the limit
    is held against. A solver that sets nothing aside answers for every pose. Where an error of the
    arm was found, ``corrected_rms``, ``corrected_rms_inliers``, ``corrected_median`` and
    ``corrected_p95`` are those of the pose and the arm so corrected.

    Figures [m, rad]: these, ``folds``, ``limit``, ``poses``, ``tilt_rms`` where normals were
    measured, and ``predicted_worst_p95``: with 95 % probability no point of the workspace is off by
    more.
    """
    from flangeye.maths.kinematics import Arm

    poses = [pair.observation for pair in calibration.pairs]
    folds = (
        deal_moments(poses, params.folds, seed) if cell else deal(len(poses), params.folds, seed)
    )
    try:
        solved = solve_without(poses, solve, folds)
    except (StageError, CalibrationRefused) as error:
        return Verification(
            False, f"without one fold of {len(folds)} there is no answer: {error}", {}
        )
    given = cell or configuration or DEFAULT, Arm(robot) if robot else None
    held = hold_out(poses, folds, [each.as_reported() for each in solved], given)
    whole = held
    if calibration.as_corrected():
        whole = hold_out(
            poses, folds, [each.as_corrected() or each.as_reported() for each in solved], given
        )
    outlying = _beyond_gate(whole, params.gate) & ~np.array([p.used for p in calibration.pairs])
    source = None if observations is None else observations.source
    figures = {
        "folds": float(len(folds)),
        "limit": params.max_rms,
        **_figures(held, outlying),
        **(_corrected_figures(whole, outlying) if whole is not held else {}),
        "predicted_worst_p95": _predicted_worst_p95(calibration, workspace, source),
    }
    passed, reason = _judge(figures, params)
    norms = np.linalg.norm(held.errors, axis=1)
    errors = {o.id: float(norm) for o, norm in zip(poses, norms, strict=True)}
    return Verification(passed, reason, figures, errors)


def deal(count: int, folds: int, seed: int) -> list[Indices]:
    """Return the indices of each fold: shuffled once, then dealt round; none is empty.

    Shuffled, because grids are recorded in raster order and whole planes would fall together.
    """
    order = np.random.default_rng(seed).permutation(count)
    folds = min(folds, count)
    return [np.sort(order[fold::folds]) for fold in range(folds)]


def deal_moments(observations: Sequence[Observation], folds: int, seed: int) -> list[Indices]:
    """Return the indices of each fold; what cameras saw of the same poses falls in one.

    Else the error of a pose that one camera saw would be known from what the other saw.
    """
    moments: dict[bytes, list[int]] = {}
    for i, o in enumerate(observations):
        poses = [o.poses[name].matrix for name in sorted(o.poses)]
        moments.setdefault(np.array(poses).tobytes(), []).append(i)
    groups = list(moments.values())
    dealt = deal(len(groups), folds, seed)
    return [np.sort(np.concatenate([groups[k] for k in fold])) for fold in dealt]


def solve_without(
    observations: Sequence[Observation], solve: Solver, folds: Sequence[Indices]
) -> list[HandEye]:
    """Return the calibration without each fold.

    Raises:
        StageError: The rest of some fold cannot be solved.
        CalibrationRefused: The rest of some fold gives no trustworthy answer.
    """
    kept = [np.setdiff1d(np.arange(len(observations)), fold) for fold in folds]
    return [solve([observations[i] for i in rest]) for rest in kept]


def hold_out(
    observations: Sequence[Observation],
    folds: Sequence[Indices],
    solved: Sequence[HandEye],
    given: tuple[Layout, Arm | None],
) -> HeldOut:
    """Measure each fold by the calibration without it."""
    n = len(observations)
    held = HeldOut(np.zeros((n, 3)), np.zeros((n, 3, 3)), np.full(n, np.nan))
    layout, arm = given
    for fold, calibration in zip(folds, solved, strict=True):
        if not layout.is_default:
            _measure_loop(calibration, observations, fold, given, held)
            continue
        for i in fold:
            expected = expected_flange(calibration, observations[i], arm)
            _measure(calibration, observations[i], expected, held, int(i))
    return held


def _measure_loop(
    calibration: HandEye,
    observations: Sequence[Observation],
    fold: Indices,
    given: tuple[Layout, Arm | None],
    held: HeldOut,
) -> None:
    """Measure a fold of any layout: where the camera says the target is, and the arms."""
    layout, arm = given
    poses = layout.corrected([observations[i] for i in fold], calibration, arm)
    transforms = {name: x.transform for name, x in calibration.transforms.items()}
    ends = layout.ends(transforms, poses, arm)
    mapped, expected = mapped_and_expected(ends, poses)
    turns, axes = ends.camera[:, :3, :3], ends.target[:, :3, 2]
    held.errors[fold] = mapped - expected
    for i, pose, turn, axis in zip(fold, poses, turns, axes, strict=True):
        held.covariances[i] = turn @ pose.feature.centre_covariance @ turn.T
        if pose.feature.normal is not None:
            held.tilts[i] = angle_between(turn @ pose.feature.normal, axis)


def expected_flange(calibration: HandEye, observation: Observation, arm: Arm | None) -> Floats:
    """Return the (4, 4) pose a calibration expects the flange at: as reported, or corrected."""
    from flangeye.maths.arm_correction import corrected_flange

    reported = observation.base_T_flange.matrix
    return corrected_flange(reported, observation.joints, calibration.correction, arm)


def _measure(
    calibration: HandEye, observation: Observation, expected: Floats, held: HeldOut, i: int
) -> None:
    estimate = calibration.base_T_camera
    rotation, seen = estimate.transform.rotation, observation.feature
    mapped = estimate.transform.apply(seen.centre)
    held.errors[i] = mapped - (expected[:3, :3] @ observation.centre_in_mount + expected[:3, 3])
    of_pose = covariance_at(calibration.scatter_covariance, estimate.about, mapped[None])[0]
    held.covariances[i] = rotation @ seen.centre_covariance @ rotation.T + of_pose
    if seen.normal is not None:
        held.tilts[i] = angle_between(rotation @ seen.normal, expected[:3, 2])


def _beyond_gate(held: HeldOut, probability: float) -> Mask:
    from flangeye.maths.statistics import chi2_quantile, excess_variance, squared_distances

    excess = excess_variance(held.errors, held.covariances)
    covariances = held.covariances + max(excess, 1e-18) * np.eye(3)
    distances = squared_distances(held.errors, covariances)
    return np.asarray(distances > chi2_quantile(probability, 3))


def _figures(held: HeldOut, outlying: Mask) -> dict[str, float]:
    from flangeye.maths.statistics import rms

    norms = np.linalg.norm(held.errors, axis=1)
    tilts = held.tilts[~outlying & np.isfinite(held.tilts)]
    figures = {
        "poses": float(len(norms)),
        "outliers": float(outlying.sum()),
        "rms": rms(norms),
        "median": float(np.median(norms)),
        "p95": float(np.quantile(norms, 0.95)),
        "max": float(norms.max()),
        "rms_inliers": rms(norms[~outlying]),
    }
    return {**figures, "tilt_rms": rms(tilts)} if len(tilts) else figures


def _corrected_figures(held: HeldOut, outlying: Mask) -> dict[str, float]:
    found = _figures(held, outlying)
    return {f"corrected_{name}": found[name] for name in ("rms", "median", "p95", "rms_inliers")}


def _predicted_worst_p95(
    calibration: HandEye, workspace: Box | None, source: Source | None
) -> float:
    from flangeye.maths.statistics import corners_of, largest_error_quantile
    from flangeye.models.workspace import work_of

    estimate = calibration.camera
    box = work_of(calibration, source or Source(""), workspace)
    corners = corners_of(box.centre, box.size) if box else estimate.about[None]
    return largest_error_quantile(estimate.covariance, estimate.about, corners)


def _judge(figures: dict[str, float], params: HoldoutParams) -> tuple[bool, str]:
    outliers, poses = int(figures["outliers"]), int(figures["poses"])
    if outliers > params.max_outliers * poses:
        return False, (
            f"{outliers} of {poses} poses are outliers, limit {params.max_outliers:.0%}: "
            "look at the scans the solver set aside"
        )
    inliers, of_all = figures["rms_inliers"], figures["rms"]
    passed = inliers <= params.max_rms
    told = f"held-out error {of_all * 1e3:.3f} mm rms"
    if outliers:
        told += f" over all {poses} poses, {inliers * 1e3:.3f} mm without {outliers} set aside"
    sign = "within" if passed else "above"
    tilt = figures.get("tilt_rms", 0.0)
    if passed and tilt > params.max_tilt:
        return False, (
            f"the measured orientations are off by {np.degrees(tilt):.1f} deg rms on poses held "
            f"out, limit {np.degrees(params.max_tilt):g} deg, while positions fit to "
            f"{inliers * 1e3:.3f} mm: the angles were read wrongly; 'flangeye doctor' tries other "
            "conventions"
        )
    return passed, f"{told}, {sign} the limit of {params.max_rms * 1e3:g} mm"
