r"""Whether a calibration still holds: a sequential likelihood-ratio test. Arrays only.

A camera that was at :math:`T` and is now at :math:`\exp(\xi) T` leaves, at a target that the arm
carries to :math:`b` and the camera sees at :math:`c`, the residual :math:`r = T c - b = -J \xi +
\varepsilon`. Each *check* is one to a few such sightings, reduced to an information matrix
:math:`H` and a vector :math:`g = -\sum J^\top W r`. The cell's motion within a day is one more
unknown of each check, with a known variance, and is marginalised. The arm's repeatable pose error
(``pose_error``) is one unknown of all checks and of the calibration: its weights follow :math:`\xi`
in one vector :math:`z`.

**Steps.** The last :math:`w` checks, with :math:`H` and :math:`g`, are compared with the earlier
ones. These begin with the calibration's own sightings and estimate :math:`z` as :math:`m` with
information :math:`B`. A motion of the camera between both has the information and the score

.. math:: I = P^\top (H - H (H + B)^{-1} H) P, \quad s = P^\top (1 - H (H + B)^{-1}) (g - H m)

where :math:`P` selects the six numbers of the motion, and :math:`s^\top I^{+} s` is the generalised
likelihood ratio of a step (Willsky & Jones 1976), largest over a window (Lai 1995). Its threshold
is a quantile of an F distribution, since the scatter is estimated from the earlier checks. The
level is the false-alarm rate divided by the number of windows (Bonferroni).

**Slow drift.** The mean of the last checks is compared with the calibration and the first checks.
The criterion is the significant part of the shift of a point of the work.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from flangeye.maths.statistics import MISFIT, chi2_quantile, f_quantile
from flangeye.types import Floats
from flangeye.types.geometry import hat, levers

NO_NORMAL = 1.0
"""Variance [rad^2] of a tilt that was not measured: no information."""


DriftState = Literal["OK", "DEGRADED", "MOVED"]


@dataclass(frozen=True, eq=False)
class CheckSightings:
    """N sightings of the target, relative to the stored calibration.

    Attributes:
        residuals: (N, 5) residuals of the centre in base [m], and of the normal across the
            flange's axis.
        effects: (N, 5, 6 + K) derivatives of the residuals by a motion of the camera about
            ``about``, then by K weights of the arm's error, which are the same at every check.
        covariances: (N, 5, 5) noise of the residuals: of the scan, and of the arm beyond those
            weights.
        flanges: (N, 3, 3) base_R_flange.
        joints: (N, 5, n) derivatives of the residuals by the arm's joints; None if these are
            unknown.
        check: (N,) index of each sighting's check, from 0, in order.
    """

    residuals: Floats
    effects: Floats
    covariances: Floats
    flanges: Floats
    joints: Floats | None
    check: NDArray[np.intp]

    def of(self, first: int, last: int) -> CheckSightings:
        """Return the sightings of the checks from ``first`` to before ``last``."""
        kept = (self.check >= first) & (self.check < last)
        joints = None if self.joints is None else self.joints[kept]
        return CheckSightings(
            self.residuals[kept], self.effects[kept], self.covariances[kept], self.flanges[kept],
            joints, self.check[kept],
        )  # fmt: skip


@dataclass(frozen=True)
class DriftTest:
    """Settings of the drift test.

    Attributes:
        false_alarms: Probability of a false alarm at one check.
        daily: Standard deviation of the cell's motion within a day, at the work [m].
        seasonal: Standard deviation of its motion within a year [m].
        window: Largest number of last checks searched for a step.
        reference: Number of earlier checks they are compared with.
        settled: Number of checks averaged for slow drift.
        limit: Slow drift of the work that counts as moved [m]; half of it, as degraded.
    """

    false_alarms: float = 2e-4
    daily: float = 0.03e-3
    seasonal: float = 0.1e-3
    window: int = 4
    reference: int = 30
    settled: int = 9
    limit: float = 0.4e-3


@dataclass(frozen=True, eq=False)
class DriftVerdict:
    """The verdict of the last check.

    Attributes:
        state: OK, DEGRADED or MOVED.
        motion: (6,) motion of the camera, about ``about`` (rotation [rad], translation [m]).
        covariance: (6, 6) covariance of the motion.
        shift: Largest shift of a point of the work by the motion [m].
        since: Index of the first check after the change; None while there is none.
        statistic: Test statistic over its threshold; above 1 something moved.
    """

    state: DriftState
    motion: Floats
    covariance: Floats
    shift: float
    since: int | None
    statistic: float


@dataclass(frozen=True, eq=False)
class Information:
    """Information matrix and vector of the camera's motion and the arm's error weights.

    Attributes:
        matrix: (..., 6 + K, 6 + K) information matrix.
        vector: (..., 6 + K) information vector.
    """

    matrix: Floats
    vector: Floats

    @classmethod
    def of_covariance(cls, covariance: Floats, mean: Floats | float = 0.0) -> Information:
        """Return a mean (D,) and its (D, D) covariance in information form."""
        matrix = np.asarray(np.linalg.inv(covariance))
        return cls(matrix, matrix @ np.broadcast_to(mean, len(matrix)))

    def after_unknown_motion(self, deviation: float) -> Information:
        """Return the information after an unknown camera motion; see ``allowance``."""
        covariance = self.covariance
        covariance[:6, :6] += allowance(deviation)
        return Information.of_covariance(covariance, self.mean)

    def summed(self, first: int, last: int | None) -> Information:
        """Return the summed information of the checks from ``first`` to ``last``, or the end."""
        return Information(self.matrix[first:last].sum(0), self.vector[first:last].sum(0))

    def plus(self, other: Information) -> Information:
        """Return the sum of two information matrices and vectors."""
        return Information(self.matrix + other.matrix, self.vector + other.vector)

    @property
    def covariance(self) -> Floats:
        """Covariance (6 + K, 6 + K); zero along directions that no sighting shows, by pinv."""
        return np.asarray(np.linalg.pinv(self.matrix, hermitian=True))

    @property
    def mean(self) -> Floats:
        """Mean (6 + K,) of the motion and the weights."""
        return np.asarray(self.covariance @ self.vector)


def allowance(deviation: float) -> Floats:
    """Return the (6, 6) covariance of a motion that moves the work by ``deviation`` [m]."""
    # The work is about a metre across: what moves its edge by a length turns it by length / 0.5 m
    return np.diag([(deviation / 0.5) ** 2] * 3 + [deviation**2] * 3)


@dataclass(frozen=True, eq=False)
class Prior:
    """Prior of the camera's motion and of the arm's error, before the first check.

    Attributes:
        information: The calibration's information on the camera's motion and the arm's error.
        freedom: Degrees of freedom of the estimated size of the arm's error.
    """

    information: Information
    freedom: float = np.inf


def information_of(sightings: CheckSightings, daily: float) -> Information:
    """Return each check's information, with the motion common to its day marginalised."""
    told = _unmarginalised(sightings)
    # The day's motion u ~ N(0, A) adds to xi: marginalised it leaves
    # H - H_u (H_uu + A^-1)^-1 H_u^T, with H_u the columns of the motion, and g likewise
    motions = told.matrix[:, :, :6]
    taken = motions @ np.linalg.inv(motions[:, :6] + np.linalg.inv(allowance(daily)))
    matrix = told.matrix - taken @ told.matrix[:, :6]
    return Information(matrix, told.vector - (taken @ told.vector[:, :6, None])[..., 0])


def _unmarginalised(sightings: CheckSightings) -> Information:
    weights = np.linalg.inv(sightings.covariances)
    weighted = sightings.effects.transpose(0, 2, 1) @ weights
    matrices, vectors = weighted @ sightings.effects, -(weighted @ sightings.residuals[..., None])
    count = int(sightings.check.max()) + 1 if len(sightings.check) else 0
    matrix, vector = np.zeros((count, *matrices.shape[1:])), np.zeros((count, *vectors.shape[1:]))
    np.add.at(matrix, sightings.check, matrices)
    np.add.at(vector, sightings.check, vectors)
    return Information(matrix, vector[..., 0])


def prior_of(sightings: CheckSightings, variances: Floats) -> Prior:
    """Return the information of a calibration's own sightings, taken as one check.

    Args:
        sightings: Sightings with the calibration's scans and the arm's noise in their covariances.
        variances: (6 + K,) prior variances of the camera's motion and the arm's weights.
    """
    told = _unmarginalised(sightings).summed(0, 1)
    start = Information.of_covariance(np.diag(variances))
    # Degrees of freedom: three a centre, two a tilt, less the six of the camera
    tilts = np.count_nonzero(sightings.covariances[:, 3, 3] < NO_NORMAL)
    return Prior(start.plus(told), max(3.0 * len(sightings.check) + 2.0 * tilts - 6.0, 1.0))


def verdict(checks: Information, prior: Prior, corners: Floats, test: DriftTest) -> DriftVerdict:
    """Judge the last of the checks.

    Args:
        checks: The n checks in order.
        prior: The calibration's information.
        corners: (8, 3) corners of the work, from ``about`` [m].
        test: Settings of the test.
    """
    n = len(checks.matrix)
    # A step is held against a calibration that the seasons may have moved. Slow drift is that
    # motion itself, so nothing is allowed for it in `_slow`
    start = Prior(prior.information.after_unknown_motion(test.seasonal), prior.freedom)
    found = max((_step(checks, start, n - w, test) for w in _windows(n, test)), key=lambda s: s[0])
    if found[0] > 1.0:
        return moved_since(checks, prior, corners, test, found[1], found[0])
    motion, covariance = _slow(checks, prior, test)
    shift = largest_shift(motion, corners)
    # Larger than its limit with 95 %, one-sided
    surely = shift - 1.64 * _deviation(motion, covariance, corners)
    drifted: DriftState = "MOVED" if surely > test.limit else "DEGRADED"
    state = drifted if surely > test.limit / 2 else "OK"
    since = None if state == "OK" else _began(checks, corners, prior, test)
    return DriftVerdict(state, motion, covariance, shift, since, found[0])


def moved_since(
    checks: Information, prior: Prior, corners: Floats, test: DriftTest, since: int, ratio: float
) -> DriftVerdict:
    """Return the camera's motion between the checks before ``since`` and those after it."""
    start = prior.information.after_unknown_motion(test.seasonal)
    before = start.plus(checks.summed(max(since - test.reference, 0), since))
    change = _change(checks.summed(since, len(checks.matrix)), before)
    shift = largest_shift(change.mean, corners)
    return DriftVerdict("MOVED", change.mean, change.covariance, shift, since, ratio)


def misfits(sightings: CheckSightings, before: Information, test: DriftTest) -> NDArray[np.bool_]:
    """Return the mask (N,) of sightings that are outliers if nothing moved."""
    effects = sightings.effects
    spread = effects @ before.covariance @ effects.transpose(0, 2, 1) + sightings.covariances
    motions = effects[..., :6]
    spread += motions @ allowance(test.daily) @ motions.transpose(0, 2, 1)
    left = sightings.residuals + effects @ before.mean
    squares = np.einsum("ni,ni->n", left, np.linalg.solve(spread, left[..., None])[..., 0])
    return np.asarray(squares > chi2_quantile(1 - MISFIT, 5))


def largest_shift(motion: Floats, corners: Floats) -> float:
    """Return the largest shift of a corner of the work by a motion (6,) [m]."""
    return float(np.linalg.norm(np.cross(motion[:3], corners) + motion[3:], axis=1).max())


def _deviation(motion: Floats, covariance: Floats, corners: Floats) -> float:
    """Return the standard deviation of the largest shift, along that shift [m]."""
    shifts = np.cross(motion[:3], corners) + motion[3:]
    lengths = np.linalg.norm(shifts, axis=1)
    worst = int(lengths.argmax())
    along = shifts[worst] / max(lengths[worst], 1e-12) @ levers(corners[worst])
    return float(np.sqrt(along @ covariance @ along))


def _windows(n: int, test: DriftTest) -> range:
    return range(1, min(test.window, n) + 1)


def _step(checks: Information, start: Prior, first: int, test: DriftTest) -> tuple[float, int]:
    """Return the test statistic of a step at check ``first`` over its threshold, and ``first``."""
    low = max(first - test.reference, 0)
    before = start.information.plus(checks.summed(low, first))
    after = checks.summed(first, len(checks.matrix))
    statistic, rank = (x.item() for x in _surprise(_change(after, before)))
    scale, freedom = _scatter(checks, before, (low, first), start.freedom)
    # With a scatter that is itself estimated, s' I+ s is distributed as rank * scale * F
    rate = test.false_alarms / test.window
    limit = rank * scale * f_quantile(1 - rate, int(rank), freedom) if rank else np.inf
    return statistic / limit, first


def _change(after: Information, before: Information) -> Information:
    """Return the estimate of a motion (..., 6) between the checks before and after."""
    # I and s of the module's head: H is `after`, B `before`, and P the cut to the first six
    taken = after.matrix @ np.linalg.inv(after.matrix + before.matrix)
    left = after.vector - after.matrix @ before.mean
    score = left - (taken @ left[..., None])[..., 0]
    told = after.matrix - taken @ after.matrix
    return Information(told[..., :6, :6], score[..., :6])


def _surprise(change: Information) -> tuple[Floats, Floats]:
    """Return the squared Mahalanobis distances (...) of a motion from zero, and their ranks."""
    values, axes = np.linalg.eigh(change.matrix)
    # Axes that few scans do not show have eigenvalues of rounding alone: their ratio is noise
    seen = values > 1e-9 * values[..., -1:]
    along = (np.swapaxes(axes, -1, -2) @ change.vector[..., None])[..., 0]
    squares = np.where(seen, along**2 / np.where(seen, values, 1.0), 0.0)
    return squares.sum(-1), seen.sum(-1)


def _scatter(
    checks: Information,
    before: Information,
    span: tuple[int, int],
    freedom: float,
    fewest: int = 10,
) -> tuple[float, float]:
    """Return the ratio of the checks' scatter to the stated one, and its degrees of freedom.

    The ratio is a median, so that one bad check does not hide the next, and at least a quarter.
    With few checks it is 1, with the calibration's degrees of freedom.
    """
    n = span[1] - span[0]
    if n < fewest:
        return 1.0, freedom
    own = Information(checks.matrix[slice(*span)], checks.vector[slice(*span)])
    squares, ranks = _surprise(_change(own, before))
    # A median is less certain than the mean of as many squares; 0.4 is below its efficiency for
    # chi-squares of three degrees and more, so the threshold is rather too high
    typical = [chi2_quantile(0.5, int(rank)) for rank in ranks]
    return max(float(np.median(squares / typical)), 0.25), 0.4 * float(ranks.mean()) * n


def _slow(checks: Information, prior: Prior, test: DriftTest) -> tuple[Floats, Floats]:
    """Return the motion from the calibration and the first checks to the last ones."""
    n = len(checks.matrix)
    if n < test.settled:
        return np.zeros(6), prior.information.covariance[:6, :6]
    first = prior.information.plus(checks.summed(0, min(test.settled, n - test.settled)))
    change = _change(checks.summed(n - test.settled, n), first)
    return change.mean, change.covariance


def _began(checks: Information, corners: Floats, prior: Prior, test: DriftTest) -> int:
    """Return the check after which a slow drift stays above a quarter of its limit."""
    shifts = []
    for n in range(test.settled, len(checks.matrix) + 1):
        motion, _ = _slow(Information(checks.matrix[:n], checks.vector[:n]), prior, test)
        shifts.append(largest_shift(motion, corners) > test.limit / 4)
    below = [i for i, above in enumerate(shifts) if not above]
    return min((below[-1] + 1 if below else 0) + test.settled - 1, len(checks.matrix) - 1)


def sightings_of(  # noqa: PLR0913  one argument a measured quantity
    pose: Floats,
    about: Floats,
    centres: Floats,
    normals: Floats,
    covariances: Floats,
    expected: Floats,
    jacobians: Floats | None,
    check: NDArray[np.intp],
) -> CheckSightings:
    """Linearise N sightings of a circle at the stored calibration.

    Args:
        pose: (4, 4) base_T_camera.
        about: (3,) reference point of motions [m].
        centres: (N, 3) circle centres in camera [m].
        normals: (N, 3) unit normals in camera; NaN where none was measured.
        covariances: (N, 5, 5) in base, tilts across the flange's axis last.
        expected: (N, 4, 4) expected pose of the circle in base, by the arm.
        jacobians: (N, 6, n) Jacobians of the circle's centre (rotation, translation), or None.
        check: (N,) index of each sighting's check.
    """
    turn, axes = pose[:3, :3], expected[:, :3, 2]
    across = expected[:, :3, :2].transpose(0, 2, 1)
    mapped, seen = centres @ turn.T + pose[:3, 3], np.nan_to_num(normals) @ turn.T
    has = np.asarray(np.isfinite(normals).all(axis=1))
    tilts = np.where(has[:, None], np.einsum("nai,ni->na", across, seen - axes), 0.0)
    effects = np.zeros((len(centres), 5, 6))
    effects[:, :3] = levers(mapped - about)
    # A turn w moves a normal n by w x n = -[n]x w
    effects[:, 3:, :3] = -across @ hat(seen) * has[:, None, None]
    own = np.array(covariances)
    own[~has, 3:, 3:] = NO_NORMAL * np.eye(2)
    joints = None
    if jacobians is not None:
        turned = across @ -hat(axes) @ jacobians[:, :3] * has[:, None, None]
        joints = np.concatenate([jacobians[:, 3:], turned], axis=1)
    residuals = np.concatenate([mapped - expected[:, :3, 3], tilts], axis=1)
    return CheckSightings(residuals, effects, own, expected[:, :3, :3], joints, np.asarray(check))
