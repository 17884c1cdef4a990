"""The torch: the tool's rotation that keeps it on the seam, its weave, its gas and arc."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from flangeye.motion.arc import BURN, GAS, OFF
from flangeye.motion.seam_following import ToolPose
from flangeye.types import Floats
from flangeye_plugins.weld.following.response import Response
from flangeye_plugins.weld.following.task import WeldTask


class WeaveOffset(NamedTuple):
    """The weave at one time, to the left of the seam; none where it is all zero.

    Attributes:
        aside: [m].
        rate: [m/s].
        rush: Its second derivative [m/s^2].
    """

    aside: float = 0.0
    rate: float = 0.0
    rush: float = 0.0

    def led(self, lag: float) -> WeaveOffset:
        """Return the swing that an arm follows with a time constant [s], to be on this one."""
        # (1 + lag d/dt) undoes a first-order lag, 1 / (1 + lag s)
        return WeaveOffset(self.aside + lag * self.rate, self.rate + lag * self.rush, self.rush)


@dataclass(frozen=True)
class Weave:
    """A sine across the seam.

    Attributes:
        width: From side to side [m].
        frequency: [Hz].
    """

    width: float
    frequency: float

    def at(self, elapsed: float) -> WeaveOffset:
        """Return the swing so long after it began [s]; none before it has."""
        if elapsed < 0.0 or not self.width:
            return WeaveOffset()
        turn = 2.0 * math.pi * self.frequency
        sine, cosine = math.sin(turn * elapsed), math.cos(turn * elapsed)
        half = self.width / 2.0
        return WeaveOffset(half * sine, half * turn * cosine, -half * turn**2 * sine)

    @property
    def fastest(self) -> float:
        """Largest speed across the seam [m/s]."""
        return math.pi * self.frequency * self.width

    @property
    def variance(self) -> float:
        """Variance of the torch across the seam due to the weave's timing error [m^2]."""
        # The arm's delay is known to 10 ms: a swing is early or late by it, and the mean square of
        # its speed is half the square of the fastest
        return (self.fastest * 10e-3) ** 2 / 2.0


Times = tuple[float, float, float]
"""Gas before the arc; standing while it is struck; standing while the crater fills [s]."""


class Striking:
    """One arc: gas, burning, out."""

    def __init__(self, times: Times) -> None:
        """Begin with neither gas nor arc."""
        self._before, self._struck_for, self._fills_for = times
        self._gas = self._strikes = self._ended = math.inf

    def gas(self, now: float) -> None:
        """Start the gas at a time [s]."""
        self._gas = min(self._gas, now)

    def strike(self, now: float) -> None:
        """Ask for the arc; it is struck once gas has flowed for its time."""
        self.gas(now)
        self._strikes = min(self._strikes, max(now, self._gas + self._before))

    def filled(self, now: float) -> bool:
        """Ask for the end of the arc; return whether its crater is filled."""
        self._ended = min(self._ended, now)
        return now >= self._ended + self._fills_for

    def level(self, now: float) -> float:
        """Return the commanded state of the arc: OFF, GAS or BURN."""
        return BURN if now >= self._strikes else GAS if now >= self._gas else OFF

    def stands(self, now: float) -> bool:
        """Return whether the torch must stand still: the arc strikes, or its crater fills."""
        asked, burns = self._strikes < math.inf, now >= self._strikes + self._struck_for
        return (asked and not burns) or self._ended < math.inf


SETTLING = 8e-3
"""Way in which an error of the torch is taken back at speed [m]."""

SLOWEST = 0.1
"""Share of its speed that the tip always keeps."""


@dataclass(frozen=True)
class Steering:
    """How the tool is turned.

    Attributes:
        distance: Tip to torch, ||d|| of the paper [m].
        gain: k_c, how fast an error of the torch is taken back [1/s].
        rate: Largest angular velocity [rad/s].
        regular: |n_d . n_t| above which equation (16) alone decides; zero half way below.
        share: Largest part of the tip's speed that taking back an error may use.
        usual: Share of the rate that following alone, or a weave alone, may use: the rest is for
            errors.
    """

    distance: float
    gain: float
    rate: float
    regular: float = 0.5
    share: float = 0.7
    usual: float = 0.8

    def turn(
        self, velocity: Floats, tool: Floats, normal: Floats, error: float, sway: float
    ) -> float:
        """Return the angular velocity [rad/s], never beyond :attr:`rate`.

        Args:
            velocity: (2,) of the robot's end point [m/s].
            tool: (2,) unit vector from the torch to the tip, t_d.
            normal: (2,) unit normal of the refined path at the torch, n_t.
            error: How far the torch is off the refined path, along ``normal`` [m].
            sway: How fast it is to leave that path to the left all the same [m/s].
        """
        cosine, sine = _cos_sin(tool, normal)
        trusted = self.trust(cosine)
        # Near n_d perpendicular to n_t equation (16) divides by zero and below it the torch would
        # be pushed, not pulled: there the tool is turned into the path's direction instead.
        aligning = -float(np.copysign(self.rate, sine))
        if not trusted:
            return aligning
        # By (12) the torch has V_t = V_r - L w n_d, and it is to have V_t . n_t = sway - k_c e:
        # w = (V_r . n_t + k_c e - sway) / (L n_d . n_t). Equation (16) has no k_c, so that an error
        # of the torch would stay, and by a slip in (15) the other sign
        most = self.share * float(np.hypot(*velocity))
        asked = float(velocity @ normal) + min(max(self.gain * error, -most), most) - sway
        wanted = trusted * asked / (self.distance * cosine) + (1.0 - trusted) * aligning
        return float(min(max(wanted, -self.rate), self.rate))

    def trust(self, cosine: float) -> float:
        """Return 1 where equation (16) decides, 0 where the tool is turned back, and between."""
        return min(max(2.0 * cosine / self.regular - 1.0, 0.0), 1.0)

    def pace(self, speed: float, tool: Floats, normal: Floats, along: Floats) -> float:
        """Return the speed that the tip may have: less where the tool is crooked or turns fast.

        Args:
            speed: That is asked for [m/s].
            tool: (2,) unit vector from the torch to the tip.
            normal: (2,) unit normal of the refined path at the torch.
            along: (2,) unit tangent of the path at the tip.
        """
        cosine, _ = _cos_sin(tool, normal)
        pace, across = cosine / self.regular, speed * abs(float(along @ normal))
        # Following alone turns the tool by v |t . n_t| / (L n_d . n_t): a share of its rate at most
        if across:
            pace = min(pace, self.usual * self.rate * self.distance * cosine / across)
        return speed * min(max(pace, SLOWEST), 1.0)


class TorchLead:
    """Leads the torch along the seam, swinging across it where a weave is asked for.

    Attributes:
        steering: How the tool is turned.
        weave: The swing.
        aim: How far to the left of the seam the torch is to be [m].
    """

    def __init__(self, task: WeldTask) -> None:
        settings = task.settings
        gain = max(settings.cross_track_gain, settings.speed / SETTLING)
        self.steering = Steering(task.belief.distance, gain, settings.turn_rate)
        self.weave = Weave(settings.weave_width, settings.weave_frequency)
        self.aim = self._beside = settings.offset_across
        self._from = max(task.start.torch, 0.0)
        self._swings: float | None = None

    def swing(self, now: float, coming: float, arm: Response) -> WeaveOffset:
        """Return the weave to command, ahead by the arm's delay; set ``aim`` to the one due now.

        Args:
            now: The time [s].
            coming: Arc length of the torch, where the arm will be [m].
            arm: Delay of the arm.
        """
        if self._swings is None and coming >= self._from:
            self._swings = now + arm.dead_time
        elapsed = -1.0 if self._swings is None else now - self._swings
        self.aim = self._beside + self.weave.at(elapsed).aside
        return self.weave.at(elapsed + arm.dead_time).led(arm.lag)

    def turn(
        self, velocity: Floats, coming: ToolPose, normal: Floats, off: float, sway: WeaveOffset
    ) -> float:
        """Return the angular velocity that keeps the torch on its target [rad/s].

        Args:
            velocity: (2,) of the robot's end point [m/s].
            coming: The tool, where the arm will be.
            normal: (2,) unit normal of the refined path at the torch.
            off: How far to the left of that path the torch is [m].
            sway: The weave to command.
        """
        if not velocity.any():
            return 0.0
        error = off - self._beside - sway.aside
        return self.steering.turn(velocity, coming.direction, normal, error, sway.rate)


def _cos_sin(tool: Floats, normal: Floats) -> tuple[float, float]:
    """Return n_d . n_t, and t_d . n_t: cosine and sine of the angle from the path to the tool."""
    return float(tool[0] * normal[1] - tool[1] * normal[0]), float(tool @ normal)
