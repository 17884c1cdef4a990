r"""An arm's pose error over its workspace, estimated from one calibration. Arrays only.

An arm's joint zeros, lengths and encoders make repeatable errors that change smoothly with the
pose. The error of a pose is a sum of few smooth functions of position and orientation, with weights
:math:`w`, plus independent noise:

.. math:: e(u) = \sum_k f_k(u) w_k + \varepsilon, \quad w_k \sim N(0, s^2), \quad
    \varepsilon \sim N(0, n^2)

with the features of :mod:`flangeye.maths.arm_correction`, to second order in place and first in
orientation. The sizes :math:`s` and :math:`n`, of positions and of tilts, maximise the likelihood
of the calibration's residuals with a free camera pose.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np

from flangeye.maths.arm_correction import RADII, features
from flangeye.types import Floats
from flangeye.types.geometry import hat, nearest_rotation, rotation_log

POWERS = tuple(
    place + turn
    for place in product(range(3), repeat=3)
    for turn in product(range(2), repeat=3)
    if sum(place) + 2 * sum(turn) <= 2
)


@dataclass(frozen=True, eq=False)
class ArmPoseErrors:
    """The errors of an arm's poses, with their sizes.

    Attributes:
        middle: (4, 4) pose in the middle of the workspace.
        lengths: (6,) correlation lengths: of position [m], then of orientation [rad].
        smooth: Standard deviations of the weights, of a position [m] and of an orientation [rad].
        noise: Standard deviations of the noise, of a centre [m] and of a tilt [rad].
    """

    middle: Floats
    lengths: Floats
    smooth: tuple[float, float]
    noise: tuple[float, float]

    def effects(self, poses: Floats) -> Floats:
        """Return shifts and tilts (N, 5, K) of circles at poses (N, 4, 4) for unit weights."""
        place = poses[:, :3, 3] - self.middle[:3, 3]
        turn = rotation_log(poses[:, :3, :3] @ self.middle[:3, :3].T)
        of_pose = features(np.concatenate([place, turn], axis=1) / self.lengths, POWERS)
        spread = (of_pose[:, None, :, None] * np.eye(3)[:, None, :]).reshape(len(poses), 3, -1)
        # A rotation w moves the normal z by w x z; what of it lies across z is the tilt
        across = poses[:, :3, :2].transpose(0, 2, 1)
        tilts = across @ -hat(poses[:, :3, 2]) @ spread
        k = spread.shape[2]
        out = np.zeros((len(poses), 5, 2 * k))
        out[:, :3, :k], out[:, 3:, k:] = spread, tilts
        return out

    @property
    def variances(self) -> Floats:
        """Prior variances (K,) of the weights."""
        return np.repeat(np.square(self.smooth), 3 * len(POWERS))

    @property
    def with_camera(self) -> Floats:
        """Variances (6 + K,) of a free motion of the camera [rad^2, m^2], and of the weights."""
        return np.concatenate([np.ones(6), self.variances])

    @property
    def beyond(self) -> Floats:
        """Covariance (5, 5) of the noise of one pose: position [m^2], then tilt [rad^2]."""
        return np.diag(np.repeat(np.square(self.noise), (3, 2)))


def pose_error_of(residuals: Floats, effects: Floats, own: Floats, poses: Floats) -> ArmPoseErrors:
    """Return the error of an arm from a calibration's N residuals.

    Args:
        residuals: (N, 5) residuals of centre [m] and tilt [rad].
        effects: (N, 5, 6) derivatives of the residuals by a free motion of the camera.
        own: (N, 5, 5) covariances of the scans alone.
        poses: (N, 4, 4) poses of the circle in ``base``.
    """
    # Four sizes are hardly better known from more than sixty poses
    chosen = np.unique(np.linspace(0, len(poses) - 1, 60).astype(int))
    bare = _unsized(poses)
    design = np.concatenate([effects, bare.effects(poses)], axis=2)[chosen]
    seen = residuals[chosen], own[chosen]

    def unlikelihood(logs: Floats) -> float:
        return _unlikelihood(design, *seen, _sized(bare, logs))

    from scipy.optimize import minimize

    # Sizes that are tried: [m] and [rad]
    bounds = [(np.log(1e-6), np.log(1e-2))] * 4
    start = np.full(4, np.log(1e-4))
    best = minimize(unlikelihood, start, method="L-BFGS-B", bounds=bounds)
    return _sized(bare, best.x)


def _unsized(poses: Floats) -> ArmPoseErrors:
    middle = np.eye(4)
    middle[:3, 3] = poses[:, :3, 3].mean(axis=0)
    middle[:3, :3] = nearest_rotation(poses[:, :3, :3].mean(axis=0))
    radius = np.linalg.norm(poses[:, :3, 3] - middle[:3, 3], axis=1).max()
    angle = np.linalg.norm(rotation_log(poses[:, :3, :3] @ middle[:3, :3].T), axis=1).max()
    # An arm's error hardly changes over less: [m] and [rad]
    lengths = RADII * np.array([max(radius, 0.05), max(angle, 0.3)])
    return ArmPoseErrors(middle, np.repeat(lengths, 3), (0.0, 0.0), (0.0, 0.0))


def _sized(bare: ArmPoseErrors, logs: Floats) -> ArmPoseErrors:
    smooth, tilt, noise, tilt_noise = np.exp(logs).tolist()
    return ArmPoseErrors(bare.middle, bare.lengths, (smooth, tilt), (noise, tilt_noise))


def _unlikelihood(design: Floats, residuals: Floats, own: Floats, error: ArmPoseErrors) -> float:
    """Return -2 log of the marginal likelihood, up to a constant."""
    # Woodbury's identity and the determinant lemma: no matrix is larger than 6 + K. The camera's
    # variance of 1 rad^2 and 1 m^2 leaves it free, which makes the likelihood a restricted one
    noise = own + error.beyond
    weighted = design.transpose(0, 2, 1) @ np.linalg.inv(noise)
    variances = error.with_camera
    information = (weighted @ design).sum(axis=0) * np.sqrt(variances[:, None] * variances)
    vector = (weighted @ residuals[..., None]).sum(axis=0)[:, 0] * np.sqrt(variances)
    inner = np.eye(len(variances)) + information
    squares = np.einsum("ni,nij,nj->", residuals, np.linalg.inv(noise), residuals)
    volume = np.linalg.slogdet(noise)[1].sum() + np.linalg.slogdet(inner)[1]
    return float(squares - vector @ np.linalg.solve(inner, vector) + volume)
