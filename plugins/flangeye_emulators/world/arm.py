"""A simulated arm whose true pose differs from the reported one, like a real arm's."""

from typing import Literal, NamedTuple

import numpy as np

from flangeye.models.robots import Joint, RobotModel
from flangeye.plugin.stage import Params
from flangeye.types import Floats
from flangeye.units import Angle, param


class ErrorSizes(NamedTuple):
    """Standard deviations of an arm's simulated errors [rad, m]."""

    zeros: float
    lengths: float = 0.0
    twists: float = 0.0
    eccentricity: float = 0.0
    sag: float = 0.0
    backlash: float = 0.0
    drift: float = 0.0


REAL = ErrorSizes(1e-3, 0.15e-3, 0.2e-3, 0.4e-3, 2e-3, 0.1e-3, 0.1e-3)
"""Sizes with which a rigid fit of simulated sessions has the residuals of published recordings of
such arms: 0.35 to 0.7 mm rms, most of it smooth over the workspace."""


class ArmErrors(Params):
    """Errors of the simulated arm against its controller's model."""

    quality: Literal["exact", "kind", "real"] = "kind"
    """kind: errors of the joint zeros only, of the robot's joint_accuracy; exact: no errors, and
    poses that repeat exactly; real: errors as in published recordings. zeros replaces the
    preset's value."""
    zeros: Angle | None = param(None, ge=0)
    """Standard deviation of the joints' zeros; real: 1 mrad."""

    def sizes(self, robot: RobotModel) -> ErrorSizes:
        """Return the standard deviations for a robot model."""
        kind = ErrorSizes(robot.joint_accuracy)
        preset = {"exact": ErrorSizes(0.0), "kind": kind, "real": REAL}[self.quality]
        return preset if self.zeros is None else preset._replace(zeros=self.zeros)

    @property
    def is_default(self) -> bool:
        """Whether no error is requested."""
        return self == ArmErrors()


class ImperfectArm:
    """An arm with errors of joint zeros, lengths, encoders and elasticity; a rail has none.

    The first joint's zero has no error by definition: it defines the base's x axis, and an error
    would be the same as a rotation of the base.
    """

    def __init__(
        self,
        robot: RobotModel,
        scale: float,
        rng: np.random.Generator,
        errors: ArmErrors | ErrorSizes | None = None,
    ) -> None:
        """Draw the arm's errors; ``scale`` multiplies every one, 0 gives a perfect arm."""
        from flangeye.maths.kinematics import Arm

        given = errors if isinstance(errors, ErrorSizes) else (errors or ArmErrors()).sizes(robot)
        sizes = ErrorSizes(*(scale * np.array(given)))
        self._believed = Arm(robot)
        # Data sheets give the mean plus three standard deviations of the distance from the mean
        # position (ISO 9283): 3.6 times the deviation along one axis, when all three are alike
        self._scatter = scale * robot.repeatability / 3.6
        n, turns = self._believed.n, ~self._believed.slides
        self.zeros = sizes.zeros * rng.standard_normal(n) * turns
        self.zeros[0] = 0.0
        self._actual = Arm(_as_built(robot, sizes, rng))
        self._phases = rng.uniform(0, 2 * np.pi, n)
        self._eccentricity, self._sag, self._backlash = np.outer(sizes[3:6], turns)
        self._drift = sizes.drift * rng.standard_normal(n) * turns
        self._drift[0] = 0.0

    def reported(self, joints: Floats) -> Floats:
        """Return the nominal ``base_T_flange`` (..., 4, 4) at joint angles (..., n) [rad]."""
        return self._believed.flange(joints)

    def angles(self, joints: Floats) -> Floats:
        """Return the true joint angles (N, n) at N poses visited in this order [rad].

        Args:
            joints: (N, n) commanded and reported joint angles [rad].
        """
        came_from = np.sign(np.diff(joints, axis=0, prepend=joints[:1]))
        warm = 1 - np.exp(-3 * np.linspace(0, 1, len(joints)))
        angles = joints + self.zeros + self._eccentricity * np.sin(joints + self._phases)
        angles = angles - self._backlash / 2 * came_from + warm[:, None] * self._drift
        return np.asarray(angles + self._sag * self._levers(angles))

    def flange(self, angles: Floats) -> Floats:
        """Return the true mean ``base_T_flange`` (..., 4, 4) at true angles (..., n) [rad]."""
        return self._actual.flange(angles)

    def frames(self, angles: Floats) -> Floats:
        """Return the true link frames (..., n + 1, 4, 4) at true angles (..., n) [rad]."""
        return self._actual.frames(angles)

    def stand(self, angles: Floats, rng: np.random.Generator) -> tuple[Floats, Floats]:
        """Return link frames (..., n + 1, 4, 4) and flange (..., 4, 4) with repeatability errors.

        Args:
            angles: (..., n) true joint angles from :meth:`angles` [rad].
            rng: Random generator of the repeatability errors.
        """
        base_T_flange = self.flange(angles)
        base_T_flange[..., :3, 3] += self._scatter * rng.standard_normal((*angles.shape[:-1], 3))
        return self.frames(angles), base_T_flange

    def _levers(self, angles: Floats) -> Floats:
        """Return gravity's lever arm about each joint (N, n): torque over supported weight [m].

        The weight is assumed to be distributed evenly over the origins of the links beyond the
        joint.
        """
        frames = self._actual.frames(angles)
        axes, origins = self._actual.axes(angles)
        n = self._actual.n
        carried = [frames[:, i + 1 :, :3, 3].mean(axis=1) - origins[:, i] for i in range(n)]
        falling = np.cross(axes, np.stack(carried, axis=1))
        # Where things fall, in `base`
        return np.asarray(falling @ (0.0, 0.0, -1.0))


def _as_built(robot: RobotModel, sizes: ErrorSizes, rng: np.random.Generator) -> RobotModel:
    """Return the robot model with true lengths and twists."""
    joints = tuple(_altered(j, robot.convention == "urdf", sizes, rng) for j in robot.joints)
    return robot.model_copy(update={"joints": joints})


def _altered(joint: Joint, urdf: bool, sizes: ErrorSizes, rng: np.random.Generator) -> Joint:
    lengths, twists = sizes.lengths * rng.standard_normal(3), sizes.twists * rng.standard_normal(3)
    if urdf:
        return joint.model_copy(
            update={"xyz": tuple(joint.xyz + lengths), "rpy": tuple(joint.rpy + twists)}
        )
    a, d, alpha = joint.a + lengths[0], joint.d + lengths[1], joint.alpha + twists[0]
    return joint.model_copy(update={"a": a, "d": d, "alpha": alpha})
