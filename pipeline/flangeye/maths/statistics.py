"""The few statistics that solvers and verifiers share. Arrays only."""

from dataclasses import replace
from itertools import product
from typing import TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from flangeye.types import Feature, Floats, Observation, PoseFeature, Transform
from flangeye.types.geometry import levers, rotation_exp

Real = TypeVar("Real", bound=np.floating)

SIGMA_OF_MAD = 1.4826
"""Standard deviation of a normal variable over its median absolute deviation."""
MISFIT = 1e-6
"""Significance level of chi-square tests: the chance that noise passes for a misfit."""


def median(values: NDArray[Real]) -> NDArray[Real]:
    """Return the medians (...) of (..., n) finite values, n at least 1, as ``np.median`` does.

    A partial sort makes it five to ten times as fast.
    """
    half = values.shape[-1] // 2
    parted = np.partition(values, half, axis=-1)
    above = parted[..., half]
    return above if values.shape[-1] % 2 else (parted[..., :half].max(axis=-1) + above) / 2


def rms(values: ArrayLike) -> float:
    """Return the root mean square of numbers of any shape."""
    return float(np.sqrt(np.mean(np.square(values))))


def chi2_quantile(probability: float, freedom: int) -> float:
    """Return the value a chi-square variable stays below with ``probability``."""
    from scipy.special import chdtri

    return float(chdtri(freedom, 1.0 - probability))


def spread_evenly(count: int, dims: int) -> Floats:
    """Return (count, dims) points of the unit cube as a Latin hypercube.

    A Latin hypercube (McKay et al. 1979), the same at every call.
    """
    rng = np.random.default_rng(0)
    rows = rng.permuted(np.tile(np.arange(count), (dims, 1)), axis=1)
    return np.asarray((rows.T + 0.5) / count)


def f_quantile(probability: float, freedom: int, noise_freedom: float) -> float:
    """Return the value a mean square of ``freedom`` degrees stays below with ``probability``.

    In units of a variance that was itself estimated from ``noise_freedom`` degrees; infinite when
    it is known.
    """
    from scipy.special import fdtri

    if np.isinf(noise_freedom):
        return chi2_quantile(probability, freedom) / freedom
    return float(fdtri(freedom, noise_freedom, probability))


def covariance_inflation(freedom: float, parameters: int = 6, probability: float = 0.95) -> float:
    """Return the factor that keeps a region's coverage if its variance is only estimated.

    Regions are usually drawn with the chi-square quantile, which takes the noise as known. When it
    was estimated from ``freedom`` degrees of freedom, the squared distance follows ``parameters *
    F(parameters, freedom)`` instead; the ratio of the quantiles makes up for it.
    """
    honest = parameters * f_quantile(probability, parameters, freedom)
    return honest / chi2_quantile(probability, parameters)


def corners_of(centre: Floats, size: Floats) -> Floats:
    """Return the (8, 3) corners of an axis-aligned box."""
    signs = np.array(list(product([-0.5, 0.5], repeat=3)))
    return np.asarray(centre + signs * size)


def largest_error_quantile(covariance: Floats, about: Floats, corners: Floats) -> float:
    """Return the 95 % quantile of the largest error anywhere in a box [m].

    The error of a small pose error is an affine function of the place, so its length is largest
    in a corner. The distribution over the corners has no closed form: it is sampled, always with
    the same draws.

    Args:
        covariance: (6, 6), order (rotation, translation), translation about ``about``.
        about: (3,) point in base to which the covariance refers [m].
        corners: (8, 3) corners of the box in base [m].
    """
    variances, axes = np.linalg.eigh(covariance)
    root = axes * np.sqrt(np.clip(variances, 0.0, None))
    samples = 4000  # a 95 % quantile from this many draws varies by one percent
    draws = np.random.default_rng(0).standard_normal((samples, 6)) @ root.T
    errors = (draws @ levers(corners - about).reshape(-1, 6).T).reshape(samples, -1, 3)
    squares = np.einsum("sci,sci->sc", errors, errors).max(axis=1)
    return float(np.sqrt(np.quantile(squares, 0.95)))


def without_shared(observation: Observation, found: Floats) -> Observation:
    """Return an observation without the errors that its whole session shares.

    Args:
        observation: The measured values.
        found: (k,) estimate of each error, in standard deviations; see :class:`HandEye`.
    """
    feature = observation.feature
    if not len(found) or not isinstance(feature, PoseFeature) or not feature.shared.size:
        return observation
    return replace(observation, feature=_moved_back(feature, found))


def _moved_back(feature: PoseFeature, found: Floats) -> Feature:
    moved = feature.shared @ found[: feature.shared.shape[1]]
    pose, seen = feature.camera_T_target.matrix.copy(), feature.camera_T_target
    pose[:3, :3] = rotation_exp(-moved[:3]) @ pose[:3, :3]
    pose[:3, 3] -= moved[3:]
    return replace(feature, camera_T_target=Transform(seen.parent, seen.child, pose))
