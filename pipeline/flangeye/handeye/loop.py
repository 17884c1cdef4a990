"""The loop A X M = Y B Z, predicted and linearised, for every configuration. Arrays only.

Unknowns are moved by (rotation, translation), ``R' = Exp(phi) R`` and ``t' = t + tau``, in the
parent's frame. The residual of a measurement is what takes the predicted target in the camera to
the measured one, in the same way.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from flangeye.handeye.components import FINEST, Noise
from flangeye.handeye.measurements import Loop, Measurements
from flangeye.handeye.nuisance import Nuisance
from flangeye.handeye.walk import Course, Of
from flangeye.maths.geometry import each_applied, hat, rotation_between, rotation_exp, rotation_log
from flangeye.types import Floats

COLUMNS = 20
"""Six for each of X, Y, Z; two for a tilt common to all normals. Nuisances come after."""


@dataclass(frozen=True, eq=False)
class Unknowns:
    """Values of the unknowns.

    Attributes:
        x: (4, 4) camera carrier to camera.
        y: (4, 4) second base in the first.
        z: (4, 4) target in its carrier.
        tilt: (2,) of all normals, about the target's x and y [rad].
        nuisance: (k,) of the arms.
        course: Where the base walked; None where it rests.
    """

    x: Floats
    y: Floats
    z: Floats
    tilt: Floats
    nuisance: Floats = field(default_factory=lambda: np.zeros(0))
    course: Course | None = None

    def moved(self, step: Floats) -> Unknowns:
        """Return the unknowns moved by (20 + k,)."""
        x, y, z = (
            _moved(m, step[6 * k : 6 * k + 6]) for k, m in enumerate((self.x, self.y, self.z))
        )
        tilt, nuisance = self.tilt + step[18:COLUMNS], self.nuisance + step[COLUMNS:]
        return Unknowns(x, y, z, tilt, nuisance, self.course)


def _moved(transform: Floats, step: Floats) -> Floats:
    out = transform.copy()
    out[:3, :3] = rotation_exp(step[:3]) @ transform[:3, :3]
    out[:3, 3] += step[3:]
    return out


@dataclass(frozen=True)
class ArmNoise:
    """Noise of a reported flange: standard deviations of rotation [rad] and translation [m]."""

    rotation: float
    translation: float

    @property
    def covariance(self) -> Floats:
        """(6, 6) in the flange's frame."""
        return np.diag([self.rotation**2] * 3 + [self.translation**2] * 3)


@dataclass(frozen=True, eq=False)
class Linear:
    """The loop at some values of its unknowns.

    Attributes:
        residuals: (N, 6).
        jacobian: (N, 6, 20 + k) of what is predicted.
        of_arms: (N, 6, 6) covariance that the arms' noise has in the camera; None if not stated.
        drift: (N, 6, s) of what is predicted by a motion of the base, and of the camera's scale;
            none where it rests.
    """

    residuals: Floats
    jacobian: Floats
    of_arms: Floats
    drift: Floats

    def where(self, chosen: NDArray[np.bool_]) -> Linear:
        """Return some of the measurements."""
        each = self.residuals, self.jacobian, self.of_arms, self.drift
        return Linear(*(of_all[chosen] for of_all in each))


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


def weights_of(measurements: Measurements, linear: Linear, noise: Noise) -> Floats:
    """Return the (N, 6, 6) inverse covariances, zero across what was not measured."""
    scale = np.repeat(np.sqrt([noise.normal_scale, noise.centre_scale]), 3)
    extra = np.diag(np.repeat([noise.tilt + FINEST**2, noise.pose + FINEST**2], 3))
    own = measurements.covariances + noise.arms * linear.of_arms
    extra[5, 5] += noise.depth
    covariance = own * np.outer(scale, scale) + extra
    if measurements.are_poses:
        return np.asarray(np.linalg.inv(covariance))
    p = measurements.projectors
    return np.asarray(p @ np.linalg.inv(p @ covariance @ p + (np.eye(6) - p)) @ p)
