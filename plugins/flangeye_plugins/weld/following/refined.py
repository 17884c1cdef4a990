"""The seam as measured by the tip: a Gaussian process along the plan, filtered at the tip.

The seam's offset from the plan is the sum of a rigid shift and turn of the whole plan and a
Matern-5/2 process with the state offset, slope and curvature. The process's standard deviation and
correlation length are unknown: a bank of Kalman filters, one for each pair, is weighted by the
likelihood of the measurements.

The offset at every place that the tip has passed stays in the joint distribution, so later
measurements smooth it. This equals a Rauch-Tung-Striebel smoother, updated with each measurement
(Hartikainen and Sarkka 2010).
"""

from __future__ import annotations

import math
from collections import deque

import numpy as np

from flangeye.types import Floats
from flangeye_plugins.weld.path import PATH_SPACING, Path

SLOPE = 1.5e-3
"""Half the base length of the finite difference for the path's direction [m]."""

SIZES, CORRELATIONS = (1.0, 3.0, 10.0), (4e-3, 12e-3, 36e-3)
"""Filter bank: standard deviations as multiples of ``wander``, and correlation lengths [m]."""

PRIOR = np.array([5e-3, 5e-3, 0.05])
"""Standard deviations of the plan's error: shift along x and y [m], rotation [rad]."""

Sample = tuple[float, float, float, float]
"""Arguments of :meth:`RefinedPath.add`: arc length, offset, angle and doubt."""


class _Field:
    """State-space form of M Matern-5/2 processes: transitions and stationary covariance."""

    def __init__(self, sizes: Floats, lengths: Floats) -> None:
        # Stationary covariance of offset, slope and curvature (Hartikainen & Sarkka 2010, with
        # lambda = sqrt(5) / length and kappa = sigma^2 lambda^2 / 3)
        rate = math.sqrt(5.0) / lengths
        self.rate, tilt = rate, sizes**2 * rate**2 / 3.0
        self.stationary = np.zeros((len(rate), 3, 3))
        self.stationary[:, 0, 0], self.stationary[:, 1, 1] = sizes**2, tilt
        self.stationary[:, 0, 2] = self.stationary[:, 2, 0] = -tilt
        self.stationary[:, 2, 2] = sizes**2 * rate**4

    def over(self, way: Floats) -> Floats:
        """Return the state transition matrices (K, M, 3, 3) over distances (K,) [m]."""
        # exp(F d) of the companion form, whose three eigenvalues are all -r
        d, r = way[:, None], self.rate
        rd = r * d
        rows = [
            [1 + rd + rd**2 / 2, d * (1 + rd), d**2 / 2 + 0 * r],
            [-(r**3) * d**2 / 2, 1 + rd - rd**2, d - r * d**2 / 2],
            [r**3 * d * (rd / 2 - 1), r * rd * (rd - 3), 1 - 2 * rd + rd**2 / 2],
        ]
        return np.asarray(
            np.exp(-rd)[..., None, None] * np.moveaxis(np.array(rows), (0, 1), (2, 3))
        )

    def offsets_over(self, way: Floats) -> Floats:
        """Return the first rows (K, M, 3) of the transition matrices, which predict the offset."""
        d = way[:, None]
        rd = self.rate * d
        row = np.empty((3, *rd.shape))
        row[0], row[1], row[2] = 1 + rd + rd**2 / 2, d * (1 + rd), d**2 / 2
        row *= np.exp(-rd)
        return row.transpose(1, 2, 0)


class RefinedPath:
    """Estimate of the seam's offset from the plan, by arc length of the plan.

    Attributes:
        noise: Standard deviation of one sample [m].
        empty: Whether no measurement has been processed yet.
    """

    def __init__(self, plan: Path, margin: float, wander: float = 0.3e-3) -> None:
        """Start without measurements.

        Args:
            plan: The planned seam.
            margin: Length beyond both ends of the plan that is covered as well [m].
            wander: Smallest standard deviation of the seam about the plan's shape [m].
        """
        self._plan, self.empty = plan, True
        self.noise = 0.01e-3  # until the sweep measures it
        sizes, lengths = (grid.ravel() for grid in np.meshgrid(SIZES, CORRELATIONS, indexing="ij"))
        self._field = _Field(wander * sizes, lengths)
        models, self._start = len(sizes), -margin
        count = int((plan.length + 2 * margin) / PATH_SPACING) + 2
        self._places: Floats = (
            self._start + (np.arange(count, dtype=np.float64) + 0.5) * PATH_SPACING
        )
        self._means, self._vars = np.zeros((models, count)), np.zeros((models, count))
        self._cross = np.zeros((models, count, 6))
        self._doubts, self._angles = np.zeros(count), np.zeros(count)
        self._felt = np.zeros((count, 3))  # arc lengths, offsets, and of how many samples
        self._likely = np.full(models, -math.log(models))
        self._state, self._covariance = np.zeros((models, 6)), np.zeros((models, 6, 6))
        self._covariance[:, :3, :3] = np.diag(PRIOR**2)
        self._covariance[:, 3:, 3:] = self._field.stationary
        self._excess = np.ones(models)
        self._at, self._next, self._low = 0.0, 0, 0
        self._sure: deque[Sample] = deque()

    def add(self, s: float, offset: float, angle: float, doubt: float = 0.0) -> None:
        """Add a measurement: the seam is ``offset`` to the left of the plan at ``s`` [m].

        The tool's angle was ``angle`` [rad]; ``doubt`` is the extra variance of a tip that may have
        been off the seam [m^2]. The measurement is only queued: :meth:`renew` processes it.
        """
        self._sure.append((s, offset, angle, doubt))

    def renew(self, torch: float, steps: int = 4) -> None:
        """Process queued measurements, a few at a time to fit in a control cycle.

        Args:
            torch: Arc length of the torch [m].
            steps: Largest number of filter steps.
        """
        # Places more than 10 mm behind the torch are no longer smoothed, to bound the cycle's time.
        self._low = max(self._index(torch - 10e-3), 0)
        while self._sure and steps > 0:
            s, offset, angle, doubt = self._sure[0]
            steps -= 1
            if self.empty:
                self._begin(s)
            elif s > self._at and self._next < len(self._places) and self._places[self._next] <= s:
                self._pass()
                continue
            self._sure.popleft()
            if s > self._at - PATH_SPACING:
                self._move(max(s, self._at))
                self._measure(s, offset)
                self._note(s, offset, angle, doubt)

    def _begin(self, s: float) -> None:
        """Initialise the filters at an arc length; the places before it get the prior."""
        self.empty, self._at = False, s
        self._next = self._index(s) + 1
        before = slice(0, self._next)
        rows = self._rows(self._places[before])
        self._vars[:, before] = np.sum((rows * PRIOR) ** 2, axis=1)
        self._vars[:, before] += self._field.stationary[:, :1, 0]
        self._cross[:, before, :3] = rows * PRIOR**2
        over = self._field.over(np.maximum(s - self._places[before], 0.0))
        joint = over @ self._field.stationary
        self._cross[:, before, 3:] = np.moveaxis(joint[..., 0], 0, 1)

    def _move(self, s: float) -> None:
        """Predict the state at an arc length ahead."""
        way = s - self._at
        if way <= 0.0:
            return
        turn = self._field.over(np.array([way]))[0]
        back = np.swapaxes(turn, 1, 2)
        full = np.zeros_like(self._covariance)
        full[:, :3, :3], full[:, 3:, 3:] = np.eye(3), turn
        self._state[:, 3:] = (turn @ self._state[:, 3:, None])[..., 0]
        self._covariance = full @ self._covariance @ np.swapaxes(full, 1, 2)
        # What keeps a stationary field stationary is its process noise: Q = P - A P A'
        stationary = self._field.stationary
        self._covariance[:, 3:, 3:] += stationary - turn @ stationary @ back
        window = slice(self._low, self._next)
        self._cross[:, window, 3:] = self._cross[:, window, 3:] @ back
        self._at = s

    def _pass(self) -> None:
        """Add the next place that the tip passes to the joint distribution."""
        self._move(float(self._places[self._next]))
        row = self._row(self._at)
        cross = self._covariance @ row
        self._cross[:, self._next], self._means[:, self._next] = cross, self._state @ row
        self._vars[:, self._next] = cross @ row
        self._angles[self._next] = self._angles[self._next - 1]
        self._next += 1

    def _measure(self, s: float, offset: float) -> None:
        """Update the filters by a sample at the tip."""
        row = self._row(self._at)
        cross = self._covariance @ row
        spread = cross @ row + self.noise**2
        off = offset - self._state @ row
        self._weigh(off, spread)
        gain = cross / spread[:, None]
        self._state += gain * off[:, None]
        self._covariance -= gain[:, :, None] * cross[:, None, :]
        # Places passed before are updated through their covariance with the state
        window = slice(self._low, self._next)
        known = self._cross[:, window] @ row
        share = known / spread[:, None]
        self._means[:, window] += share * off[:, None]
        self._vars[:, window] -= share * known
        self._cross[:, window] -= share[:, :, None] * cross[:, None, :]

    def _weigh(self, off: Floats, spread: Floats) -> None:
        """Update each filter's weight by its innovation (M,), and the scale of its noise."""
        # Forgetting factor of 1 % per measurement: the seam may become wavier further on.
        unlikely, kept = off**2 / spread, 0.99
        self._excess = np.maximum(kept * self._excess + (1 - kept) * unlikely, 1e-3)
        self._likely = kept * self._likely - 0.5 * (unlikely + np.log(spread))
        self._likely -= np.logaddexp.reduce(self._likely)

    def _note(self, s: float, offset: float, angle: float, doubt: float) -> None:
        index = self._index(s)
        self._felt[index] += s, offset, 1.0
        self._doubts[index] = max(self._doubts[index], doubt)
        self._angles[index] = self._angles[self._next - 1] = angle

    def samples(self) -> Floats:
        """Return the measurements, averaged by place, as rows (K, 5).

        Columns are arc length [m], offset [m], tool angle [rad], count and extra variance [m^2].
        """
        filled = np.flatnonzero(self._felt[:, 2])
        along, offset, count = self._felt[filled].T
        return np.column_stack(
            [along / count, offset / count, self._angles[filled], count, self._doubts[filled]]
        )

    def recall(self, samples: Floats) -> None:
        """Add the samples (K, 5) of an earlier weld of this plan; see :meth:`samples`."""
        for s, offset, angle, _, doubt in samples.tolist():
            self.add(s, offset, angle, doubt)
        self.renew(self._start, 4 * len(self._places))

    # --- what follows from it -------------------------------------------------------------------

    def offset(self, s: float) -> float:
        """Return the seam's offset from the plan at one arc length [m]."""
        return float(self.offsets(np.array([s]))[0])

    def slope(self, s: float) -> float:
        """Return the seam's slope relative to the plan just before ``s``, positive to the left."""
        before, here = self.offsets(np.array([s - SLOPE, s])).tolist()
        return float((here - before) / SLOPE)

    def variance(self, s: float) -> float:
        """Return the variance of the seam's offset at an arc length [m^2]."""
        return self.expected(s)[1]

    def expected(self, s: float) -> tuple[float, float]:
        """Return the seam's offset from the plan at an arc length [m], and its variance [m^2]."""
        if self.empty:
            return 0.0, float(PRIOR[0] ** 2)
        means, variances = self._each(s)
        weights = self._weights
        middle = weights @ means
        spread = np.maximum(self._excess, 1.0) * variances + (means - middle) ** 2
        index, near = self._index(s), round(4e-3 / PATH_SPACING)
        doubt = self._doubts[max(index - near, 0) : index + near + 1].max()
        return float(middle), float(weights @ spread + doubt)

    @property
    def _weights(self) -> Floats:
        """Weights (M,) of the filters; they sum to 1."""
        return np.asarray(np.exp(self._likely))

    @property
    def settled(self) -> float:
        """Arc length up to which later measurements hardly change the path [m].

        It is the shortest correlation length behind the tip.
        """
        return self._at - CORRELATIONS[0]

    def angle(self, s: float, otherwise: float) -> float:
        """Return the tool's angle [rad] at the measurement nearest to ``s``, or ``otherwise``."""
        if self.empty:
            return otherwise
        filled = np.flatnonzero(self._felt[:, 2])
        return float(self._angles[filled[np.abs(filled - self._index(s)).argmin()]])

    def frame(self, s: float) -> tuple[Floats, Floats]:
        """Return the point (2,) and the unit normal (2,) of the refined path at ``s``."""
        before, here, after = self.offsets(np.array([s - SLOPE, s, s + SLOPE])).tolist()
        place = self._plan.at(s)
        slope = (after - before) / (2 * SLOPE)
        (tx, ty), (nx, ny), norm = place.tangent, place.normal, math.hypot(1.0, slope)
        normal = np.array([(nx - slope * tx) / norm, (ny - slope * ty) / norm])
        return place.point + here * place.normal, normal

    def offsets(self, s: Floats) -> Floats:
        """Return the seam's offsets (K,) from the plan at arc lengths (K,) [m].

        They are smoothed behind the tip and predicted ahead of it.
        """
        if self.empty:
            return np.zeros(len(s))
        means = self._between(self._means, s)
        ahead = (s > self._passed).nonzero()[0]
        if len(ahead):
            means[:, ahead] = np.einsum("kmi,mi->mk", self._ahead(s[ahead]), self._state)
        return np.asarray(self._weights @ means)

    def _each(self, s: float) -> tuple[Floats, Floats]:
        """Return each filter's offset (M,) at an arc length [m], and its variance (M,) [m^2]."""
        at = np.array([s])
        if s <= self._passed:
            return self._between(self._means, at)[:, 0], self._between(self._vars, at)[:, 0]
        rows, field = self._ahead(at)[0], self._field.stationary
        known = np.einsum("mi,mij,mj->m", rows, self._covariance, rows)
        over = rows[:, 3:]
        lost = field[:, 0, 0] - np.einsum("mi,mij,mj->m", over, field, over)
        return np.einsum("mi,mi->m", rows, self._state), known + np.maximum(lost, 0.0)

    @property
    def _passed(self) -> float:
        """Arc length of the last place that the tip has passed [m]."""
        return float(self._places[self._next - 1])

    def _between(self, kept: Floats, s: Floats) -> Floats:
        """Return the filters' values at N places (M, N), interpolated at arc lengths (K,)."""
        first = (s - self._start) / PATH_SPACING - 0.5
        below = np.minimum(np.maximum(first.astype(int), 0), max(self._next - 2, 0))
        share = np.minimum(np.maximum(first - below, 0.0), 1.0)
        return np.asarray((1 - share) * kept[:, below] + share * kept[:, below + 1])

    def _ahead(self, s: Floats) -> Floats:
        """Return the rows (K, M, 6) by which the state predicts the offset ahead of the tip."""
        over = self._field.offsets_over(np.maximum(s - self._at, 0.0))
        rows = np.empty((*over.shape[:2], 6))
        rows[..., :3], rows[..., 3:] = self._rows(s)[:, None, :], over
        return rows

    def _row(self, s: float) -> Floats:
        return np.concatenate([self._rows(np.array([s]))[0], [1.0, 0.0, 0.0]])

    def _rows(self, s: Floats) -> Floats:
        """Return the derivatives (K, 3) of the plan's normal offset by shift x, y and rotation."""
        points, tangents = self._plan.evaluate(s)
        # A turn about the plan's start moves a place at lever l by (-l_y, l_x)
        levers = points[:, :2] - self._plan.points[0, :2]
        out = np.empty((len(s), 3))
        out[:, 0], out[:, 1] = -tangents[:, 1], tangents[:, 0]
        out[:, 2] = out[:, 1] * levers[:, 0] - out[:, 0] * levers[:, 1]
        return out

    def _index(self, s: float) -> int:
        return min(max(int((s - self._start) / PATH_SPACING), 0), len(self._places) - 1)
