"""A small sweep of the seated tip before the weld, which identifies finger, clock and arm.

The groove's walls hold the tip, like a punch mark, while the arm moves across by ``D`` to either
side. With the tip at ``y0`` and the end point at ``P`` the true displacement is ``u = y0 - P``. The
finger measures ``m = c + (1 + g) u + w sign(du/dt)`` in an image whose timestamp is off by ``tau``.
Gain error ``g`` and half width ``w`` of play and hysteresis are estimated by least squares, ``tau``
and the reversal's length by a grid search.

Both sides are swept with the tool turned a little to the left, then to the right. The turn shifts
``c`` in proportion to the error of the tip's position ahead, which is estimated from it. Along
walls that stand askew to the plan the tip slides, which shifts ``c`` as well: their slope is
estimated too.

A tip that climbs its wall shows less displacement than it should when pressed hard, and is higher
there. In that case the sweep is repeated with half the reach. The weld then presses by a third of
the largest deflection at which the tip stayed seated, so that neither friction nor a flatter wall
lets it climb.
"""

from __future__ import annotations

import math

import numpy as np

from flangeye.types import Floats
from flangeye_plugins.weld.following.model_prior import ModelPrior, SweepFit
from flangeye_plugins.weld.following.response import identify
from flangeye_plugins.weld.settings import Following

SWEEP_MARGIN = 1.25
"""Ratio of the sweep's reach to ``deflection``."""

SOFTER = 3.0
"""Between two walls the weld presses by the largest safe deflection of the sweep divided by this:
with friction 0.3, a tip that has climbed a 45-degree wall slides down only once it is pressed by
3.4 times less than what made it climb.
"""

PIVOTS = 0.1
"""The tool is turned about the tip to either side by this [rad]."""

PIVOTED = 0.02e-3
"""Best accuracy of the tip distance estimated by the sweep [m]."""

REST_TIMEOUT = 4.0
"""Longest wait for the tip to rest, or for enough measurements at the hard end [s]."""


class Probing:
    """The sweep: commands its motion, collects the measurements, and fits the calibration.

    Attributes:
        over: Whether the sweep's motion is complete.
    """

    def __init__(self, settings: Following, prior: ModelPrior, side: float) -> None:
        self._rate, self._turn_rate = 4e-3, settings.turn_rate / 3.0
        self._prior = prior
        self._two_walls, self._settings = prior.two_walls, settings
        self._side, self._noise = side, prior.noise
        self._turned = 0.0
        self._sweep(SWEEP_MARGIN * settings.deflection)

    def _sweep(self, reach: float) -> None:
        """Begin a sweep over ``reach`` to either side [m]."""
        # The last motion is outwards: that takes up play and hysteresis in the weld's direction.
        self._reach, self._goals = reach, [(reach, 0.0), (0.3 * reach, 0.0), (0.6 * reach, 0.0)]
        if self._two_walls:
            sides = [(side, turn) for turn in (PIVOTS, -PIVOTS) for side in (reach, -reach)]
            self._goals = [*sides, (reach / SOFTER, 0.0)]
        self._wanted: float | None = None
        self._pressed: tuple[float, int] | None = None
        self.over, self._time = False, 0.0
        self._cycles: list[tuple[float, float, float, float]] = []
        self._felt: list[tuple[float, float, float, float]] = []

    def begin(self, noise: float) -> None:
        """Set the noise of one measurement across the seam before the sweep begins [m]."""
        self._noise = (max(self._noise[0], noise), self._noise[1])

    def velocity(self, elapsed: float) -> tuple[float, float]:
        """Return the sweep's velocity to the left [m/s] and its turn [rad/s] in this cycle."""
        (goal, turn), self._time = self._goals[0], self._time + elapsed
        if self._wanted is None:  # contact is found on the way to it: first it comes to rest
            self._wanted = self._rested()
            return 0.0, 0.0
        # The speed varies, as at constant speed a delay looks like play: both shift by a constant.
        rate = self._rate * (0.2 + 0.8 * math.sin(math.pi * self._time / 0.8) ** 2)
        step = float(np.clip(goal - self._wanted, -rate * elapsed, rate * elapsed))
        most = self._turn_rate * elapsed
        turned = float(np.clip(turn - self._turned, -most, most))
        self._wanted, self._turned = self._wanted + step, self._turned + turned
        if abs(goal - self._wanted) + abs(turn - self._turned) < 1e-9 and self._settled():
            self._goals.pop(0)
            self.over = not self._goals
        return (self._side * step / elapsed, turned / elapsed) if elapsed else (0.0, 0.0)

    @property
    def rests(self) -> bool:
        """Whether the sweep still waits for the tip to come to rest."""
        return self._wanted is None

    def _rested(self) -> float | None:
        """Return the deflection at the start of the sweep [m]; None while the tip moves."""
        since = self._standing_since()
        felt = [-self._side * across for time, across, *_ in self._felt if time >= since]
        rested = felt[len(felt) // 2 :]
        told = bool(rested) and len(rested) >= self._enough
        # No sooner the tip has come to rest where it met the wall.
        if self._time < 0.4 or (not told and self._time < REST_TIMEOUT):
            return None
        return float(np.mean(rested)) if rested else self._reach / SOFTER

    def _standing_since(self) -> float:
        """Return the time since which the arm has been at rest [s]; infinity while it moves.

        It moves for a while after a stop command, longest if it also rotated.
        """
        now, _, here, _ = self._cycles[-1] if self._cycles else (0.0, 0.0, 0.0, 0.0)
        since = math.inf
        for time, _, lateral, _ in reversed(self._cycles):
            # An arm is at rest if it has moved by less than 0.02 mm within 0.2 s.
            if abs(lateral - here) > 0.02e-3:
                break
            since = time
        return since if now - since >= 0.2 else math.inf

    def _settled(self) -> bool:
        """Return whether enough measurements were taken at the end of this stroke."""
        since, before = self._pressed = self._pressed or (self._time, len(self._felt))
        return len(self._felt) - before >= self._enough or self._time - since > REST_TIMEOUT

    @property
    def _enough(self) -> float:
        """Number of measurements needed for the mean at the end of a stroke."""
        # The mean at the hard end is to be known to 0.03 mm.
        return (self._noise[0] / 0.03e-3) ** 2

    def note(self, time: float, sent: float, lateral: float, slant: float = 0.0) -> None:
        """Record a cycle.

        Args:
            time: Time [s].
            sent: Speed to the left that was commanded [m/s].
            lateral: The end point's offset to the left [m].
            slant: Sine of the tool's angle to the plan.
        """
        self._cycles.append((time, sent, lateral, slant))

    def feel(self, time: float, across: float, height: float, along: float) -> None:
        """Store a measurement: displacement to the left and forwards, and the tip's height [m]."""
        self._felt.append((time, across, height, along))

    def learned(self) -> SweepFit | str | None:
        """Return the calibration, or the reason for not welding; None to repeat the sweep."""
        if len(self._felt) < 15:  # four unknowns, and as many again for what is unexplained
            return "the tag was seen too seldom while the finger was probed"
        felt, cycles = np.array(self._felt), np.array(self._cycles)
        found, climbs = self._fit(felt, cycles)
        if not climbs and found.least < self._reach:
            return found
        half = self._reach / 2.0
        if not climbs:
            return (
                f"the finger has {2 * abs(found.width) * 1e3:.2f} mm of play or hysteresis and "
                f"{found.noise * 1e3:.2f} mm of noise: pressed by {self._reach * 1e3:.2f} mm a "
                "held tip and a free one look the same; fasten it, or its tag"
            )
        if not self._two_walls or half < max(found.least, self._settings.probe):
            return f"{climbs}; lower 'deflection' or raise 'preload', or calibrate the finger"
        self._sweep(half)
        return None

    def _fit(self, felt: Floats, cycles: Floats) -> tuple[SweepFit, str]:
        """Return the calibration fitted to the sweep, and why it is rejected ("" if it is not)."""
        noise = max(_scatter(felt[:, 1]), self._noise[0])
        late = np.arange(-0.12, 0.121, 0.01)  # timestamps, or early, by up to 120 ms
        reversals = 1e-3 * np.array([0.02, 0.05, 0.1, 0.15, 0.2, 0.25, 0.3, 0.4, 0.6, 1.0])
        stamps, widths = (grid.ravel() for grid in np.meshgrid(late, reversals, indexing="ij"))
        at, slant = (
            np.interp(felt[:, 0] - stamps[:, None], cycles[:, 0], cycles[:, i]) for i in (2, 3)
        )
        rms, solutions = _explained(at, slant, widths, felt[:, 1])
        prior = self._prior
        # The scale is at least the best candidate's rms: model error counts like noise
        unlikely = len(felt) * (rms / max(noise, float(rms.min()))) ** 2
        unlikely += ((stamps - prior.stamp) / prior.stamp_sigma) ** 2
        unlikely += ((solutions[:, 2] + prior.play) / prior.play_sigma) ** 2
        best = int(np.argmin(unlikely))
        _, across, play, *_ = solutions[best].tolist()
        left = max(float(rms[best]), noise)
        rows = _rows(at[best][None], slant[best][None], widths[best : best + 1])[0]
        askew = _askew(at[best], felt[:, 3], across)
        # Friction of 0.3 holds a tip off the walls' normal by as much. On one wall nothing else is
        # taken for a slide: pressed by a leaning tool the tip moves forwards too
        expected = askew, 0.3 if self._two_walls else 1e-3
        (_, across, _, _, ahead, slope), _ = _on_walls(rows, felt, expected, left)
        # A tip that climbs shows less beyond half the reach
        away = at[best] - np.median(at[best] + felt[:, 1])
        hard = np.sign(away) * np.maximum(np.abs(away) - self._reach / 2.0, 0.0)
        bend, sigmas = _on_walls(np.column_stack([rows, hard]), felt, expected, left)
        pivoted = self._two_walls and float(np.ptp(slant[best])) > PIVOTS
        ahead, told = float(ahead / across), float(sigmas[4]) if pivoted else 1e3
        known = prior.ahead_known**2 / (prior.ahead_known**2 + told**2)
        # Walls that stand askew may be curved too: the correction is as uncertain as it is large.
        sigma = math.hypot(float(sigmas[1]), askew**2)
        dead, lag = identify(cycles[:, :3])
        found = SweepFit(
            float(across - 1.0), sigma, -play, float(widths[best]), float(stamps[best]), dead, lag,
            math.sqrt(max(float(rms[best]) ** 2 - noise**2, 0.0)), float(slope), noise, self._reach,
            prior.ahead + known * ahead, math.sqrt(known) * told,
            *_spread(unlikely, stamps, solutions[:, 2], best),
        )  # fmt: skip
        # Play follows the model to 30 %, all else to 0.04 mm.
        beyond = 4.0 * math.hypot(prior.ahead_known, told)
        if prior.ahead_sigma is not None and abs(ahead) > beyond:
            return found, (
                f"the tip is {ahead * 1e3:+.2f} mm ahead of where earlier welds found it, "
                f"{beyond * 1e3:.2f} mm are allowed: it was bent or changed; delete the file that "
                "'prior' names"
            )
        if found.unexplained > 0.04e-3 + noise + 0.3 * abs(play):
            return found, (
                f"gain, play and delay leave {found.unexplained * 1e3:.2f} mm of the finger's "
                "displacement unexplained"
            )
        return found, self._climbs(felt, at[best], found.gain, (bend[5], sigmas[5]))

    def _climbs(self, felt: Floats, at: Floats, gain: float, bend: tuple[float, float]) -> str:
        """Return a message if the tip climbs or shows less when pressed hard; else ""."""
        # A gain off by more is not a drift but another finger, or a tip that climbs.
        if abs(gain) > 0.35:
            return f"the finger's gain is off by {gain:.0%}, or the tip climbs the wall"
        if bend[0] > 0.1 + 3.0 * bend[1]:
            return (
                f"the tip climbs the wall: at full deflection the finger shows {bend[0]:.0%} less "
                "displacement than at small ones"
            )
        from_wall = self._side * at
        middle = from_wall.min()
        if self._two_walls:
            middle = (middle + from_wall.max()) / 2
        pressed = np.abs(from_wall - middle) / max(float(np.abs(from_wall - middle).max()), 1e-9)
        hard, soft = felt[pressed > 0.85, 2], felt[pressed < 0.5, 2]
        if min(len(hard), len(soft)) < 3:
            return ""
        rise = float(hard.mean() - soft.mean())
        scatter = max(_scatter(felt[:, 2]), self._noise[1])
        sigma = scatter * float(np.sqrt(1 / len(hard) + 1 / len(soft)))
        # A seated tip rises by less than 0.05 mm.
        if rise <= 0.05e-3 + 3.0 * sigma:
            return ""
        return f"the tip climbs the wall by {rise * 1e3:.2f} mm when it is pressed aside"


def _scatter(values: Floats) -> float:
    """Return the noise of one measurement in a series, from its second differences."""
    # Second differences have no trend, and of white noise six times the variance
    return float(np.median(np.abs(np.diff(values, 2))) / 0.6745 / np.sqrt(6.0))


def _explained(at: Floats, slant: Floats, widths: Floats, felt: Floats) -> tuple[Floats, Floats]:
    """Return the rms residuals (C,) and least-squares solutions (C, 5) of C candidates.

    The five unknowns are those of :func:`_rows`.

    Args:
        at: (C, N) end point's offset at the measurements, by each candidate's time offset [m].
        slant: (C, N) sine of the tool's angle to the plan.
        widths: (C,) each candidate's reversal length [m].
        felt: (N,) measured displacements across [m].
    """
    rows = _rows(at, slant, widths)
    gram = np.swapaxes(rows, 1, 2) @ rows
    solutions = np.einsum("cij,cnj,n->ci", np.linalg.pinv(gram, hermitian=True), rows, felt)
    left = felt - np.einsum("cni,ci->cn", rows, solutions)
    return np.sqrt(np.mean(left**2, axis=1)), np.asarray(solutions)


def _askew(at: Floats, along: Floats, across: float) -> float:
    """Return the tangent of the angle between the pressed tip's displacement and the plan's normal.

    Args:
        at: (N,) end point's offset [m].
        along: (N,) displacement forwards [m].
        across: Displacement across for one of the end point.
    """
    middle = at - at.mean()
    moved = float(middle @ middle) + 1e-12
    return float(middle @ (along - along.mean())) / moved / across


def _on_walls(
    rows: Floats, felt: Floats, expected: tuple[float, float], noise: float
) -> tuple[Floats, Floats]:
    """Return the sweep's unknowns and the walls' slope (K + 1,), and their standard deviations.

    A tip that slides along walls askew to the plan moves across it as well, by the walls' slope.
    Without friction it is displaced along the walls' normal, which gives the slope. Where friction
    holds it, its slides show the slope.

    Args:
        rows: (N, K) design matrix of the sweep; see :func:`_rows`.
        felt: (N, 4) time, displacement across, height, and displacement forwards.
        expected: The slope, tangent of the walls' angle to the plan, before the fit; its standard
            deviation.
        noise: Standard deviation of a displacement [m].
    """
    rows = np.column_stack([rows, felt[:, 3] - felt[:, 3].mean()]) / noise
    information, right = rows.T @ rows, rows.T @ felt[:, 1] / noise
    information[-1, -1] += expected[1] ** -2
    right[-1] += expected[0] * expected[1] ** -2
    covariance = np.linalg.pinv(information, hermitian=True)
    return np.asarray(covariance @ right), np.sqrt(np.diag(covariance))


def _spread(unlikely: Floats, stamps: Floats, plays: Floats, best: int) -> tuple[float, float]:
    """Return the posterior standard deviations of play [m] and timestamp delay [s] on the grid.

    The grid's resolution (20 um and 10 ms, uniform) is added.
    """
    weights = np.exp(-0.5 * (unlikely - unlikely[best]))
    weights /= weights.sum()
    play, stamp = (float(weights @ (x - x[best]) ** 2) for x in (plays, stamps))
    return math.sqrt(play + (20e-6) ** 2 / 12.0), math.sqrt(stamp + 10e-3**2 / 12.0)


def _rows(at: Floats, slant: Floats, widths: Floats) -> Floats:
    """Return the design matrices (C, N, 5): offset, gain, play, initial play state, tip ahead.

    The initial state within the play is unknown, so it has a column of its own: half the difference
    between starting at the right and at the left end, which vanishes after the first reversals.
    """
    left, right = (_dragged(at, widths, end) for end in (-1.0, 1.0))
    reversal, began = (left + right) / 2.0 - at, (right - left) / 2.0
    scale = widths[:, None]
    return np.stack([np.ones_like(at), -at, reversal / scale, began / scale, -slant], axis=2)


def _dragged(at: Floats, half: Floats, end: float) -> Floats:
    """Return motions (C, N) passed through a backlash of half widths ``half`` (C,).

    The output starts ``end`` half widths from the input: 1 or -1, the two ends of the backlash.
    """
    dragged = at + end * half[:, None]
    for i in range(1, at.shape[1]):
        dragged[:, i] = np.clip(dragged[:, i - 1], at[:, i] - half, at[:, i] + half)
    return dragged
