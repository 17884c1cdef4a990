"""``refine.arm``: the arm's own joint zeros and lengths, from scans of its flange alone."""

from __future__ import annotations

from dataclasses import replace
from typing import ClassVar

import numpy as np

from flangeye import Params, stage
from flangeye.estimation.arm_parameters import ArmParameters, most_telling_poses, parameters_of
from flangeye.estimation.calibrate import Options, answered
from flangeye.estimation.effects.arm import known
from flangeye.estimation.plan import foreseen, foreseen_poses
from flangeye.estimation.session import Session, session_of
from flangeye.models.cell import cell_of
from flangeye.models.configuration import DEFAULT, Configuration
from flangeye.models.robots import RobotModel
from flangeye.models.scanners import ScannerModel
from flangeye.types import BASE, FLANGE, Floats, HandEye, Observation, Transform

CANDIDATES, SPREAD = 300, 0.6
"""Poses looked at for the next session, and their joints' largest change from the last [rad]."""
MARGIN, SQUAREST = 0.05, np.cos(np.radians(50))
"""A camera is taken to see the target so far about where it did [m], and at this cosine of the
angle between its axis and the ray, or more."""
NAMES = ("zero", "a", "d", "alpha")
UNITS = (("mrad", 1e3), ("mm", 1e3), ("mm", 1e3), ("mrad", 1e3))


class ArmParams(Params):
    """Parameters of ``refine.arm``."""

    # Number of further poses to propose for identifying the arm
    propose: ClassVar[int] = 6

    @property
    def corrects_arm(self) -> bool:
        """Whether the arm's own error may be found."""
        return True


@stage("refine.arm")
def refine_arm(
    calibration: HandEye,
    params: ArmParams,
    robot: RobotModel,
    scanner: ScannerModel | None = None,
    configuration: Configuration | None = None,
) -> HandEye:
    """Say which of the arm's joint zeros and lengths the poses tell, and correct the arm by them.

    The pose for the arm as its controller reports it stays; the pose for the arm so corrected is
    put beside it, if it is expected to help. The notes say which parameters the poses identify
    and which not, and propose poses that would tell more. ``export.robot`` writes the corrected
    arm as a robot file.

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
        "the arm's parameters are left out, for correcting them is not expected to help"
        if found.corrected is None
        else "the arm's parameters are corrected"
    )
    notes = (*calibration.notes, *about_arm, kept)
    return replace(calibration, corrected=found.corrected, notes=notes, without=found.without)


def _identifiability(told: ArmParameters, session: Session) -> str:
    """Describe how well the poses determine the arm's errors."""
    poses = np.array([o.poses[FLANGE].matrix for o in session.observations])
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
        f"the poses identify none of the arm's {count} parameters singly{one}, and {combined} of "
        "them: the correction predicts at poses like these, and says nothing of any one joint"
    )


def _combinations(told: ArmParameters) -> str:
    return f"{told.combinations} combination{'' if told.combinations == 1 else 's'}"


def _listed(told: ArmParameters) -> list[str]:
    """Name what is identified, with value and deviation, and what is not, where anything is."""
    single: list[str] = []
    combined_only: list[str] = []
    for (joint, which), singly in np.ndenumerate(told.identified):
        name, (unit, scale) = f"joint {joint + 1} {NAMES[which]}", UNITS[which]
        value, deviation = (x[joint, which] * scale for x in (told.values, told.deviations))
        (single if singly else combined_only).append(
            f"{name} {value:+.2f} ± {deviation:.2f} {unit}" if singly else name
        )
    if not single:
        return []
    lines = [f"identified: {'; '.join(single)}"]
    return lines + ([f"not identified singly: {', '.join(combined_only)}"] if combined_only else [])


def _ways(told: ArmParameters) -> list[str]:
    """Say that the joints may have been otherwise, where nobody recorded them."""
    if told.ways == 1:
        return []
    ways = "any number of" if np.isinf(told.ways) else told.ways
    return [
        "the recordings have no joint angles, and the arm may have reached the poses in "
        f"{ways} ways that fit alike: what they do not agree on is not identified, and the "
        "corrected arm is that of the best of them; record the joint angles with the poses"
    ]


def _proposed(session: Session, told: ArmParameters, count: int) -> list[str]:
    """Propose poses that would determine the arm's errors better."""
    candidates = _candidates(session)
    if not count or not candidates:
        return []
    chosen, after = most_telling_poses(session, told, candidates, count)
    listed = "; ".join(
        ", ".join(f"{x:.0f}" for x in np.degrees(candidates[i].joints)) for i in chosen
    )
    them = "them" if told.ways == 1 else "them, and all joint angles,"
    return [
        f"poses that would tell more, joints in deg: {listed}; with {them} "
        f"{after.identified.sum()} of {after.sizes.size} parameters are identified singly, and "
        f"{_combinations(after)}"
    ]


def _candidates(session: Session) -> list[Observation]:
    """Return sightings about the session's, as near and as square as the camera saw those."""
    arm, at = known(next(c for c in session.found.problem.carriers if c.frame == FLANGE))
    rng, places = np.random.default_rng(0), session.found.places
    joints = at[rng.integers(len(at), size=CANDIDATES)]
    joints = joints + rng.uniform(-SPREAD, SPREAD, joints.shape)
    joints = joints[((joints > arm.lower) & (joints < arm.upper)).all(axis=1)]
    like = session.observations[0]
    moments = [_at(like, pose, q) for pose, q in zip(arm.flange(joints), joints, strict=True)]
    seen = foreseen_poses(moments, places, session.cell)
    before = np.array([o.feature.centre for o in session.observations])
    near = (seen[:, :3, 3] > before.min(axis=0) - MARGIN) & (
        seen[:, :3, 3] < before.max(axis=0) + MARGIN
    )
    facing = np.abs((seen[:, :3, 2] * seen[:, :3, 3]).sum(axis=1))
    kept = near.all(axis=1) & (facing > SQUAREST * np.linalg.norm(seen[:, :3, 3], axis=1))
    chosen = [moments[i] for i in np.flatnonzero(kept)]
    return foreseen(chosen, places, session.cell) if chosen else []


def _at(like: Observation, pose: Floats, joints: Floats) -> Observation:
    poses = {**like.poses, FLANGE: Transform(BASE, FLANGE, pose)}
    return replace(like, poses=poses, joints=joints, motion=None)
