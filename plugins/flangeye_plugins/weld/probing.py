"""A small sweep of the seated tip before the weld: what finger, clock and arm really do.

The tip is held by the groove's walls, as in a punch mark, while the arm moves across by ``D`` to
one side and to the other. With the tip at ``y0`` and the end point at ``P`` the true displacement
is ``u = y0 - P``; the finger says ``m = c + (1 + g) u + w sign(du/dt)``, of an image whose
timestamp is off by ``tau``. Gain error ``g``, the half width ``w`` of play and hysteresis, and
``tau`` follow by least squares, ``tau`` and the reversal's length from a grid. A tip that climbs
its wall is seen by its height.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from flangeye.types import Floats
from flangeye_plugins.weld.belief import STEEP, Belief
from flangeye_plugins.weld.response import identify
from flangeye_plugins.weld.settings import Following
from flangeye_plugins.weld.sliding import Sliding

MARGIN = 1.25
"""The sweep presses harder than the weld by this, so that the tip is known to stay seated."""

ENDS = 0.75
"""The sweep ends with this share of the deflection; the weld then presses on outwards."""

SLOWEST, BEAT = 0.2, 0.8
"""The sweep's speed swings between this share of it and all of it, with this period [s]."""

USUAL_STAMP, USUAL_WIDTH = 0.05, 0.1e-3
"""Standard deviations of what is expected of timestamps [s] and of play [m]: priors."""

STAMPS = np.arange(-0.06, 0.121, 0.01)
"""Errors of the timestamps among which the sweep's is sought [s]."""

REVERSALS = (0.02e-3, 0.1e-3, 0.2e-3, 0.4e-3, 1e-3)
"""Half widths of play or hysteresis among which the finger's is sought [m]."""

CLIMBED = 0.05e-3
"""A seated tip rises by less when it is pressed [m]."""

UNSEEN = 0.1e-3
"""A tip that goes along with the sweep by no more is in the stated bound [m]."""

UNEXPLAINED = 0.04e-3
"""A finger whose displacement the sweep leaves unexplained by more is not understood [m]."""

CURVED = 0.1e-3
"""Where walls stand askew they are curved too: so much more may be left, times the tangent [m]."""

LARGEST_GAIN = 0.35
"""A gain that is off by more is no drift but another finger."""

LARGEST_PLAY = 0.1e-3
"""Within more play, to each side, nothing tells where the tip is [m]."""

LOOSE = 0.5
"""Share of the deflection down to which the tip is let go of before it is pressed for the weld."""

FEWEST = 15
"""Samples of a sweep without which it says nothing."""

KNEE = 0.8
"""A tip that leaves its seat does so beyond this share of the deflection, or shows less anyway."""

RESTS = 0.4
"""No sooner the tip has come to rest where it met the wall [s]."""

STANDING, STANDS = 0.2, 0.02e-3
"""An arm stands that for so long [s] was nowhere farther aside than this [m]."""

TOLD = 0.03e-3
"""So well the mean of what is felt where the tip is pressed hardest is to be known [m]."""

LONGEST = 4.0
"""No longer is it pressed for that [s]."""


@dataclass(frozen=True)
class Learned:
    """What the sweep found.

    Attributes:
        gain: The finger shows displacements larger by this share.
        gain_sigma: Its standard deviation.
        width: Half width of play and hysteresis [m].
        stamp: Timestamps are late by this [s].
        dead_time: Dead time of the arm [s].
        lag: Lag of the arm [s].
        unexplained: rms that the model leaves beyond the noise [m].
        askew: Tangent of the angle at which the walls stand to the plan.
        noise: Standard deviation of one measurement across [m].
    """

    gain: float = 0.0
    gain_sigma: float = 0.05
    width: float = 0.0
    stamp: float = 0.0
    dead_time: float = 0.0
    lag: float = 0.0
    unexplained: float = 0.0
    askew: float = 0.0
    noise: float = 10e-6


class Probing:
    """The sweep: where to go next, what was felt, and what follows from it.

    Attributes:
        over: Whether the sweep has been made.
    """

    def __init__(self, settings: Following, belief: Belief, side: float) -> None:
        self._rate = min(settings.lateral_speed, 4e-3)
        reach = MARGIN * settings.deflection
        back = -reach if belief.two_walls else 0.4 * settings.deflection
        # It ends outwards: play and hysteresis are then where the weld keeps them.
        ends = ENDS * settings.deflection
        self._turns = [reach, back, ends]
        # Then it slides along, pressed hard, and ends outwards again.
        self._last = [reach, LOOSE * settings.deflection, ends] if belief.two_walls else []
        self._sliding = Sliding(0.0)
        self._two_walls = belief.two_walls
        self._side, self._noise = side, belief.noise
        self._deflection, self._flat = settings.deflection, belief.flat(side)
        self._preload = settings.preload
        self._wanted: float | None = None
        self._pressed: tuple[float, int] | None = None
        self.over, self._time = False, 0.0
        self._swept: tuple[int, int] | None = None
        self._cycles: list[tuple[float, float, float]] = []
        self._felt: list[tuple[float, float, float, float]] = []

    def begin(self, noise: float) -> None:
        """Begin, with a finger of which one measurement across scatters by ``noise`` [m]."""
        self._noise = (max(self._noise[0], noise), self._noise[1])

    def velocity(self, elapsed: float) -> float:
        """Return the velocity of the sweep in this cycle, to the left [m/s]."""
        goal, self._time = self._turns[0], self._time + elapsed
        if self._wanted is None:  # contact is found on the way to it: first it comes to rest
            self._wanted = self._rested()
            return 0.0
        # At one speed a delay would look like play: both then shift the tag by the same.
        rate = self._rate * (SLOWEST + (1.0 - SLOWEST) * math.sin(math.pi * self._time / BEAT) ** 2)
        step = float(np.clip(goal - self._wanted, -rate * elapsed, rate * elapsed))
        self._wanted += step
        if abs(goal - self._wanted) < 1e-9 and self._settled() and not self.slides:
            self._turns.pop(0)
            if not self._turns and self._swept is None:
                self._swept = len(self._felt), len(self._cycles)
                self._turns = self._last
                heights = np.array([sample[2] for sample in self._felt])
                self._sliding = Sliding((_scatter(heights) / TOLD) ** 2 if len(heights) > 2 else 0)
            self.over = not self._turns
        return self._side * step / elapsed if elapsed else 0.0

    @property
    def slides(self) -> bool:
        """Whether the tip is at the end of the sweep where it slides along."""
        goal = self._turns[0] if self._turns else math.nan
        ends = self._swept is not None and len(self._turns) == len(self._last)
        return ends and self._wanted == goal and self._sliding.state != "over"

    def along(self, elapsed: float) -> float:
        """Return the velocity of the sweep along the seam in this cycle [m/s]."""
        return self._sliding.velocity(elapsed) if self.slides else 0.0

    def _rested(self) -> float | None:
        """Return by how much the tip is pressed where the sweep begins [m]; None before."""
        since = self._standing_since()
        felt = [-self._side * across for time, across, *_ in self._felt if time >= since]
        rested = felt[len(felt) // 2 :]
        told = bool(rested) and len(rested) >= self._enough
        if self._time < RESTS or (not told and self._time < LONGEST):
            return None
        return float(np.mean(rested)) if rested else self._deflection

    def _standing_since(self) -> float:
        """Return since when the arm stands [s], infinity where it still moves.

        It does for a while after it was told to stop, longest where it turned as well.
        """
        now, _, here = self._cycles[-1] if self._cycles else (0.0, 0.0, 0.0)
        since = math.inf
        for time, _, lateral in reversed(self._cycles):
            if abs(lateral - here) > STANDS:
                break
            since = time
        return since if now - since >= STANDING else math.inf

    def _settled(self) -> bool:
        """Return whether enough was felt at the highest pressing force."""
        since, before = self._pressed = self._pressed or (self._time, len(self._felt))
        return len(self._felt) - before >= self._enough or self._time - since > LONGEST

    @property
    def _enough(self) -> float:
        """Measurements whose mean is known as well as it has to be."""
        return (self._noise[0] / TOLD) ** 2

    def note(self, time: float, told: float, lateral: float) -> None:
        """Record a cycle: the commanded speed [m/s] and the end point's offset to the left [m]."""
        self._cycles.append((time, told, lateral))

    def feel(self, time: float, across: float, height: float, along: float) -> None:
        """Remember a measurement: displacements to the left and forwards, the tip's height [m]."""
        self._felt.append((time, across, height, along))
        if self.slides:
            self._sliding.feel(self._side * across, height)

    def learned(self) -> Learned | str:
        """Return what was found, or why the weld must not begin."""
        if len(self._felt) < FEWEST:
            return "the tag was seen too seldom while the finger was probed"
        samples, ticks = self._swept or (len(self._felt), len(self._cycles))
        felt, cycles = np.array(self._felt[:samples]), np.array(self._cycles[:ticks])
        found = self._fit(felt, cycles)
        if abs(found.gain) > LARGEST_GAIN:
            return f"the finger's gain is off by {found.gain:.0%}; calibrate it again"
        left = math.hypot(found.unexplained, found.noise)
        if left > UNEXPLAINED + CURVED * abs(found.askew) + found.noise:
            return (
                "the finger's displacement is not understood: "
                f"{left * 1e3:.2f} mm are left unexplained by gain, play and delay"
            )
        if abs(found.width) > LARGEST_PLAY:
            return (
                f"the finger has {2 * abs(found.width) * 1e3:.2f} mm of play or hysteresis, at "
                f"most {2 * LARGEST_PLAY * 1e3:.2f} mm are allowed; fasten it, or its tag"
            )
        return self._climb(felt, cycles, found) or self._slid() or found

    def _slid(self) -> str | None:
        """Say that the tip climbs where it slides along its wall, or that it may."""
        climbed = self._sliding.climbed()
        if climbed is None:
            return None
        (aside, rise), (aside_sigma, rise_sigma) = climbed[0].tolist(), climbed[1].tolist()
        if climbs := _climbs(rise, rise_sigma, "slides along it, pressed aside"):
            return climbs
        least = self._just_held()
        if rise + 2 * rise_sigma > least and aside + 2 * aside_sigma > least * self._flat:
            return (
                "whether the tip climbs the wall where it slides along it is known to "
                f"{rise_sigma * 1e3:.2f} mm only; raise 'preload' or lower 'deflection', or see to "
                "it that the tag is read better"
            )
        return None

    def _just_held(self) -> float:
        """Return how far a tip rises that is just held at the deflection, pressed by MARGIN [m]."""
        ratio = self._preload / self._deflection
        return (MARGIN - 1.0) * self._preload / (ratio * self._flat + 1.0)

    def _fit(self, felt: Floats, cycles: Floats) -> Learned:
        noise = max(_scatter(felt[:, 1]), self._noise[0])
        stamps, widths = (grid.ravel() for grid in np.meshgrid(STAMPS, REVERSALS, indexing="ij"))
        at = np.interp(felt[:, 0] - stamps[:, None], cycles[:, 0], cycles[:, 2])
        rms, solutions = _explained(at, widths, felt[:, 1])
        unlikely = len(felt) * (rms / noise) ** 2 + (stamps / USUAL_STAMP) ** 2
        best = int(np.argmin(unlikely + (solutions[:, 2] / USUAL_WIDTH) ** 2))
        _, across, play = solutions[best].tolist()
        slid = felt[:, 3] - felt[:, 3].mean()
        middle = at[best] - at[best].mean()
        moved = float(middle @ middle) + 1e-12
        # On walls that stand askew the tip slides along them: what is left is across the wall.
        askew = float(middle @ slid) / moved / across
        gain = across * (1.0 + askew**2) - 1.0
        sigma = max(float(rms[best]), noise) / math.sqrt(moved)
        # Walls that stand askew may be curved too: the correction is as uncertain as it is large.
        sigma = math.hypot(sigma, askew**2)
        dead, lag = identify(cycles)
        return Learned(
            gain=gain,
            gain_sigma=sigma,
            width=-play,
            stamp=float(stamps[best]),
            dead_time=dead,
            lag=lag,
            unexplained=math.sqrt(max(float(rms[best]) ** 2 - noise**2, 0.0)),
            askew=askew,
            noise=noise,
        )

    def _climb(self, felt: Floats, cycles: Floats, found: Learned) -> str | None:
        """Say that the tip rises where it is pressed hard, or that it may."""
        at = np.interp(felt[:, 0] - found.stamp, cycles[:, 0], cycles[:, 2])
        from_wall = self._side * at
        middle = from_wall.min()
        if self._two_walls:
            middle = (middle + from_wall.max()) / 2
        pressed = np.abs(from_wall - middle) / max(float(np.abs(from_wall - middle).max()), 1e-9)
        hard, soft = felt[pressed > 0.85, 2], felt[pressed < 0.5, 2]
        if min(len(hard), len(soft)) < 3:
            return None
        rise = float(hard.mean() - soft.mean())
        scatter = max(_scatter(felt[:, 2]), self._noise[1])
        sigma = scatter * float(np.sqrt(1 / len(hard) + 1 / len(soft)))
        if climbs := _climbs(rise, sigma):
            return climbs
        # A tip that climbs goes along with the arm, and so looks like a finger that shows less.
        aside = -found.gain * MARGIN * self._deflection
        if aside > UNSEEN and rise + 2 * sigma > STEEP * aside / self._flat:
            return (
                f"the finger shows {-found.gain:.0%} less than its file says, or the tip climbs "
                "the wall, and it is too noisy to tell; calibrate it again, or raise 'preload'"
            )
        return self._hardly_held(felt, at, found)

    def _hardly_held(self, felt: Floats, at: Floats, found: Learned) -> str | None:
        """Say that the tip leaves its seat where it is pressed hardest, or that it may."""
        rise, sigma = self._knee(felt, at, found)
        if climbs := _climbs(rise, sigma):
            return climbs
        if rise + 2 * sigma > self._just_held():
            return (
                f"whether the tip climbs the wall is known to {sigma * 1e3:.2f} mm only; raise "
                "'preload' or lower 'deflection', or see to it that the tag is read better"
            )
        return None

    def _knee(self, felt: Floats, at: Floats, found: Learned) -> tuple[float, float]:
        """Return how far the tip has risen at the hard end of the sweep, and its sigma [m].

        A tip that leaves its seat goes aside and up from there on: the finger then shows less, by
        a bend that gain, play and delay do not have. Both are fitted together, each by its noise.
        """
        pressed = self._side * at
        pressed -= np.median(pressed + self._side * felt[:, 1] / (1.0 + found.gain))
        beyond = (pressed / self._deflection - KNEE) / (MARGIN - KNEE)
        share, one = np.maximum(beyond, 0.0), np.ones_like(at)
        if np.count_nonzero(share) < 3:
            return 0.0, math.inf
        noise = math.hypot(found.noise, found.unexplained)
        high = max(_scatter(felt[:, 2]), self._noise[1])
        none, best = np.zeros((len(at), 3)), (math.inf, 0.0, math.inf)
        heights = np.column_stack([none, none[:, 0], one, share]) / high
        for width in REVERSALS:
            reversal = (_dragged(at[None], np.array([width]))[0] - at) / width
            aside = self._side * self._flat * share
            across = np.column_stack([one, -at, reversal, none[:, :2], aside]) / noise
            rows = np.vstack([across, heights])
            said = np.concatenate([felt[:, 1] / noise, felt[:, 2] / high])
            solved = np.linalg.lstsq(rows, said, rcond=None)[0]
            left = float(np.sum((said - rows @ solved) ** 2))
            sigma = math.sqrt(float(np.linalg.pinv(rows.T @ rows)[-1, -1]))
            best = min(best, (left, float(solved[-1]), sigma))
        return best[1:]


def _climbs(rise: float, sigma: float, when: str = "is pressed aside") -> str | None:
    """Say that the tip climbs its wall, where it rises for certain."""
    if rise <= CLIMBED + 3 * sigma:
        return None
    return (
        f"the tip climbs the wall by {rise * 1e3:.2f} mm when it {when}; lower "
        "'deflection' or raise 'preload'"
    )


def _scatter(values: Floats) -> float:
    """Return the standard deviation of one of a row of measurements, by second differences."""
    return float(np.median(np.abs(np.diff(values, 2))) / 0.6745 / np.sqrt(6.0))


def _explained(at: Floats, widths: Floats, felt: Floats) -> tuple[Floats, Floats]:
    """Return rms (C,) and offset, gain and play (C, 3) that explain what was felt (N,).

    Args:
        at: (C, N) where the end point was, for each candidate's timestamps [m].
        widths: (C,) of each candidate's reversal [m].
        felt: (N,) displacements across [m].
    """
    reversal = (_dragged(at, widths) - at) / widths[:, None]
    rows = np.stack([np.ones_like(at), -at, reversal], axis=2)
    gram = np.swapaxes(rows, 1, 2) @ rows
    solutions = np.einsum("cij,cnj,n->ci", np.linalg.pinv(gram, hermitian=True), rows, felt)
    left = felt - np.einsum("cni,ci->cn", rows, solutions)
    return np.sqrt(np.mean(left**2, axis=1)), np.asarray(solutions)


def _dragged(at: Floats, half: Floats) -> Floats:
    """Return what motions (C, N) drag along with dead bands of ``half`` (C,) to both sides."""
    dragged = at.copy()
    for i in range(1, at.shape[1]):
        dragged[:, i] = np.clip(dragged[:, i - 1], at[:, i] - half, at[:, i] + half)
    return dragged
