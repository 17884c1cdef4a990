"""``refine.arm``: the arm's own joint zeros and lengths, from scans of its flange alone."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from flangeye import Params, StageError, stage
from flangeye.estimation.arm_model import (
    ArmFit,
    ArmSession,
    combinations,
    covariance_at_work,
    deviations,
    fit_arm,
    identified,
    most_telling,
    residuals,
)
from flangeye.maths.arm_correction import follow
from flangeye.maths.kinematics import Arm
from flangeye.models.robots import RobotModel
from flangeye.types import (
    ArmCorrection,
    CorrectedArm,
    Floats,
    HandEye,
    Mask,
    Observation,
    TransformEstimate,
)

FOLDS, HELPFUL = 5, 0.95
"""The arm's error is kept when it brings the error on poses held out to this share or less."""
CANDIDATES, SPREAD = 300, 0.6
"""Poses looked at for the next session, and their joints' largest change from the last [rad]."""
NAMES = ("zero", "a", "d", "alpha")
UNITS = (("mrad", 1e3), ("mm", 1e3), ("mm", 1e3), ("mrad", 1e3))


class ArmParams(Params):
    """Parameters of ``refine.arm``."""

    # Expected standard deviation of a joint's zero [rad]
    zeros: ClassVar[float] = 5e-3
    # Number of further poses to propose for identifying the arm
    propose: ClassVar[int] = 6

    @property
    def corrects_arm(self) -> bool:
        """Whether the arm's own error may be found."""
        return True


@dataclass(frozen=True, eq=False)
class _Found:
    """One branch of the arm, fitted.

    Attributes:
        session: The poses with the joint angles of the branch.
        fit: What they tell.
        used: (N,) those that take part.
        offset: (3,) where the circle was taken to be in the flange [m].
        alike: How many branches fit as well, where no joint angles were recorded.
        apart: (n, 4) standard deviation of the parameters between these.
    """

    session: ArmSession
    fit: ArmFit
    used: Mask
    offset: Floats
    alike: int = 1
    apart: Floats | float = 0.0

    @property
    def rms(self) -> float:
        return float(np.sqrt((self.fit.scatter + self.session.noise.mean()) * 3))


@stage("refine.arm")
def refine_arm(calibration: HandEye, params: ArmParams, robot: RobotModel) -> HandEye:
    """Find the arm's joint zeros and lengths together with the camera's pose.

    The pose for the arm as its controller reports it stays; the pose for the arm so corrected is
    put beside it, if it helps on poses held out. The notes say which parameters the poses identify
    and which not, and propose poses that would tell more. ``export.robot`` writes the corrected
    arm as a robot file.

    Raises:
        StageError: There are too few poses, or the robot's model does not reach them.
    """
    before, arm = calibration.as_reported(), Arm(robot)
    # Expected of link lengths and offsets [m], and of twists [rad], of a calibrated arm.
    prior = deviations(arm.n, params.zeros, 0.5e-3, 1e-3)
    found = _best(before, arm, prior)
    errors = _held_out(before, arm, found, prior)
    known = identified(found.fit, prior, found.apart)
    if _offset_of(before).any():
        known[-1, NAMES.index("a") : NAMES.index("d") + 1] = False  # moves the circle likewise
    about_arm = [
        _identifiability(known, combinations(found.fit, prior), found),
        *_listed(known, found, prior),
        *_branches_alike(found),
    ]
    about_arm += _proposed(arm, found, prior, params.propose)
    compared = f"held-out error {errors[1] * 1e3:.3f} mm with it, {errors[0] * 1e3:.3f} mm without"
    notes = (*before.notes, *about_arm)
    if errors[1] > HELPFUL * errors[0]:
        left = f"the arm's parameters left out, for they do not help ({compared})"
        return replace(before, notes=(*notes, left))
    kept = f"the arm's parameters are corrected ({compared})"
    return replace(before, notes=(*notes, kept), corrected=_corrected(before, found, arm))


def _best(calibration: HandEye, arm: Arm, prior: Floats) -> _Found:
    """Fit on every branch the arm may be on, and return the one that fits best.

    With the offset of the circle that was found, and without: an arm that is off looks like one.
    """
    observations = [pair.observation for pair in calibration.pairs]
    offset = _offset_of(calibration)
    found = [
        _fitted(observations, joints, each, calibration, arm, prior)
        for joints in _branches(observations, arm)
        for each in ([offset, 0 * offset] if offset.any() else [offset])
    ]
    used = np.array([pair.used for pair in calibration.pairs])
    if not found or used.sum() < 6:
        why = "the robot's model does not reach the poses" if not found else "6 poses are needed"
        raise StageError(f"refine.arm: {why}; name the arm that was recorded, or take more poses")
    best = min(found, key=lambda each: each.rms)
    shares = _shares(found, prior)
    off = np.array([each.fit.parameters - best.fit.parameters for each in found])
    apart = np.sqrt(np.einsum("b,bij->ij", shares, off**2))
    # An arm of more joints reaches a pose in any number of ways
    if arm.n > 6 and any(o.joints is None for o in observations):
        apart = np.full_like(apart, np.inf)  # the ways that were looked at are a few of a continuum
    # Probability of a branch that does not count among those that fit alike
    likely = [each for each, share in zip(found, shares, strict=True) if share > 0.01]
    alike = len({id(each.session.joints) for each in likely})
    return replace(best, alike=alike, apart=apart)


def _offset_of(calibration: HandEye) -> Floats:
    """Return (3,) where the circle was found to be in the flange [m]."""
    correction = calibration.correction
    return np.zeros(3) if correction is None else np.asarray(correction.tool_offset)


def _shares(found: Sequence[_Found], prior: Floats) -> Floats:
    """Return the probability of each branch by what it leaves of the poses."""
    free = prior > 0
    deviance = np.array([
        3 * each.used.sum() * np.log(each.rms**2)
        + ((each.fit.parameters[free] / prior[free]) ** 2).sum()
        for each in found
    ])  # fmt: skip
    likely = np.exp((deviance.min() - deviance) / 2)
    return np.asarray(likely / likely.sum())


def _fitted(
    observations: Sequence[Observation],
    joints: Floats,
    offset: Floats,
    calibration: HandEye,
    arm: Arm,
    prior: Floats,
) -> _Found:
    used = np.array([pair.used for pair in calibration.pairs])
    session = _session(observations, joints, offset)
    fit = fit_arm(arm, session.where(used), _start(calibration), prior, (0.2e-3) ** 2)
    return _Found(session, fit, used, offset)


def _session(observations: Sequence[Observation], joints: Floats, offset: Floats) -> ArmSession:
    return ArmSession(
        joints,
        np.array([o.base_T_flange.matrix for o in observations]),
        np.array([o.circle.centre for o in observations]),
        np.array([o.centre_in_mount + offset for o in observations]),
        np.array([np.trace(o.circle.covariance) / 3 for o in observations]),
    )


def _branches(observations: Sequence[Observation], arm: Arm) -> Iterator[Floats]:
    """Give the (N, n) joint angles [rad], on each branch they may be on."""
    poses = np.array([o.base_T_flange.matrix for o in observations])
    given = [o.joints for o in observations if o.joints is not None and len(o.joints) == arm.n]
    if len(given) == len(observations):
        joints = np.array(given)
        apart = np.linalg.norm((arm.flange(joints) - poses)[:, :3, 3], axis=1).max()
        # Further from the controller's poses than this [m], the arm is another one
        if apart < 5e-3:
            yield joints
        return
    for first in arm.inverse(poses[0], starts=96):
        with suppress(ValueError):  # this branch does not reach all poses
            yield follow(arm, poses, first)


def _held_out(calibration: HandEye, arm: Arm, found: _Found, prior: Floats) -> tuple[float, float]:
    """Return the rms error on poses held out, without and with the arm's parameters [m]."""
    session = found.session.where(found.used)
    reported = replace(session, mounts=session.mounts + _offset_of(calibration) - found.offset)
    order = np.random.default_rng(0).permutation(len(session.joints))
    squares = np.zeros((2, len(order)))
    for fold in range(FOLDS):
        part = np.isin(np.arange(len(order)), order[fold::FOLDS])
        for row, allowed in enumerate((0 * prior, prior)):
            start = found.fit.base_T_camera if row else _start(calibration)
            given = session if row else reported
            fit = fit_arm(arm, given.where(~part), start, allowed, found.fit.scatter)
            squares[row, part] = (residuals(arm, given.where(part), fit) ** 2).sum(axis=1)
    without, with_it = np.sqrt(squares.mean(axis=1))
    return float(without), float(with_it)


def _start(calibration: HandEye) -> Floats:
    return calibration.base_T_camera.transform.matrix


def _corrected(calibration: HandEye, found: _Found, arm: Arm) -> CorrectedArm:
    fit = found.fit
    covariance = covariance_at_work(arm, found.session.where(found.used), fit)
    before = calibration.correction or ArmCorrection(np.zeros(3))
    correction = replace(
        before,
        tool_offset=found.offset,
        joint_offsets=fit.parameters[:, 0],
        lengths=fit.parameters[:, 1:],
        joints=found.session.joints[0],
    )
    transform = replace(calibration.base_T_camera.transform, matrix=fit.base_T_camera)
    camera = TransformEstimate(transform, 0.5 * (covariance + covariance.T), fit.about)
    return CorrectedArm(camera, correction)


def _identifiability(known: Mask, combined: int, found: _Found) -> str:
    """Describe how well the poses determine the arm's errors."""
    turns = found.session.poses[:, :3, :3]
    cosine = (np.einsum("nij,mij->nm", turns, turns).min() - 1) / 2
    widest = np.arccos(np.clip(cosine, -1, 1))
    one = (
        f" (one orientation: they turn by {np.degrees(widest):.1f} deg at most)"
        if widest < np.radians(10.0)
        else ""
    )
    if known.any():
        return (
            f"the poses identify {known.sum()} of {known.size} parameters of the arm singly, and "
            f"{combined} combinations of them{one}"
        )
    return (
        f"the poses identify none of the arm's {known.size} parameters singly{one}, and {combined} "
        "combinations of them: the correction predicts at poses like these, and says nothing of "
        "any one joint"
    )


def _listed(known: Mask, found: _Found, prior: Floats) -> list[str]:
    """Name what is identified, with value and deviation, and what is not."""
    fit = found.fit
    own = np.maximum(np.diag(fit.covariance)[6:], 0.0).reshape(prior.shape)
    sigma = np.sqrt(own + np.square(found.apart))
    single: list[str] = []
    combined_only: list[str] = []
    for (joint, which), singly in np.ndenumerate(known):
        name, (unit, scale) = f"joint {joint + 1} {NAMES[which]}", UNITS[which]
        value, deviation = fit.parameters[joint, which] * scale, sigma[joint, which] * scale
        (single if singly else combined_only).append(
            f"{name} {value:+.2f} ± {deviation:.2f} {unit}" if singly else name
        )
    lines = [f"identified: {'; '.join(single)}"] if single else []
    return lines + ([f"not identified singly: {', '.join(combined_only)}"] if combined_only else [])


def _branches_alike(found: _Found) -> list[str]:
    """Say that the joints may have been otherwise, where nobody recorded them."""
    endless = bool(np.isinf(found.apart).any())
    if found.alike == 1 and not endless:
        return []
    ways = "any number of" if endless else found.alike
    return [
        "the recordings have no joint angles, and the arm may have reached the poses in "
        f"{ways} ways that fit alike: what they do not agree on is not identified, and the "
        "corrected arm is that of the best of them; record the joint angles with the poses"
    ]


def _proposed(arm: Arm, found: _Found, prior: Floats, count: int) -> list[str]:
    """Propose poses that would determine the arm's errors better."""
    candidates = _candidates(arm, found)
    if not count or not len(candidates.joints):
        return []
    chosen, after = most_telling(arm, candidates, found.fit, prior, count)
    listed = "; ".join(
        ", ".join(f"{x:.0f}" for x in np.degrees(candidates.joints[i])) for i in chosen
    )
    would = int(identified(after, prior).sum())
    them = "them" if not _branches_alike(found) else "them, and all joint angles,"
    return [
        f"poses that would tell more, joints in deg: {listed}; with {them} {would} of {prior.size} "
        f"parameters are identified singly, and {combinations(after, prior)} combinations"
    ]


def _candidates(arm: Arm, found: _Found) -> ArmSession:
    """Return poses about the session's that its camera sees as it saw those: as near, as square."""
    session, rng = found.session, np.random.default_rng(0)
    centre = session.joints[rng.integers(len(session.joints), size=CANDIDATES)]
    joints = centre + rng.uniform(-SPREAD, SPREAD, centre.shape)
    joints = joints[((joints > arm.lower) & (joints < arm.upper)).all(axis=1)]
    poses = arm.flange(joints)
    eye = found.fit.base_T_camera
    seen = (poses[:, :3, 3] - eye[:3, 3]) @ eye[:3, :3]
    low, high = session.centres.min(axis=0) - 0.05, session.centres.max(axis=0) + 0.05
    away = -(poses[:, :3, 2] * (poses[:, :3, 3] - eye[:3, 3])).sum(axis=1)
    facing = away / np.linalg.norm(seen, axis=1) > np.cos(np.radians(50))
    kept = ((seen > low) & (seen < high)).all(axis=1) & facing
    n = int(kept.sum())
    mounts, noise = np.tile(session.mounts[0], (n, 1)), np.full(n, np.median(session.noise))
    return ArmSession(joints[kept], poses[kept], seen[kept], mounts, noise)
