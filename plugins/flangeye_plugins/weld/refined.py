"""The seam as the tip felt it: the paper's refined path, kept as an offset from the plan.

The plan is wrong mostly as a whole, shifted and turned, so the offset changes slowly even where
the seam curves. What that leaves is a smooth field: a Gaussian process of two parts. One is what a
plan's shape is off by in any case (``wander``, over :data:`SLOW`); the other has the amplitude of
what is left, and the correlation length of the greatest likelihood. Where nothing was
felt (before the start, in a gap, beyond the end) the shifted and turned plan and the field's
continuation stand in. Both are found together, by generalised least squares: bins that are off
alike are not taken for independent witnesses (Rasmussen and Williams 2006, 2.7).
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Generator, Iterable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import blas, lapack

from flangeye.types import Floats
from flangeye_plugins.weld.path import Path

BIN = 0.5e-3
"""Samples are averaged over this length of the seam [m]."""

SLOPE = 1.5e-3
"""Half the length over which the path's direction is taken [m]."""

BESIDE = 16
"""Filled bins to either side that have a say in what is left of the fit: across a gap too."""

LENGTHS = (1.5e-3, 3e-3, 6e-3, 12e-3, 24e-3)
"""Correlation lengths among which the field's is chosen, each twice the one before [m]."""

SLOW = 30e-3
"""Correlation length of what a plan's shape is off by in any case [m]."""

CHOOSING = 12
"""New bins after which motion and field are found again."""

FEW = 48
"""While fewer bins are filled, each new one counts as many."""

ZONE = 8
"""Bins for which the plan is shifted and turned alike."""

DOUBTED = 4e-3
"""So far along the seam a doubt reaches: it comes a few measurements late [m]."""

SMALLEST = 0.02e-3
"""A field's amplitude is not believed to be less [m]."""

SCANTY = 10
"""With so many bins the standard deviation is taken for twice of what they say."""

GUESSED = 1.3
"""Where nothing was felt the field's variance is larger by this: its size and length are guessed
from what was felt elsewhere."""

SAYING, THINNED = 120, 60
"""Filled bins to either side that have a say in how the plan is moved; so many are looked at."""

PRIOR = np.array([5e-3, 5e-3, 0.05])
"""Standard deviations of the plan's error: shift along x and y [m], rotation [rad]."""

PRIOR_WEIGHT = np.diag(PRIOR**-2)
"""(3, 3) their inverse covariance."""

SAMPLE_SIGMA = 0.01e-3
"""Standard deviation of one sample, until it is known [m]."""

SPAN = 5
"""Bins to both sides of a place at which its fit is tabulated: the direction is taken there, of the
bin beside it too."""


class _Fit(NamedTuple):
    """The seam around one bin.

    Attributes:
        bin: Its number.
        offsets: (2 SPAN + 1,) of the seam from the plan at the bins around it [m].
        variance: Of the one in the middle [m^2].
        angle: Of the tool when the nearest bin was felt [rad].
    """

    bin: int
    offsets: list[float]
    variance: float
    angle: float


class _Field(NamedTuple):
    """What the plan's motion leaves, as a Gaussian process.

    Attributes:
        variance: Of the part that was felt [m^2].
        length: Its correlation length [m].
        wander: Variance of what a plan's shape is off by in any case [m^2].
    """

    variance: float
    length: float
    wander: float

    def covariance(self, here: Floats, there: Floats) -> Floats:
        """Return the covariances (N, M) between two rows of places [m^2]."""
        squared = (here[:, None] - there) ** 2
        felt = self.variance * np.exp(squared * (-0.5 / self.length**2))
        return np.asarray(felt + self.wander * np.exp(squared * (-0.5 / SLOW**2)))


class _Explained(NamedTuple):
    """A motion of the plan that explains offsets, beside a field of some length.

    Attributes:
        unlikely: Twice the negative logarithm of the marginal likelihood, but for a constant.
        shift: (3,) along x and y [m], and turn [rad].
        covariance: (3, 3) of it.
        excess: See :class:`_Motion`.
    """

    unlikely: float
    shift: Floats
    covariance: Floats
    excess: float


class _Motion(NamedTuple):
    """How the plan is shifted and turned onto what was felt in a zone of the seam.

    Attributes:
        about: (2,) the middle of what was felt [m].
        shift: (3,) along x and y [m], and turn about the middle [rad].
        covariance: (3, 3) of it.
        field: What it leaves.
        excess: By so much the variance of what was felt exceeds what the field expects, at least 1.
    """

    about: Floats
    shift: Floats
    covariance: Floats
    field: _Field
    excess: float


class RefinedPath:
    """What the tip felt, by arc length of the plan.

    Attributes:
        noise: Standard deviation of one sample [m].
        hurried: Whether what was found before does until :meth:`renew` has come to it; otherwise
            it is found again as soon as it is asked for.
    """

    def __init__(self, plan: Path, margin: float, wander: float = 0.3e-3) -> None:
        """Start empty.

        Args:
            plan: The planned seam.
            margin: Room beyond both ends of the plan [m].
            wander: Standard deviation of the seam about the plan's shape [m].
        """
        self._plan, self._wander = plan, wander**2
        self._start = -margin - SPAN * BIN
        count = int((plan.length - 2 * self._start) / BIN) + 2
        self._sum, self._count, self._angle = np.zeros(count), np.zeros(count), np.zeros(count)
        self._along, self._doubt = np.zeros(count), np.zeros(count)
        self._middles: Floats = self._start + (np.arange(count, dtype=np.float64) + 0.5) * BIN
        points, tangents = plan.evaluate(self._middles)
        self._points, self._normals = points[:, :2], _left(tangents)
        self._fits: dict[int, _Fit | None] = {}
        self._motions: dict[int, _Motion | None] = {}
        self._sound: set[int] = set()  # bins and zones in which nothing new has been felt since
        self._sound_zones: set[int] = set()
        self._used: list[int] = []
        self._moving: tuple[int, Generator[None, None, _Motion | None]] | None = None
        self.noise, self._new, self.hurried = SAMPLE_SIGMA, 0, False
        self._pending: deque[tuple[float, float, float, float, float]] = deque()

    @property
    def empty(self) -> bool:
        """Whether nothing has been confirmed yet."""
        return not self._count.any()

    def add(self, time: float, s: float, offset: float, angle: float, doubt: float = 0.0) -> None:
        """Note that the tip was ``offset`` to the left of the plan at ``s``; not yet believed.

        The tool then stood at ``angle`` [rad]; the tip may be off the seam by ``doubt`` [m].
        """
        self._pending.append((time, s, offset, angle, doubt))

    def confirm(self, until: float) -> None:
        """Believe what was felt up to the time ``until`` [s]."""
        while self._pending and self._pending[0][0] <= until:
            _, s, offset, angle, doubt = self._pending.popleft()
            index = int((s - self._start) / BIN)
            if 0 <= index < len(self._count):
                self._sum[index] += offset
                self._along[index] += s
                self._angle[index] = angle
                self._doubt[index] = max(self._doubt[index], doubt)
                self._new += not self._count[index]
                self._count[index] += 1
                self._doubt_fits(index)

    def _doubt_fits(self, index: int) -> None:
        """Fit again around a bin that has a new sample; everywhere, when there are many."""
        if self._new >= CHOOSING or (self._new and len(np.flatnonzero(self._count)) < FEW):
            self._new, self._moving = 0, None
            self._sound.clear()
            self._sound_zones.clear()
        near = BESIDE + SPAN
        self._sound.difference_update(range(index - near, index + near + 1))

    def renew(self, places: Iterable[float], shares: int = 1) -> None:
        """Find one thing again for each share, at the first of these arc lengths where that is due.

        Two milliseconds have time for one, or for one length of the field in a zone's motion; a few
        cycles later all are renewed. Where nothing was found yet comes first: who asks there would
        have to wait for all of it. What is due at other places is forgotten: it would be old when
        the torch comes there.
        """
        bins = [self._index(s) for s in places]
        if bins != self._used:
            self._used, used = bins, self._sound.union(bins)
            self._fits = {i: fit for i, fit in self._fits.items() if i in used}
            zones = self._sound_zones.union(index // ZONE for index in bins)
            self._motions = {i: motion for i, motion in self._motions.items() if i in zones}
        while shares > 0 and self._renewed(bins):
            shares -= 1

    def _renewed(self, bins: list[int]) -> bool:
        """Find one thing again at the first of the bins where that is due; whether any was."""
        new = next((index for index in bins if index not in self._fits), None)
        due = next((index for index in bins if index not in self._sound), None)
        if new is not None and (zone := self._known_zone(new)) is not None:
            self._fits[new] = self._fitted(new, zone)
        elif (first := due if new is None else new) is not None:
            self._find(first)
        return new is not None or due is not None

    def _find(self, index: int) -> None:
        """Find the fit around a bin again; a piece of its zone's motion, where that is due."""
        zone = index // ZONE
        if zone in self._sound_zones:
            self._fits[index] = self._fitted(index, zone)
            self._sound.add(index)
            return
        if self._moving is None or self._moving[0] != zone:
            self._moving = zone, self._moved(zone)
        try:
            next(self._moving[1])
        except StopIteration as found:
            self._motions[zone], self._moving = found.value, None
            self._sound_zones.add(zone)

    def forget_pending(self) -> None:
        """Drop what is not yet believed: contact is lost, and it may be wrong already."""
        self._pending.clear()

    def samples(self) -> Floats:
        """Return what is believed: rows (K, 5) of arc length, offset, angle, count and doubt."""
        filled = np.flatnonzero(self._count)
        count = self._count[filled]
        means = (self._along[filled] / count, self._sum[filled] / count)
        return np.column_stack([*means, self._angle[filled], count, self._doubt[filled]])

    def recall(self, samples: Floats) -> None:
        """Believe samples (K, 5) of an earlier weld of this plan; see :meth:`samples`."""
        for s, offset, angle, count, doubt in samples.tolist():
            for _ in range(int(count)):
                self.add(-math.inf, s, offset, angle, doubt)
        self.confirm(0.0)

    def suspect(self, begin: float, end: float, doubt: float) -> None:
        """Note that the tip may be off the seam by ``doubt`` between two arc lengths [m]."""
        between = slice(self._index(begin), self._index(end) + 1)
        self._doubt[between] = np.maximum(self._doubt[between], doubt)

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

    def doubt(self, s: float) -> float:
        """Return how far off the seam the tip may have been around a place [m]."""
        index, near = self._index(s), round(DOUBTED / BIN)
        return float(self._doubt[max(index - near, 0) : index + near + 1].max())

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
        first = (s - self._start) / BIN - 0.5 - fit.bin + SPAN
        offsets = []
        for away in beside:
            place = min(max(first + away / BIN, 0.0), 2 * SPAN - 1e-9)
            index = int(place)
            share = place - index
            offsets.append(float((1.0 - share) * table[index] + share * table[index + 1]))
        return offsets

    def _index(self, s: float) -> int:
        index, last = int((s - self._start) / BIN), len(self._count) - SPAN - 1
        return SPAN if index < SPAN else last if index > last else index

    def _fit(self, s: float) -> _Fit | None:
        """Return how the seam lies about ``s``; kept until something new is believed there.

        Who is hurried takes that of the bin beside it, where that is what there is.
        """
        index = self._index(s)
        if self.hurried:
            near = next((i for i in (index, index - 1, index + 1) if i in self._fits), None)
            if near is not None:
                return self._fits[near]
            if (zone := self._known_zone(index)) is not None:
                self._fits[index] = self._fitted(index, zone)
                return self._fits[index]
        while index not in self._sound:
            self._find(index)
        return self._fits[index]

    def _known_zone(self, index: int) -> int | None:
        """Return the zone whose motion does for a bin: its own, or the next where that is known."""
        zone = index // ZONE
        return next((z for z in (zone, zone - 1, zone + 1) if z in self._motions), None)

    def _fitted(self, index: int, zone: int) -> _Fit | None:
        """Return the plan, moved onto what was felt as in a zone, and the field that this leaves.

        The variance is that of universal kriging: where the field is held by samples, an error of
        the motion does no harm (Rasmussen and Williams 2006, 2.42).
        """
        motion = self._motions[zone]
        if motion is None:
            return None
        near, rows, residual = self._residual(motion, index)
        felt, field = self._along[near] / self._count[near], motion.field
        table = slice(index - SPAN, index + SPAN + 1)
        there = self._rows(motion, table)
        covariance = field.covariance(np.concatenate([felt, self._middles[table]]), felt)
        among, kernel = covariance[: len(near)], covariance[len(near) :]
        among.ravel()[:: len(near) + 1] += self._noise(near)
        weights = _solved(among, kernel.T)[1].T
        offsets = there @ motion.shift + weights @ residual
        free = there[SPAN] - weights[SPAN] @ rows
        held = float(weights[SPAN] @ kernel[SPAN])
        left = GUESSED * motion.excess * max(field.variance + field.wander - held, 0.0)
        variance = left + float(free @ motion.covariance @ free)
        nearest = int(near[np.abs(near - index).argmin()])
        return _Fit(index, offsets.tolist(), variance, float(self._angle[nearest]))

    def _moved(self, zone: int) -> Generator[None, None, _Motion | None]:
        """Find how the plan is moved in a zone, the same for all its bins; a piece at a time.

        The field's length is that of the greatest marginal likelihood.
        """
        used = self._nearest(zone * ZONE + ZONE // 2, SAYING)
        if not len(used):
            return None
        some = used[:: -(-len(used) // THINNED)]
        count, about = self._count[some], self._points[some].mean(axis=0)
        rows = _rigid_rows(self._points[some] - about, self._normals[some])
        along, felt = self._along[some] / count, self._sum[some] / count
        waviness = max(_unexplained(rows, felt), SMALLEST**2)
        squared = (along[:, None] - along) ** 2
        rest = self._wander * np.exp(squared * (-0.5 / SLOW**2))
        rest.ravel()[:: len(some) + 1] += self._noise(some) + 1e-6 * waviness
        correlation = np.exp(squared * (-0.5 / LENGTHS[-1] ** 2))
        explained: dict[float, _Explained] = {}
        for length in reversed(LENGTHS):
            yield
            explained[length] = _explained(waviness * correlation + rest, rows, felt)
            correlation = (correlation * correlation) ** 2  # half as long: to the fourth power
        length = min(explained, key=lambda length: explained[length].unlikely)
        _, shift, covariance, excess = explained[length]
        # What was felt at few places only may be off by more than it seems there.
        few = (1.0 + SCANTY / len(used)) ** 2
        field = _Field(waviness, length, self._wander)
        return _Motion(about, shift, few * covariance, field, few * excess)

    def _residual(self, motion: _Motion, index: int) -> tuple[NDArray[np.intp], Floats, Floats]:
        """Return the filled bins nearest to one, their rows, and what the motion leaves there."""
        near = self._nearest(index, BESIDE)
        rows = self._rows(motion, near)
        return near, rows, self._sum[near] / self._count[near] - rows @ motion.shift

    def _rows(self, motion: _Motion, bins: NDArray[np.intp] | slice) -> Floats:
        return _rigid_rows(self._points[bins] - motion.about, self._normals[bins])

    def _noise(self, used: NDArray[np.intp]) -> Floats:
        return np.asarray(self.noise**2 / np.minimum(self._count[used], 4.0))

    def _nearest(self, index: int, count: int) -> NDArray[np.intp]:
        """Return the filled bins nearest to one, ``count`` to either side; more where one ends."""
        # A piece of the seam, not all of it: a long seam costs a cycle no more than a short one.
        filled = np.flatnonzero(self._count)
        low = int(np.searchsorted(filled, index)) - count
        low = max(min(low, len(filled) - 2 * count), 0)
        return np.asarray(filled[low : low + 2 * count])


def _left(tangents: Floats) -> Floats:
    return np.stack([-tangents[:, 1], tangents[:, 0]], axis=1)


def _rigid_rows(levers: Floats, normals: Floats) -> Floats:
    """Return (K, 3): how a shift and a small turn of the plan move it along its normals."""
    turned = normals[:, 1] * levers[:, 0] - normals[:, 0] * levers[:, 1]
    return np.concatenate([normals, turned[:, None]], axis=1)


def _unexplained(rows: Floats, felt: Floats) -> float:
    """Return the variance that no motion of the plan explains [m^2]."""
    return float(np.var(felt - rows @ np.linalg.lstsq(rows, felt, rcond=None)[0]))


def _explained(among: Floats, rows: Floats, felt: Floats) -> _Explained:
    """Return the motion that explains offsets (K,) best beside a field.

    The marginal likelihood (Rasmussen and Williams 2006, 2.45) has the scale of field and prior
    left free: a motion that hardly any plan is off by explains no waves.

    Args:
        among: (K, K) covariance of the offsets [m^2].
        rows: (K, 3) how a motion moves the plan.
        felt: (K,) offsets [m].
    """
    diagonal, white = _whitened(among, np.concatenate([rows, felt[:, None]], axis=1))
    normal = white[:, :3].T @ white
    root, inverse = _solved(normal[:, :3] + PRIOR_WEIGHT, np.eye(3))
    shift = inverse @ normal[:, 3]
    left = white[:, 3] - white[:, :3] @ shift
    freedom = max(len(felt) - 3, 1)
    scale = max(float(left @ left + np.sum((shift / PRIOR) ** 2)) / freedom, 1e-9)
    volume = 2.0 * float(np.log(root).sum() + np.log(diagonal).sum())
    excess = max(scale, 1.0)
    return _Explained(freedom * math.log(scale) + volume, shift, excess * inverse, excess)


def _whitened(among: Floats, columns: Floats) -> tuple[Floats, Floats]:
    """Return the diagonal (K,) of a covariance's Cholesky root, and columns (K, M) solved by it.

    LAPACK itself: a control cycle waits for it, and NumPy's way there takes three times as long.
    Not its dtrtrs, which wakes threads for whatever size, and waits for them.
    """
    root, failed = lapack.dpotrf(among.T, lower=1, clean=0)
    if failed:
        raise np.linalg.LinAlgError("the covariance of what was felt is not positive definite")
    return np.diagonal(root), blas.dtrsm(1.0, root, columns, lower=1)


def _solved(positive: Floats, columns: Floats) -> tuple[Floats, Floats]:
    """Return the diagonal (K,) of a (K, K) matrix's Cholesky root, and columns solved by it."""
    root, solved, failed = lapack.dposv(positive.T, columns, lower=1)
    if failed:
        raise np.linalg.LinAlgError("the covariance of what was felt is not positive definite")
    return np.diagonal(root), solved
