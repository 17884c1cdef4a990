"""The seam as the tip felt it: the paper's refined path, kept as an offset from the plan.

The plan is wrong mostly as a whole, shifted and turned, so the offset changes slowly even where
the seam curves. Where nothing was felt (before the start, in a gap, beyond the end) the plan,
shifted and turned onto what was felt nearby, stands in. What that leaves is a smooth field: a
Gaussian process, whose amplitude is that of what is left and whose correlation length is the one
that predicts each bin best from its neighbours (leave-one-out; Rasmussen and Williams 2006, 5.12).
"""

from __future__ import annotations

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

SMALLEST = 0.02e-3
"""A field's amplitude is not believed to be less [m]."""

WINDOW = 60e-3
"""How far along the seam samples have a say in how the plan is shifted and turned [m]."""

PRIOR = np.array([5e-3, 5e-3, 0.05])
"""Standard deviations of the plan's error: shift along x and y [m], rotation [rad]."""

SAMPLE_SIGMA = 0.05e-3
"""Standard deviation of a bin about a plan that is only shifted and turned [m]."""


class _Fit(NamedTuple):
    """The plan, shifted and turned onto what was felt around one place.

    Attributes:
        about: (2,) the middle of what was felt [m].
        motion: (3,) shift [m] and turn [rad] about it.
        covariance: (3, 3) of the motion.
        middles: (K,) arc lengths of the bins near the place.
        weights: (K,) of each in the field: the inverse of their covariance times the residual.
        precision: (K, K) that inverse [1/m^2].
        amplitude: Variance of the field [m^2].
        away: How far from the place something was felt [m].
    """

    about: Floats
    motion: Floats
    covariance: Floats
    middles: Floats
    weights: Floats
    precision: Floats
    amplitude: float
    away: float


class RefinedPath:
    """What the tip felt, by arc length of the plan.

    Attributes:
        noise: Standard deviation of one sample [m].
    """

    def __init__(self, plan: Path, margin: float) -> None:
        """Start empty, with room for ``margin`` [m] beyond both ends of the plan."""
        self._plan = plan
        self._start = -margin
        count = int((plan.length + 2 * margin) / BIN) + 2
        self._sum, self._count = np.zeros(count), np.zeros(count)
        self._middles: Floats = self._start + (np.arange(count, dtype=np.float64) + 0.5) * BIN
        points, tangents = plan.evaluate(self._middles)
        self._points, self._normals = points[:, :2], _left(tangents)
        self._fits: dict[int, _Fit | None] = {}
        self.noise = SAMPLE_SIGMA / 5
        self._length, self._new = LENGTHS[1], 0
        self._pending: deque[tuple[float, float, float]] = deque()

    @property
    def empty(self) -> bool:
        """Whether nothing has been confirmed yet."""
        return not self._count.any()

    def add(self, time: float, s: float, offset: float) -> None:
        """Note that the tip was ``offset`` to the left of the plan at ``s``; not yet believed."""
        self._pending.append((time, s, offset))

    def confirm(self, until: float) -> None:
        """Believe what was felt up to the time ``until`` [s]."""
        while self._pending and self._pending[0][0] <= until:
            _, s, offset = self._pending.popleft()
            index = int((s - self._start) / BIN)
            if 0 <= index < len(self._count):
                self._sum[index] += offset
                self._new += not self._count[index]
                self._count[index] += 1
                self._fits.clear()

    def forget_pending(self) -> None:
        """Drop what is not yet believed: contact is lost, and it may be wrong already."""
        self._pending.clear()

    def offsets(self, s: Floats) -> Floats:
        """Return the seam's offset from the plan at arc lengths (K,), which lie close together."""
        fit = self._fit(float(s[len(s) // 2]))
        if fit is None:
            return np.zeros(len(s))
        predicted = np.array([self._moved(fit, x) for x in s.tolist()])
        distance = (s[:, None] - fit.middles) / self._length
        return np.asarray(predicted + fit.amplitude * np.exp(-0.5 * distance**2) @ fit.weights)

    def variance(self, s: float) -> float:
        """Return the variance of the seam's offset at an arc length [m^2]."""
        fit = self._fit(s)
        if fit is None:
            return float(PRIOR[0] ** 2)
        near = fit.amplitude * np.exp(-0.5 * ((s - fit.middles) / self._length) ** 2)
        place = self._plan.at(s)
        row = _rigid_rows((place.point - fit.about)[None], place.normal[None])[0]
        field = max(fit.amplitude - float(near @ fit.precision @ near), 0.0)
        # Beyond what was felt the plan's shape is trusted less the farther, and the less the worse
        # it has fitted so far: an error of its curvature grows with the square of the distance.
        beyond = (1.0 + (fit.away / BEYOND) ** 2) ** 2 if fit.away > REACH / 2 else 1.0
        return field * beyond + float(row @ fit.covariance @ row)

    def waviness(self, s: float) -> float:
        """Return the variance of the field that the plan's motion leaves around a place [m^2]."""
        fit = self._fit(s)
        return 0.0 if fit is None else fit.amplitude

    def _moved(self, fit: _Fit, s: float) -> float:
        """Return how far a fit moves the plan along its normal at ``s``: a row of _rigid_rows."""
        place = self._plan.at(s)
        lever, (nx, ny), (x, y, turn) = place.point - fit.about, place.normal, fit.motion
        return float(nx * x + ny * y + turn * (ny * lever[0] - nx * lever[1]))

    def offset(self, s: float) -> float:
        """Return the seam's offset from the plan at one arc length."""
        return float(self.offsets(np.array([s]))[0])

    def frame(self, s: float) -> tuple[Floats, Floats]:
        """Return the point (2,) and the unit normal (2,) of the refined path at ``s``."""
        before, here, after = self.offsets(s + SLOPE * np.array([-1.0, 0.0, 1.0]))
        place = self._plan.at(s)
        tangent = place.tangent + (after - before) / (2 * SLOPE) * place.normal
        tangent /= np.hypot(*tangent)
        return place.point + here * place.normal, np.array([-tangent[1], tangent[0]])

    def _fit(self, s: float) -> _Fit | None:
        """Return how the plan lies about ``s``; kept until something new is believed."""
        index = int((s - self._start) / BIN)
        if index not in self._fits:
            self._fits[index] = self._fitted(float(self._middles[index]))
        return self._fits[index]

    def _fitted(self, s: float) -> _Fit | None:
        used = self._near(s)
        if not len(used):
            return None
        felt = self._sum[used] / self._count[used]
        about = self._points[used].mean(axis=0)
        rows = _rigid_rows(self._points[used] - about, self._normals[used])
        motion, covariance = _solve(rows, felt)
        residual = felt - rows @ motion
        amplitude = max(float(np.mean(residual**2)), SMALLEST**2)
        near = np.abs(self._middles[used] - s) <= REACH
        middles, residual = self._middles[used][near], residual[near]
        noise = self.noise**2 / np.minimum(self._count[used][near], 4.0)
        if self._new >= CHOOSING:
            self._length, self._new = _best_length(middles, residual, amplitude, noise), 0
        precision = _precision(middles, amplitude, noise, self._length)
        weights = precision @ residual
        away = float(np.abs(self._middles[used] - s).min())
        return _Fit(about, motion, covariance, middles, weights, precision, amplitude, away)

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
    distance = (middles[:, None] - middles) / length
    covariance = amplitude * np.exp(-0.5 * distance**2)
    return np.asarray(np.linalg.inv(covariance + np.diag(noise)))


def _best_length(middles: Floats, residual: Floats, amplitude: float, noise: Floats) -> float:
    """Return the correlation length that predicts each bin best from the others."""

    def missed(length: float) -> float:
        precision = _precision(middles, amplitude, noise, length)
        return float(np.mean((precision @ residual / np.diag(precision)) ** 2))

    return min(LENGTHS, key=missed) if len(middles) > 3 else LENGTHS[1]
