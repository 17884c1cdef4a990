"""Estimate the torch's bias, which only a profile of the bead behind it can measure.

The torch is off the seam by what is measured of it and a bias: ``off = raw + b``. In b are the
torch's place on the tool, its yaw, and how far heat has moved the seam since the tip felt it. All
of it is in what the files state beforehand, one variance P0 about zero. A look at the bead gives z,
how far the torch really was off where it passed; the measured part of it then is known, so
z - raw is b there, with an error of variance R: of the look, of the arm and of what the tip felt.
Such errors are alike over about a tool's length L (an arm that waves, a profile read askew), so a
look that comes after a way d counts as d / L independent ones.

From place to place b is a random walk. The files state by how much heat moves the seam, D one
sigma, while the torch goes on by L: D^2 / L per length. That is a Kalman filter of one state,

    P <- P + d D^2 / L,   k = P / (P + R L / d),   b <- b + k (z - raw - b),   P <- (1 - k) P.

Once there are looks the torch, by how far they lag behind it, is known to P + (that way) D^2 / L.
Where there have been none for long, nothing is left but the files: about b these have P0 + b^2,
the most that is stated.
"""

from __future__ import annotations

import bisect
import math

BEYOND = 4.0
"""A look that is farther off contradicts what is known, in standard deviations."""

CONTRADICTIONS = 5
"""So many looks in succession that contradict what is known stop the weld; fewer are spatter."""


class Trail:
    """Measured positions of the torch as it passed, by arc length and by time."""

    def __init__(self) -> None:
        self._times: list[float] = []
        self._along: list[float] = []
        self._rows: list[tuple[float, float]] = []

    def pass_by(self, time: float, s: float, raw: float, variance: float) -> None:
        """Remember a place that the torch is at.

        Args:
            time: [s].
            s: Arc length of the torch [m].
            raw: Measured distance of the torch to the left of the refined path [m].
            variance: Variance of the offset that the tip measured there, at the torch [m^2].
        """
        # A place every 0.2 mm is enough: what is looked at is hardly smaller.
        if not self._along or s >= self._along[-1] + 0.2e-3:
            self._times.append(time)
            self._along.append(s)
            self._rows.append((raw, variance))

    def place_at(self, time: float) -> float | None:
        """Return the arc length of the torch at a time [m]; None before the first place."""
        after = bisect.bisect_right(self._times, time)
        return None if after == 0 else self._along[after - 1]

    def passing(self, s: float) -> tuple[float, float] | None:
        """Return (raw, variance) at an arc length; None where the torch was not."""
        after = bisect.bisect_right(self._along, s)
        return None if after == 0 else self._rows[after - 1]


class Bias:
    """Estimates the bias of the torch, by arc length.

    Attributes:
        value: How far the torch is to the left of where it is measured to be [m].
        doubt: What the newest look contradicts, once enough have; else nothing.
        prior: Variance before any look [m^2].
    """

    def __init__(self, prior: float, distortion: float, length: float) -> None:
        """Begin with what the files state.

        Args:
            prior: Variance of the bias about zero, P0 [m^2].
            distortion: Standard deviation of heat's part of it, D [m].
            length: Length of the tool, from the torch to the tip, L [m].
        """
        self.value, self.doubt = 0.0, ""
        self.prior, self._length = prior, length
        self._growth = distortion**2 / length
        self._variance, self._seen, self._sigma = prior, -math.inf, 0.0
        self._contradicted = 0

    @property
    def looked(self) -> bool:
        """Whether any profile was accepted."""
        return self._seen > -math.inf

    def variance(self, s: float) -> float:
        """Return the variance of the bias about its value, with the torch at an arc length [m^2].

        Looks that are all wrong alike are no better than one of them.
        """
        if not self.looked:
            return self.prior
        grown = self._variance + self._growth * max(s - self._seen, 0.0)
        return min(grown + self._sigma**2, self.prior + self.value**2)

    def look(self, s: float, bias: float, sigma: float, others: float) -> None:
        """Process a profile of the bead.

        Args:
            s: Arc length of the place that was looked at [m].
            bias: How far to the left of where it was measured the torch was there [m].
            sigma: Standard deviation of the look [m].
            others: Variance of all else in it: the arm, what the tip felt [m^2].
        """
        way = s - self._seen
        if way <= 0.0:
            return
        grown = self.prior
        if self.looked:
            grown = min(self._variance + self._growth * way, self.prior + self.value**2)
        one = sigma**2 + others
        if self._contradicts(bias, grown + one, self.prior + one):
            return
        noise = one * max(self._length / way, 1.0)
        gain = grown / (grown + noise)
        self.value += gain * (bias - self.value)
        self._variance, self._seen, self._sigma = (1.0 - gain) * grown, s, sigma

    def _contradicts(self, bias: float, now: float, before: float) -> bool:
        """Return whether a look is beyond what is known now, or beyond what the files state."""
        wrong = abs(bias - self.value) > BEYOND * math.sqrt(now)
        wrong = wrong or abs(bias) > BEYOND * math.sqrt(before)
        self._contradicted = self._contradicted + 1 if wrong else 0
        if self._contradicted >= CONTRADICTIONS:
            self.doubt = (
                f"the look behind the torch sees the bead {bias * 1e3:+.2f} mm to the left of "
                f"where the torch was taken to be; {self.value * 1e3:+.2f} mm were known, and the "
                f"files allow {BEYOND * math.sqrt(before) * 1e3:.2f} mm: calibrate the tool "
                "(flangeye tactile calibrate), or state more 'distortion'"
            )
        return wrong
