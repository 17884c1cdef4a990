"""What an arm may be off by, as large as residuals show it, in the covariance of one loop.

As for a cell's arms (``cell_arms``): zeros of joints, encoders, sag, lengths, twists, and what is
smooth over the workspace. They move neighbouring poses alike, so that the answer follows them where
independent noise would average out. ("Consider" covariance, Schmidt 1966.)
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from flangeye.handeye.arm import MovedFlange
from flangeye.handeye.arm_sizes import Sizes, sizes_told
from flangeye.handeye.bent import Bent
from flangeye.handeye.candidates import Model, weighed_with
from flangeye.handeye.likelihood import Solution
from flangeye.types import Floats

WORSE = 1.2
"""Standard deviation of the logarithm of how much worse an arm is than its file says: one in three
is three times worse, one in twenty ten times. Where few poses tell, this does."""


def with_arm_errors(model: Model, flange: MovedFlange, inflation: float) -> tuple[Floats, Sizes]:
    """Return the (18, 18) covariance of the transforms with the arm's errors in it.

    With the sizes of these in units of what the robot's file says; see
    :class:`flangeye.handeye.arm_sizes.Sizes`.

    Args:
        model: What was found for the arm as reported.
        flange: The arm, of known kinematics that reach its poses.
        inflation: Factor on the covariance of the fit itself, for its noise was estimated.

    Raises:
        ValueError: The kinematics are not known, or do not reach the poses.
    """
    fit, counts = _fitted(model, flange)
    p = fit.basis.shape[1] - sum(counts)
    known: Floats = np.asarray(np.linalg.inv(fit.information[:p, :p]), dtype=np.float64)
    sizes = _sizes(model, fit, known, counts)
    each = np.split(known @ fit.information[:p, p:], np.cumsum(counts)[:-1], axis=1)
    mixed = sizes.mixed([inflation * known, *(followed @ followed.T for followed in each)])
    basis = fit.basis[:18, :p]
    return np.asarray(basis @ mixed @ basis.T), sizes


def evidence(model: Model, flange: MovedFlange) -> float:
    """Return twice by how much likelier residuals are with errors of the arm than without.

    Args:
        model: As in :func:`with_arm_errors`.
        flange: The arm; where its kinematics are not known, or do not reach its poses, it is 0.
    """
    if flange.some_joints is None or flange.kinematics is None:
        return 0.0
    fit, counts = _fitted(model, flange)
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


def _kinds(flange: MovedFlange) -> list[Floats]:
    """Return what errors of each kind, as large as the robot's file says, do to the flange."""
    joints = flange.some_joints
    if joints is None or flange.kinematics is None:
        raise ValueError("the arm's kinematics are not known, or do not reach its poses")
    arm = Bent("", flange.kinematics, joints, flange.deviation, np.zeros(flange.kinematics.n))
    return [arm.twists, *arm.others]


def _fitted(model: Model, flange: MovedFlange) -> tuple[Solution, list[int]]:
    """Return the fit with the arm's errors beside its unknowns, and how many each kind has."""
    kinds = _kinds(flange)
    bare = replace(model.problem, nuisance=model.problem.nuisance.without_sized())
    moves = flange.nuisance(np.concatenate(kinds, axis=2), 1.0)
    return weighed_with(bare, model.found, moves), [kind.shape[2] for kind in kinds]
