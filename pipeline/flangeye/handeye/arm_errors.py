"""What an arm may be off by, as large as residuals show it, in the covariance of one loop.

As for a cell's arms (``cell_arms``): zeros of joints, encoders, sag, lengths, twists, and what is
smooth over the workspace. They move neighbouring poses alike, so that the answer follows them where
independent noise would average out ("consider" covariance, Schmidt 1966). Of what it followed,
residuals tell most: they say where the truth is to be looked for, and a region is about the answer
as it was given.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import reduce
from itertools import chain
from typing import NamedTuple

import numpy as np

from flangeye.handeye.arm import MovedFlange
from flangeye.handeye.arm_sizes import Answer, Sizes, sizes_told, stated
from flangeye.handeye.bent import Bent
from flangeye.handeye.candidates import Model, following, weighed_with
from flangeye.handeye.components import Noise
from flangeye.handeye.likelihood import Problem, Solution, with_noise
from flangeye.handeye.nuisance import Nuisance
from flangeye.types import Floats

Arms = Sequence[Sequence[MovedFlange]]
"""What each of some arms moves."""


def with_arm_errors(model: Model, arms: Arms, inflation: float) -> tuple[Floats, Sizes]:
    """Return the (18, 18) covariance of the transforms with the arm's errors in it.

    With the sizes of these in units of what the robot's file says; see
    :class:`flangeye.handeye.arm_sizes.Sizes`.

    Args:
        model: What was found for the arm as reported.
        arms: Those that move camera or target, of known kinematics that reach their poses.
        inflation: Factor on the covariance of the fit itself, for its noise was estimated.

    Raises:
        ValueError: The kinematics are not known, or do not reach the poses.
    """
    return with_errors(model.problem, model.found, _kinds(arms), inflation)


def with_errors(
    problem: Problem, found: Solution, kinds: Sequence[Nuisance], inflation: float
) -> tuple[Floats, Sizes]:
    """Return the (6 K, 6 K) covariance of the places with errors of some kinds in it, and sizes.

    Args:
        problem: What was given.
        found: Its fit without them.
        kinds: The errors of each kind, as large as was said.
        inflation: Factor on the covariance of the fit itself, for its noise was estimated.
    """
    sizes = sizes_of(problem, found, kinds)
    beside = _noise_beside(problem, found, kinds, sizes.expected)
    return _told(problem, replace(found, noise=beside), kinds).stated(inflation)


def last_unknown_by_arms(model: Model, arms: Arms) -> float:
    """Return the standard deviation that the arms' errors give the last of the model's nuisances.

    Args:
        model: What was found for the arm as reported, that nuisance with it.
        arms: As in :func:`evidence`; where they are not known, it is 0.
    """
    if are_unknown(arms):
        return 0.0
    kinds = _kinds(arms)
    moved = following(model.problem, model.found, reduce(Nuisance.and_also, kinds))[-1]
    each = np.split(moved, np.cumsum([len(kind) for kind in kinds])[:-1])
    squares = np.array([followed @ followed for followed in each])
    return float(np.sqrt(sizes_of(model.problem, model.found, kinds).expected ** 2 @ squares))


def evidence(model: Model, arms: Arms) -> float:
    """Return twice by how much likelier residuals are with errors of the arms than without.

    Args:
        model: As in :func:`with_arm_errors`.
        arms: Those that move camera or target; where the kinematics of one are not known, or do
            not reach its poses, it is 0.
    """
    return 0.0 if are_unknown(arms) else sizes_of(model.problem, model.found, _kinds(arms)).gain


def note_of_errors(arms: Arms, sizes: Sizes) -> str:
    """Say what is in the covariance, and how large it was found."""
    zeros = arms[0][0].deviation * 1e3 * float(sizes.expected[0])
    return (
        f"what the arm does wrong alike at all poses is in the covariance, as large as the "
        f"residuals show it: joint zeros of about {zeros:.1f} mrad, and encoders, sag, lengths, "
        "twists and a smooth error beside them; at poses like these most of it cancels, and "
        "held-out errors show what does not"
    )


def are_unknown(arms: Arms) -> bool:
    """Whether the kinematics of some arm are not known, or do not reach its poses."""
    return any(moved.kinematics is None or moved.some_joints is None for moved in chain(*arms))


def sizes_of(problem: Problem, found: Solution, kinds: Sequence[Nuisance]) -> Sizes:
    """Return how large errors of some kinds are, by a fit in which each is as large as was said."""
    return _told(problem, found, kinds).sizes


class _Told(NamedTuple):
    """What agreeing measurements tell of the unknowns, and of errors as large as was said.

    Attributes:
        fit: Both, at what was found of the former without the latter.
        counts: How many errors each kind has.
        freedom: How many numbers the residuals are, less the unknowns.
    """

    fit: Solution
    counts: list[int]
    freedom: float

    @property
    def sizes(self) -> Sizes:
        """How large the errors are."""
        return sizes_told(self._gram, self.counts, self.freedom)

    def stated(self, inflation: float) -> tuple[Floats, Sizes]:
        """Return the (6 K, 6 K) covariance of the places, and the sizes."""
        p, known, across = self._unknowns
        places = self.fit.basis[: self.fit.at.of_places, :p]
        own = inflation * places @ known @ places.T
        answer = Answer(places @ known @ self.fit.slope[:p], own, places @ known @ across)
        return stated(self._gram, self.counts, self.freedom, answer)

    @property
    def _gram(self) -> Floats:
        p, known, across = self._unknowns
        information, slope = self.fit.information, self.fit.slope
        along = slope[p:] - across.T @ known @ slope[:p]
        left = self.fit.cost - slope[:p] @ known @ slope[:p]
        expected = np.eye(len(along))
        effects = information[p:, p:] - expected - across.T @ known @ across
        return np.block([[effects, along[:, None]], [along, left]])

    @property
    def _unknowns(self) -> tuple[int, Floats, Floats]:
        """How many there are, their (p, p) covariance, and (p, k) what they share with errors."""
        p = self.fit.basis.shape[1] - sum(self.counts)
        information = self.fit.information
        return p, np.asarray(np.linalg.inv(information[:p, :p])), information[:p, p:]


def _told(problem: Problem, found: Solution, kinds: Sequence[Nuisance]) -> _Told:
    """Return what the measurements that agree tell of errors of some kinds.

    By the fit's information and slope, so that what walked has been taken out as well.
    """
    fit = weighed_with(_bare(problem), found, reduce(Nuisance.and_also, kinds))
    counts = [len(kind) for kind in kinds]
    measured = np.trace(problem.measurements.projectors[fit.inliers], axis1=1, axis2=2).sum()
    return _Told(fit, counts, float(measured) - fit.basis.shape[1] + sum(counts))


def _noise_beside(
    problem: Problem, found: Solution, kinds: Sequence[Nuisance], sizes: Floats
) -> Noise:
    """Return the noise that is left beside errors of those sizes.

    As long as they are not known they look like noise, and more like that of places than of turns.
    """
    sized = [
        replace(kind, prior=size * kind.prior) for kind, size in zip(kinds, sizes, strict=True)
    ]
    errors, bare = reduce(Nuisance.and_also, sized), _bare(problem)
    return with_noise(bare.beside(errors), weighed_with(bare, found, errors)).noise


def _bare(problem: Problem) -> Problem:
    """Return the problem without a smooth error found: it would explain what the arm's do."""
    return replace(problem, nuisance=problem.nuisance.without_sized())


def _kinds(arms: Arms) -> list[Nuisance]:
    """Return the errors of each kind, as large as the robots' files say."""
    each = [_kinds_of(moved) for moved in arms]
    return [reduce(Nuisance.and_also, kind) for kind in zip(*each, strict=True)]


def _kinds_of(moved: Sequence[MovedFlange]) -> list[Nuisance]:
    """Return the errors of one arm: they move all that it moves, what is smooth each by itself."""
    *common, smooth = zip(*map(_moves, moved), strict=True)
    return [*(reduce(Nuisance.joined, kind) for kind in common), reduce(Nuisance.and_also, smooth)]


def _moves(moved: MovedFlange) -> list[Nuisance]:
    joints, arm = moved.some_joints, moved.kinematics
    if joints is None or arm is None:
        raise ValueError("the arm's kinematics are not known, or do not reach its poses")
    bent = Bent("", arm, joints, moved.deviation, np.zeros(arm.n), moved.link)
    return [moved.nuisance(kind, 1.0) for kind in (bent.twists, *bent.others)]
