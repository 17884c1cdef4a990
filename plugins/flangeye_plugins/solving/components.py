"""How much noise residuals show beyond the features' own, and whose: variance components, arrays.

After Helmert: each component is such that the weighted squares it explains are as many as there are
numbers, less those that the fit took up.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flangeye.statistics import chi2_quantile
from flangeye_plugins.solving.equations import FINEST, Noise

Floats = NDArray[np.float64]

LARGEST = 1e8
"""Factor on a noise beyond which nothing is looked for."""


def noise_of(turned: Residuals, shifted: Residuals, own: Floats, arms: Floats) -> Noise:
    """Return the noise that residuals show.

    What translations show beyond their own noise is the arms', which turn what is far from them
    the more, as long as the rotations do not speak against it; the rest is added evenly.

    Args:
        turned: Of N rotations.
        shifted: Of N translations.
        own: (N, 6, 6) covariances of the features, order (rotation, translation).
        arms: (N, 6, 6) those of typical arms' poses; zero where nothing is known of them.
    """
    share = _share_of_arms(turned, shifted, own, arms)
    own = own + share * arms
    tilt, normal_scale = turned.extra(own[:, :3, :3])
    pose, centre_scale = shifted.extra(own[:, 3:, 3:])
    return Noise(pose, tilt, centre_scale, normal_scale, share)


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

    def squares(self, covariances: Floats) -> float:
        """Return the sum of squared distances, the noise being (N, 3, 3)."""
        p, eye = self.projectors, np.eye(3)
        solved = np.linalg.solve(
            p @ (covariances + FINEST**2 * eye) @ p + (eye - p), self.errors[..., None]
        )
        return float((self.errors * solved[..., 0]).sum())

    def factor(self, own: Floats, further: Floats, wanted: float) -> float:
        """Return how often covariances have to be added to own ones for a sum of squares."""
        if np.isinf(wanted) or self.squares(own) <= wanted:
            return 0.0
        low, high = 0.0, 1.0
        while self.squares(own + high * further) > wanted and high < LARGEST:
            low, high = high, 4 * high
        for _ in range(40):
            middle = 0.5 * (low + high)
            more = self.squares(own + middle * further) > wanted
            low, high = (middle, high) if more else (low, middle)
        return high

    def extra(self, own: Floats) -> tuple[float, float]:
        """Return the variance to add, and the scale of the covariances, at most one."""
        if np.isinf(self.freedom):
            return 0.0, 1.0
        freedom = max(self.freedom, 1.0)
        explained = self.squares(own)
        if explained <= freedom:
            return 0.0, max(explained / freedom, 1e-6)
        unit = float((self.errors**2).mean())
        return unit * self.factor(own, unit * np.eye(3), freedom), 1.0
