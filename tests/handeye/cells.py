"""Observations of known truth for every configuration, drawn in a moment."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from flangeye.handeye.components import Noise as Beyond
from flangeye.handeye.likelihood import Solution, climb, weigh
from flangeye.handeye.loop import ArmNoise, LoopProblem
from flangeye.handeye.measurements import loop_of, measurements_of
from flangeye.handeye.nuisance import Nuisance, nuisance_of
from flangeye.handeye.starts import start_of
from flangeye.handeye.unknowns import Unknowns
from flangeye.maths.geometry import (
    hat,
    invert,
    rigid,
    rotation_exp,
    rotation_from_quaternion,
    rotation_from_rpy,
    rotation_log,
)
from flangeye.maths.kinematics import Arm
from flangeye.maths.streams import joints_at, passed, pose_at, with_joints
from flangeye.models.configuration import ORIGIN, Configuration, carriers_of
from flangeye.models.loading import load_model
from flangeye.types import (
    BASE,
    BASE2,
    CAMERA,
    FLANGE,
    FLANGE2,
    TARGET,
    CircleFeature,
    Observation,
    Observations,
    PoseFeature,
    Source,
    Transform,
    by_frame,
)

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
NOTHING_BEYOND = Beyond(0.0, 0.0)


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
    if configuration.name == "eye-on-arm":
        joints = HOME + rng.uniform(-tilt, tilt, (n, 6)) if joints is None else joints
        first = Arm(ROBOT).flange(joints)
    x = rigid(rotation(rng), rng.normal(0, 0.05, 3))
    z = configuration.place
    seen = rigid(rotation_from_rpy(np.pi, 0, 0), np.array([0.0, 0.0, 0.6]))
    # Carriers as reported; the place left over closes the loop at the first pose.
    bare = [_observation(i, None, first, joints, second, configuration) for i in range(n)]
    carriers = carriers_of(configuration, bare, Arm(ROBOT))
    a, b, y = carriers.camera, carriers.target, np.eye(4)
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
    turn, shift = max(noise.turn, 1e-7) ** 2, max(noise.shift, 1e-7) ** 2
    if kind == "pose":
        covariance = np.diag([turn] * 3 + [shift] * 3)
        return PoseFeature(Transform(CAMERA, TARGET, rigid(turned, centre)), covariance)
    normal = turned[:, 2] if kind == "normal" else None
    of_normal = None if normal is None else -turn * hat(normal) @ hat(normal)
    return CircleFeature(centre, normal, {"rim": 0.0315}, shift * np.eye(3), of_normal, 1.0)


def errors(found, truth):
    """Return (6,) rotation and translation error, as the covariance of an estimate takes it."""
    error = found.transform.matrix @ np.linalg.inv(truth)
    shift = error[:3, :3] @ found.about + error[:3, 3] - found.about
    return np.concatenate([rotation_log(error[:3, :3]), shift])


def wandering(made, rng, turn=2e-3, shift=1e-3, wrong=0.08):
    """Return a session of poses with noise that lasts for some twenty poses, and wrong ones."""
    walk, out = np.zeros(6), []
    for o in made.observations:
        walk = 0.95 * walk + np.sqrt(1 - 0.95**2) * rng.standard_normal(6)
        off = np.concatenate([turn * walk[:3], shift * walk[3:]])
        if rng.random() < wrong:
            off = np.concatenate([rng.normal(0, 0.5, 3), rng.normal(0, 0.1, 3)])
        pose = o.feature.camera_T_target.matrix
        moved = rigid(rotation_exp(off[:3]) @ pose[:3, :3], pose[:3, 3] + off[3:])
        feature = PoseFeature(Transform(CAMERA, TARGET, moved), o.feature.covariance)
        out.append(replace(o, feature=feature))
    return replace(made, observations=out)


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


def walking(made, rng, turn=5e-4, shift=2e-4):
    """Return a session in whose steps camera and target walk at random against each other."""
    cell, motion, out = made.configuration, np.eye(4), []
    x = next(iter(made.truth.values()))
    for o in made.observations:
        hand = o.base_T_flange.matrix if cell.camera == FLANGE else np.eye(4)
        seen, camera = o.feature.camera_T_target.matrix, hand @ x
        place = camera @ seen if cell.camera == FLANGE else camera
        step = rigid(rotation_exp(rng.normal(0, turn, 3)), rng.normal(0, shift, 3))
        motion = place @ step @ invert(place) @ motion
        moved = Transform(CAMERA, TARGET, invert(camera) @ motion @ camera @ seen)
        out.append(replace(o, feature=PoseFeature(moved, o.feature.covariance)))
    return replace(made, observations=out)


def given(name: str, feature: str, n: int, noise: Noise = ISSUE, **more: Any) -> LoopProblem:
    """Return the problem of a session of n measurements; its noise is stated, where not said."""
    configuration = CONFIGURATIONS[name]
    made = session(configuration, np.random.default_rng(n), n, 0.4, noise, feature)
    measured = measurements_of(made.observations, configuration, Arm(ROBOT))
    more = {"stated": True, **more}
    return LoopProblem(
        measurements=measured,
        loop=loop_of(configuration),
        arms=ArmNoise(2e-4, 5e-5),
        tilt=1e-3,
        **more,
    )


def start(problem: LoopProblem) -> Unknowns:
    """Return where its search begins."""
    return start_of(problem.measurements, problem.loop, np.random.default_rng(0))


def fitted(problem: LoopProblem, beyond: Beyond = NOTHING_BEYOND) -> Solution:
    """Return the most likely unknowns, all measurements taking part."""
    every = np.ones(len(problem.measurements))
    return climb(problem, weigh(problem, start(problem), beyond, every), beyond, every)


def two_numbers(n: int, sized: bool = False) -> Nuisance:
    """Return two nuisances of random effects, expected at values of their own."""
    effects = np.random.default_rng(7).normal(size=(3, n, 6, 2))
    told = nuisance_of(effects[0], effects[1], 2e-4, sized, effects[2])
    return replace(told, mean=np.array([1e-4, -2e-4]))


def with_wrong(problem, count):
    """Return a problem whose first measurements are wrong, and which those are (N,)."""
    s, n = problem.measurements, len(problem.measurements)
    wrong, aside = np.arange(n) < count, rotation_exp(np.random.default_rng(1).normal(size=(n, 3)))
    rotations = np.where(wrong[:, None, None], aside @ s.rotations, s.rotations)
    centres = s.centres + np.where(wrong[:, None], [0.3, -0.2, 0.1], 0.0)
    return replace(problem, measurements=replace(s, rotations=rotations, centres=centres)), wrong
