"""How much noise residuals show beyond the features' own, and whose: variance components, arrays.

After Helmert: each component is such that the weighted squares it explains are as many as there are
numbers, less those that the fit took up.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from flangeye.handeye.walk import NO_WALK, StepSize
from flangeye.maths.statistics import chi2_quantile
from flangeye.types import Floats

FINEST = 1e-7
"""Added to every standard deviation [m, rad]: exact inputs keep finite weights."""


LARGEST = 1e8
"""Factor on a noise beyond which nothing is looked for."""
TURN, SHIFT = slice(3), slice(3, None)
"""Where rotation and translation stand in six numbers."""
STEPS = 40
"""Of Newton's method for a factor, at most; three are usual."""


@dataclass(frozen=True)
class Noise:
    """Noise beside the covariances of the features.

    Attributes:
        pose: Variance of each coordinate of the arm's position [m^2].
        tilt: Variance of each component of the arm's axis [rad^2].
        centre_scale: Factor on the centres' covariances, at most 1.
        normal_scale: Factor on the normals' covariances, at most 1.
        arms: Factor on the covariances that are taken for the arms' poses.
        size: Standard deviation of the nuisances whose size is estimated.
        depth: Variance along the camera's axis beyond that of each coordinate [m^2].
        walk: Size of the steps of what walks.
    """

    pose: float
    tilt: float
    centre_scale: float = 1.0
    normal_scale: float = 1.0
    arms: float = 1.0
    size: float = 1.0
    depth: float = 0.0
    walk: StepSize = NO_WALK

    def is_close(self, other: Noise) -> bool:
        """Whether nothing differs by more than a thousandth."""
        pairs = zip(self._variances(), other._variances(), strict=True)
        return all(abs(a - b) <= 1e-3 * max(a, b) + 1e-12 for a, b in pairs)

    def _variances(self) -> tuple[float, ...]:
        walk = (each**2 for each in self.walk)
        scales = self.centre_scale, self.normal_scale, self.arms, self.size**2, *walk
        return (self.pose, self.tilt, self.depth, *scales)


def noise_of(turned: Residuals, shifted: Residuals, own: Floats, arms: Floats) -> Noise:
    """Return the noise that residuals show.

    What translations show beyond their own noise is the arms', which turn what is far from them
    the more, as long as the rotations do not speak against it; the rest is added evenly.

    Args:
        turned: Residuals of the N rotations.
        shifted: Residuals of the N translations.
        own: (N, 6, 6) covariances of the features, order (rotation, translation).
        arms: (N, 6, 6) those of typical arms' poses; zero where nothing is known of them.
    """
    share = _share_of_arms(turned, shifted, own, arms)
    own = own + share * arms
    tilt, normal_scale = turned.extra(own[:, :3, :3])
    pose, centre_scale = shifted.extra(own[:, 3:, 3:])
    return Noise(pose, tilt, centre_scale, normal_scale, share)


def with_depth(noise: Noise, along: Residuals, own: Floats, arms: Floats) -> Noise:
    """Return the noise with what residuals along the camera's axis show beyond it.

    Args:
        noise: As residuals across the axis show it.
        along: Residuals along it.
        own: (N, 6, 6) covariances of the features.
        arms: (N, 6, 6) those of typical arms' poses.
    """
    known = noise.centre_scale * (own + noise.arms * arms)[:, 3:, 3:] + noise.pose * np.eye(3)
    return replace(noise, depth=along.extra(known)[0])


def without_arms(turned: Residuals, shifted: Residuals, own: Floats) -> Noise:
    """Return the noise that residuals show if none of it is the arms'; see :func:`noise_of`."""
    return replace(noise_of(turned, shifted, own, np.zeros_like(own)), arms=0.0)


def _share_of_arms(turned: Residuals, shifted: Residuals, own: Floats, arms: Floats) -> float:
    """Return the factor on the arms' covariances with which the translations are explained.

    At most that with which rotations would be explained too well to be chance, at 5 %.
    """
    if not arms.any():
        return 1.0
    share = shifted.factor(own[:, 3:, 3:], arms[:, 3:, 3:], shifted.freedom)
    if np.isinf(turned.freedom):
        return share
    least = chi2_quantile(0.05, max(round(turned.freedom), 1))
    return min(share, turned.factor(own[:, :3, :3], arms[:, :3, :3], least))


@dataclass(frozen=True, eq=False)
class Residuals:
    """Errors of one kind, to find their noise from.

    Attributes:
        errors: (N, 3).
        projectors: (N, 3, 3) onto what was measured.
        freedom: How many numbers they are, less what the fit took up; infinite where none.
    """

    errors: Floats
    projectors: Floats
    freedom: float

    def factor(self, own: Floats, further: Floats, wanted: float) -> float:
        """Return how often covariances have to be added to own ones for a sum of squares."""
        return _factor(*self._along(own, further), wanted)

    def extra(self, own: Floats) -> tuple[float, float]:
        """Return the variance to add, and the scale of the covariances, at most one.

        One, where less than one number is free: a fit that takes up all says nothing against them.
        """
        if np.isinf(self.freedom):
            return 0.0, 1.0
        freedom, unit = max(self.freedom, 1.0), max(float((self.errors**2).mean()), FINEST**2)
        squares, shares = self._beside(own, unit)
        explained = float(squares.sum())
        if explained <= freedom:
            return 0.0, max(explained / freedom, 1e-6) if self.freedom >= 1.0 else 1.0
        return unit * _factor(squares, shares, freedom), 1.0

    def _beside(self, own: Floats, variance: float) -> tuple[Floats, Floats]:
        """Return the same where a variance is to be added evenly: along the axes of ``own``."""
        p, eye = self.projectors, np.eye(3)
        variances, axes = np.linalg.eigh(p @ (own + FINEST**2 * eye) @ p + (eye - p))
        errors = (self.errors[:, None] @ axes)[:, 0]
        measured = (axes * (p @ axes)).sum(axis=1)  # 1, or 0 across what was not
        return (errors**2 / variances).ravel(), (variance * measured / variances).ravel()

    def _along(self, own: Floats, further: Floats) -> tuple[Floats, Floats]:
        """Return squared errors (3 N,) in units of their noise, and what is to be added there.

        Along the axes in which both covariances are diagonal.
        """
        p, eye = self.projectors, np.eye(3)
        root = np.linalg.cholesky(p @ (own + FINEST**2 * eye) @ p + (eye - p))
        whiten = np.linalg.inv(root)
        onto = whiten @ p
        added = onto @ further @ np.swapaxes(onto, 1, 2)
        shares, axes = np.linalg.eigh(0.5 * (added + np.swapaxes(added, 1, 2)))
        errors = (np.swapaxes(axes, 1, 2) @ (whiten @ self.errors[..., None]))[..., 0]
        return (errors**2).ravel(), np.maximum(shares, 0.0).ravel()


def _factor(squares: Floats, shares: Floats, wanted: float) -> float:
    """Return the factor on shares of a noise to be added at which squares come to a sum."""
    # Newton on the reciprocal of the sum, which is concave: it climbs to the answer from below.
    factor = 0.0
    for _ in range(STEPS):
        terms = squares / (1 + factor * shares)
        total, slope = terms.sum(), (terms * shares / (1 + factor * shares)).sum()
        if total <= wanted * (1 + 1e-9) or factor > LARGEST:
            break
        factor += total * (total - wanted) / max(wanted * slope, 1e-200)
    return float(min(factor, LARGEST))
