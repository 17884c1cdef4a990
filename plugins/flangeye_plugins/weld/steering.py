"""How fast the tool must turn so that the torch behind it stays on the seam (README, eq. A)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from flangeye.types import Floats

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
        if across:
            pace = min(pace, self.usual * self.rate * self.distance * cosine / across)
        return speed * min(max(pace, SLOWEST), 1.0)


def _cos_sin(tool: Floats, normal: Floats) -> tuple[float, float]:
    """Return n_d . n_t, and t_d . n_t: cosine and sine of the angle from the path to the tool."""
    return float(tool[0] * normal[1] - tool[1] * normal[0]), float(tool @ normal)
