"""Estimate an arm's own parameters from sightings: joint zeros, link lengths and twists."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from flangeye.errors import StageError
from flangeye.estimation.effects.arm import joints_known
from flangeye.estimation.estimate import Estimate, estimate
from flangeye.estimation.graph import Carrier
from flangeye.estimation.mixed import fit
from flangeye.estimation.plan import most_informative, whitened
from flangeye.estimation.session.session import Session
from flangeye.estimation.start.sightings import branches_of
from flangeye.maths.threads import on_one_thread
from flangeye.types import FLANGE, Floats, Indices, Mask, Observation

KNOWN = 0.5
"""A parameter counts as identified singly if its posterior deviation is at most this share of its
prior one, with all others free."""


@dataclass(frozen=True, eq=False)
class ArmParameters:
    """The n joints' parameters, each (n, 4): zero [rad], a [m], d [m] and alpha [rad].

    Attributes:
        values: Corrections to add to the arm model's parameters.
        deviations: Standard deviations of the corrections.
        sizes: Estimated standard deviation of each parameter in arms of this quality.
        alone: (4n, 4n) covariance from the poses alone, in units of the sizes.
        ways: Number of inverse-kinematics branches that fit equally well if no joint angles were
            recorded; infinity for an arm with more than six joints.
    """

    values: Floats
    deviations: Floats
    sizes: Floats
    alone: Floats
    ways: float = 1

    @property
    def identified(self) -> Mask:
        """Mask (n, 4) of the parameters that the poses identify singly."""
        singly = np.diag(self.alone).reshape(self.sizes.shape) <= KNOWN**2
        return np.asarray(singly & (self.deviations <= KNOWN * self.sizes))

    @property
    def combinations(self) -> int:
        """How many combinations of the parameters the poses identify."""
        return int((np.linalg.eigvalsh(self.alone) <= KNOWN**2).sum())


@on_one_thread
def parameters_of(session: Session) -> ArmParameters:
    """Return the estimated parameters, with covariance, of the arm that moves the flange.

    Without recorded joint angles, it is what all likely inverse-kinematics branches agree on.

    Raises:
        StageError: The arm's model does not reach its poses.
    """
    carrier = next((c for c in session.found.problem.carriers if joints_known(c)), None)
    if carrier is None:
        raise StageError(
            "refine.arm: the robot's model does not reach the poses; name the arm that was recorded"
        )
    ways = _ways(session, carrier)
    costs = np.array([way.posterior.cost for way in ways])
    # Costs are -2 log of the likelihood; the least is taken off so that no exponential underflows
    chances = np.exp((costs.min() - costs) / 2)
    chances /= chances.sum()
    each = [_of_one_way(way, carrier.arm) for way in ways]
    best = each[int(np.argmax(chances))]
    apart = sum(p * (one.values - best.values) ** 2 for p, one in zip(chances, each, strict=True))
    # Of the endless ways of an arm of more joints, those looked at are a few
    endless = len(ways) > 1 and len(best.values) > 6
    spread = np.full_like(apart, np.inf) if endless else np.sqrt(best.deviations**2 + apart)
    # Ways to the poses that are a hundredth as probable, or more, count as alike.
    count = np.inf if endless else int((chances > 0.01).sum())
    return replace(best, deviations=spread, ways=count)


def _ways(session: Session, carrier: Carrier) -> list[Estimate]:
    """Return the estimate for each inverse-kinematics branch that reaches the poses."""
    found = session.found
    if carrier.arm in session.cell.joints(session.observations):
        return [found]
    branches = branches_of(found.problem, replace(carrier, joints=None))
    problems = [found.problem.with_joints(carrier.arm, joints) for joints in branches]
    return [estimate(each, found.places, found.effects, found.inliers) for each in problems]


def _of_one_way(found: Estimate, arm: str) -> ArmParameters:
    columns, of_size = _columns(found, arm)
    known, sizes = found.posterior, found.posterior.mode.sizes
    own = sizes[of_size]
    poses_alone = _loosely(found, of_size)[np.ix_(columns.ravel(), columns.ravel())]
    return ArmParameters(
        known.mean[columns],
        np.sqrt(np.diag(known.covariance)[columns]),
        own,
        poses_alone / np.outer(own.ravel(), own.ravel()),
    )


def _loosely(found: Estimate, of_size: Indices) -> Floats:
    """Return the (P + K, P + K) information with a far wider prior on the arm's parameters."""
    sizes = found.posterior.mode.sizes.copy()
    # Each other parameter may be off by a hundred times its own size: identified by the poses,
    # not by what is expected
    sizes[np.unique(of_size)] *= 100.0
    return fit(found.posterior.model, sizes).covariance


def _columns(found: Estimate, arm: str) -> tuple[Indices, Indices]:
    """Return (n, 4) the column of each parameter among the unknowns, and the index of its size."""
    zeros, lengths, twists = (
        next(np.arange(at.start, at.stop) for e, at in found.rows(kind) if e.cause == arm)
        for kind in ("zeros", "lengths", "twists")
    )
    columns = np.column_stack([zeros, lengths.reshape(-1, 2), twists])
    return columns, found.posterior.model.sizes.effect[columns - found.posterior.model.p]


def most_informative_poses(
    session: Session, known: ArmParameters, candidates: Sequence[Observation], count: int
) -> tuple[Indices, ArmParameters]:
    """Return ``count`` most informative further sightings, and the parameters known with them.

    The parameters ``known`` are those of the session; candidates have joint angles.
    """
    found = session.found
    columns, of_size = _columns(found, FLANGE)
    covariance = _loosely(found, of_size)
    rows, _ = whitened(candidates, found, session.cell)
    levers = np.eye(len(covariance))[columns.ravel()] / known.sizes.ravel()[:, None]
    chosen, after = most_informative(rows, covariance, levers, count)
    left = levers @ after @ levers.T
    deviations = known.sizes * np.sqrt(np.diag(left)).reshape(known.sizes.shape)
    return chosen, replace(known, alone=left, deviations=np.minimum(deviations, known.deviations))
