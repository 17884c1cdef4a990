"""Observations of known truth for every configuration, drawn in a moment."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from flangeye.estimation.graph import Problem
from flangeye.estimation.start.sightings import problem_of
from flangeye.maths.kinematics import Arm
from flangeye.maths.streams import joints_at, passed, pose_at, with_joints
from flangeye.models.cell import Frame, cell_of
from flangeye.models.configuration import ORIGIN, Configuration
from flangeye.models.loading import load_model
from flangeye.models.robots import RobotModel
from flangeye.types import (
    BASE,
    BASE2,
    CAMERA,
    FLANGE,
    FLANGE2,
    TARGET,
    CircleFeature,
    HandEye,
    Observation,
    Observations,
    PoseFeature,
    Source,
    Transform,
    by_frame,
)
from flangeye.types.geometry import (
    hat,
    invert,
    rigid,
    rotation_exp,
    rotation_from_quaternion,
    rotation_from_rpy,
    rotation_log,
)
from flangeye_plugins.solve.robust import RobustParams, solve_cell

ROBOT = load_model("robots", "ur5", None)
KNOWN = (0.02, -0.01, 0.05), (0.1, -0.2, 0.3)

CONFIGURATIONS = {
    "eye-on-base, flange": Configuration(stands=ORIGIN),
    "eye-on-base, marker": Configuration(),
    "eye-in-hand, marker": Configuration("eye-in-hand", FLANGE, BASE),
    "eye-in-hand, base circle": Configuration("eye-in-hand", FLANGE, BASE, KNOWN),
    "eye-on-arm 1, marker": Configuration("eye-on-arm", "link3", FLANGE),
    "eye-on-arm 1, flange": Configuration("eye-on-arm", "link3", FLANGE, ORIGIN),
    "eye-on-arm 2, marker": Configuration("eye-on-arm", "link3", BASE),
    "eye-on-arm 2, base circle": Configuration("eye-on-arm", "link3", BASE, KNOWN),
    "two arms, marker": Configuration("two-arms", FLANGE, FLANGE2),
    "two arms, flange": Configuration("two-arms", FLANGE, FLANGE2, ORIGIN),
}


@dataclass(frozen=True)
class Noise:
    """Standard deviations; the issue's by default."""

    turn: float = np.radians(0.05)
    shift: float = 1e-4
    arm_turn: float = 2e-4
    arm_shift: float = 5e-5

    def scaled(self, k: float) -> "Noise":
        return Noise(k * self.turn, k * self.shift, k * self.arm_turn, k * self.arm_shift)


@dataclass(frozen=True)
class Session:
    configuration: Configuration
    observations: list
    truth: dict

    def stream(self):
        return Observations(self.observations, Source("cells"), len(self.observations))


def rotation(rng):
    return rotation_from_quaternion(rng.standard_normal(4))


def moves(rng, n, tilt, reach=0.15):
    """Return (n, 4, 4) small motions: roll, pitch, yaw within the tilt, shifts within the reach."""
    turns = [rotation_from_rpy(*rng.uniform(-tilt, tilt, 3)) for _ in range(n)]
    return np.array([rigid(r, rng.uniform(-reach, reach, 3)) for r in turns])


TILT = np.radians(17)
HOME = np.array([0.2, -1.4, 1.3, -1.2, -1.4, 0.3])
"""Joint angles of an arm a link of which carries the camera."""
ISSUE = Noise()
OF_95_PERCENT, OF_MOST = 12.592, 22.458
"""Chi-square quantiles of six degrees of freedom: 95 % and 99.9 %."""


def session(
    configuration, rng, n=15, tilt=TILT, noise=ISSUE, feature="pose", poses=None, joints=None
):
    """Draw a session whose target is some 0.6 m before the camera.

    ``poses`` gives (n, 4, 4) motions of every arm in place of those drawn, or (2, n, 4, 4), and
    ``joints`` (n, 6) where a link carries the camera.
    """
    homes = [rigid(rotation(rng), np.array([0.4, 0.1, 0.4])) for _ in range(2)]
    drawn = [moves(rng, n, tilt) if poses is None else poses for _ in range(2)]
    drawn = drawn[0] if np.ndim(drawn[0]) == 4 else drawn
    first, second = homes[0] @ drawn[0], homes[1] @ drawn[1]
    if "link" in configuration.camera + configuration.target:
        joints = HOME + rng.uniform(-tilt, tilt, (n, 6)) if joints is None else joints
        first = Arm(ROBOT).flange(joints)
    x = rigid(rotation(rng), rng.normal(0, 0.05, 3))
    z = configuration.place
    seen = rigid(rotation_from_rpy(np.pi, 0, 0), np.array([0.0, 0.0, 0.6]))
    # Carriers as reported; the place left over closes the loop at the first pose.
    bare = [_observation(i, None, first, joints, second, configuration) for i in range(n)]
    frames = cell_of(configuration, ROBOT, ROBOT).graph(bare)
    still = Frame(BASE, np.tile(np.eye(4), (n, 1, 1)))
    carriers = (configuration.camera, configuration.target)
    a, b = (np.asarray(frames.get(x, still).place) for x in carriers)
    y = np.eye(4)
    if configuration.other_base:
        z = rigid(rotation(rng), rng.normal(0, 0.05, 3)) if z is None else z
        y = a[0] @ x @ seen @ invert(b[0] @ z)
    elif z is None:
        z = invert(b[0]) @ a[0] @ x @ seen
    else:
        x = invert(a[0]) @ b[0] @ z @ invert(seen)
    a, b = (
        m if frame == BASE else m @ _jitter(rng, n, noise.arm_turn, noise.arm_shift)
        for frame, m in ((configuration.camera, a), (configuration.target, b))
    )
    true = invert(a @ x) @ (y @ b @ z)
    observations = [
        replace(o, feature=_feature(m, noise, feature, rng))
        for o, m in zip(bare, true, strict=True)
    ]
    values = [x, *([y] if configuration.other_base else []), z]
    return Session(
        configuration, observations, dict(zip(configuration.unknowns, values, strict=False))
    )


def _observation(i, feature, first, joints, second, configuration):
    return Observation(
        f"{i:03d}",
        feature,
        by_frame(
            Transform(BASE, FLANGE, first[i]),
            Transform(BASE2, FLANGE2, second[i]) if configuration.other_base else None,
        ),
        None if joints is None else joints[i],
    )


def _jitter(rng, n, turn, shift):
    out = np.tile(np.eye(4), (n, 1, 1))
    out[:, :3, :3] = rotation_exp(turn * rng.standard_normal((n, 3)))
    out[:, :3, 3] = shift * rng.standard_normal((n, 3))
    return out


def _feature(true, noise, kind, rng):
    turned = rotation_exp(noise.turn * rng.standard_normal(3)) @ true[:3, :3]
    centre = true[:3, 3] + noise.shift * rng.standard_normal(3)
    turn, shift = noise.turn**2, noise.shift**2
    if kind == "pose":
        covariance = np.diag([turn] * 3 + [shift] * 3)
        return PoseFeature(Transform(CAMERA, TARGET, rigid(turned, centre)), covariance)
    normal = turned[:, 2] if kind == "normal" else None
    of_normal = None if normal is None else -turn * hat(normal) @ hat(normal)
    return CircleFeature(centre, normal, {"rim": 0.0315}, shift * np.eye(3), of_normal, 1.0)


EXACT = Noise(1e-7, 1e-8, 0.0, 0.0)
"""Of features alone: a millionth of what real ones have."""


def problem_in(name: str, feature: str, n: int = 15, seed: int = 1) -> Problem:
    """Return the problem of a session of a configuration whose sightings are exact."""
    configuration = CONFIGURATIONS[name]
    made = session(configuration, np.random.default_rng(seed), n, 0.6, EXACT, feature)
    return problem_of(made.observations, cell_of(configuration, ROBOT, ROBOT), True)


def errors(found, truth):
    """Return (6,) rotation and translation error, as the covariance of an estimate takes it."""
    error = found.transform.matrix @ np.linalg.inv(truth)
    shift = error[:3, :3] @ found.about + error[:3, 3] - found.about
    return np.concatenate([rotation_log(error[:3, :3]), shift])


def moving(times):
    """Return (n, 4, 4) the motion of an arm that never stands still, some 0.2 m/s and 0.5 rad/s."""
    turn = np.stack([0.4 * np.sin(times), 0.3 * np.cos(1.3 * times), 0.4 * np.sin(0.7 * times)], 1)
    place = np.stack([0.15 * np.sin(1.1 * times), 0.15 * np.cos(0.9 * times),
                      0.1 * np.sin(1.7 * times)], 1)  # fmt: skip
    return np.array([rigid(rotation_exp(w), p) for w, p in zip(turn, place, strict=True)])


def passing(configuration, rng, delay, n=40, **more):
    """Draw a session of a moving arm, seen by ``delay`` [s] later than the poses' times."""
    at = np.sort(rng.uniform(1.0, 25.0, n))
    if configuration.name == "eye-on-arm":
        return _turning(configuration, rng, (at, delay), **more)
    made = session(configuration, rng, n=n, poses=both(at + delay), **more)
    stream, before, start = np.arange(0.0, 26.0, 0.01), made.observations[0].poses, both(at + delay)
    moved = {
        name: before[name].matrix @ invert(first[0]) @ motion
        for name, first, motion in zip((FLANGE, FLANGE2), start, both(stream), strict=True)
        if name in before
    }
    second = {FLANGE2: (stream, moved[FLANGE2])} if FLANGE2 in moved else None
    out = []
    for o, when in zip(made.observations, at, strict=True):
        motion = passed(stream, moved[FLANGE], when, second)
        at_pose = {FLANGE: pose_at(motion, 0.0)}
        at_pose |= {name: pose_at(motion, 0.0, name) for name in motion.others}
        poses = {name: replace(o.poses[name], matrix=x) for name, x in at_pose.items()}
        out.append(replace(o, poses=poses, motion=motion))
    return replace(made, observations=out)


def _turning(configuration, rng, when, **more):
    """Draw the same of an arm a link of which carries the camera, its joints recorded."""
    at, delay = when
    made = session(configuration, rng, n=len(at), joints=swinging(at + delay), **more)
    stream, out = np.arange(0.0, 26.0, 0.01), []
    for o, time in zip(made.observations, at, strict=True):
        motion = passed(stream, Arm(ROBOT).flange(swinging(stream)), time)
        motion = with_joints(motion, time, FLANGE, (stream, swinging(stream)))
        flange = replace(o.poses[FLANGE], matrix=pose_at(motion, 0.0))
        joints = joints_at(motion, 0.0, FLANGE)
        out.append(replace(o, poses={FLANGE: flange}, joints=joints, motion=motion))
    return replace(made, observations=out)


def swinging(times):
    """Return (n, 6) joint angles of an arm that never stands still, some 0.3 rad/s each."""
    rates = np.array([0.7, 1.3, 0.9, 1.1, 1.7, 0.8])
    return HOME + 0.3 * np.sin(np.multiply.outer(times, rates) + np.arange(6))


def both(times):
    """Return the motions of two arms that never stand still."""
    return moving(times), moving(1.3 * times + 5.0)


def answer(
    observations: Sequence[Observation],
    configuration: Configuration,
    robot: RobotModel | None = ROBOT,
    **params: Any,
) -> HandEye:
    """Return what ``solve.robust`` finds in a configuration."""
    standing = cell_of(configuration, robot, robot)
    return solve_cell(observations, standing, RobustParams.model_validate(params))


def solved(made: Session, robot: RobotModel | None = ROBOT, **params: Any) -> HandEye:
    """Return what ``solve.robust`` finds in a session."""
    return answer(made.observations, made.configuration, robot, **params)


def squares(found: HandEye, truth: dict[str, Any]) -> list[float]:
    """Return the squared distance of each true transform, in what is stated of it.

    Of what nothing tells, such as a circle's turn about itself, nothing counts.
    """
    out = []
    for estimate in found.true:
        off, free = errors(estimate, truth[estimate.transform.name]), estimate.unobservable
        off = off - free.T @ (free @ off)
        out.append(float(off @ np.linalg.pinv(estimate.covariance, 1e-12) @ off))
    return out


def squares_at(found: HandEye, places: dict[str, Any]) -> list[float]:
    """Return the same where the true places (4, 4) are known by their frames."""
    return squares(found, {n: places[x.transform.child] for n, x in found.transforms.items()})
