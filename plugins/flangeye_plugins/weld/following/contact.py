"""Estimate the tip's contact with the joint by a hidden Markov model.

A tip is seated between the walls, up the pressed wall, up the other wall, free and moving with the
arm on the joint's bottom, or fallen off the joint. Each measurement is compared with the
extrapolated seam:

* seated: the tip is on the seam, at its former height or lifted by a tack weld;
* up a wall: the tip has risen by about :data:`RISE` and moved aside by ``flat`` times that;
* free: the tip is hardly deflected, at any height;
* fallen: the tip is hardly compressed either.

The tip may climb a wall if its ratio of side force to preload nears the largest one at which it
stayed seated in the initial sweep. A measurement is used after a short delay, smoothed by a
forward-backward pass over the newest ones; its extra variance allows for a tip that climbed.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from enum import IntEnum
from typing import NamedTuple

import numpy as np

from flangeye.types import Floats


class Mode(IntEnum):
    """Contact of the tip: between the walls, up the pressed one, up the other, free, or fallen."""

    SEATED, PRESSED, OTHER, FREE, FALLEN = range(5)


LOSS_PROBABILITY = 0.9
"""Contact is lost above this probability of a free tip, and regained below its complement."""

RISE = 0.5e-3
"""Typical height of a tip that has climbed a wall [m]."""

LIFTS = 1.0e-3
"""Typical height of tack welds, and typical unplanned bend of the seam [m]."""

STRIDE = 10e-3
"""Travel over which modes and heights change [m]."""

STRAINED = 0.9
"""The tip may climb above this share of the largest deflection at which it stayed seated."""

RARE = 1e-3
"""Probability, per STRIDE, that a lightly pressed tip climbs."""


@dataclass(frozen=True, eq=False)
class SeamReading:
    """The seam at the tip: measured in contact, otherwise predicted.

    Attributes:
        offset: Offset to the left of the plan [m].
        height: Height above the plan [m].
    """

    offset: float
    height: float


class TipPosition(NamedTuple):
    """Position of the tip at one measurement.

    Attributes:
        time: Time of the measurement [s].
        s: Arc length on the plan [m].
        seam: The seam there, if the tip is seated.
        deflection: Deflection of the tip, towards the pressed wall [m].
        compression: Compression of the tip, into the joint [m].
        angle: Angle of the tool [rad].
    """

    time: float
    s: float
    seam: SeamReading
    deflection: float
    compression: float
    angle: float


class _WeighedMeasurement(NamedTuple):
    """A measurement, and its likelihood in each mode.

    Attributes:
        felt: The measurement.
        likely: (5,) probability of each mode, given all measurements up to this one.
        moves: (5, 5) transition probabilities from each former mode to each present one.
        chances: (5,) likelihood of the measurement in each mode.
        climbed: Height that the tip has risen, if it has climbed [m].
    """

    felt: TipPosition
    likely: Floats
    moves: Floats
    chances: Floats
    climbed: float


class Contact:
    """Filter for the tip's contact mode.

    Attributes:
        likely: (5,) probability of each mode.
        deflection: Filtered deflection, positive towards the pressed side [m].
        compression: Filtered compression into the joint [m].
        at: Arc length of the newest measurement [m].
        steady: Largest ratio of deflection to compression at which the tip stayed seated.
        play: Deflection that a free tip shows after having been pressed [m].
        fell: Arc length at which the tip fell off the joint [m]; None while the joint bears it.
    """

    def __init__(
        self, flat: float, slides: float, preload: float, noise: tuple[float, float]
    ) -> None:
        """Begin seated.

        Args:
            flat: Lateral motion of the tip per unit of height when it climbs a wall.
            slides: Largest deflection that friction alone can cause [m].
            preload: Compression of a tip on the joint [m].
            noise: Standard deviations of one measurement across and up [m].
        """
        self.likely = only(Mode.SEATED)
        self.deflection = self.compression = 0.0
        self.steady, self.play = math.inf, 0.0
        self.noise = noise
        self._flat, self._slides, self._preload = flat, slides, preload
        self._time, self.at = -math.inf, math.inf
        self._height, self._spread = 0.0, math.inf
        self._newest: deque[_WeighedMeasurement] = deque()
        self.fell: float | None = None
        self._borne: tuple[float, float] | None = None

    def seat(self, time: float, deflection: float, compression: float) -> None:
        """Set the state to seated, with this deflection and compression [m]."""
        self.likely = only(Mode.SEATED)
        self.deflection, self.compression, self._time = deflection, compression, time
        self._borne = None
        self._spread = math.inf

    def lose(self) -> None:
        """Set the state to free: no wall holds the tip."""
        self.likely, self.deflection = only(Mode.FREE), 0.0

    @property
    def free(self) -> float:
        """Probability that no wall holds the tip."""
        return float(self.likely[Mode.FREE] + self.likely[Mode.FALLEN])

    @property
    def bears(self) -> bool:
        """Whether the joint supports the tip, by its walls or by its bottom."""
        return float(self.likely[Mode.FALLEN]) < 0.5

    @property
    def strained(self) -> float:
        """Deflection as a share of the largest one at which the tip is known to stay seated.

        It is 0 of a tip that hangs past the joint's end, where nothing compresses the finger.
        """
        if not self.bears:
            return 0.0
        stands = self.steady * max(self.compression, 1e-9)
        return abs(self.deflection) / stands

    def take(self, felt: TipPosition, aside: float, spread: float, side: float) -> None:
        """Update the modes' probabilities by a measurement.

        Args:
            felt: The measurement.
            aside: Its offset to the left of the expected seam [m].
            spread: Variance of ``aside``: measurement and expectation [m^2].
            side: Side of the pressed wall: 1 left, -1 right.
        """
        # Deflection and compression are filtered over 0.1 s.
        kept = math.exp(-(felt.time - self._time) / 0.1)
        self.deflection += (1.0 - kept) * (felt.deflection - self.deflection)
        self.compression += (1.0 - kept) * (felt.compression - self.compression)
        way, self._time, self.at = abs(felt.s - self.at), felt.time, felt.s
        if self._spread == math.inf:
            way, self._height, self._spread = 0.0, felt.seam.height, self.noise[1] ** 2
        # A tip that is pressed aside by more than it stands climbs within 1 mm.
        share, soon = (1.0 - math.exp(-(way + 1e-4) / over) for over in (STRIDE, 1e-3))
        self._spread += share * LIFTS**2 / 100.0
        moves = self._moves(share, soon)
        chances, climbed = self._chances(felt, side * aside, spread)
        weighed = (self.likely @ moves) * chances
        self.likely = weighed / weighed.sum()
        self._newest.append(_WeighedMeasurement(felt, self.likely, moves, chances, climbed))
        # Only a seated tip measures the height of the seam
        gain = float(self.likely[Mode.SEATED]) * self._spread / (self._spread + self.noise[1] ** 2)
        self._height += gain * (felt.seam.height - self._height)
        self._spread *= 1.0 - gain

    def forget(self) -> None:
        """Drop the measurements not yet used, which were made while no wall held the tip."""
        self._newest.clear()

    def settled(self, until: float) -> Iterator[tuple[TipPosition, float]]:
        """Yield valid measurements up to a time [s], each with its extra variance [m^2]."""
        # Backward pass: `since` is the likelihood of all later measurements, given each mode
        since, off = np.ones(len(Mode)), []
        for weighed in reversed(self._newest):
            likely = weighed.likely * since
            off.append(likely / likely.sum())
            since = weighed.moves @ (weighed.chances * since)
            since /= since.sum()
        while self._newest and self._newest[0].felt.time <= until:
            weighed, likely = self._newest.popleft(), off.pop()
            self._part(weighed.felt.s, float(likely[Mode.FALLEN]))
            # A free tip moves with the arm and would drag the path along: 10 % probability is too
            # much.
            if likely[Mode.FREE] + likely[Mode.FALLEN] < 0.1:
                climbs = float(likely[Mode.PRESSED] + likely[Mode.OTHER])
                yield weighed.felt, climbs * (self._flat * weighed.climbed) ** 2

    def _part(self, s: float, fallen: float) -> None:
        """Update where the tip fell off the joint, given the probability that it has fallen."""
        if fallen < 0.5:
            self.fell, self._borne = None, (self._borne[1] if self._borne else s, s)
        elif self.fell is None and self._borne is not None:
            # Friction has held the tip back: falling, it springs ahead. The joint ended on the way
            # from the last measurement on it to the next, which is as long as the way before.
            before, last = self._borne
            self.fell = last + (last - before) / 2.0

    def _moves(self, share: float, soon: float) -> Floats:
        """Return the transition probabilities (5, 5) of the modes.

        ``share`` and ``soon`` are the probabilities of a change within the travel since the last
        measurement, for changes over STRIDE and over 1 mm.
        """
        climbing = share * RARE + soon * min(max(self.strained - STRAINED, 0.0) ** 2, 0.9)
        moves = np.diag(np.full(len(Mode), 1.0 - share))
        moves[:, Mode.SEATED] += share
        moves[Mode.SEATED, Mode.PRESSED if self.deflection > 0.0 else Mode.OTHER] = climbing
        moves[Mode.SEATED, [Mode.FREE, Mode.FALLEN]] = share * RARE * 10.0
        moves[Mode.SEATED, Mode.SEATED] -= climbing + 2.0 * share * RARE * 10.0
        return moves

    def _chances(self, felt: TipPosition, aside: float, spread: float) -> tuple[Floats, float]:
        """Return a measurement's likelihood in each mode (5,), and the height climbed [m].

        ``aside`` is its offset from the expected seam towards the pressed side [m].
        """
        up, tall = felt.seam.height - self._height, self._spread + self.noise[1] ** 2
        # Tack welds lift the tip on 10 % of a seam; 2 % of a seam bend in a way not planned.
        seated = _mostly(up, tall, 0.1) * _mostly(aside, spread, 0.02)
        walls = [_up_a_wall(s * aside, up, spread, tall, self._flat) for s in (1, -1)]
        free = self._let_go(felt.deflection) * _normal(up, tall + LIFTS**2)
        climbed = walls[0][1] if felt.deflection > 0.0 else walls[1][1]
        borne, hangs = self._compressed(felt.compression)
        held = np.array([seated, walls[0][0], walls[1][0], free]) * borne
        chances = np.array([*held, free * hangs]) + 1e-12
        # Neighbouring measurements share the error of the expectation: each counts as half a one.
        return chances**0.5, max(climbed, RISE)

    def _compressed(self, compression: float) -> tuple[float, float]:
        """Return the likelihoods of a compression [m], for a tip on the joint and a fallen one."""
        # At a tack weld or a dip the preload is off by a third until it is controlled again.
        up = self.noise[1] ** 2
        borne = _normal(compression - self._preload, up + (self._preload / 3.0) ** 2)
        return borne, _normal(compression, up + (self._preload / 10.0) ** 2)

    def _let_go(self, deflection: float) -> float:
        """Return the likelihood of a deflection [m], given that the tip is free.

        A released finger shows no deflection, its remaining play, or the displacement that friction
        causes.
        """
        noise, play = self.noise[0] ** 2, self.play
        held = _normal(deflection, noise) + _normal(deflection - play, noise + (0.3 * play) ** 2)
        return 0.25 * held + 0.5 * _normal(deflection, noise + self._slides**2)


def only(mode: Mode) -> Floats:
    """Return the probabilities (5,) of the modes where one of them is certain."""
    return np.array([float(mode is each) for each in Mode])


def _mostly(off: float, variance: float, seldom: float) -> float:
    """Return the density of a normal mixture: a share ``seldom`` is wider by the scale LIFTS."""
    wide = _normal(off, variance + LIFTS**2)
    return (1.0 - seldom) * _normal(off, variance) + seldom * wide


def _normal(off: float, variance: float) -> float:
    return math.exp(-0.5 * off * off / variance) / math.sqrt(2.0 * math.pi * variance)


def _up_a_wall(
    aside: float, up: float, across: float, tall: float, flat: float
) -> tuple[float, float]:
    """Return the likelihood of a tip that climbed a wall, and the estimated height climbed [m]."""
    # A rise r of N(RISE, RISE^2), seen as flat r aside and r up, integrated out in closed form
    weight = 1.0 / RISE**2 + flat**2 / across + 1.0 / tall
    risen = (1.0 / RISE + flat * aside / across + up / tall) / weight
    left = (risen - RISE) ** 2 / RISE**2
    left += (aside - flat * risen) ** 2 / across + (up - risen) ** 2 / tall
    scale = 2.0 * math.pi * RISE * math.sqrt(across * tall * weight)
    return math.exp(-0.5 * left) / scale, risen
