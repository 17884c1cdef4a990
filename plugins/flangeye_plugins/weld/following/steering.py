"""Steering of the torch: the tool's rotation, the weave, and the switching of gas and arc."""

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
    """The weave at one time, to the left of the seam; all zero means no weave.

    Attributes:
        aside: Offset [m].
        rate: Velocity [m/s].
        rush: Acceleration [m/s^2].
    """

    aside: float = 0.0
    rate: float = 0.0
    rush: float = 0.0

    def for_lag(self, lag: float) -> WeaveOffset:
        """Return the weave to command so that an arm with this lag [s] follows this weave."""
        # (1 + lag d/dt) undoes a first-order lag, 1 / (1 + lag s)
        return WeaveOffset(self.aside + lag * self.rate, self.rate + lag * self.rush, self.rush)


@dataclass(frozen=True)
class Weave:
    """A sinusoidal weave across the seam.

    Attributes:
        width: Peak-to-peak width [m].
        frequency: Frequency [Hz].
    """

    width: float
    frequency: float

    def at(self, elapsed: float) -> WeaveOffset:
        """Return the weave at a time after its start [s]; no weave before."""
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
        # The arm's delay is known to 10 ms, so the weave is early or late by that; the mean square
        # speed of a sine is half its peak speed squared
        return (self.fastest * 10e-3) ** 2 / 2.0


Times = tuple[float, float, float]
"""Gas pre-flow, wait while the arc strikes, wait while the crater fills [s]."""


class ArcSequence:
    """Sequence of one arc: gas pre-flow, ignition, burning, crater fill, off."""

    def __init__(self, times: Times) -> None:
        """Start with gas and arc off."""
        self._before, self._struck_for, self._fills_for = times
        self._gas = self._strikes = self._ended = math.inf

    def gas(self, now: float) -> None:
        """Start the gas at a time [s]."""
        self._gas = min(self._gas, now)

    def strike(self, now: float) -> None:
        """Request the arc; it is struck after the gas pre-flow."""
        self.gas(now)
        self._strikes = min(self._strikes, max(now, self._gas + self._before))

    def filled(self, now: float) -> bool:
        """Request the end of the arc; return whether its crater is filled."""
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
"""Distance along the seam over which an error of the torch is corrected at full speed [m]."""

SLOWEST = 0.1
"""Smallest share of its speed to which the tip slows down."""


@dataclass(frozen=True)
class Steering:
    """Control law for the tool's rotation.

    Attributes:
        distance: Distance from tip to torch, ||d|| in the paper [m].
        gain: k_c, gain on the torch's cross-track error [1/s].
        rate: Largest angular velocity [rad/s].
        regular: n_d . n_t from which equation (16) has the full weight; below half of this value
            its weight is zero.
        share: Largest speed at which the error is corrected, as a share of the tip's speed.
        usual: Share of ``rate`` that following or weaving may use; the rest is left for
            corrections.
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
            velocity: (2,) velocity of the robot's end point [m/s].
            tool: (2,) unit vector from the torch to the tip, t_d.
            normal: (2,) unit normal of the refined path at the torch, n_t.
            error: Distance of the torch from the refined path, along ``normal`` [m].
            sway: Velocity of the weave, to the left [m/s].
        """
        cosine, sine = _cos_sin(tool, normal)
        trusted = self.trust(cosine)
        # Equation (16) divides by n_d . n_t. Near zero it is singular, and below zero the torch
        # would be pushed, not pulled: there the tool is turned into the path's direction instead.
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
        """Return the weight of equation (16), 0 to 1; the rest aligns the tool with the path."""
        return min(max(2.0 * cosine / self.regular - 1.0, 0.0), 1.0)

    def pace(self, speed: float, tool: Floats, normal: Floats, along: Floats) -> float:
        """Return the tip's speed [m/s], reduced at large tool angles and turn rates.

        Args:
            speed: Requested speed [m/s].
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
    """Steers the torch along the seam, with a weave if one is configured.

    Attributes:
        steering: Control law of the tool's rotation.
        weave: The configured weave.
        aim: Present target of the torch, to the left of the seam [m].
    """

    def __init__(self, task: WeldTask) -> None:
        settings = task.settings
        gain = max(settings.cross_track_gain, settings.speed / SETTLING)
        self.steering = Steering(task.prior.distance, gain, settings.turn_rate)
        self.weave = Weave(settings.weave_width, settings.weave_frequency)
        self.aim = self._beside = settings.offset_across
        self._from = max(task.start.torch, 0.0)
        self._swings: float | None = None

    def swing(self, now: float, coming: float, arm: Response) -> WeaveOffset:
        """Return the weave to command, advanced by the arm's delay; update ``aim``.

        Args:
            now: Present time [s].
            coming: Arc length of the torch at the arm's predicted pose [m].
            arm: Model of the arm's delay.
        """
        if self._swings is None and coming >= self._from:
            self._swings = now + arm.dead_time
        elapsed = -1.0 if self._swings is None else now - self._swings
        self.aim = self._beside + self.weave.at(elapsed).aside
        return self.weave.at(elapsed + arm.dead_time).for_lag(arm.lag)

    def turn(
        self, velocity: Floats, coming: ToolPose, normal: Floats, off: float, sway: WeaveOffset
    ) -> float:
        """Return the angular velocity that keeps the torch on its target [rad/s].

        Args:
            velocity: (2,) velocity of the robot's end point [m/s].
            coming: Predicted pose of the tool.
            normal: (2,) unit normal of the refined path at the torch.
            off: Offset of the torch to the left of that path [m].
            sway: The weave to command.
        """
        if not velocity.any():
            return 0.0
        error = off - self._beside - sway.aside
        return self.steering.turn(velocity, coming.direction, normal, error, sway.rate)


def _cos_sin(tool: Floats, normal: Floats) -> tuple[float, float]:
    """Return n_d . n_t and t_d . n_t: cosine and sine of the angle from the path to the tool."""
    return float(tool[0] * normal[1] - tool[1] * normal[0]), float(tool @ normal)
