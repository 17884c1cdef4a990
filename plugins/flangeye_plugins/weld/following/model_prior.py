"""The controller's model of tool, finger and joint, with its uncertainty."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from flangeye.models.finger import Finger
from flangeye.types import Floats
from flangeye_plugins.weld.frame import LeaningTool, body_from
from flangeye_plugins.weld.joint import WeldJoint, joint_of
from flangeye_plugins.weld.settings import Following

BAND = 2.0
"""The torch's 95 % band, in standard deviations."""


@dataclass(frozen=True)
class ModelPrior:
    """Prior of tool, finger and joint: values from the files, each with its standard deviation.

    Attributes:
        distance: Horizontal distance from the torch to the tip [m].
        lateral: Stiffness across the finger [N/m]; the default is a soft finger's.
        axial: Stiffness along the finger [N/m].
        half_angle: Angle of the joint's walls from their bisector [rad]; None if unknown.
        noise: Standard deviations of one measurement across and up [m].
        torch_sigma: Standard deviation of the torch's position across the tool, from the tip [m].
        along_sigma: Standard deviation of the distance from the torch to the tip [m].
        tip_sigma: Standard deviation of the tip in the flange, along each axis [m].
        two_walls: Whether the joint has a second wall that holds the tip.
        lean: Lean of the walls' bisector from the plane's normal, to the left [rad].
        radius: Radius of the tip's ball [m].
        level_R_tool: Rotation from the tool's axes to level axes; see
            :mod:`flangeye_plugins.weld.frame`.
        behind: Distance behind the torch at which a profile sensor sees the bead [m]; None without
            one.
        arc: Gas pre-flow, wait while the arc strikes, wait while the crater fills [s].
        ahead: Tip's position minus its position in the finger's file, forwards, from earlier welds
            [m].
        ahead_sigma: Standard deviation of ``ahead`` [m]; None without earlier welds: ``tip_sigma``.
        play: Expected half width of the finger's play and hysteresis [m].
        play_sigma: Standard deviation of ``play`` [m].
        stamp: Expected delay of the images' timestamps [s].
        stamp_sigma: Standard deviation of ``stamp`` [s].
    """

    distance: float
    lateral: float = 1000.0
    axial: float = 2000.0
    half_angle: float | None = None
    noise: tuple[float, float] = (10e-6, 60e-6)
    torch_sigma: float = 0.05e-3
    along_sigma: float = 0.3e-3
    tip_sigma: float = 0.1e-3
    two_walls: bool = True
    lean: float = 0.0
    radius: float = 1.5e-3
    level_R_tool: tuple[tuple[float, ...], ...] = (
        (1.0, 0.0, 0.0),
        (0.0, 1.0, 0.0),
        (0.0, 0.0, 1.0),
    )
    behind: float | None = None
    arc: tuple[float, float, float] = (0.0, 0.0, 0.0)
    ahead: float = 0.0
    ahead_sigma: float | None = None
    play: float = 0.0
    play_sigma: float = 0.1e-3
    stamp: float = 0.0
    stamp_sigma: float = 0.05

    @property
    def ahead_known(self) -> float:
        """Standard deviation of ``ahead`` before the sweep [m]."""
        return self.tip_sigma if self.ahead_sigma is None else self.ahead_sigma

    @property
    def joint(self) -> WeldJoint | None:
        """The joint's walls; None if unknown."""
        return None if self.half_angle is None else WeldJoint(self.half_angle, self.lean)

    @property
    def beside(self) -> float:
        """Offset of a tip that touches both walls, to the left of the seam [m]."""
        return 0.0 if self.joint is None else self.joint.seat(self.radius)[0]

    def set_down(self, settings: Following) -> float:
        """Return the lateral offset at which the tip is set down, to the left of the plan [m].

        At a joint with one upright wall this is on the flat plate, away from the wall.
        """
        return 0.0 if self.two_walls else self.beside - settings.sign * settings.reach / 2.0

    def pressing(self, settings: Following) -> Floats:
        """Return the tip's stiffness matrix (2, 2) [N/m].

        Rows are the forces towards the pressed wall and into the joint; columns are deflection and
        preload. The tip is free to slide along the seam.
        """
        axes = np.array(self.level_R_tool)
        stiff = axes @ np.diag([self.lateral, self.lateral, self.axial]) @ axes.T
        # No force along the seam, where the tip slides: the stiffness is condensed onto the rest
        free = stiff[1:, 1:] - np.outer(stiff[1:, 0], stiff[0, 1:]) / stiff[0, 0]
        facing = np.diag([settings.sign, -1.0])
        return np.asarray(facing @ free @ facing)

    def flat(self, side: float) -> float:
        """Return the tip's lateral motion per unit of height when it climbs a side's wall."""
        if self.joint is None:
            return 1.0
        # Nothing climbs a wall that leans by less than one degree.
        return math.tan(max(self.joint.left if side > 0 else self.joint.right, math.radians(1.0)))

    def seating(self, settings: Following) -> float | None:
        """Return the ratio of the force into the joint to the force that lifts the tip.

        Below 1 the tip climbs the pressed wall. For an upright joint the ratio is axial stiffness
        times preload times cot(half angle), divided by lateral stiffness times deflection.
        Friction helps and is neglected. None if the half angle is not known.
        """
        if self.joint is None:
            return None
        aside, into = self.pressing(settings) @ [settings.deflection, settings.preload]
        return float(into / max(aside * self._steepness(settings), 1e-9))

    def sliding(self, settings: Following) -> float:
        """Return the largest deflection that friction alone can cause on a flat plate [m]."""
        forces = self.pressing(settings)
        return float(settings.friction * forces[1, 1] * settings.preload / forces[0, 0])

    def reaching(self, settings: Following) -> float:
        """Return the ratio of the force towards the wall to the friction on a flat plate."""
        aside, into = self.pressing(settings) @ [settings.deflection, settings.preload]
        return float(aside / max(settings.friction * into, 1e-9))

    def remedy(self, settings: Following, share: float) -> tuple[float, float]:
        """Return the deflection and the preload [m] that each alone give a seating ratio."""
        forces, wall = self.pressing(settings), share * self._steepness(settings)
        per_deflection = wall * forces[0, 0] - forces[1, 0]
        per_preload = forces[1, 1] - wall * forces[0, 1]
        ratio = float(per_deflection / per_preload)
        return settings.preload / ratio, settings.deflection * ratio

    def fixed_variance(self, settings: Following) -> float:
        """Return the torch's variance that measurements ahead of it cannot reduce [m^2].

        The arm's error counts twice: when the tip passes a place and when the torch does. In the
        worst case the two have opposite signs, as for a periodic path error with half a period
        between tip and torch.
        """
        # A finger creeps by 2 % of its deflection, one standard deviation.
        creep = 0.02 * settings.deflection
        parts = (self.torch_sigma, 2.0 * settings.arm_sigma, settings.distortion, creep)
        return sum(part**2 for part in parts) + self._seat_variance(settings)

    def arm_variance(self, settings: Following) -> float:
        """Return the arm's part of the fixed variance [m^2]."""
        return (2.0 * settings.arm_sigma) ** 2

    def _seat_variance(self, settings: Following) -> float:
        """Return the variance of the seated tip's lateral position in an asymmetric joint [m^2]."""
        if self.joint is None or not self.lean:
            return 0.0
        walls = settings.joint_sigma * self.joint.seat_slope(self.radius)
        # The radius of the tip's ball is known to 0.02 mm.
        return float(2.0 * walls**2 + (0.02e-3 * self.beside / self.radius) ** 2)

    def _steepness(self, settings: Following) -> float:
        """Return the tangent of the pressed wall's angle from the plane's normal; 0 if unknown."""
        if self.half_angle is None:
            return 0.0
        return max(math.tan(self.half_angle + settings.sign * self.lean), 0.0)


@dataclass(frozen=True)
class SweepFit:
    """Calibration of finger, clock and arm, as estimated from the sweep.

    Attributes:
        gain: Relative gain error of the finger; 0.1 shows displacements 10 % too large.
        gain_sigma: Standard deviation of ``gain``.
        width: Half width of play and hysteresis [m].
        reversal: Half the travel that a reversal of motion needs to pass through the play [m].
        stamp: Delay of the images' timestamps [s].
        dead_time: Dead time of the arm [s].
        lag: Lag of the arm [s].
        unexplained: Residual of the fit beyond the measurement noise, rms [m].
        askew: Tangent of the angle between the walls and the plan.
        noise: Standard deviation of one measurement across [m].
        swept: Largest deflection at which the tip stayed in its seat [m].
        ahead: Tip's position minus its position in the finger's file, forwards [m].
        ahead_sigma: Standard deviation of ``ahead`` after the sweep [m].
        width_sigma: Standard deviation of ``width`` [m].
        stamp_sigma: Standard deviation of ``stamp`` [s].
    """

    gain: float = 0.0
    gain_sigma: float = 0.05
    width: float = 0.0
    reversal: float = 0.02e-3
    stamp: float = 0.0
    dead_time: float = 0.0
    lag: float = 0.0
    unexplained: float = 0.0
    askew: float = 0.0
    noise: float = 10e-6
    swept: float = math.inf
    ahead: float = 0.0
    ahead_sigma: float = math.inf
    width_sigma: float = 0.1e-3
    stamp_sigma: float = 0.05

    @property
    def kept(self) -> float:
        """Probability that the contact force keeps the play on its pressed side."""
        # Pressed to one side, the deflection still changes by 0.2 mm back and forth.
        return self.reversal / (self.reversal + 0.2e-3)

    @property
    def systematic(self) -> float:
        """Variance common to successive measurements of the tip [m^2].

        It has two parts. The measurements are corrected by ``kept`` times the half width of the
        play, but the finger is at the pressed side with probability ``kept`` only, and uniformly
        anywhere in the play otherwise. The second part is the sweep's unexplained residual.
        """
        # Variance of x = 1 with probability `kept`, else uniform in [-1, 1]: E x^2 - (E x)^2
        spread = self.kept + (1.0 - self.kept) / 3.0 - self.kept**2
        return (spread * self.width**2 + self.unexplained**2) / (1.0 + self.gain) ** 2

    @property
    def variance(self) -> float:
        """Variance of one measurement of the tip [m^2]."""
        return (self.noise / (1.0 + self.gain)) ** 2 + self.systematic

    @property
    def least(self) -> float:
        """Smallest deflection that tells a held tip from a free one despite play and noise [m]."""
        return 3.0 * abs(self.width) + 2.0 * self.noise


def body_of(finger: Finger, settings: Following) -> LeaningTool:
    """Return the finger's tool in its orientation along the seam."""
    work = settings.sign * settings.work_angle
    return body_from(finger.torch_from_tip, work, settings.travel_angle)


def model_prior_of(
    finger: Finger, body: LeaningTool, half_angle: float | None, settings: Following
) -> ModelPrior:
    """Return the prior from a finger's file, the tool's orientation and the plan."""
    known = finger.calibration
    lateral, axial = ModelPrior.lateral, ModelPrior.axial
    if known is not None and known.lateral is not None and known.axial is not None:
        lateral, axial = known.lateral, known.axial
    noise = (10e-6, 60e-6) if known is None else (known.noise[1], known.noise[2])
    radius = finger.radius
    joint = joint_of(settings.joint, half_angle, settings.sign, radius, settings.root_gap)
    # A wall that leans by more than 60 degrees does not hold a tip that is moved against it.
    other = None if joint is None else joint.right if settings.side == "left" else joint.left
    return ModelPrior(
        body.distance, lateral, axial, None if joint is None else joint.half_angle, noise,
        finger.torch_sigma, finger.along_sigma, finger.tip_sigma,
        bool(other is None or other < math.radians(60.0)),
        0.0 if joint is None else joint.lean, radius,
        tuple(tuple(row) for row in body.level_R_tool.tolist()),
    )  # fmt: skip
