"""Convert a cell's observations into the arrays of a problem."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from flangeye.errors import StageError
from flangeye.estimation.graph import Carrier, Problem, Sightings
from flangeye.maths.arm_correction import reached_from
from flangeye.maths.kinematics import Arm
from flangeye.maths.statistics import SIGMA_OF_MAD
from flangeye.maths.streams import rates_of
from flangeye.models.cell import Axis, Cell, Frame, chain
from flangeye.models.robots import RobotModel
from flangeye.types import Feature, Floats, Motion, Observation, PoseFeature
from flangeye.types.geometry import basis_of_plane, hat

REACHED = 5e-3
"""Distance of a reported flange from the model's kinematics [m] beyond which the model is taken
for another arm's."""


def problem_of(observations: Sequence[Observation], cell: Cell, normals: bool = True) -> Problem:
    """Return N observations as a problem of N sightings, each at its own time.

    Joint angles that were not recorded stay unknown; see ``branches_of``. ``normals`` says whether
    the normals of circles are used.

    Raises:
        StageError: There is no observation, or one lacks the pose of a moving frame.
    """
    if not observations:
        raise StageError("no pose to solve with: every capture was rejected, see the reasons above")
    ends = list(dict.fromkeys((o.camera, o.target) for o in observations))
    each = [_measured(o.feature, normals) for o in observations]
    rotations, covariances, projectors = (np.array(column) for column in zip(*each, strict=True))
    seen = Sightings(
        times=np.arange(len(observations)),
        pairs=np.array([ends.index((o.camera, o.target)) for o in observations], dtype=np.intp),
        rotations=rotations,
        centres=np.array([o.feature.centre for o in observations]),
        covariances=covariances,
        projectors=projectors,
        offsets=np.array([o.centre_in_mount for o in observations]),
        by_depth=np.array([_by_depth(o.feature) for o in observations]),
        shared=_shared(observations),
    )
    frames = cell.graph(observations)
    return Problem(frames, ends, seen, _carriers(observations, cell, frames))


def _measured(feature: Feature, normals: bool) -> tuple[Floats, Floats, Floats]:
    """Return (3, 3) rotation, (6, 6) covariance and (6, 6) projector of one feature."""
    if isinstance(feature, PoseFeature):
        return feature.camera_T_target.rotation, feature.covariance, np.eye(6)
    covariance, projector = np.zeros((6, 6)), np.zeros((6, 6))
    covariance[3:, 3:], projector[3:, 3:] = feature.covariance, np.eye(3)
    if feature.normal is None or feature.normal_covariance is None or not normals:
        return np.eye(3), covariance, projector
    # An error dn of a normal n is the turn n x dn
    turn = hat(feature.normal)
    covariance[:3, :3] = turn @ feature.normal_covariance @ turn.T
    projector[:3, :3] = np.eye(3) - np.outer(feature.normal, feature.normal)
    return basis_of_plane(feature.normal).T, covariance, projector


def _by_depth(feature: Feature) -> bool:
    return not (isinstance(feature, PoseFeature) and len(feature.corners))


def _shared(observations: Sequence[Observation]) -> Floats:
    """Return (N, 6, k) shifts of the features by each of k shared errors, in ``camera``."""
    each = [o.feature.shared if isinstance(o.feature, PoseFeature) else None for o in observations]
    moves = {i: moved for i, moved in enumerate(each) if moved is not None}
    out = np.zeros((len(each), 6, max((m.shape[1] for m in moves.values()), default=0)))
    for i, moved in moves.items():
        out[i, :, : moved.shape[1]] = moved
    return out


def _carriers(
    observations: Sequence[Observation], cell: Cell, frames: Mapping[str, Frame]
) -> list[Carrier]:
    """Return the carriers of cameras and targets."""
    ends = {end for o in observations for end in (o.camera, o.target)}
    used = {frame for end in ends for frame in chain(frames, end)}
    joints, motions = cell.joints(observations), _motions(observations, cell)
    out = []
    for frame in (each for each in cell.measured if each in used):
        link = cell.links.get(frame)
        arm, number = (link.arm, link.number) if link else (frame, None)
        mover, rates = cell.movers.get(arm), rates_of(motions, frame) if motions else None
        if isinstance(mover, RobotModel):
            own, accuracy = joints.get(arm), mover.joint_accuracy
            out.append(Carrier(frame, arm, Arm(mover), own, accuracy, number, rates))
        else:
            out.append(Carrier(frame, arm, rates=rates, axis=isinstance(mover, Axis)))
    return out


def _motions(observations: Sequence[Observation], cell: Cell) -> list[Motion] | None:
    """Return the recorded motion of every carrier about each capture; None where not recorded."""
    motions = [cell.passing(o.motion) for o in observations if o.motion is not None]
    told = [m for m in motions if {*cell.measured} <= {*m.others}]
    return told if len(told) == len(observations) else None


def branches_of(problem: Problem, carrier: Carrier) -> Iterator[Floats]:
    """Yield candidate joint angles (T, n) of an arm at its poses, one IK branch each [rad].

    Recorded joint angles are the only candidate, if they reach the poses. There is none if the
    arm's model is unknown or does not reach the poses.
    """
    arm, poses = carrier.kinematics, np.asarray(problem.frames[carrier.frame].place)
    if arm is None:
        return
    if carrier.joints is not None:
        reached = arm.pose(carrier.joints, carrier.link)
        if np.linalg.norm((reached - poses)[:, :3, 3], axis=1).max() < REACHED:
            yield carrier.joints
        return
    # 48 starts, for arms without a closed form
    starts = arm.inverse(poses[0], 48)[:, None]
    each, all_reached = reached_from(
        arm, np.broadcast_to(poses, (len(starts), *poses.shape)), starts
    )
    yield from each[all_reached.all(axis=1)]


def roll_note(
    observations: Sequence[Observation], base_R_camera: Floats, covariance: Floats
) -> str:
    """Return a note on the flange roll, or that it is not observable.

    The roll is the rotation of the bolt pattern about the flange's axis. Centres and normals do not
    show it, so the camera's pose does not depend on it. A seam found in the flange's frame, or a
    registration of the flange's shape, does.

    Args:
        observations: The inlying observations.
        base_R_camera: (3, 3) the estimated rotation.
        covariance: (3, 3) covariance of that rotation [rad^2].
    """
    turns = roll_of(observations, base_R_camera)
    # Fewer have no scatter that means anything
    if len(turns) < 3:
        return (
            f"flange roll is not observable: the bolt holes show in {len(turns)} of "
            f"{len(observations)} poses; the camera's pose does not depend on it"
        )
    mean = np.angle(np.exp(1j * turns).mean())  # the angles may lie about half a turn
    off = np.angle(np.exp(1j * (turns - mean)))
    degrees = round(float(np.degrees(mean + np.median(off))), 2)
    middle = 180 - (180 - degrees) % 360  # within (-180, 180]
    of_one = SIGMA_OF_MAD * float(np.median(np.abs(off - np.median(off))))
    rotation = float(np.sqrt(np.linalg.eigvalsh(covariance)[-1]))
    # A median's standard deviation is 1.25 times a mean's.
    deviation = np.hypot(1.25 * of_one / np.sqrt(len(turns)), rotation)
    return (
        f"flange roll against the controller's frame: {middle:.2f} +- {np.degrees(deviation):.2f} "
        f"deg (bolt pattern in {len(turns)} poses); the camera's pose does not depend on it"
    )


def roll_of(observations: Sequence[Observation], base_R_camera: Floats) -> Floats:
    """Return the (M,) angles of the hole pattern about the flange's z [rad], where holes show."""
    turns = []
    for o in observations:
        if o.circle.roll is None or o.circle.normal is None:
            continue
        across = basis_of_plane(o.circle.normal)
        angle = o.circle.roll
        x_in_camera = np.cos(angle) * across[0] + np.sin(angle) * across[1]
        x, y, _ = o.base_T_flange.rotation.T @ base_R_camera @ x_in_camera
        turns.append(np.arctan2(y, x))
    return np.array(turns)
