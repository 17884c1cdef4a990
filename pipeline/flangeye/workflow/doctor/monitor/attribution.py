"""Which part of a cell has changed: scanner, flange or arm. Arrays only.

A moved scanner, a changed joint zero and a moved flange leave different residual patterns. The
marginal likelihoods of the three are compared, each with a Gaussian prior of its parameters.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from flangeye.maths.statistics import MISFIT, chi2_quantile
from flangeye.types import Floats
from flangeye.types.geometry import adjoint_shift, stack_rows
from flangeye.workflow.doctor.monitor.drift import CheckSightings, Information, allowance

PART_CHANGE = 1e-3
"""Prior standard deviation of a part's change [rad] or [m]."""


def attribute_change(
    before: Information, after: CheckSightings, about: Floats, scanner: Floats, daily: float
) -> Mapping[str, float]:
    """Return each part's probability of having caused a change, likeliest first.

    Causes are: the scanner turned, shifted or both; the flange replaced, so that the circle has
    moved on it; and, if the arm's kinematics are known, one joint or the whole arm re-mastered.

    Args:
        before: Estimate of the camera motion and the arm's error weights before the change.
        after: Sightings since the change.
        about: (3,) reference point of the motions, in base [m].
        scanner: (3,) the scanner's position, about which it rotates, in base [m].
        daily: Standard deviation of the cell's day-to-day motion at the work [m].
    """
    # Residuals are -J z (see drift): adding J z takes off the motion before the change
    residuals = after.residuals + after.effects @ before.mean
    designs = _designs(after, about, scanner)
    noise = _noise(before, after, daily)
    scores = {part: _evidence(residuals.ravel(), noise, *d) for part, d in designs.items()}
    best = max(scores.values())
    weights = {part: float(np.exp(score - best)) for part, score in scores.items()}
    total = sum(weights.values())
    return {part: w / total for part, w in sorted(weights.items(), key=lambda x: -x[1])}


def explained(
    before: Information, after: CheckSightings, about: Floats, scanner: Floats, daily: float
) -> bool:
    """Return whether one move explains the sightings: of the scanner, the flange or the arm.

    Arguments are those of :func:`attribute_change`.
    """
    residuals = (after.residuals + after.effects @ before.mean).ravel()
    noise = _noise(before, after, daily)
    limit = chi2_quantile(1 - MISFIT, len(residuals))
    # Any motion up to 0.1 m or 0.1 rad (one sigma) is possible
    totals = (noise + 0.1**2 * d @ d.T for d, _ in _designs(after, about, scanner).values())
    return any(residuals @ np.linalg.solve(total, residuals) < limit for total in totals)


def suspects(parts: Mapping[str, float]) -> list[tuple[str, float]]:
    """Return (scanner, flange or arm, its probability), likeliest first."""
    of = {"scanner": 0.0, "flange": 0.0, "arm": 0.0}
    for part, probability in parts.items():
        of[part.split()[0].replace("joint", "arm")] += probability
    return sorted(of.items(), key=lambda x: -x[1])


def _designs(
    after: CheckSightings, about: Floats, scanner: Floats
) -> dict[str, tuple[Floats, Floats]]:
    n = len(after.residuals)
    # About the scanner's own position, for what is loose in its mount turns there; taken about
    # the work a small turn would look like a large shift
    at_scanner = -after.effects[..., :6] @ adjoint_shift(about - scanner)
    # A new flange has its circle shifted by d in its own axes, by R d in the base; no tilt
    tool = np.concatenate([after.flanges, np.zeros((n, 2, 3))], axis=1)
    moved = stack_rows(at_scanner)
    found = {
        "scanner turned": (moved[:, :3], np.full(3, PART_CHANGE)),
        "scanner shifted": (moved[:, 3:], np.full(3, PART_CHANGE)),
        "scanner moved": (moved, np.full(6, PART_CHANGE)),
        "flange replaced": (stack_rows(tool), np.full(3, PART_CHANGE)),
    }
    if after.joints is None:
        return found
    k = after.joints.shape[2]
    columns = stack_rows(after.joints)
    # The first joint turns the base as the scanner would, so it is not a suspect of its own.
    scale = np.full(k - 1, PART_CHANGE)
    one = {f"joint {j + 1} re-mastered": (columns[:, [j]], scale[:1]) for j in range(1, k)}
    return found | one | {"arm re-mastered": (columns[:, 1:], scale)}


def _noise(before: Information, after: CheckSightings, daily: float) -> Floats:
    """Return the (5N, 5N) covariance of the residuals without a change."""
    stacked = stack_rows(after.effects)
    out = stacked @ before.covariance @ stacked.T
    # The day's motion is the same for all scans of a check, and independent between checks
    same = np.repeat(after.check, 5)[:, None] == np.repeat(after.check, 5)
    out += same * (stacked[:, :6] @ allowance(daily) @ stacked[:, :6].T)
    for i, own in enumerate(after.covariances):
        out[5 * i : 5 * i + 5, 5 * i : 5 * i + 5] += own
    return np.asarray(out)


def _evidence(residuals: Floats, noise: Floats, design: Floats, prior: Floats) -> float:
    """Return the log of the marginal likelihood of residuals under a linear cause."""
    # The amounts are integrated out, so that a part with more of them must explain more
    total = noise + (design * prior**2) @ design.T
    _, volume = np.linalg.slogdet(total)
    return float(-0.5 * (residuals @ np.linalg.solve(total, residuals) + volume))
