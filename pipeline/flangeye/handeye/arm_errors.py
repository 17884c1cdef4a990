"""What an arm may be off by, as large as residuals show it, in the covariance of one loop.

As for a cell's arms (``cell_arms``): zeros of joints, encoders, sag, lengths, twists, and what is
smooth over the workspace. They move neighbouring poses alike, so that the answer follows them where
independent noise would average out. ("Consider" covariance, Schmidt 1966.)
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from flangeye.handeye.arm import MovedFlange
from flangeye.handeye.arm_sizes import Sizes, likely_sizes
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
    kinds = _kinds(flange)
    fit, ends = _fitted(model, flange, kinds)
    kept, p = fit.inliers, fit.basis.shape[1] - ends[-1]
    w = _roots(fit.weights[kept])
    told = w @ fit.linear.jacobian[kept] @ fit.basis
    rows, effects = told[:, :, :p], np.split(told[:, :, p:], ends[:-1], axis=2)
    errors = (w @ fit.linear.residuals[kept][..., None])[..., 0]
    measured = np.trace(model.problem.measurements.projectors[kept], axis1=1, axis2=2).sum()
    sizes = likely_sizes(rows, effects, errors, float(measured), WORSE, one_each=True)
    known: Floats = np.asarray(np.linalg.inv(fit.information[:p, :p]), dtype=np.float64)
    followed = [known @ np.einsum("nij,nik->jk", rows, kind) for kind in effects]
    mixed = sizes.mixed([inflation * known, *(kind @ kind.T for kind in followed)])
    basis = fit.basis[:18, :p]
    return np.asarray(basis @ mixed @ basis.T), sizes


def _kinds(flange: MovedFlange) -> list[Floats]:
    """Return what errors of each kind, as large as the robot's file says, do to the flange."""
    joints = flange.some_joints
    if joints is None or flange.kinematics is None:
        raise ValueError("the arm's kinematics are not known, or do not reach its poses")
    arm = Bent("", flange.kinematics, joints, flange.deviation, np.zeros(flange.kinematics.n))
    return [arm.twists, *arm.others]


def _fitted(
    model: Model, flange: MovedFlange, kinds: list[Floats]
) -> tuple[Solution, NDArray[np.intp]]:
    """Return the fit with errors of the kinds beside its unknowns, and where each kind ends."""
    bare = replace(model.problem, nuisance=model.problem.nuisance.without_sized())
    moves = flange.nuisance(np.concatenate(kinds, axis=2), 1.0)
    return weighed_with(bare, model.found, moves), np.cumsum([kind.shape[2] for kind in kinds])


def _roots(weights: Floats) -> Floats:
    """Return (N, 6, 6) W with W^T W the weights, which may be singular."""
    values, axes = np.linalg.eigh(weights)
    return np.asarray(np.sqrt(np.maximum(values, 0.0))[..., None] * np.swapaxes(axes, 1, 2))
