"""The equations of the camera's pose, linearised. Arrays only.

The residual of a centre is ``R c + t - b``, that of a normal the two components of
``R n - z`` across the flange's axis ``z``; ``b`` and ``z`` as the nuisances move them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from flangeye.geometry import hat
from flangeye_plugins.solving.evidence import Evidence, Nuisance

Floats = NDArray[np.float64]

FINEST = 1e-7
"""Added to every standard deviation [m, rad]: exact inputs keep finite weights."""


@dataclass(frozen=True)
class Noise:
    """Noise beside the covariances of the circles.

    Attributes:
        pose: Variance of each coordinate of the arm's position [m^2].
        tilt: Variance of each component of the arm's axis [rad^2].
        centre_scale: Factor on the centres' covariances, at most 1.
        normal_scale: Factor on the normals' covariances, at most 1.
        arms: Factor on the covariances that are taken for the arms' poses.
    """

    pose: float
    tilt: float
    centre_scale: float = 1.0
    normal_scale: float = 1.0
    arms: float = 1.0


@dataclass(frozen=True, eq=False)
class Fit:
    """A pose with its nuisances, and how well they are known.

    Attributes:
        rotation: (3, 3) base_R_camera.
        translation: (3,) [m].
        nuisance: (k,) their values.
        noise: Noise the weights were made from.
        about: (3,) where the translation's error is taken, in ``base`` [m].
        information: (6 + k, 6 + k) Fisher information: rotation, translation, nuisances.
        freedom: Degrees of freedom the noise was estimated from.
        tilt_freedom: The same for the normals.
    """

    rotation: Floats
    translation: Floats
    nuisance: Floats
    noise: Noise
    about: Floats
    information: Floats
    freedom: float = np.inf
    tilt_freedom: float = np.inf

    @property
    def covariance(self) -> Floats:
        """(6 + k, 6 + k) inverse of the information."""
        return np.asarray(np.linalg.inv(self.information))


@dataclass(frozen=True, eq=False)
class Rows:
    """One sort of equation, linearised.

    Attributes:
        residuals: (M, d).
        jacobian: (M, d, 6 + k).
        own: (M, d, d) covariance of each by its circle.
    """

    residuals: Floats
    jacobian: Floats
    own: Floats

    def weights(self, scale: float, extra: float) -> Floats:
        """Return the (M, d, d) inverse covariances."""
        noise = (extra + FINEST**2) * np.eye(self.own.shape[1])
        return np.asarray(np.linalg.inv(scale * self.own + noise))

    def information(self, weights: Floats) -> Floats:
        """Return the (6 + k, 6 + k) these rows contribute."""
        return np.asarray(np.einsum("mai,mab,mbj->ij", self.jacobian, weights, self.jacobian))

    def gradient(self, weights: Floats) -> Floats:
        """Return the (6 + k,) slope of half the squared sum."""
        return np.asarray(np.einsum("mai,mab,mb->i", self.jacobian, weights, self.residuals))


@dataclass(frozen=True, eq=False)
class Equations:
    """All equations, linearised at a fit.

    Attributes:
        centres: Three for each pose.
        normals: Two for each pose whose normal was measured.
        known: (6 + k,) information known beforehand: none of the pose, the nuisances' prior.
        surprise: (6 + k,) how far the nuisances are from what was expected.
    """

    centres: Rows
    normals: Rows
    known: Floats
    surprise: Floats

    def information(self, noise: Noise) -> Floats:
        """Return the (6 + k, 6 + k) Fisher information."""
        of_centres, of_normals = self._weights(noise)
        measured = self.centres.information(of_centres) + self.normals.information(of_normals)
        return np.asarray(measured + np.diag(self.known))

    def gradient(self, noise: Noise) -> Floats:
        """Return the (6 + k,) slope of half the squared sum."""
        of_centres, of_normals = self._weights(noise)
        gradient = self.centres.gradient(of_centres) + self.normals.gradient(of_normals)
        return np.asarray(gradient + self.known * self.surprise)

    def _weights(self, noise: Noise) -> tuple[Floats, Floats]:
        return (
            self.centres.weights(noise.centre_scale, noise.pose),
            self.normals.weights(noise.normal_scale, noise.tilt),
        )


def linearise(evidence: Evidence, nuisance: Nuisance, fit: Fit) -> Equations:
    """Linearise all equations at a fit."""
    centres, normals = _centre_rows(evidence, nuisance, fit), _normal_rows(evidence, nuisance, fit)
    known = np.concatenate([np.zeros(6), nuisance.prior**-2.0])
    surprise = np.concatenate([np.zeros(6), fit.nuisance - nuisance.mean])
    return Equations(centres, normals, known, surprise)


def start_at(
    rotation: Floats, translation: Floats, evidence: Evidence, nuisance: Nuisance, noise: Noise
) -> Fit:
    """Return a pose to start from, with the information the evidence has there."""
    k, about = len(nuisance.prior), evidence.tcps.mean(axis=0)
    fit = Fit(rotation, translation, np.zeros(k), noise, about, np.zeros((6 + k, 6 + k)))
    return replace(fit, information=linearise(evidence, nuisance, fit).information(noise))


def _centre_rows(evidence: Evidence, nuisance: Nuisance, fit: Fit) -> Rows:
    """Linearise the centres at a fit."""
    mapped = evidence.centres @ fit.rotation.T + fit.translation
    expected = evidence.tcps + nuisance.moves @ fit.nuisance
    n = len(mapped)
    identity = np.broadcast_to(np.eye(3), (n, 3, 3))
    jacobian = np.concatenate([-hat(mapped - fit.about), identity, -nuisance.moves], axis=2)
    own = fit.rotation @ evidence.centre_covariances @ fit.rotation.T
    return Rows(mapped - expected, jacobian, own)


def _normal_rows(evidence: Evidence, nuisance: Nuisance, fit: Fit) -> Rows:
    """Linearise the normals at a fit; poses without one have no row."""
    have = evidence.has_normal
    axes, turns = evidence.axes[have], nuisance.turns[have]
    mapped = evidence.normals[have] @ fit.rotation.T
    expected = axes + np.cross(turns @ fit.nuisance, axes)
    across = evidence.flanges[have][:, :, :2].transpose(0, 2, 1)
    jacobian = np.concatenate(
        [-across @ hat(mapped), np.zeros((len(axes), 2, 3)), across @ hat(axes) @ turns], axis=2
    )
    covariances = fit.rotation @ evidence.normal_covariances[have] @ fit.rotation.T
    own = across @ covariances @ across.transpose(0, 2, 1)
    return Rows(np.einsum("mai,mi->ma", across, mapped - expected), jacobian, own)
