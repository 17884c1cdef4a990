"""The law of propagation of uncertainty (JCGM 100:2008, the GUM). Arrays only."""

from __future__ import annotations

import numpy as np

from flangeye.types import Floats


def propagated(sensitivities: Floats, standard: Floats, correlation: Floats) -> Floats:
    """Return the (m, m) covariance of m results of n inputs (GUM, equation 13).

    Args:
        sensitivities: (m, n) derivatives of the results by the inputs.
        standard: (n,) standard uncertainties of the inputs.
        correlation: (n, n) of the inputs.
    """
    scaled = np.asarray(sensitivities) * standard
    return np.asarray(scaled @ correlation @ scaled.T)


def correlation_of(covariance: Floats) -> tuple[Floats, Floats]:
    """Return standard uncertainties (n,) and correlations (n, n) of a covariance (n, n)."""
    standard = np.sqrt(np.diag(covariance))
    safe = np.where(standard > 0, standard, 1.0)
    correlation = covariance / np.outer(safe, safe)
    np.fill_diagonal(correlation, 1.0)
    return standard, np.asarray(correlation)


def effective_freedom(contributions: Floats, freedoms: Floats) -> float:
    """Return the degrees of freedom of a sum of independent parts (Welch-Satterthwaite, G.2b).

    Args:
        contributions: (n,) standard uncertainties of the parts, in the unit of the result.
        freedoms: (n,) degrees of freedom of each; infinite where it is known.
    """
    fourth = float(np.sum(np.asarray(contributions) ** 4 / freedoms))
    total = float(np.sum(np.asarray(contributions) ** 2))
    return total**2 / fourth if fourth > 0 else float("inf")


def coverage_factor(freedom: float, probability: float = 0.95) -> float:
    """Return k with which k times the standard uncertainty holds ``probability`` (Student's t)."""
    from scipy.special import ndtri, stdtrit

    upper = 0.5 * (1.0 + probability)
    return float(ndtri(upper) if np.isinf(freedom) else stdtrit(freedom, upper))
