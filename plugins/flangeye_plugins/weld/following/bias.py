"""Estimate the torch's bias, which only a profile of the bead behind it can measure.

The torch's true offset from the seam is the measured offset plus a bias: ``off = raw + b``. The
bias b contains the torch's position error on the tool, its yaw, and the seam's thermal distortion
since the tip felt it. Its prior is zero with variance P0, from the files. A bead profile gives z,
the true offset where the torch passed. As ``raw`` was stored there, z - raw measures b with
variance R: profile, arm and touch. These errors are correlated over about one tool length L (a
periodic path error of the arm, a tilted profile), so a profile taken a distance d after the last
one counts as d / L independent ones.

Along the seam b is a random walk of variance D^2 / L per length, where D is the standard deviation
of the thermal distortion while the torch advances by L. The estimate is a scalar Kalman filter:

    P <- P + d D^2 / L,   k = P / (P + R L / d),   b <- b + k (z - raw - b),   P <- (1 - k) P.

The bias at the torch, a distance l ahead of the newest profile, has variance P + l D^2 / L. After a
long time without profiles only the prior is left, so the variance is at most P0 + b^2.
"""

from __future__ import annotations

import bisect
import math

BEYOND = 4.0
"""A profile farther from the estimate than this contradicts it [standard deviations]."""

CONTRADICTIONS = 5
"""This many contradicting profiles in succession stop the weld; fewer may be spatter."""


class Trail:
    """Measured positions of the torch as it passed, by arc length and by time."""

    def __init__(self) -> None:
        self._times: list[float] = []
        self._along: list[float] = []
        self._rows: list[tuple[float, float]] = []

    def pass_by(self, time: float, s: float, raw: float, variance: float) -> None:
        """Store the torch's present place.

        Args:
            time: Time [s].
            s: Arc length of the torch [m].
            raw: Measured distance of the torch to the left of the refined path [m].
            variance: Variance of the offset that the tip measured there, at the torch [m^2].
        """
        # One place per 0.2 mm is enough: a profile resolves hardly less.
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
    """Estimates the torch's bias along the seam.

    Attributes:
        value: Estimated bias: true minus measured offset of the torch, to the left [m].
        doubt: Message once enough profiles in succession have contradicted the estimate; else "".
        prior: Variance before any profile [m^2].
    """

    def __init__(self, prior: float, distortion: float, length: float) -> None:
        """Start with the prior from the files.

        Args:
            prior: Variance of the bias about zero, P0 [m^2].
            distortion: Standard deviation of the thermal distortion over one tool length, D [m].
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
        """Return the variance of the bias with the torch at an arc length [m^2].

        It includes one profile's variance, as an error common to all profiles does not average out.
        """
        if not self.looked:
            return self.prior
        grown = self._variance + self._growth * max(s - self._seen, 0.0)
        return min(grown + self._sigma**2, self.prior + self.value**2)

    def look(self, s: float, bias: float, sigma: float, others: float) -> None:
        """Update the estimate with a bead profile.

        Args:
            s: Arc length of the profile [m].
            bias: True minus measured offset of the torch there, to the left [m].
            sigma: Standard deviation of the profile [m].
            others: Variance of the arm and of the tip's measurement there [m^2].
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
        """Return whether a profile contradicts the present estimate or the prior."""
        wrong = abs(bias - self.value) > BEYOND * math.sqrt(now)
        wrong = wrong or abs(bias) > BEYOND * math.sqrt(before)
        self._contradicted = self._contradicted + 1 if wrong else 0
        if self._contradicted >= CONTRADICTIONS:
            self.doubt = (
                f"the profile sensor behind the torch sees the bead {bias * 1e3:+.2f} mm left of "
                f"the torch's measured path; {self.value * 1e3:+.2f} mm were expected, and the "
                f"files allow {BEYOND * math.sqrt(before) * 1e3:.2f} mm: calibrate the tool "
                "(flangeye tactile calibrate), or raise 'distortion'"
            )
        return wrong
