"""Sessions of arms that are as bad as one likes, of known truth, for every configuration."""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from flangeye.maths.kinematics import Arm
from flangeye.models.configuration import LINK, Configuration
from flangeye.types import (
    BASE,
    BASE2,
    FLANGE,
    FLANGE2,
    Floats,
    HandEye,
    Observation,
    Transform,
    by_frame,
)
from flangeye.types.geometry import invert, rigid, rotation_from_rpy
from flangeye_emulators.world.arm import ArmErrors, ImperfectArm
from tests.estimation.cells import ROBOT, Noise, _feature, answer, errors

ARM, HOME = Arm(ROBOT), np.array([0.2, -1.4, 1.3, -1.2, -1.4, 0.3])
NOISE = Noise(turn=5e-4, shift=1e-4)
AHEAD = rigid(rotation_from_rpy(np.pi, 0, 0), np.array([0.0, 0.0, 0.6]))
REAL = ArmErrors(quality="real")


def worse(times: float) -> ArmErrors:
    """Return an arm whose joints' zeros are so many times worse than its file states."""
    return ArmErrors(zeros=f"{times * ROBOT.joint_accuracy} rad")


class Moved(NamedTuple):
    """An arm at its poses: (n, 6) joints as reported, and as they are."""

    arm: ImperfectArm
    joints: Floats
    angles: Floats

    def at(self, frame: str) -> Floats:
        """Return (n, 4, 4) where a frame of it truly is."""
        if frame == BASE:
            return np.tile(np.eye(4), (len(self.joints), 1, 1))
        if frame.startswith(LINK):
            return self.arm.frames(self.angles)[:, int(frame.removeprefix(LINK))]
        return self.arm.flange(self.angles)


def drawn(
    configuration: Configuration, seed: int, arm: ArmErrors, n: int = 16, smooth: bool = False
) -> tuple[list[Observation], list[Floats]]:
    """Return what is seen of such arms, here and there or along a path, and the true transforms."""
    rng = np.random.default_rng(seed)
    arms = [_moved(rng, n, arm, smooth) for _ in range(2 if configuration.other_base else 1)]
    x, z = near(rng), near(rng) if configuration.other_base else np.eye(4)
    z = z if configuration.place is None else configuration.place
    camera, target = arms[0].at(configuration.camera), arms[-1].at(configuration.target)
    others = []
    if configuration.other_base:
        others = [camera[0] @ x @ AHEAD @ invert(target[0] @ z)]
        target = others[0] @ target
    elif configuration.place is not None:
        x = invert(camera[0]) @ target[0] @ z @ invert(AHEAD)
    elif configuration.camera == BASE:
        x, z = target[0] @ x @ invert(AHEAD), x
    else:
        z = invert(target[0]) @ camera[0] @ x @ AHEAD
    seen = invert(camera @ x) @ target @ z
    reported = [each.arm.reported(each.joints) for each in arms]
    joints = arms[0].joints if configuration.camera.startswith(LINK) else [None] * n
    kind = "pose" if configuration.place is None else "normal"
    observations = [
        Observation(f"{i:02d}", _feature(pose, NOISE, kind, rng), poses(reported, i), angles)
        for i, (pose, angles) in enumerate(zip(seen, joints, strict=True))
    ]
    return observations, [x, *others, *([z] if configuration.place is None else [])]


def near(rng: np.random.Generator) -> Floats:
    """Return (4, 4) where something is mounted."""
    return rigid(rotation_from_rpy(*rng.normal(0, 0.3, 3)), rng.normal(0, 0.05, 3))


def _moved(rng: np.random.Generator, n: int, errors: ArmErrors, smooth: bool) -> Moved:
    joints = HOME + rng.uniform(-0.5, 0.5, (n, 6))
    if smooth:
        along = np.linspace(0.0, 2 * np.pi, n)[:, None]
        joints = HOME + 0.5 * np.sin(along + rng.uniform(0.0, 2 * np.pi, 6))
    arm = ImperfectArm(ROBOT, 1.0, rng, errors)
    return Moved(arm, joints, arm.angles(joints))


def poses(reported: list[Floats], i: int) -> Mapping[str, Transform]:
    """Return the flanges' poses at one moment, as the controllers have them."""
    names = ((BASE, FLANGE), (BASE2, FLANGE2))
    return by_frame(*(Transform(*n, r[i]) for n, r in zip(names, reported, strict=False)))


def solved(observations: list[Observation], configuration: Configuration, **params: Any) -> HandEye:
    """Return the answer of ``solve.robust``."""
    return answer(observations, configuration, **params)


def squares(answer: HandEye, truth: list[Floats]) -> list[float]:
    """Return the squared distances of the true transforms, in what is stated of them."""
    estimates = answer.true
    off = [errors(found, true) for found, true in zip(estimates, truth, strict=True)]
    return [
        float(e @ np.linalg.solve(found.covariance, e))
        for e, found in zip(off, estimates, strict=True)
    ]
