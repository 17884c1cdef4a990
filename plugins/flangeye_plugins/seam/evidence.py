"""Hold fitted poses against what the scanner saw, finely: for judging them, and to end a slide."""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import numpy as np

from flangeye.maths.seam_geometry import distances_to_line
from flangeye.models.workpiece import CadSeam
from flangeye.types import Floats
from flangeye_plugins.seam.depthmap import DepthMap
from flangeye_plugins.seam.part import CadPart
from flangeye_plugins.seam.points import Oriented
from flangeye_plugins.seam.refine import CadFit, moved
from flangeye_plugins.seam.search import agreement, model_of, shares

FINE = 200
"""How many times the finest thing looked at goes into the part's diagonal."""


class RayEvidence:
    """Evidence for a part's pose: the rays that agree with it and against it."""

    def __init__(
        self, part: CadPart, seam: CadSeam, seen: DepthMap, rng: np.random.Generator
    ) -> None:
        self.part, self.floor = part, part.diagonal / FINE
        self._model, self._seen = model_of(part, rng, 2 * self.floor), seen
        # Samples of the part that are looked at on the way
        sliding = 3000
        self._few = self._model.thinned(sliding, rng)
        surface = self._model.surface
        # How far around a seam the surface is its own, at least, as a share of the diagonal
        around = 0.05
        reach = max(2 * (seam.half_width or 0.0), around * part.diagonal)
        self._near_seam = surface.take(distances_to_line(surface.points, seam.points) < reach)

    def of(self, fit: CadFit) -> tuple[float, float]:
        """Return which shares of the surface towards the scanner were seen, and refuted."""
        return self._shares(fit, self._model.surface)

    def at_seam(self, fit: CadFit) -> tuple[float, float]:
        """Return the same for the surface around the seam."""
        return self._shares(fit, self._near_seam)

    def scores(self, poses: Floats, noise: float) -> Floats:
        """Return the (K,) agreements of many poses (K, 4, 4), from a part of the samples."""
        return agreement(poses, self._few, self._seen, self._tolerance(noise))

    def score(self, fit: CadFit) -> float:
        """Return the agreement of a fit."""
        tolerance = self._tolerance(fit.noise)
        return float(agreement(fit.pose[None], self._model, self._seen, tolerance)[0])

    def _shares(self, fit: CadFit, surface: Oriented) -> tuple[float, float]:
        tolerance = self._tolerance(fit.noise)
        seen, refuted = shares(fit.pose[None], surface, self._seen, tolerance)
        return float(seen[0]), float(refuted[0])

    def _tolerance(self, noise: float) -> float:
        return max(5 * noise, self.floor)


def slid(fit: CadFit, evidence: RayEvidence) -> CadFit:
    """Slide a part along what its planes leave open to where its outline agrees.

    A block with a straight groove can slide along it without any distance to a plane changing;
    where it begins and ends is then all there is to go by. Its deviation is a quarter of the
    width of the agreement's peak.
    """
    units = np.array([2 / evidence.part.diagonal] * 3 + [1.0] * 3)
    values, vectors = np.linalg.eigh(fit.covariance / np.outer(units, units))
    # Either way, as shares of the diagonal
    for k, share in product(np.nonzero(values > evidence.floor**2)[0], (0.2, 0.03)):
        ways = np.linspace(-share, share, 101) * evidence.part.diagonal
        poses = np.array([moved(fit.pose, w * vectors[:, k] * units, fit.about) for w in ways])
        way, values[k] = _peak(ways, evidence.scores(poses, fit.noise), values[k])
        fit = replace(fit, pose=moved(fit.pose, way * vectors[:, k] * units, fit.about))
    covariance = vectors @ np.diag(values) @ vectors.T * np.outer(units, units)
    return replace(fit, covariance=covariance)


def _peak(ways: Floats, scores: Floats, variance: float) -> tuple[float, float]:
    """Return where the peak is, and its variance; where there is none, what it was."""
    # The part of the peak that is taken for where its middle is
    top = scores > scores.max() - 0.3 * (scores.max() - np.median(scores))
    inside = ways[top]
    if top[[0, -1]].any() or np.ptp(inside) > 0.5 * np.ptp(ways):
        return 0.0, variance
    return float(inside.mean()), float((np.ptp(inside) / 4) ** 2)
