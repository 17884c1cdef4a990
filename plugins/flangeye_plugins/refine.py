"""``refine.*``: change a calibration after solving: for the arm's errors, or by equation (19)."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Annotated, ClassVar

import numpy as np

from flangeye import BoundPart, CalibrationRefused, Choose, Params, StageError, stage
from flangeye.estimation.arm_parameters import ArmParameters, most_informative_poses, parameters_of
from flangeye.estimation.calibrate import Options, answered
from flangeye.estimation.effects.arm import kinematics_and_joints
from flangeye.estimation.plan import predict, predicted_poses
from flangeye.estimation.session.session import Session, session_of
from flangeye.maths.arm_correction import corrected_view
from flangeye.maths.kinematics import Arm
from flangeye.models.cell import cell_of
from flangeye.models.configuration import DEFAULT, Configuration
from flangeye.models.robots import RobotModel
from flangeye.models.scanners import ScannerModel
from flangeye.models.targets import Flange
from flangeye.types import (
    BASE,
    CAMERA,
    FLANGE,
    Floats,
    HandEye,
    Observation,
    Pair,
    PoseError,
    Transform,
    TransformEstimate,
    Views,
)
from flangeye.types.geometry import rigid, rotation_log
from flangeye.units import param


class CompensateParams(Params):
    """Parameters of ``refine.compensate``."""

    error: Annotated[BoundPart, Choose("error")] = param({"icp": {}})
    """How the remaining error is measured, on a verification view."""
    rotation: bool = True
    """Apply the error's rotation too, as the paper does. A flange 60 mm wide determines rotation
    poorly, and over the workspace a rotation error counts ten times as much."""


@stage("refine.compensate")
def refine_compensate(
    calibration: HandEye,
    views: Views,
    params: CompensateParams,
    flange: Flange | None = None,
    robot: RobotModel | None = None,
) -> HandEye:
    """Apply the error measured on a verification view to the answer: equation (19).

    The error takes the measured flange onto the predicted one, in ``camera``, so it goes to the
    right: ``base_T_camera @ error`` puts what was measured where the robot reports it. This order,
    which is the paper's, is correct for an error of this direction only. The result fits that one
    view, including its noise, the arm's error there and the flange's roll. The notes state the
    effect on the poses used for solving. The covariance grows by the step taken, as if it were one
    standard deviation.

    Raises:
        StageError: There is no verification view, or the recipe names no robot.
        CalibrationRefused: The error cannot be measured.
    """
    if not views:
        raise StageError(
            "refine.compensate: no verification view to measure the error on; let the acquire "
            "step keep one, or leave this step out"
        )
    calibration = calibration.as_reported()
    arm = Arm(robot) if robot else None
    expected = Views(corrected_view(view, calibration.correction, arm) for view in views)

    def measure(base_T_camera: Transform) -> PoseError | None:
        found: PoseError | None = params.error(base_T_camera, (), expected, flange)
        return found

    before = calibration.base_T_camera.transform
    error = measure(before)
    if error is None:
        raise CalibrationRefused(
            f"refine.compensate: the error on view {views[0].id} could not be measured, so "
            "equation (19) cannot be applied",
            "leave the step out, or see what verify.icp says",
        )
    after = compensated(before, error, params.rotation)
    pairs = [_moved(pair, before, after) for pair in calibration.pairs]
    return replace(
        calibration,
        camera=widened(calibration.base_T_camera, after),
        pairs=tuple(pairs),
        notes=(*calibration.notes, *_notes(calibration.pairs, pairs, error, measure(after))),
    )


def compensated(base_T_camera: Transform, error: PoseError, rotation: bool = True) -> Transform:
    """Return ``base_T_camera`` with a measured error applied.

    Args:
        base_T_camera: The answer it was measured of.
        error: Motion in ``camera`` from measured to predicted points.
        rotation: Whether its rotation counts; else only what it does where the flange was.
    """
    motion = error.motion if rotation else rigid(np.eye(3), error.displacement())
    # On the right, equation (19): the error is a motion in the camera's frame
    return Transform(BASE, CAMERA, base_T_camera.matrix @ motion)


def widened(estimate: TransformEstimate, after: Transform) -> TransformEstimate:
    """Return an estimate moved to ``after``, its covariance grown by the step that moved it."""
    step = after.matrix @ estimate.transform.inverse().matrix
    shift = step[:3, :3] @ estimate.about + step[:3, 3] - estimate.about
    taken = np.concatenate([rotation_log(step[:3, :3]), shift])
    return TransformEstimate(after, estimate.covariance + np.outer(taken, taken), estimate.about)


def _moved(pair: Pair, before: Transform, after: Transform) -> Pair:
    centre = pair.observation.circle.centre
    return replace(pair, residual=pair.residual + after.apply(centre) - before.apply(centre))


def _notes(
    before: Sequence[Pair], after: Sequence[Pair], error: PoseError, left: PoseError | None
) -> tuple[str, str]:
    turn = np.degrees(np.linalg.norm(rotation_log(error.motion[:3, :3])))
    rest = "not measurable" if left is None else f"{_mm(left.displacement())} mm"
    then, now = _rms(before), _rms(after)
    verdict = "worse" if now > then else "better"
    return (
        f"compensation (19): error {_mm(error.displacement())} mm and {turn:.3f} deg at the "
        f"verification view, {rest} after it; that view no longer verifies anything",
        f"compensation (19) changes the residual on the {sum(p.used for p in before)} poses solved "
        f"from {then * 1e3:.3f} to {now * 1e3:.3f} mm rms: {verdict} for them",
    )


def _rms(pairs: Sequence[Pair]) -> float:
    """Return the residual over the poses that were used, rms [m]."""
    residuals = np.array([pair.residual for pair in pairs if pair.used])
    return float(np.sqrt((residuals**2).sum(axis=1).mean()))


def _mm(displacement: Floats) -> str:
    return f"{np.linalg.norm(displacement) * 1e3:.3f}"


class ArmParams(Params):
    """Parameters of ``refine.arm``."""

    # Number of further poses to propose for identifying the arm
    propose: ClassVar[int] = 6

    @property
    def corrects_arm(self) -> bool:
        """Whether an arm's own errors may be estimated."""
        return True


@stage("refine.arm")
def refine_arm(
    calibration: HandEye,
    params: ArmParams,
    robot: RobotModel,
    scanner: ScannerModel | None = None,
    configuration: Configuration | None = None,
) -> HandEye:
    """Estimate the arm's observable joint zeros and link lengths, and correct the arm by them.

    The pose for the arm as its controller reports it is kept. A second pose, for the corrected arm,
    is added if the correction is expected to help. The notes list the parameters that the poses
    identify, and propose poses that would identify more. ``export.robot`` writes the corrected arm
    as a robot file.

    Raises:
        StageError: There are too few poses, or the robot's model does not reach them.
        CalibrationRefused: The poses leave the camera's place unknown.
    """
    observations = [pair.observation for pair in calibration.pairs]
    session = session_of(observations, cell_of(configuration or DEFAULT, robot), scanner)
    told = parameters_of(session)
    about_arm = (
        _identifiability(told, session),
        *_listed(told),
        *_ways(told),
        *_proposed(session, told, params.propose),
    )
    found = answered(session, Options(), calibration.method)
    kept = (
        "the arm's parameters are not corrected, because no smaller error is expected from it"
        if found.corrected is None
        else "the arm's parameters are corrected"
    )
    notes = (*calibration.notes, *about_arm, kept)
    return replace(calibration, corrected=found.corrected, notes=notes, without=found.without)


def _identifiability(told: ArmParameters, session: Session) -> str:
    """Describe how well the poses determine the arm's errors."""
    poses = np.array([o.poses[FLANGE].matrix for o in session.observations])
    # Two rotations R, S differ by the angle whose cosine is (trace(R'S) - 1) / 2
    cosine = (np.einsum("nij,mij->nm", poses[:, :3, :3], poses[:, :3, :3]).min() - 1) / 2
    widest = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
    one = f" (one orientation: they turn by {widest:.1f} deg at most)" if widest < 10.0 else ""
    count, combined = told.sizes.size, _combinations(told)
    if told.identified.any():
        return (
            f"the poses identify {told.identified.sum()} of {count} parameters of the arm singly, "
            f"and {combined} of them{one}"
        )
    return (
        f"the poses identify {combined} of the arm's {count} parameters, and none singly{one}: the "
        "correction is valid at similar poses, and gives no value for any single joint"
    )


def _combinations(told: ArmParameters) -> str:
    return f"{told.combinations} combination{'' if told.combinations == 1 else 's'}"


def _listed(told: ArmParameters) -> list[str]:
    """Return notes with the identified parameters, and those not identified; empty without any."""
    single: list[str] = []
    combined_only: list[str] = []
    for (joint, which), singly in np.ndenumerate(told.identified):
        what, unit = (("zero", "mrad"), ("a", "mm"), ("d", "mm"), ("alpha", "mrad"))[which]
        name = f"joint {joint + 1} {what}"
        value, deviation = (x[joint, which] * 1e3 for x in (told.values, told.deviations))
        (single if singly else combined_only).append(
            f"{name} {value:+.2f} ± {deviation:.2f} {unit}" if singly else name
        )
    if not single:
        return []
    lines = [f"identified: {'; '.join(single)}"]
    return lines + ([f"not identified singly: {', '.join(combined_only)}"] if combined_only else [])


def _ways(told: ArmParameters) -> list[str]:
    """Return a note that joint angles are ambiguous, where they were not recorded."""
    if told.ways == 1:
        return []
    ways = "any number of" if np.isinf(told.ways) else told.ways
    return [
        "the recordings have no joint angles, and the arm may have reached the poses in "
        f"{ways} ways that fit equally: parameters on which these disagree are not identified, and "
        f"the correction is that of the best one; record the joint angles with the poses"
    ]


def _proposed(session: Session, told: ArmParameters, count: int) -> list[str]:
    """Propose poses that would determine the arm's errors better."""
    candidates = _candidates(session)
    if not count or not candidates:
        return []
    chosen, after = most_informative_poses(session, told, candidates, count)
    listed = "; ".join(
        ", ".join(f"{x:.0f}" for x in np.degrees(candidates[i].joints)) for i in chosen
    )
    them = "them" if told.ways == 1 else "them, and all joint angles,"
    return [
        f"poses that would identify more, joints in deg: {listed}; with {them} "
        f"{after.identified.sum()} of {after.sizes.size} parameters are identified singly, and "
        f"{_combinations(after)}"
    ]


def _candidates(session: Session) -> list[Observation]:
    """Return predicted sightings around the session's, at similar distances and incidence."""
    arm, at = kinematics_and_joints(
        next(c for c in session.found.problem.carriers if c.frame == FLANGE)
    )
    rng, places = np.random.default_rng(0), session.found.places
    joints = at[rng.integers(len(at), size=300)]
    spread = 0.6  # of the joints from the last session's [rad]
    joints = joints + rng.uniform(-spread, spread, joints.shape)
    joints = joints[((joints > arm.lower) & (joints < arm.upper)).all(axis=1)]
    like = session.observations[0]
    moments = [_at(like, pose, q) for pose, q in zip(arm.flange(joints), joints, strict=True)]
    seen = predicted_poses(moments, places, session.cell)
    before = np.array([o.feature.centre for o in session.observations])
    margin = 0.05  # a camera is taken to see the target so far about where it did [m]
    near = (seen[:, :3, 3] > before.min(axis=0) - margin) & (
        seen[:, :3, 3] < before.max(axis=0) + margin
    )
    facing = np.abs((seen[:, :3, 2] * seen[:, :3, 3]).sum(axis=1))
    # The largest angle between its axis and the ray is 50 deg
    squarest = np.cos(np.radians(50))
    kept = near.all(axis=1) & (facing > squarest * np.linalg.norm(seen[:, :3, 3], axis=1))
    chosen = [moments[i] for i in np.flatnonzero(kept)]
    return predict(chosen, places, session.cell) if chosen else []


def _at(like: Observation, pose: Floats, joints: Floats) -> Observation:
    poses = {**like.poses, FLANGE: Transform(BASE, FLANGE, pose)}
    return replace(like, poses=poses, joints=joints, motion=None)
