"""Covariance of fits to points whose errors are correlated with their neighbours'."""

import numpy as np
from numpy.typing import NDArray

from flangeye.maths.circles import distances, sectors
from flangeye.plugin.stage import Params
from flangeye.types import Floats
from flangeye.units import Length, param

STRETCHES = 12
"""Stretches of a rim that err independently, 30 degrees each: the correlation length of the
residuals on the published clouds."""


class ScannerErrorParams(Params):
    """Common parameters of fits to a scan."""

    scanner_error: Length = param("0.06 mm", ge=0)
    """Standard deviation along each axis of the scanner's own distortion, which a single scan
    cannot show: its calibration accuracy over root 3; added to the covariance."""


def clustered_covariance(
    jacobian: Floats,
    residual: Floats,
    weights: Floats,
    cluster: NDArray[np.intp],
    curvature: Floats | None = None,
) -> Floats:
    """Return the covariance (p, p) of a weighted least-squares fit with correlated residuals.

    This is the sandwich estimator with clusters (Liang and Zeger 1986): residuals may be correlated
    within a cluster and differ in variance between clusters. Both hold for edge points: the pixel
    grid, the chamfer and reflections displace whole stretches of an edge, so treating the points as
    independent understates a centre's standard deviation several times.

    Args:
        jacobian: (N, p) derivatives of the residuals.
        residual: (N,) residuals at the solution.
        weights: (N,) weight of each residual.
        cluster: (N,) number of the cluster each residual belongs to, from zero.
        curvature: (N,) derivatives of ``weights * residual`` by the residual; None for constant
            weights.
    """
    p = jacobian.shape[1]
    each = jacobian.T * (weights * residual)
    scores = np.stack([np.bincount(cluster, column) for column in each], axis=1)
    occupied = np.count_nonzero(np.bincount(cluster))
    slope = weights if curvature is None else curvature
    bread = np.linalg.pinv((jacobian.T * slope) @ jacobian)
    small_sample = occupied / max(occupied - p, 1)
    return np.asarray(small_sample * bread @ (scores.T @ scores) @ bread)


def plane_covariance(offsets: Floats, heights: Floats) -> Floats:
    """Return the covariance (3, 3) of a plane's two slopes and its height at the origin.

    As a face's unevenness is correlated over more than one point, the clusters are sectors of 15
    degrees in three rings.

    Args:
        offsets: (N, 2) points in the plane, relative to the point of the height [m].
        heights: (N,) residuals [m].
    """
    radius = distances(offsets)
    third = np.minimum((3 * radius / radius.max()).astype(np.intp), 2)
    cluster = 2 * STRETCHES * third + sectors(offsets, 2 * STRETCHES)
    jacobian = -np.stack([*offsets.T, np.ones(len(offsets))]).T
    return clustered_covariance(jacobian, heights, np.ones(len(offsets)), cluster)
