"""The loop A X M = Y B Z of one camera and one target, predicted and linearised. Arrays only.

The graph of frames (:mod:`flangeye.handeye.graph`) of every configuration with one camera, written
out: it has closed forms to begin with, and what walks.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from flangeye.handeye.likelihood import Problem
from flangeye.handeye.measurements import Loop, Measurements
from flangeye.handeye.nuisance import Nuisance
from flangeye.handeye.unknowns import Linear, Unknowns
from flangeye.handeye.walk import Of
from flangeye.maths.geometry import each_applied, hat, rotation_between, rotation_exp, rotation_log
from flangeye.types import Floats

COLUMNS = 20
"""Six for each of X, Y, Z; two for a tilt common to all normals. Nuisances come after."""


@dataclass(frozen=True)
class ArmNoise:
    """Noise of a reported flange: standard deviations of rotation [rad] and translation [m]."""

    rotation: float
    translation: float

    @property
    def covariance(self) -> Floats:
        """(6, 6) in the flange's frame."""
        return np.diag([self.rotation**2] * 3 + [self.translation**2] * 3)


@dataclass(frozen=True, eq=False, kw_only=True)
class LoopProblem(Problem):
    """What is given of a loop.

    Attributes:
        measurements: N of them.
        loop: What is unknown.
        arms: Noise of the arms' reported poses; None where nothing is known of it.
    """

    measurements: Measurements
    loop: Loop
    arms: ArmNoise | None

    def linearised(self, at: Unknowns) -> Linear:
        """Return what is predicted at some values of the unknowns."""
        return linearise(self.measurements, self.loop, at, self.arms, self.nuisance)

    def free(self, at: Unknowns) -> Floats:
        """Return a basis of the moves that anything could be known of; see ``free_columns``."""
        return free_columns(self.measurements, self.loop, at, self.tilt)


def linearise(
    measurements: Measurements,
    loop: Loop,
    at: Unknowns,
    arms: ArmNoise | None,
    nuisance: Nuisance | None = None,
) -> Linear:
    """Predict every measurement, and how the prediction moves with each unknown."""
    if at.course is not None:
        measurements = at.course.applied(measurements)
    chain = _Chain(measurements, at)
    jacobian = np.zeros((len(measurements), 6, COLUMNS + len(at.nuisance)))
    jacobian[:, :, :6] = chain.of_camera()
    if loop.y:
        jacobian[:, :, 6:12] = chain.of_second_base()
    if loop.z:
        jacobian[:, :, 12:18] = chain.of_place()
    jacobian[:, :3, 18:COLUMNS] = chain.turns @ at.z[:3, :2]
    residuals = chain.residuals()
    of_camera, of_target = chain.of_camera_arm(), chain.of_arm()
    if nuisance is not None and len(nuisance):
        moves = of_camera @ nuisance.camera + of_target @ nuisance.target + nuisance.seen
        jacobian[:, :, COLUMNS:] = measurements.projectors @ moves
        residuals = residuals - jacobian[:, :, COLUMNS:] @ at.nuisance
    covariance = np.zeros((len(measurements), 6, 6))
    if arms is not None:
        for moved, effect in (loop.camera_moves, of_camera), (loop.target_moves, of_target):
            if moved:
                covariance += effect @ arms.covariance @ effect.transpose(0, 2, 1)
    drift = (
        measurements.projectors @ chain.of_walk(at.course.of)
        if at.course
        else np.zeros((len(jacobian), 6, 0))
    )
    return Linear(residuals, jacobian, covariance, drift)


class _Chain:
    """The chain from the camera's carrier to the target, and its derivatives."""

    def __init__(self, measurements: Measurements, at: Unknowns) -> None:
        self._s, self._at = measurements, at
        self._eye = at.x[:3, :3].T
        self._to_carrier = np.swapaxes(measurements.a[:, :3, :3], 1, 2)
        self._seen = measurements.offsets @ at.z[:3, :3].T + at.z[:3, 3]
        carried = each_applied(measurements.b, self._seen)
        self._from_base2 = carried @ at.y[:3, :3].T
        self._in_base = in_base = self._from_base2 + at.y[:3, 3]
        in_carrier = (self._to_carrier @ (in_base - measurements.a[:, :3, 3])[..., None])[..., 0]
        self._in_carrier, self._from_camera = in_carrier, in_carrier - at.x[:3, 3]
        self._to_target_carrier = self._to_carrier @ at.y[:3, :3] @ measurements.b[:, :3, :3]
        self.turns = self._eye @ self._to_target_carrier

    def residuals(self) -> Floats:
        s, at = self._s, self._at
        predicted = self.turns @ at.z[:3, :3] @ rotation_exp(np.append(at.tilt, 0.0))
        turned, whole = np.zeros((len(s), 3)), s.freedoms == 6
        if whole.any():
            turned[whole] = rotation_log(s.rotations[whole] @ np.swapaxes(predicted[whole], 1, 2))
        if not whole.all():
            turned[~whole] = rotation_between(predicted[~whole, :, 2], s.rotations[~whole, :, 2])
        out = np.concatenate([turned, s.centres - self._from_camera @ self._eye.T], axis=1)
        return np.asarray((s.projectors @ out[..., None])[..., 0])

    def of_camera(self) -> Floats:
        return self._blocks(-self._eye, self._eye @ hat(self._from_camera), -self._eye)

    def of_second_base(self) -> Floats:
        turn = self._eye @ self._to_carrier
        return self._blocks(turn, -turn @ hat(self._from_base2), turn)

    def of_walk(self, of: Of) -> Floats:
        if of == "base":
            turn = self._eye @ self._to_carrier
            moved = self._blocks(turn, -turn @ hat(self._in_base), turn)
        else:
            moved = -(self.of_camera_arm() if of == "camera" else self.of_arm())
        longer = np.concatenate([np.zeros_like(self._s.centres), -self._s.centres], axis=1)
        return np.concatenate([moved, longer[..., None]], axis=2)

    def of_place(self) -> Floats:
        from_origin = self._seen - self._at.z[:3, 3]
        return self._blocks(self.turns, -self.turns @ hat(from_origin), self.turns)

    def of_camera_arm(self) -> Floats:
        return self._blocks(-self._eye, self._eye @ hat(self._in_carrier), -self._eye)

    def of_arm(self) -> Floats:
        return self._blocks(self.turns, -self.turns @ hat(self._seen), self.turns)

    def _blocks(self, turn: Floats, lever: Floats, shift: Floats) -> Floats:
        out = np.zeros((len(self._s), 6, 6))
        out[:, :3, :3], out[:, 3:, :3], out[:, 3:, 3:] = turn, lever, shift
        return out


def free_columns(
    measurements: Measurements, loop: Loop, at: Unknowns, tilt: float | None
) -> Floats:
    """Return (20 + k, p), a basis of the moves that anything could be known of.

    Those of X; of Y where there is one; of the target's place where it is unknown: of a circle not
    the turn about its own axis, of a centre no turn at all. The tilt of all normals, where the
    place is known. Every nuisance.
    """
    eye = np.eye(COLUMNS + len(at.nuisance))
    basis = [eye[:, :6]]
    if loop.y:
        basis.append(eye[:, 6:12])
    if loop.z:
        basis += [_turns_of_place(measurements, at, seen=True), eye[:, 15:18]]
    elif tilt is not None and (measurements.freedoms == 5).any():
        basis.append(eye[:, 18:COLUMNS])
    return np.concatenate([*basis, eye[:, COLUMNS:]], axis=1)


def meaningless_turns(measurements: Measurements, loop: Loop, at: Unknowns) -> Floats:
    """Return (20 + k, m) the turns of the target's place that its features do not have."""
    if not loop.z:
        return np.zeros((COLUMNS + len(at.nuisance), 0))
    return _turns_of_place(measurements, at, seen=False)


def _turns_of_place(measurements: Measurements, at: Unknowns, seen: bool) -> Floats:
    known = {6: 3, 5: 2, 3: 0}[int(measurements.freedoms.max())]
    axes = at.z[:3, :known] if seen else at.z[:3, known:3]
    turns = np.zeros((COLUMNS + len(at.nuisance), axes.shape[1]))
    turns[12:15] = axes
    return turns
