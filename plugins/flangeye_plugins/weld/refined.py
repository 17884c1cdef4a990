"""The seam as the tip felt it: the paper's refined path, kept as an offset from the plan.

The plan is wrong mostly as a whole, shifted and turned, so the offset changes slowly even where
the seam curves. Where nothing was felt (before the start, in a gap, beyond the end) the plan,
shifted and turned onto what was felt nearby, stands in. What that leaves is a smooth field: a
Gaussian process, whose amplitude is that of what is left and whose correlation length is the one
that predicts each bin best from its neighbours (leave-one-out; Rasmussen and Williams 2006, 5.12).
"""

from __future__ import annotations

import math
from collections import deque
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from flangeye.types import Floats
from flangeye_plugins.weld.path import Path

BIN = 0.5e-3
"""Samples are averaged over this length of the seam [m]."""

SLOPE = 1.5e-3
"""Half the length over which the path's direction is taken [m]."""

REACH = 8e-3
"""How far along the seam what is left of the fit has a say [m]."""

LENGTHS = (1.5e-3, 3e-3, 6e-3)
"""Correlation lengths among which the field's stiffness is chosen [m]."""

BEYOND = 15e-3
"""So far from what was felt the plan's shape is trusted half as well [m]."""

CHOOSING = 12
"""New bins after which the stiffness is chosen again."""

FEW = 48
"""While fewer bins are filled, each new one counts as many."""

ZONE = 8
"""Bins for which the plan is shifted and turned alike."""

SMALLEST = 0.02e-3
"""A field's amplitude is not believed to be less [m]."""

WINDOW = 60e-3
"""How far along the seam samples have a say in how the plan is shifted and turned [m]."""

PRIOR = np.array([5e-3, 5e-3, 0.05])
"""Standard deviations of the plan's error: shift along x and y [m], rotation [rad]."""

SAMPLE_SIGMA = 0.05e-3
"""Standard deviation of a bin about a plan that is only shifted and turned [m]."""


SPAN = 4
"""Bins to both sides of a place at which its fit is tabulated: the direction is taken there."""


class _Fit(NamedTuple):
    """The seam around one bin.

    Attributes:
        offsets: (2 SPAN + 1,) of the seam from the plan at the bins around it [m].
        variance: Of the one in the middle [m^2].
        amplitude: Variance of the field [m^2].
        angle: Of the tool when the nearest bin was felt [rad].
    """

    offsets: list[float]
    variance: float
    amplitude: float
    angle: float


class _Motion(NamedTuple):
    """How the plan is shifted and turned onto what was felt in a zone of the seam.

    Attributes:
        about: (2,) the middle of what was felt [m].
        shift: (3,) along x and y [m], and turn about the middle [rad].
        covariance: (3, 3) of it.
        amplitude: Variance of what it leaves [m^2].
        used: The filled bins.
    """

    about: Floats
    shift: Floats
    covariance: Floats
    amplitude: float
    used: NDArray[np.intp]


class RefinedPath:
    """What the tip felt, by arc length of the plan.

    Attributes:
        noise: Standard deviation of one sample [m].
    """

    def __init__(self, plan: Path, margin: float) -> None:
        """Start empty, with room for ``margin`` [m] beyond both ends of the plan."""
        self._plan = plan
        self._start = -margin - SPAN * BIN
        count = int((plan.length - 2 * self._start) / BIN) + 2
        self._sum, self._count, self._angle = np.zeros(count), np.zeros(count), np.zeros(count)
        self._along = np.zeros(count)
        self._middles: Floats = self._start + (np.arange(count, dtype=np.float64) + 0.5) * BIN
        points, tangents = plan.evaluate(self._middles)
        self._points, self._normals = points[:, :2], _left(tangents)
        self._fits: dict[int, _Fit | None] = {}
        self._motions: dict[int, _Motion | None] = {}
        self.noise = SAMPLE_SIGMA / 5
        self._length, self._new = LENGTHS[1], 0
        self._pending: deque[tuple[float, float, float, float]] = deque()

    @property
    def empty(self) -> bool:
        """Whether nothing has been confirmed yet."""
        return not self._count.any()

    def add(self, time: float, s: float, offset: float, angle: float) -> None:
        """Note that the tip was ``offset`` to the left of the plan at ``s``; not yet believed.

        The tool then stood at ``angle`` [rad].
        """
        self._pending.append((time, s, offset, angle))

    def confirm(self, until: float) -> None:
        """Believe what was felt up to the time ``until`` [s]."""
        while self._pending and self._pending[0][0] <= until:
            _, s, offset, angle = self._pending.popleft()
            index = int((s - self._start) / BIN)
            if 0 <= index < len(self._count):
                self._sum[index] += offset
                self._along[index] += s
                self._angle[index] = angle
                self._new += not self._count[index]
                self._count[index] += 1
                self._forget_fits(index)

    def _forget_fits(self, index: int) -> None:
        """Fit again around a bin that has a new sample; everywhere, when there are many."""
        if self._new >= CHOOSING or (self._new and len(np.flatnonzero(self._count)) < FEW):
            self._new = 0
            self._fits.clear()
            self._motions.clear()
            self._choose_length(index)
        near = round(REACH / BIN) + SPAN
        for other in [i for i in self._fits if abs(i - index) <= near]:
            del self._fits[other]

    def forget_pending(self) -> None:
        """Drop what is not yet believed: contact is lost, and it may be wrong already."""
        self._pending.clear()

    def samples(self) -> Floats:
        """Return what is believed: rows (K, 4) of arc length, offset, tool's angle and count."""
        filled = np.flatnonzero(self._count)
        count = self._count[filled]
        means = (self._along[filled] / count, self._sum[filled] / count)
        return np.column_stack([*means, self._angle[filled], count])

    def recall(self, samples: Floats) -> None:
        """Believe samples (K, 4) of an earlier weld of this plan; see :meth:`samples`."""
        for s, offset, angle, count in samples.tolist():
            for _ in range(int(count)):
                self.add(-math.inf, s, offset, angle)
        self.confirm(0.0)

    def offset(self, s: float) -> float:
        """Return the seam's offset from the plan at one arc length."""
        return self._offsets(s, (0.0,))[0]

    def slope(self, s: float) -> float:
        """Return how fast the seam leaves the plan to the left, per length of it, before ``s``."""
        before, here = self._offsets(s, (-SLOPE, 0.0))
        return (here - before) / SLOPE

    def variance(self, s: float) -> float:
        """Return the variance of the seam's offset at an arc length [m^2]."""
        fit = self._fit(s)
        return float(PRIOR[0] ** 2) if fit is None else fit.variance

    def waviness(self, s: float) -> float:
        """Return the variance of the field that the plan's motion leaves around a place [m^2]."""
        fit = self._fit(s)
        return 0.0 if fit is None else fit.amplitude

    def angle(self, s: float, otherwise: float) -> float:
        """Return the tool's angle when the seam was felt at ``s``, or nearest to it [rad]."""
        fit = self._fit(s)
        return otherwise if fit is None else fit.angle

    def frame(self, s: float) -> tuple[Floats, Floats]:
        """Return the point (2,) and the unit normal (2,) of the refined path at ``s``."""
        before, here, after = self._offsets(s, (-SLOPE, 0.0, SLOPE))
        place = self._plan.at(s)
        slope = (after - before) / (2 * SLOPE)
        (tx, ty), (nx, ny), norm = place.tangent, place.normal, math.hypot(1.0, slope)
        normal = np.array([(nx - slope * tx) / norm, (ny - slope * ty) / norm])
        return place.point + here * place.normal, normal

    def _offsets(self, s: float, beside: tuple[float, ...]) -> list[float]:
        """Return the offsets at places beside ``s``, by at most ``SLOPE``."""
        fit = self._fit(s)
        if fit is None:
            return [0.0] * len(beside)
        table = fit.offsets
        first = (s - self._middles[self._index(s)]) / BIN + SPAN
        offsets = []
        for away in beside:
            place = min(max(first + away / BIN, 0.0), 2 * SPAN - 1e-9)
            index = int(place)
            share = place - index
            offsets.append(float((1.0 - share) * table[index] + share * table[index + 1]))
        return offsets

    def _index(self, s: float) -> int:
        return min(max(int((s - self._start) / BIN), SPAN), len(self._count) - SPAN - 1)

    def _fit(self, s: float) -> _Fit | None:
        """Return how the seam lies about ``s``; kept until something new is believed there."""
        index = self._index(s)
        if index not in self._fits:
            self._fits[index] = self._fitted(index)
        return self._fits[index]

    def _fitted(self, index: int) -> _Fit | None:
        """Return the plan, shifted and turned onto what was felt, and the field that this leaves.

        The variance is that of universal kriging: where the field is held by samples, an error of
        the motion does no harm (Rasmussen and Williams 2006, 2.42).
        """
        motion = self._motion(index)
        if motion is None:
            return None
        near, rows, residual = self._residual(motion, index)
        felt = self._along[near] / self._count[near]
        precision = _precision(felt, motion.amplitude, self._noise(near), self._length)
        table = np.arange(index - SPAN, index + SPAN + 1)
        there = self._rows(motion, table)
        kernel = _kernel(self._middles[table], felt, motion.amplitude, self._length)
        weights = kernel @ precision
        offsets = there @ motion.shift + weights @ residual
        free = there[SPAN] - weights[SPAN] @ rows
        field = max(motion.amplitude - float(weights[SPAN] @ kernel[SPAN]), 0.0)
        filled = near if len(near) else motion.used
        nearest = int(filled[np.abs(filled - index).argmin()])
        away = abs(nearest - index) * BIN
        # Beyond what was felt the plan's shape is trusted less the farther, and the less the worse
        # it has fitted so far: an error of its curvature grows with the square of the distance.
        beyond = (1.0 + (away / BEYOND) ** 2) ** 2 if away > REACH / 2 else 1.0
        variance = field * beyond + float(free @ motion.covariance @ free)
        return _Fit(offsets.tolist(), variance, motion.amplitude, float(self._angle[nearest]))

    def _motion(self, index: int) -> _Motion | None:
        """Return how the plan is moved in the zone of a bin; the same for all its bins."""
        zone = index // ZONE
        if zone not in self._motions:
            middle = min(zone * ZONE + ZONE // 2, len(self._middles) - 1)
            self._motions[zone] = self._moved(float(self._middles[middle]))
        return self._motions[zone]

    def _moved(self, s: float) -> _Motion | None:
        used = self._near(s)
        if not len(used):
            return None
        felt = self._sum[used] / self._count[used]
        about = self._points[used].mean(axis=0)
        rows = _rigid_rows(self._points[used] - about, self._normals[used])
        shift, covariance = _solve(rows, felt)
        amplitude = max(float(np.mean((felt - rows @ shift) ** 2)), SMALLEST**2)
        return _Motion(about, shift, covariance, amplitude, used)

    def _residual(self, motion: _Motion, index: int) -> tuple[NDArray[np.intp], Floats, Floats]:
        """Return the filled bins near one, their rows, and what the motion leaves there."""
        reach = round(REACH / BIN)
        low = max(index - reach, 0)
        near = low + np.flatnonzero(self._count[low : index + reach + 1])
        rows = self._rows(motion, near)
        return near, rows, self._sum[near] / self._count[near] - rows @ motion.shift

    def _rows(self, motion: _Motion, bins: NDArray[np.intp]) -> Floats:
        return _rigid_rows(self._points[bins] - motion.about, self._normals[bins])

    def _noise(self, used: NDArray[np.intp]) -> Floats:
        return np.asarray(self.noise**2 / np.minimum(self._count[used], 4.0))

    def _choose_length(self, index: int) -> None:
        """Choose the field's stiffness by what was felt around a bin."""
        motion = self._motion(index)
        if motion is None:
            return
        near, _, residual = self._residual(motion, index)
        felt = self._along[near] / self._count[near]
        noise = self._noise(near)
        self._length = _best_length(felt, residual, motion.amplitude, noise)

    def _near(self, s: float) -> NDArray[np.intp]:
        """Return the filled bins that have a say at ``s``."""
        # A piece of the seam, not all of it: a long seam costs a cycle no more than a short one.
        low = max(int((s - WINDOW - self._start) / BIN), 0)
        high = int((s + WINDOW - self._start) / BIN) + 1
        near = low + np.flatnonzero(self._count[low:high])
        if len(near):
            return np.asarray(near)
        filled = np.flatnonzero(self._count)  # far from all that was felt, which is rare
        distance = np.abs(self._middles[filled] - s)
        return np.asarray(filled[distance <= distance.min(initial=np.inf) + WINDOW / 2])


def _left(tangents: Floats) -> Floats:
    return np.stack([-tangents[:, 1], tangents[:, 0]], axis=1)


def _rigid_rows(levers: Floats, normals: Floats) -> Floats:
    """Return (K, 3): how a shift and a small turn of the plan move it along its normals."""
    turned = normals[:, 1] * levers[:, 0] - normals[:, 0] * levers[:, 1]
    return np.column_stack([normals, turned])


def _solve(rows: Floats, felt: Floats) -> tuple[Floats, Floats]:
    """Return the shift and turn (3,) that explain the offsets, the smallest where free.

    With their covariance (3, 3), from what is left.
    """
    gram = rows.T @ rows + np.diag((SAMPLE_SIGMA / PRIOR) ** 2)
    inverse = np.linalg.inv(gram)
    motion = inverse @ (rows.T @ felt)
    left = max(float(np.mean((felt - rows @ motion) ** 2)), (1.5 * SMALLEST) ** 2)
    return np.asarray(motion), np.asarray(left * inverse)


def _precision(middles: Floats, amplitude: float, noise: Floats, length: float) -> Floats:
    covariance = _kernel(middles, middles, amplitude, length)
    return np.asarray(np.linalg.inv(covariance + np.diag(noise)))


def _kernel(here: Floats, there: Floats, amplitude: float, length: float) -> Floats:
    """Return the field's covariances (N, M) between two rows of places."""
    return amplitude * np.exp(-0.5 * ((here[:, None] - there) / length) ** 2)


def _best_length(middles: Floats, residual: Floats, amplitude: float, noise: Floats) -> float:
    """Return the correlation length that predicts each bin best from the others."""

    def missed(length: float) -> float:
        precision = _precision(middles, amplitude, noise, length)
        return float(np.mean((precision @ residual / np.diag(precision)) ** 2))

    return min(LENGTHS, key=missed) if len(middles) > 3 else LENGTHS[1]
