"""A small sweep of the seated tip before the weld, which identifies finger, clock and arm.

The tip is held by the groove's walls, as in a punch mark, while the arm moves across by ``D`` to
one side and to the other. With the tip at ``y0`` and the end point at ``P`` the true displacement
is ``u = y0 - P``; the finger measures ``m = c + (1 + g) u + w sign(du/dt)``, of an image whose
timestamp is off by ``tau``. Gain error ``g``, the half width ``w`` of play and hysteresis, and
``tau`` follow by least squares, ``tau`` and the reversal's length from a grid. Both sides are swept
with the tool turned a little to the left, then to the right: what that shifts ``c`` by is how far
the tip is ahead of where its file has it. A tip that climbs
its wall shows less the harder it is pressed, and is higher there: it is swept again by half as
much. The weld then presses by a third of what the tip was seen to stand, so that neither friction
nor a flatter wall lets it climb.
"""

from __future__ import annotations

import math

import numpy as np

from flangeye.types import Floats
from flangeye_plugins.weld.following.belief import Belief, Learned
from flangeye_plugins.weld.following.response import identify
from flangeye_plugins.weld.settings import Following

SWEEP_MARGIN = 1.25
"""The sweep presses harder than ``deflection`` by this."""

SOFTER = 3.0
"""The weld presses between two walls by so much less than the tip was seen to stand: friction of
0.3 holds a tip on a wall of 45 degrees at 3.4 times what lets it slide down again."""

PIVOTS = 0.1
"""The tool is turned about the tip to either side by this [rad]."""

PIVOTED = 0.02e-3
"""Best accuracy of the tip distance estimated by the sweep [m]."""

LONGEST = 4.0
"""Longest wait for the tip to rest, or for enough measurements at the hard end [s]."""


class Probing:
    """The sweep: its next motion, its measurements, and the estimates from them.

    Attributes:
        over: Whether the sweep has been made.
    """

    def __init__(self, settings: Following, belief: Belief, side: float) -> None:
        self._rate, self._turn_rate = 4e-3, settings.turn_rate / 3.0
        self._belief = belief
        self._two_walls, self._settings = belief.two_walls, settings
        self._side, self._noise = side, belief.noise
        self._turned = 0.0
        self._sweep(SWEEP_MARGIN * settings.deflection)

    def _sweep(self, reach: float) -> None:
        """Begin a sweep by ``reach`` [m]."""
        # It ends outwards: play and hysteresis are then where the weld keeps them.
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
        """Begin, with the noise of one measurement across the seam [m]."""
        self._noise = (max(self._noise[0], noise), self._noise[1])

    def velocity(self, elapsed: float) -> tuple[float, float]:
        """Return the sweep's velocity to the left [m/s] and its turn [rad/s] in this cycle."""
        (goal, turn), self._time = self._goals[0], self._time + elapsed
        if self._wanted is None:  # contact is found on the way to it: first it comes to rest
            self._wanted = self._rested()
            return 0.0, 0.0
        # At one speed a delay would look like play: both then shift the tag by the same.
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
        """Whether the tip still comes to rest before the sweep."""
        return self._wanted is None

    def _rested(self) -> float | None:
        """Return by how much the tip is pressed where the sweep begins [m]; None before."""
        since = self._standing_since()
        felt = [-self._side * across for time, across, *_ in self._felt if time >= since]
        rested = felt[len(felt) // 2 :]
        told = bool(rested) and len(rested) >= self._enough
        # No sooner the tip has come to rest where it met the wall.
        if self._time < 0.4 or (not told and self._time < LONGEST):
            return None
        return float(np.mean(rested)) if rested else self._reach / SOFTER

    def _standing_since(self) -> float:
        """Return since when the arm stands [s], infinity where it still moves.

        It moves for a while after the command to stop, longest where it turned as well.
        """
        now, _, here, _ = self._cycles[-1] if self._cycles else (0.0, 0.0, 0.0, 0.0)
        since = math.inf
        for time, _, lateral, _ in reversed(self._cycles):
            # An arm stands that for 0.2 s was nowhere farther aside than 0.02 mm.
            if abs(lateral - here) > 0.02e-3:
                break
            since = time
        return since if now - since >= 0.2 else math.inf

    def _settled(self) -> bool:
        """Return whether enough was felt at the highest pressing force."""
        since, before = self._pressed = self._pressed or (self._time, len(self._felt))
        return len(self._felt) - before >= self._enough or self._time - since > LONGEST

    @property
    def _enough(self) -> float:
        """Measurements whose mean is known as well as it has to be."""
        # The mean at the hard end is to be known to 0.03 mm.
        return (self._noise[0] / 0.03e-3) ** 2

    def note(self, time: float, sent: float, lateral: float, slant: float = 0.0) -> None:
        """Record a cycle.

        Args:
            time: [s].
            sent: Speed to the left that was commanded [m/s].
            lateral: The end point's offset to the left [m].
            slant: Sine of the tool's angle to the plan.
        """
        self._cycles.append((time, sent, lateral, slant))

    def feel(self, time: float, across: float, height: float, along: float) -> None:
        """Remember a measurement: displacements to the left and forwards, the tip's height [m]."""
        self._felt.append((time, across, height, along))

    def learned(self) -> Learned | str | None:
        """Return the estimates, or why the weld must not begin; None to repeat the sweep."""
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

    def _fit(self, felt: Floats, cycles: Floats) -> tuple[Learned, str]:
        """Fit finger and clock to the sweep; return the fit, and whether the tip climbs."""
        noise = max(_scatter(felt[:, 1]), self._noise[0])
        late = np.arange(-0.12, 0.121, 0.01)  # timestamps, or early, by up to 120 ms
        reversals = 1e-3 * np.array([0.02, 0.05, 0.1, 0.15, 0.2, 0.25, 0.3, 0.4, 0.6, 1.0])
        stamps, widths = (grid.ravel() for grid in np.meshgrid(late, reversals, indexing="ij"))
        at, slant = (
            np.interp(felt[:, 0] - stamps[:, None], cycles[:, 0], cycles[:, i]) for i in (2, 3)
        )
        rms, solutions = _explained(at, slant, widths, felt[:, 1])
        belief = self._belief
        # What no candidate explains is no smaller an error for being no noise.
        unlikely = len(felt) * (rms / max(noise, float(rms.min()))) ** 2
        unlikely += ((stamps - belief.stamp) / belief.stamp_sigma) ** 2
        unlikely += ((solutions[:, 2] + belief.play) / belief.play_sigma) ** 2
        best = int(np.argmin(unlikely))
        _, across, play, _, ahead = solutions[best].tolist()
        slid = felt[:, 3] - felt[:, 3].mean()
        middle = at[best] - at[best].mean()
        moved = float(middle @ middle) + 1e-12
        # On walls that stand askew the tip slides along them, and shows only what is across.
        askew = float(middle @ slid) / moved / across
        gain = across * (1.0 + askew**2) - 1.0
        left = max(float(rms[best]), noise)
        bend, sigma, told = self._bent(felt, at[best], slant[best], float(widths[best]), left)
        known = belief.ahead_known**2 / (belief.ahead_known**2 + told**2)
        # Walls that stand askew may be curved too: the correction is as uncertain as it is large.
        sigma = math.hypot(sigma, askew**2)
        dead, lag = identify(cycles[:, :3])
        found = Learned(
            gain, sigma, -play, float(widths[best]), float(stamps[best]), dead, lag,
            math.sqrt(max(float(rms[best]) ** 2 - noise**2, 0.0)), askew, noise, self._reach,
            belief.ahead + known * ahead / across, math.sqrt(known) * told,
            *_spread(unlikely, stamps, solutions[:, 2], best),
        )  # fmt: skip
        # Play follows the model to 30 %, all else to 0.04 mm.
        beyond = 4.0 * math.hypot(belief.ahead_known, told)
        if belief.ahead_sigma is not None and abs(ahead / across) > beyond:
            return found, (
                f"the tip is {ahead / across * 1e3:+.2f} mm ahead of where earlier welds found it, "
                f"{beyond * 1e3:.2f} mm are allowed: it was bent or changed; delete the file that "
                "'prior' names"
            )
        left = 0.04e-3 + noise + 0.3 * abs(play)
        if found.unexplained > left:
            return found, (
                f"gain, play and delay leave {found.unexplained * 1e3:.2f} mm of the finger's "
                "displacement unexplained"
            )
        return found, self._climbs(felt, at[best], gain, bend)

    def _bent(
        self, felt: Floats, at: Floats, slant: Floats, width: float, noise: float
    ) -> tuple[tuple[float, float], float, float]:
        """Return by how much less is shown in the hard half; its, the gain's and ahead's sigma."""
        away = at - np.median(at + felt[:, 1])
        hard = np.sign(away) * np.maximum(np.abs(away) - self._reach / 2.0, 0.0)
        *through, ahead = _rows(at[None], slant[None], np.array([width]))[0].T
        rows = np.column_stack([*through, hard, ahead])
        inverse = np.linalg.pinv(rows.T @ rows)
        less = float((inverse @ rows.T @ felt[:, 1])[4])
        _, gain, _, _, hardly, leads = (noise * np.sqrt(np.diag(inverse))).tolist()
        pivoted = self._two_walls and float(np.ptp(slant)) > PIVOTS
        return (less, hardly), gain, leads if pivoted else 1e3

    def _climbs(self, felt: Floats, at: Floats, gain: float, bend: tuple[float, float]) -> str:
        """Return that the tip rises, or its reading falls, where it is pressed hard; else ""."""
        # A gain off by more is not a drift but another finger, or a tip that climbs.
        if abs(gain) > 0.35:
            return f"the finger's gain is off by {gain:.0%}, or the tip climbs the wall"
        if bend[0] > 0.1 + 3.0 * bend[1]:
            return f"the tip climbs the wall: pressed hard the finger shows {bend[0]:.0%} less"
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
    """Return the standard deviation of one of a row of measurements, by second differences."""
    # Second differences have no trend, and of white noise six times the variance
    return float(np.median(np.abs(np.diff(values, 2))) / 0.6745 / np.sqrt(6.0))


def _explained(at: Floats, slant: Floats, widths: Floats, felt: Floats) -> tuple[Floats, Floats]:
    """Return rms (C,) and the five unknowns of :func:`_rows` (C, 5) that explain touches (N,).

    Args:
        at: (C, N) where the end point was, for each candidate's timestamps [m].
        slant: (C, N) sines of the tool's angle.
        widths: (C,) of each candidate's reversal [m].
        felt: (N,) displacements across [m].
    """
    rows = _rows(at, slant, widths)
    gram = np.swapaxes(rows, 1, 2) @ rows
    solutions = np.einsum("cij,cnj,n->ci", np.linalg.pinv(gram, hermitian=True), rows, felt)
    left = felt - np.einsum("cni,ci->cn", rows, solutions)
    return np.sqrt(np.mean(left**2, axis=1)), np.asarray(solutions)


def _spread(unlikely: Floats, stamps: Floats, plays: Floats, best: int) -> tuple[float, float]:
    """Return the standard deviations of play [m] and stamp [s] over the grid (C,) about the best.

    Neither is known better than the grid is fine: 20 um and 10 ms, evenly distributed.
    """
    weights = np.exp(-0.5 * (unlikely - unlikely[best]))
    weights /= weights.sum()
    play, stamp = (float(weights @ (x - x[best]) ** 2) for x in (plays, stamps))
    return math.sqrt(play + (20e-6) ** 2 / 12.0), math.sqrt(stamp + 10e-3**2 / 12.0)


def _rows(at: Floats, slant: Floats, widths: Floats) -> Floats:
    """Return the design (C, N, 5): offset, gain, play, where in its play it began, and ahead.

    Where in its play the finger stood at first is a column of its own: the difference between
    beginning at the one end and at the other, until both are the same.
    """
    left, right = (_dragged(at, widths, end) for end in (-1.0, 1.0))
    reversal, began = (left + right) / 2.0 - at, (right - left) / 2.0
    scale = widths[:, None]
    return np.stack([np.ones_like(at), -at, reversal / scale, began / scale, -slant], axis=2)


def _dragged(at: Floats, half: Floats, end: float) -> Floats:
    """Return what motions (C, N) drag along with dead bands of ``half`` (C,) to both sides.

    It begins at an end of its band: 1 for the left one, -1 for the right.
    """
    dragged = at + end * half[:, None]
    for i in range(1, at.shape[1]):
        dragged[:, i] = np.clip(dragged[:, i - 1], at[:, i] - half, at[:, i] + half)
    return dragged
