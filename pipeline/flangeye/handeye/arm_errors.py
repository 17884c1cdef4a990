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
from flangeye.handeye.candidates import Model, weighed_with
from flangeye.handeye.likelihood import Solution
from flangeye.handeye.nuisance import Nuisance
from flangeye.types import Floats

WORSE = 1.2
"""Standard deviation of the logarithm of how much worse an arm is than its file says: one in three
is three times worse, one in twenty ten times. Where few poses tell, this does."""


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
    fit, counts = _fitted(model, arms)
    p = fit.basis.shape[1] - sum(counts)
    known: Floats = np.asarray(np.linalg.inv(fit.information[:p, :p]), dtype=np.float64)
    sizes = _sizes(model, fit, known, counts)
    each = np.split(known @ fit.information[:p, p:], np.cumsum(counts)[:-1], axis=1)
    mixed = sizes.mixed([inflation * known, *(followed @ followed.T for followed in each)])
    basis = fit.basis[:18, :p]
    return np.asarray(basis @ mixed @ basis.T), sizes


def evidence(model: Model, arms: Arms) -> float:
    """Return twice by how much likelier residuals are with errors of the arms than without.

    Args:
        model: As in :func:`with_arm_errors`.
        arms: Those that move camera or target; where the kinematics of one are not known, or do
            not reach its poses, it is 0.
    """
    if any(moved.kinematics is None or moved.some_joints is None for moved in chain(*arms)):
        return 0.0
    fit, counts = _fitted(model, arms)
    p = fit.basis.shape[1] - sum(counts)
    return _sizes(model, fit, np.asarray(np.linalg.inv(fit.information[:p, :p])), counts).gain


def _sizes(model: Model, fit: Solution, known: Floats, counts: Sequence[int]) -> Sizes:
    """Return how large the arm's errors are, by a fit in which each is expected as the file says.

    Of the fit's information and slope, so that what walked has been taken out as well.
    """
    p, own = len(known), fit.information[len(known) :, len(known) :]
    across = fit.information[:p, p:]
    along = fit.slope[p:] - across.T @ known @ fit.slope[:p]
    left = fit.cost - fit.slope[:p] @ known @ fit.slope[:p]
    effects = own - np.eye(len(own)) - across.T @ known @ across  # less what is expected of each
    gram = np.block([[effects, along[:, None]], [along, left]])
    measured = np.trace(model.problem.measurements.projectors[fit.inliers], axis1=1, axis2=2).sum()
    return sizes_told(gram, counts, float(measured) - p, WORSE, one_each=True)


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


def _fitted(model: Model, arms: Arms) -> tuple[Solution, list[int]]:
    """Return the fit with the arms' errors beside its unknowns, and how many each kind has."""
    kinds = _kinds(arms)
    bare = replace(model.problem, nuisance=model.problem.nuisance.without_sized())
    moves = reduce(Nuisance.and_also, kinds)
    return weighed_with(bare, model.found, moves), [len(kind) for kind in kinds]
