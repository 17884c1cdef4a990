"""A walk's part in the normal equations of the other unknowns, marginalised. Arrays only."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from flangeye.handeye.unknowns import Linear
from flangeye.handeye.walk import FINEST_STEP, Course, StepSize, Walk
from flangeye.maths.tridiagonal import Tridiagonal, solve_tridiagonal
from flangeye.types import Floats

GROUPS = slice(3), slice(3, 6), slice(6, None)
"""Where turns, shifts and a change of scale stand in a step."""


@dataclass(frozen=True, eq=False)
class Smoothed:
    """The course's part in the normal equations, the other unknowns' given.

    Attributes:
        told: The (N, s, 1 + p) solution of its own equations: by how much it moves, and by how much
            less for each other unknown's move; with the inverse's blocks.
        information: (p, p) that the others lose to it.
        slope: (p,) that they lose.
        cost: Squares of its steps, in their variances.
        gain: By how much its own move would lower the cost.
        logdet_before: Logarithm of the determinant of the covariance that it had before.
    """

    told: Tridiagonal
    information: Floats
    slope: Floats
    cost: float
    gain: float
    logdet_before: float

    @property
    def logdet(self) -> float:
        """Of its precision after what was measured, less that before."""
        return self.told.logdet + self.logdet_before

    @property
    def followed(self) -> Floats:
        """(N, s, p) by how much less it moves for each other unknown's move."""
        return self.told.solution[:, :, 1:]

    def moved(self, step: Floats) -> Floats:
        """Return (N, s) by how much it moves when the others take a (p,) step."""
        return np.asarray(self.told.solution[:, :, 0] - self.followed @ step)

    def spread(self, walk: Walk, covariance: Floats) -> Floats:
        """Return the (N - 1, s) variances of the steps after the first, with the others' (p, p)."""
        own, cross = self.told.diagonal, self.told.below
        between = own[1:] + own[:-1] - cross - np.swapaxes(cross, 1, 2)
        change = np.diff(self.followed, axis=0)
        local = walk.local()[1:]
        both = between + change @ covariance @ np.swapaxes(change, 1, 2)
        return np.asarray(np.einsum("nij,njk,nik->ni", local, both, local))


def smoothed(
    walk: Walk,
    size: StepSize,
    course: Course,
    linear: Linear,
    jacobian: Floats,
    weights: Floats,
) -> Smoothed:
    """Return what the course takes from the normal equations of the others.

    Args:
        walk: How it walks.
        size: Of its steps.
        course: Where it is thought to be.
        linear: The measurements there.
        jacobian: (N, 6, p) of what is predicted by the other unknowns.
        weights: (N, 6, 6) inverse covariances of the measurements; zero for those left out.
    """
    local, variances, drift = walk.local(), walk.variances(size), linear.drift[:, :, : walk.states]
    steps = course.steps(walk)
    back = np.swapaxes(local, 1, 2) / variances[:, None]
    stiff, pull = back @ local, (back @ steps[..., None])[..., 0]
    told = np.swapaxes(drift, 1, 2) @ weights
    own = (told @ linear.residuals[..., None])[..., 0] - pull
    own[:-1] += pull[1:]
    right = np.concatenate([own[..., None], told @ jacobian], axis=2)
    diagonal = told @ drift + stiff
    diagonal[:-1] += stiff[1:]
    found = solve_tridiagonal(diagonal, -stiff[1:], right)
    taken = np.tensordot(right, found.solution, axes=([0, 1], [0, 1]))
    before = float(np.log(variances).sum())
    cost = float((steps**2 / variances).sum())
    return Smoothed(found, taken[1:, 1:], taken[1:, 0], cost, float(taken[0, 0]), before)


def size_told(walk: Walk, size: StepSize, course: Course, spread: Floats) -> StepSize:
    """Return the size of steps that makes them most likely, one iteration on (MacKay 1992).

    Args:
        walk: How it walks.
        size: As believed until now.
        course: Where it walked, by that.
        spread: (N - 1, s) variances of its steps.
    """
    steps, sizes = course.steps(walk)[1:], list(size)
    for i, told in enumerate(steps_told(walk, size, spread)):
        squares = (steps[:, GROUPS[i]] ** 2).sum()
        sizes[i] = max(float(np.sqrt(squares / max(told, 1e-3))), FINEST_STEP)
    return StepSize(*sizes)


def steps_told(walk: Walk, size: StepSize, spread: Floats) -> list[float]:
    """Return of how many numbers the steps' turns, shifts and, if it grows, scales are known.

    Args:
        walk: How it walks.
        size: Of its steps.
        spread: (N - 1, s) variances of the steps.
    """
    variances = [max(each, FINEST_STEP) ** 2 for each in size]
    return [
        spread[:, at].size - float(spread[:, at].sum()) / variance
        for at, variance in zip(GROUPS[: 3 if walk.grows else 2], variances, strict=False)
    ]
