"""What an arm may be off by, as large as residuals show it, in the covariance of one loop.

As for a cell's arms (``cell_arms``): zeros of joints, encoders, sag, lengths, twists, and what is
smooth over the workspace. They move neighbouring poses alike, so that the answer follows them where
independent noise would average out. ("Consider" covariance, Schmidt 1966.)
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import reduce
from itertools import chain

import numpy as np

from flangeye.handeye.arm import MovedFlange
from flangeye.handeye.arm_sizes import Sizes, sizes_told
from flangeye.handeye.bent import Bent
from flangeye.handeye.candidates import Model, following, weighed_with
from flangeye.handeye.likelihood import Problem, Solution
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
    own = inflation * model.found.covariance[:18, :18]
    return with_errors(model.problem, model.found, _kinds(arms), own)


def with_errors(
    problem: Problem, found: Solution, kinds: Sequence[Nuisance], own: Floats
) -> tuple[Floats, Sizes]:
    """Return the (6 K, 6 K) covariance of the places with errors of some kinds in it, and sizes.

    Args:
        problem: What was given.
        found: Its fit without them.
        kinds: The errors of each kind, as large as was said.
        own: (6 K, 6 K) covariance of the fit itself.
    """
    sizes = sizes_of(problem, found, kinds)
    moved = following(problem, found, reduce(Nuisance.and_also, kinds))[: len(own)]
    each = np.split(moved, np.cumsum([len(kind) for kind in kinds])[:-1], axis=1)
    return sizes.mixed([own, *(followed @ followed.T for followed in each)]), sizes


def last_unknown_by_arms(model: Model, arms: Arms) -> float:
    """Return the standard deviation that the arms' errors give the last of the model's nuisances.

    Args:
        model: What was found for the arm as reported, that nuisance with it.
        arms: As in :func:`evidence`; where they are not known, it is 0.
    """
    if _unknown(arms):
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
    return 0.0 if _unknown(arms) else sizes_of(model.problem, model.found, _kinds(arms)).gain


def _unknown(arms: Arms) -> bool:
    return any(moved.kinematics is None or moved.some_joints is None for moved in chain(*arms))


def sizes_of(problem: Problem, found: Solution, kinds: Sequence[Nuisance]) -> Sizes:
    """Return how large errors of some kinds are, by a fit in which each is as large as was said.

    Of the fit's information and slope, so that what walked has been taken out as well. A smooth
    error that was found is none of it: it would explain what the arm's do.
    """
    bare = replace(problem, nuisance=problem.nuisance.without_sized())
    fit = weighed_with(bare, found, reduce(Nuisance.and_also, kinds))
    counts = [len(kind) for kind in kinds]
    p = fit.basis.shape[1] - sum(counts)
    known, across = np.linalg.inv(fit.information[:p, :p]), fit.information[:p, p:]
    along = fit.slope[p:] - across.T @ known @ fit.slope[:p]
    left = fit.cost - fit.slope[:p] @ known @ fit.slope[:p]
    expected = np.eye(sum(counts))
    effects = fit.information[p:, p:] - expected - across.T @ known @ across
    gram = np.block([[effects, along[:, None]], [along, left]])
    measured = np.trace(problem.measurements.projectors[fit.inliers], axis1=1, axis2=2).sum()
    return sizes_told(gram, counts, float(measured) - p)


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
