"""Generalised least squares: centres and normals, each with its own covariance. Arrays only.

Noise that the covariances do not explain (the arm's, mostly) is found by variance components.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from flangeye.geometry import rotation_exp
from flangeye_plugins.solving.equations import FINEST, Equations, Fit, Noise, Rows, linearise
from flangeye_plugins.solving.evidence import Evidence, Nuisance

Floats = NDArray[np.float64]

ITERATIONS = 50


def adjust(
    evidence: Evidence, nuisance: Nuisance, start: Fit, pose_noise: float | None = None
) -> Fit:
    """Fit pose, nuisances and noise to the evidence, by Gauss-Newton steps from ``start``.

    Args:
        evidence: N poses without outliers.
        nuisance: Their common errors.
        start: A pose near the answer, and the noise to begin with.
        pose_noise: Variance of the arm's position [m^2] where it is known; else it is found.
    """
    fit = start
    for _ in range(ITERATIONS):
        equations = linearise(evidence, nuisance, fit)
        information = equations.information(fit.noise)
        gradient = equations.gradient(fit.noise)
        step = np.asarray(-np.linalg.solve(information, gradient))
        found = _with_noise(fit, equations, information, pose_noise)
        settled = np.abs(step).max() < 1e-10 and _close(found.noise, fit.noise)
        fit = _moved(found, step, information)
        if settled:
            break
    return fit


def _moved(fit: Fit, step: Floats, information: Floats) -> Fit:
    turn = rotation_exp(step[:3])
    return replace(
        fit,
        rotation=turn @ fit.rotation,
        translation=fit.about + turn @ (fit.translation - fit.about) + step[3:6],
        nuisance=fit.nuisance + step[6:],
        information=information,
    )


def _with_noise(
    fit: Fit, equations: Equations, information: Floats, pose_noise: float | None
) -> Fit:
    """Return the fit with noise that makes each sort's squared sum equal its freedom."""
    covariance, noise = np.asarray(np.linalg.inv(information)), fit.noise
    if pose_noise is None:
        freedom, scale, pose = _component(
            equations.centres, noise.centre_scale, noise.pose, covariance
        )
        noise = replace(noise, centre_scale=scale, pose=pose)
        fit = replace(fit, freedom=freedom)
    if len(equations.normals.residuals):
        freedom, scale, tilt = _component(
            equations.normals, noise.normal_scale, noise.tilt, covariance
        )
        noise = replace(noise, normal_scale=scale, tilt=tilt)
        fit = replace(fit, tilt_freedom=freedom)
    return replace(fit, noise=noise)


def _component(
    rows: Rows, scale: float, extra: float, covariance: Floats
) -> tuple[float, float, float]:
    """Return freedom, scale and extra variance of one sort of equation.

    Variance components after Helmert: the freedom is the number of equations less their share in
    what was fitted. When the covariances explain more than the residuals show they are scaled
    down; otherwise a variance is added to each (Mandel & Paule 1970).
    """
    share = float(np.trace(covariance @ rows.information(rows.weights(scale, extra))))
    freedom = max(rows.residuals.size - share, 1.0)
    variances, axes = np.linalg.eigh(rows.own)
    squares = np.einsum("mba,mb->ma", axes, rows.residuals) ** 2

    def too_large(variance: float) -> bool:
        return bool((squares / (variances + variance + FINEST**2)).sum() > freedom)

    if not too_large(0.0):
        explained = float((squares / (variances + FINEST**2)).sum())
        return freedom, max(explained / freedom, 1e-6), 0.0
    low, high = 0.0, float(squares.sum())
    while too_large(high):
        high *= 2
    for _ in range(60):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if too_large(middle) else (low, middle)
    return freedom, 1.0, high


def _close(first: Noise, second: Noise) -> bool:
    pairs = (
        (first.pose + FINEST**2, second.pose + FINEST**2),
        (first.tilt + FINEST**2, second.tilt + FINEST**2),
        (first.centre_scale, second.centre_scale),
        (first.normal_scale, second.normal_scale),
    )
    return all(abs(a - b) <= 1e-6 * max(a, b) for a, b in pairs)
