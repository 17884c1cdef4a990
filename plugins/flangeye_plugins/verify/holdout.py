"""``verify.holdout``: error of a calibration on poses that were not used for it."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from pydantic import Field

from flangeye import CalibrationRefused, Params, StageError, stage
from flangeye.estimation.session.readings import Pairs, Reading, likely, other_axes
from flangeye.models.cell import Cell, cell_of
from flangeye.models.configuration import CELL, DEFAULT, EVERY, Configuration, mapped_and_expected
from flangeye.models.robots import RobotModel, SecondRobot
from flangeye.types import (
    FLANGE,
    Feature,
    Floats,
    HandEye,
    Indices,
    Mask,
    Observation,
    PoseFeature,
    Seed,
    Solver,
    Verification,
)
from flangeye.types.geometry import angle_between, invert, rotation_log
from flangeye.units import Length, param


class HoldoutParams(Params):
    """Parameters of ``verify.holdout``."""

    folds: int = Field(5, ge=2)
    """Number of folds; each is held out once."""
    max_rms: Length = param("1 mm", gt=0)
    """Largest held-out error that passes, rms."""
    optical: bool = True
    """Whether markers are seen in a camera's own frame, z forward."""
    # Largest held-out angle between measured and expected faces that passes, rms. Positions alone
    # can fit while every angle was read wrongly [rad]
    max_tilt: ClassVar[float] = float(np.radians(2))
    # Largest share of poses the solver may set aside as wrong
    max_outliers: ClassVar[float] = 0.3


@dataclass(frozen=True)
class HeldOut:
    """Errors of all poses, each by a calibration without that pose.

    Attributes:
        errors: (N, 3) measured centre mapped by the calibration, minus the arm's centre [m].
        tilts: (N,) angle between measured and expected orientation [rad]: of a full pose, or of a
            face's normal; NaN for a centre alone.
    """

    errors: Floats
    tilts: Floats


@stage("verify.holdout", serves=(*EVERY, CELL))
def verify_holdout(  # noqa: PLR0913  what it asks the runner for
    calibration: HandEye,
    solve: Solver,
    params: HoldoutParams,
    robot: RobotModel | None = None,
    configuration: Configuration | None = None,
    cell: Cell | None = None,
    second: SecondRobot | None = None,
    seed: Seed = Seed(0),  # noqa: B008  a NewType is the int itself
) -> Verification:
    """Cross-validate the calibration over k folds of poses.

    Each fold's error is that of the calibration without the fold. A solver that can remove poses
    from its result is used directly; any other solves the remaining poses again.

    ``rms``, ``median``, ``p95`` and ``max`` are over all poses except outliers, for the arm as its
    controller reports it; ``rms_inliers`` equals ``rms``, and ``rms_all`` is over all poses.
    ``outliers`` is the number of poses that the solver did not use and whose error exceeds the
    limit. ``corrected_rms``, ``corrected_median`` and ``corrected_p95`` are for the corrected arm,
    if the solver gave a result for it.

    The figures [m, rad] are these, ``folds``, ``limit``, ``poses``, and ``tilt_rms`` if
    orientations were measured.
    """
    poses = [pair.observation for pair in calibration.pairs]
    deals = (
        deal_moments(poses, params.folds, seed) if cell else deal(len(poses), params.folds, seed)
    )
    try:
        solved = solve_without(calibration, solve, deals)
    except (StageError, CalibrationRefused) as error:
        why = f"the calibration without one of {len(deals)} folds fails: {error.wrong}"
        return Verification(False, why, {}, advice=error.advice)
    standing = cell or cell_of(configuration or DEFAULT, robot, second.model if second else None)
    used = np.array([pair.used for pair in calibration.pairs])
    held = hold_out(poses, deals, [each.as_reported() for each in solved], standing)
    norms = np.linalg.norm(held.errors, axis=1)
    # A pose that the solver set aside but predicts well is no outlier: counting it keeps the error
    # honest.
    counted = used | (norms <= params.max_rms)
    figures = {"folds": float(len(deals)), "limit": params.max_rms, **_figures(held, counted)}
    # The same folds and the same poses, so that both answers can be compared.
    if calibration.as_corrected():
        answers = [each.as_corrected() or each.as_reported() for each in solved]
        corrected = _figures(hold_out(poses, deals, answers, standing), counted)
        figures |= {f"corrected_{name}": corrected[name] for name in ("rms", "median", "p95")}
    passed, reason, advice = _judge(figures, params)
    misread = _misread(calibration, standing, params.optical) if passed else None
    if misread:
        passed, (reason, advice) = False, misread
    errors = {o.id: float(norm) for o, norm in zip(poses, norms, strict=True)}
    units = dict.fromkeys(figures, "m") | dict.fromkeys(("folds", "poses", "outliers"), "")
    units |= {"tilt_rms": "rad"}
    return Verification(passed, reason, figures, errors, advice, units)


def deal(count: int, folds: int, seed: int) -> list[Indices]:
    """Return the indices of each fold: shuffled, then dealt in turn; no fold is empty.

    Without shuffling, poses recorded on a grid would put whole planes into one fold.
    """
    order = np.random.default_rng(seed).permutation(count)
    folds = min(folds, count)
    # Dealt like cards: folds differ by one pose at most.
    return [np.sort(order[fold::folds]) for fold in range(folds)]


def deal_moments(observations: Sequence[Observation], folds: int, seed: int) -> list[Indices]:
    """Return the indices of each fold; all observations of one moment are in the same fold.

    Otherwise another camera's observation of the same arm pose would make the test dependent.
    """
    moments: dict[bytes, list[int]] = {}
    for i, o in enumerate(observations):
        poses = [o.poses[name].matrix for name in sorted(o.poses)]
        # Equal to the last bit: observations of one moment carry the same reported poses.
        moments.setdefault(np.array(poses).tobytes(), []).append(i)
    groups = list(moments.values())
    dealt = deal(len(groups), folds, seed)
    return [np.sort(np.concatenate([groups[k] for k in fold])) for fold in dealt]


def solve_without(calibration: HandEye, solve: Solver, folds: Sequence[Indices]) -> list[HandEye]:
    """Return the calibration without each fold.

    Raises:
        StageError: The poses outside a fold cannot be solved.
        CalibrationRefused: The poses outside a fold give no acceptable result.
    """
    poses = [pair.observation for pair in calibration.pairs]
    # Removing poses in closed form keeps the estimated variances, and costs no new search.
    if without := calibration.without or solve(poses).without:  # a log does not hold it
        return [without(fold) for fold in folds]
    kept = [np.setdiff1d(np.arange(len(poses)), fold) for fold in folds]
    return [solve([poses[i] for i in rest]) for rest in kept]


def hold_out(
    observations: Sequence[Observation],
    folds: Sequence[Indices],
    solved: Sequence[HandEye],
    cell: Cell,
) -> HeldOut:
    """Return the errors of each fold by the calibration without it."""
    n = len(observations)
    held = HeldOut(np.zeros((n, 3)), np.full(n, np.nan))
    for fold, calibration in zip(folds, solved, strict=True):
        poses = cell.corrected([observations[i] for i in fold], calibration)
        transforms = {name: x.transform for name, x in calibration.transforms.items()}
        ends = cell.ends(transforms, poses)
        mapped, expected = mapped_and_expected(ends, poses)
        held.errors[fold] = mapped - expected
        # Expected camera_R_target
        turns = invert(ends.camera)[:, :3, :3] @ ends.target[:, :3, :3]
        held.tilts[fold] = _tilts([o.feature for o in poses], turns)
    return held


def _tilts(features: Sequence[Feature], turns: Floats) -> Floats:
    """Return the angles (N,) between features' orientations and expected ones (N, 3, 3) [rad]."""
    whole = np.array([isinstance(each, PoseFeature) for each in features])
    out, nothing = np.empty(len(features)), np.full(3, np.nan)
    seen = [each.camera_T_target.rotation for each in features if isinstance(each, PoseFeature)]
    off = np.reshape(seen, (-1, 3, 3)) @ np.swapaxes(turns[whole], 1, 2)
    out[whole] = np.linalg.norm(rotation_log(off), axis=1)
    axes = [
        nothing if each.normal is None else each.normal
        for each in features
        if not isinstance(each, PoseFeature)
    ]
    # A circle has no orientation about its normal, so the normals are compared.
    out[~whole] = angle_between(np.reshape(axes, (-1, 3)), turns[~whole, :, 2])
    return out


def _figures(held: HeldOut, counted: Mask) -> dict[str, float]:
    from flangeye.maths.statistics import rms

    every = np.linalg.norm(held.errors, axis=1)
    norms, tilts = every[counted], held.tilts[counted & np.isfinite(held.tilts)]
    figures = {
        "poses": float(len(every)),
        "outliers": float((~counted).sum()),
        "rms": rms(norms),
        "rms_inliers": rms(norms),
        "rms_all": rms(every),
        "median": float(np.median(norms)),
        "p95": float(np.quantile(norms, 0.95)),
        "max": float(norms.max()),
    }
    return {**figures, "tilt_rms": rms(tilts)} if len(tilts) else figures


def _misread(calibration: HandEye, cell: Cell, optical: bool) -> tuple[str, str] | None:
    """Return a more plausible interpretation of arm and marker poses, and what to do about it."""
    seen = [o for pair in calibration.pairs if pair.used for o in [pair.observation]]
    shown = [o.feature.camera_T_target for o in seen if isinstance(o.feature, PoseFeature)]
    if (
        len(shown) < len(seen)
        or len(cell.unknown_frames) != 2
        or len(cell.movers) != 1
        or cell.links
    ):
        return None
    found = {x.transform.parent: x.transform for x in calibration.transforms.values()}
    if len(found) != 2 or FLANGE not in found:
        return None
    carried = found.pop(FLANGE)
    ((_, standing),) = found.items()
    markers = np.array([each.matrix for each in shown])
    pairs = Pairs(
        np.array([o.poses[FLANGE].matrix for o in seen]), markers, carried.child == cell.cameras[0]
    )
    near, far = (float(np.linalg.norm(each.translation)) for each in (carried, standing))
    readings = likely(pairs, near, far, next(iter(cell.arms.values()), None))
    # Inverted poses fit exactly as well as right ones, so no residual shows them: only the
    # distances of camera and target from what carries them do.
    if Reading() not in readings:
        return (
            f"as the poses are read, {carried.child} is {near:.2f} m from the flange, and "
            f"{standing.child} {far:.2f} m from the base; the poses fit as well, at more usual "
            f"distances, if {readings[0].mistake(pairs.in_hand)}",
            "measure one of the two distances: if it is right, state the target's place "
            "(configuration: {place: …}); the origin of visual odometry may be anywhere, so its "
            "distances decide nothing",
        )
    axes = other_axes(markers[:, :3, 3]) if optical else None
    side = {"opengl": "behind", "ros": "beside"}
    return axes and (
        f"all targets are {side[axes]} the camera: z of its frame is not forward",
        "if that is intended, write verify.holdout: {optical: false}",
    )


def _judge(figures: dict[str, float], params: HoldoutParams) -> tuple[bool, str, str]:
    """Return whether the calibration passed, why, and the next step if one is known."""
    outliers, poses = int(figures["outliers"]), int(figures["poses"])
    # Before the error: with most poses set aside the rest may well agree, on a wrong answer.
    if outliers > params.max_outliers * poses:
        told = f"{outliers} of {poses} poses are outliers, limit {params.max_outliers:.0%}"
        return False, told, "look at the scans the solver set aside"
    passed, tilt = figures["rms"] <= params.max_rms, figures.get("tilt_rms", 0.0)
    aside = f" ({outliers} of {poses} poses set aside)" if outliers else ""
    sign = "within" if passed else "above"
    told = f"held-out error {figures['rms'] * 1e3:.3f} mm rms"
    # Positions alone can fit with orientations read in a wrong convention.
    if passed and tilt > params.max_tilt:
        told = (
            f"the measured orientations are off by {np.degrees(tilt):.1f} deg rms on poses held "
            f"out, limit {np.degrees(params.max_tilt):g} deg, while positions fit to "
            f"{figures['rms'] * 1e3:.3f} mm: the angles were read wrongly"
        )
        return False, told, "'flangeye doctor' tries other conventions"
    return passed, f"{told}{aside}, {sign} the limit of {params.max_rms * 1e3:g} mm", ""
