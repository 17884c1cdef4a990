"""Errors of the arm itself: found when the poses show them, kept when they help on others."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from flangeye.handeye.candidates import (
    Model,
    better,
    considered,
    held_out,
    rms,
    weighed_with,
    with_nuisance,
)
from flangeye.handeye.nuisance import Nuisance, nuisance_of
from flangeye.maths.arm_correction import follow
from flangeye.maths.geometry import rotation_log
from flangeye.maths.kinematics import Arm
from flangeye.maths.smooth_field import effects, field_over
from flangeye.maths.statistics import f_quantile
from flangeye.types import ArmCorrection, Floats

SIGNIFICANT = 0.9999
OBSERVABLE = 0.5e-3
"""An offset that would be known less well than this [m] is not estimated."""
LARGEST_MODEL_ERROR = 5e-3
"""Further from the controller's poses than this [m], the catalogue's arm is another one."""
FEWEST_FOR_FIELD = 12
"""Poses below which a field is not looked for: its folds would hold too few to compare."""


@dataclass(frozen=True, eq=False)
class MovedFlange:
    """The arm whose flange, or a link of which, carries one end of the loop.

    Attributes:
        poses: (N, 4, 4) base_T_flange as reported, or that of the link by its joints.
        joints: (N, n) as reported [rad], or None.
        carries_camera: Whether it carries the camera, else the target.
        kinematics: The arm's, where its model is known.
        deviation: Standard deviation of a joint's zero [rad], by the robot's file.
        link: Which link it is; None for the flange.
    """

    poses: Floats
    joints: Floats | None
    carries_camera: bool
    kinematics: Arm | None = None
    deviation: float = 0.0
    link: int | None = None

    def nuisance(self, twists: Floats, deviation: float, sized: bool = False) -> Nuisance:
        """Return numbers that move the flange by (N, 6, k) twists, in ``base`` at its origin."""
        turned = np.swapaxes(self.poses[:, :3, :3], 1, 2)
        moves = np.concatenate([turned @ twists[:, :3], turned @ twists[:, 3:]], axis=1)
        still = np.zeros_like(moves)
        pair = (moves, still) if self.carries_camera else (still, moves)
        return nuisance_of(*pair, deviation, sized)

    def branches(self, starts: int = 96) -> Iterator[Floats]:
        """Give the (N, n) joint angles [rad], on each branch they may be on.

        Args:
            starts: Number of starts of the search for branches; few find one, many all.
        """
        arm = self.kinematics
        if arm is None:
            return
        if self.joints is not None:
            reached = arm.pose(self.joints, self.link)
            apart = np.linalg.norm((reached - self.poses)[:, :3, 3], axis=1).max()
            if apart < LARGEST_MODEL_ERROR:
                yield self.joints
            return
        for first in arm.inverse(self.poses[0], starts):
            with suppress(ValueError):  # this branch does not reach all poses
                yield follow(arm, self.poses, first)

    @cached_property
    def some_joints(self) -> Floats | None:
        """(N, n) joint angles [rad] on one branch; None where the model reaches no pose."""
        return next(self.branches(starts=12), None)

    def zeros(self, deviation: float, sized: bool = False) -> Nuisance | None:
        """Return what joint zeros do; None when the arm's model does not reach the poses.

        The first joint's zero is right by definition: it fixes the base's x axis.
        """
        joints = self.some_joints
        if joints is None or self.kinematics is None:
            return None
        return self.nuisance(self.kinematics.jacobian(joints)[:, :, 1:], deviation, sized)


def with_field(model: Model, flange: MovedFlange) -> Model:
    """Estimate a smooth error of the arm over the workspace, if that helps.

    Its size is found with it. It is without a rigid part, so the camera's pose stays the best for
    the arm as reported; where joint offsets are corrected, it is what these leave.
    """
    if int(model.found.inliers.sum()) < FEWEST_FOR_FIELD:
        return model
    begun = [model] if model.found.inliers.all() else [model, _with_all(model)]
    fitted = [each for start in begun if (each := _with_field_from(start, flange))]
    if not fitted:
        return model
    kept = np.any([each.found.inliers for each in (model, *(m for m, _ in fitted))], axis=0)
    best, size = min(fitted, key=lambda each: rms(held_out(each[0].found)[0][kept]))
    what = f"the arm is off by a smooth error over the workspace, {size * 1e3:.3f} mm rms"
    chosen = better(model, best, what)
    return model if chosen.found is model.found else chosen


def _with_all(model: Model) -> Model:
    """Return the model with every measurement in it: a smooth error may have set some aside."""
    found = replace(model.found, inliers=np.ones_like(model.found.inliers))
    return replace(model, consensus=replace(model.consensus, found=found))


def _with_field_from(model: Model, flange: MovedFlange) -> tuple[Model, float] | None:
    """Return the model with a smooth error, begun with those that agree, and its rms [m]."""
    places = flange.poses[:, :3, 3]
    field = field_over(places[model.found.inliers])
    moves = effects(field, places)
    twists = np.concatenate([np.zeros_like(moves), moves], axis=1)
    candidate = with_nuisance(model, flange.nuisance(twists, 1.0, sized=True))
    if candidate is None:
        return None
    k, found = len(field.weights), candidate.found
    field = replace(
        field,
        weights=found.at.nuisance[-k:],
        covariance=found.covariance[-k:, -k:],
        size=found.noise.size,
    )
    correction = replace(_refitted(model, candidate), field=field)
    size = rms(moves[found.inliers] @ field.weights)
    return replace(candidate, correction=correction), size


def _refitted(model: Model, candidate: Model) -> ArmCorrection:
    """Return the model's correction with what a candidate with further errors has of it."""
    before, own = model.correction, model.found.at.nuisance
    if before is None:
        return ArmCorrection(np.zeros(3))
    change = candidate.found.at.nuisance[: len(own)] - own
    of_joints, tool = np.zeros(0), before.tool_offset
    if before.joint_offsets is not None:
        change, of_joints = np.split(change, [len(own) - len(before.joint_offsets) + 2])
    if tool.any():
        tool = tool + change[-3:]
    if before.joint_offsets is None:
        return replace(before, tool_offset=tool)
    offsets = before.joint_offsets + np.pad(of_joints, 1)
    return replace(before, tool_offset=tool, joint_offsets=offsets)


def with_tool_offset(model: Model, flange: MovedFlange) -> Model:
    """Estimate an offset of the seen circle in the flange frame, if the poses can show it.

    It shows when the flange turns between poses; with constant orientation it moves all centres
    alike, as the camera's position does. Joint zeros that are off bend the arm's space, and part
    of that looks like an offset of a millimetre: it has to be larger than they explain.
    """
    moves = np.zeros((len(flange.poses), 6, 3))
    moves[:, 3:] = np.eye(3)
    offset = nuisance_of(np.zeros_like(moves), moves, np.inf)
    for with_zeros in (False, True):
        zeros = flange.zeros(flange.deviation) if with_zeros and flange.deviation else None
        others = offset if zeros is None else zeros.and_also(offset)
        covariance = _covariance_of_last(model, others, 3)
        known = float(np.sqrt(np.linalg.eigvalsh(covariance)[-1]))
        if known > OBSERVABLE:
            return model.noted(_not_told_apart(known, flange.poses[:, :3, :3]))
    candidate = with_nuisance(model, offset)
    if candidate is None:
        return model
    values = candidate.found.at.nuisance[-3:]
    if not _significant(values, covariance, candidate.found.freedom):
        return model
    listed = ", ".join(f"{value * 1e3:.3f}" for value in values)
    what = f"the seen circle is ({listed}) mm from the origin of the flange frame, in it"
    return better(model, replace(candidate, correction=ArmCorrection(values)), what)


def with_joint_offsets(model: Model, flange: MovedFlange, prior: float) -> Model:
    """Estimate offsets of the arm's joints together with the pose, if that helps.

    Those of the first and of the last joint do not show: one turns the base with the camera, the
    other the flange about its own axis. Where no joint angles are known, every branch of the
    inverse kinematics is tried and the one that fits best is taken.

    Args:
        model: What was found without.
        flange: The arm.
        prior: Standard deviation of an offset expected beforehand [rad].
    """
    fitted = [_with_offsets(model, flange, joints, prior) for joints in flange.branches()]
    candidates = [candidate for candidate in fitted if candidate is not None]
    if not candidates:
        return model.noted("joint offsets left out: the arm's model does not reach these poses")
    kept = model.found.inliers
    best = min(candidates, key=lambda candidate: rms(candidate.residuals()[kept]))
    offsets = None if best.correction is None else best.correction.joint_offsets
    listed = ", ".join(f"{offset * 1e3:.2f}" for offset in np.asarray(offsets))
    what = f"the joints are off by ({listed}) mrad; the matrix holds for the arm so corrected"
    return better(model, best, what)


def unknown_zeros(model: Model, flange: MovedFlange) -> Floats:
    """Return what unknown joint zeros add to the (18, 18) covariance of the transforms.

    Nothing when the arm's model does not reach the poses.
    """
    zeros = flange.zeros(flange.deviation)
    return np.zeros((18, 18)) if zeros is None else considered(model, zeros)


def _with_offsets(model: Model, flange: MovedFlange, joints: Floats, prior: float) -> Model | None:
    """Fit with offsets linearised about none, then about those found; None if it is refused."""
    if flange.kinematics is None:
        return None
    k, offsets, fitted = flange.kinematics.n - 2, np.zeros(flange.kinematics.n), model
    for _ in range(2):
        candidate = _about(model, flange, joints, offsets, prior)
        if candidate is None:
            return None
        fitted, values = candidate, candidate.found.at.nuisance
        offsets = offsets + np.pad(values[-k:], 1)
    tool = np.zeros(3) if model.correction is None else fitted.found.at.nuisance[-k - 3 : -k]
    return replace(fitted, correction=ArmCorrection(tool, offsets, joints[0]))


def _about(
    model: Model, flange: MovedFlange, joints: Floats, offsets: Floats, prior: float
) -> Model | None:
    """Return the model with the arm moved by ``offsets``, and what remains of them as nuisances."""
    arm, s = flange.kinematics, model.problem.measurements
    if arm is None:
        return None
    move = np.linalg.inv(arm.flange(joints)) @ arm.flange(joints + offsets)
    moved = replace(flange, poses=flange.poses @ move)
    s = replace(s, a=s.a @ move) if flange.carries_camera else replace(s, b=s.b @ move)
    remainder = moved.nuisance(arm.jacobian(joints + offsets)[:, :, 1:-1], prior)
    remainder = replace(remainder, mean=-offsets[1:-1])
    return with_nuisance(replace(model, consensus=replace(
        model.consensus, problem=replace(model.problem, measurements=s))), remainder)  # fmt: skip


def _covariance_of_last(model: Model, nuisance: Nuisance, k: int) -> Floats:
    """Return the (k, k) covariance that the last k of the nuisances would have."""
    information = weighed_with(model.problem, model.found, nuisance).information
    rest, cross = information[:-k, :-k], information[:-k, -k:]
    own = information[-k:, -k:] - cross.T @ np.linalg.solve(rest, cross)
    values, vectors = np.linalg.eigh(own)
    return np.asarray(vectors / np.maximum(values, 1e-12) @ vectors.T)


def _significant(values: Floats, covariance: Floats, freedom: float) -> bool:
    square = float(values @ np.linalg.solve(covariance, values)) / len(values)
    return square > f_quantile(SIGNIFICANT, len(values), freedom)


def _not_told_apart(known: float, turns: Floats) -> str:
    between = rotation_log(turns[:, None] @ np.swapaxes(turns, 1, 2))
    turn = np.degrees(np.linalg.norm(between, axis=2).max())
    how = f"would be known to {known * 1e3:.1f} mm only" if known < 0.1 else "does not show"
    return (
        "a constant offset of the seen circle in the flange frame (tool frame, bias of the fit) "
        f"{how}, for orientations differ by {turn:.1f} deg at most: it stays in the camera's place"
    )
