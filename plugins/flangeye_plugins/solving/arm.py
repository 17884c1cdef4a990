"""Errors of the arm itself: found when the poses show them, kept when they help on others."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from flangeye.correction import follow
from flangeye.kinematics import Arm
from flangeye.statistics import f_quantile
from flangeye.types import ArmCorrection, Observation
from flangeye_plugins.solving.evidence import Evidence, Nuisance, tool_offset
from flangeye_plugins.solving.model import Agree, Model, agreed, better, information_with, rms

Floats = NDArray[np.float64]

SIGNIFICANT = 0.9999
OBSERVABLE = 0.5e-3
"""An offset that would be known less well than this [m] is not estimated."""
LARGEST_MODEL_ERROR = 5e-3
"""Further from the controller's poses than this [m], the catalogue's arm is another one."""


def with_tool_offset(model: Model, agree: Agree, zeros: Nuisance | None = None) -> Model:
    """Estimate an offset of the seen circle in the flange frame, if the poses can show it.

    It shows when the flange turns between poses; with constant orientation it moves all centres
    alike, as the camera's position does. Joint zeros that are off bend the arm's space, and part
    of that looks like an offset of a millimetre: it has to be larger than they explain.

    Args:
        model: What was found without.
        agree: The robust fit.
        zeros: What the arm's joint zeros may be off by, where that is known; see :func:`zeros_of`.
    """
    offset = tool_offset(model.evidence.flanges)
    others = model.nuisance if zeros is None else model.nuisance.and_also(zeros)
    covariance = _covariance_of_last(model, others.and_also(offset), 3)
    known = float(np.sqrt(np.linalg.eigvalsh(covariance)[-1]))
    if known > OBSERVABLE:
        return model.noted(_not_told_apart(known, model.evidence))
    candidate = agreed(replace(model, nuisance=model.nuisance.and_also(offset)), agree)
    if candidate is None:
        return model
    fit = candidate.found.fit
    values = fit.nuisance[-3:]
    if not _significant(values, covariance, fit.freedom):
        return model
    listed = ", ".join(f"{value * 1e3:.3f}" for value in values)
    what = f"the seen circle is ({listed}) mm from the origin of the flange frame, in it"
    return better(model, replace(candidate, correction=ArmCorrection(values)), agree, what)


def with_joint_offsets(
    model: Model, agree: Agree, observations: Sequence[Observation], arm: Arm, prior: float
) -> Model:
    """Estimate offsets of the arm's joints together with the pose, if that helps.

    Those of the first and of the last joint do not show: one turns the base with the camera, the
    other the flange about its own axis. Where no joint angles are known, every branch of the
    inverse kinematics is tried and the one that fits best is taken.

    Args:
        model: What was found without.
        agree: The robust fit.
        observations: The N poses.
        arm: The kinematics.
        prior: Standard deviation of an offset expected beforehand [rad].
    """
    fitted = [
        _with_offsets(model, agree, arm, joints, prior)
        for joints in joint_angles(observations, arm)
    ]
    candidates = [candidate for candidate in fitted if candidate is not None]
    if not candidates:
        return model.noted("joint offsets left out: the arm's model does not reach these poses")
    kept = model.found.inliers
    best = min(candidates, key=lambda candidate: rms(candidate.residuals()[kept]))
    offsets = np.zeros(arm.n) if best.correction is None else best.correction.joint_offsets
    listed = ", ".join(f"{offset * 1e3:.2f}" for offset in np.asarray(offsets))
    what = f"the joints are off by ({listed}) mrad; the matrix holds for the arm so corrected"
    return better(model, best, agree, what)


def joint_angles(observations: Sequence[Observation], arm: Arm) -> Iterator[Floats]:
    """Give the (N, n) joint angles [rad], on each branch they may be on."""
    poses = np.array([o.base_T_flange.matrix for o in observations])
    given = [o.joints for o in observations if o.joints is not None and len(o.joints) == arm.n]
    if len(given) == len(observations):
        joints = np.array(given)
        apart = np.linalg.norm((arm.flange(joints) - poses)[:, :3, 3], axis=1).max()
        if apart < LARGEST_MODEL_ERROR:
            yield joints
        return
    for first in arm.inverse(poses[0], starts=96):
        with suppress(ValueError):  # this branch does not reach all poses
            yield follow(arm, poses, first)


def zeros_of(
    evidence: Evidence, observations: Sequence[Observation], arm: Arm, deviation: float
) -> Nuisance | None:
    """Return what joint zeros do to each pose; None when the arm's model does not reach them.

    The first joint's zero is right by definition: it fixes the base's x axis.

    Args:
        evidence: The N poses.
        observations: The same.
        arm: The kinematics.
        deviation: Standard deviation of a joint's zero [rad].
    """
    joints = next(joint_angles(observations, arm), None)
    if joints is None:
        return None
    moves, turns = _effects(arm.jacobian(joints)[:, :, 1:], evidence.levers)
    return Nuisance(moves, turns, np.full(arm.n - 1, deviation), np.zeros(arm.n - 1))


def unknown_zeros(
    model: Model, observations: Sequence[Observation], arm: Arm, deviation: float
) -> Floats | None:
    """Return what unknown joint zeros add to the (6, 6) covariance of the pose.

    None when the arm's model does not reach the poses.

    They move neighbouring poses alike, so that the answer follows them where independent noise
    would average out; residuals do not show that. ("Consider" covariance, Schmidt 1966.)

    Args:
        model: What the poses agree on.
        observations: The N poses.
        arm: The kinematics.
        deviation: Standard deviation of a joint's zero [rad].
    """
    zeros = zeros_of(model.evidence, observations, arm, np.inf)
    if zeros is None:
        return None
    k, information = arm.n - 1, information_with(model, model.nuisance.and_also(zeros))
    followed = np.linalg.solve(information[:-k, :-k], information[:-k, -k:])[:6]
    return np.asarray(deviation**2 * followed @ followed.T)


def _with_offsets(
    model: Model, agree: Agree, arm: Arm, joints: Floats, prior: float
) -> Model | None:
    """Fit with offsets linearised about none, then about those found; None if it is refused."""
    k, offsets, fitted = arm.n - 2, np.zeros(arm.n), model
    for _ in range(2):
        candidate = agreed(_about(model, arm, joints, offsets, prior), agree)
        if candidate is None:
            return None
        fitted, values = candidate, candidate.found.fit.nuisance
        offsets = offsets + np.pad(values[-k:], 1)
    tool = np.zeros(3) if model.correction is None else fitted.found.fit.nuisance[-k - 3 : -k]
    return replace(fitted, correction=ArmCorrection(tool, offsets, joints[0]))


def _about(model: Model, arm: Arm, joints: Floats, offsets: Floats, prior: float) -> Model:
    """Return the model with the arm moved by ``offsets``, and what remains of them as nuisances."""
    evidence, k = model.evidence, arm.n - 2
    move = np.linalg.inv(arm.flange(joints)) @ arm.flange(joints + offsets)
    flanges = evidence.flanges @ move[:, :3, :3]
    turned = flanges @ evidence.flanges.transpose(0, 2, 1)
    levers = (turned @ evidence.levers[:, :, None])[..., 0]
    origins = evidence.tcps - evidence.levers + (evidence.flanges @ move[:, :3, 3, None])[..., 0]
    moved = replace(evidence, tcps=origins + levers, flanges=flanges, levers=levers)
    moves, turns = _effects(arm.jacobian(joints + offsets)[:, :, 1:-1], levers)
    remainder = Nuisance(moves, turns, np.full(k, prior), -offsets[1:-1])
    return replace(model, evidence=moved, nuisance=model.nuisance.and_also(remainder))


def _effects(jacobian: Floats, levers: Floats) -> tuple[Floats, Floats]:
    """Return how joints move a point off the flange's origin and turn it, both (N, 3, k)."""
    turns = jacobian[:, :3]
    return jacobian[:, 3:] + np.cross(turns, levers[:, :, None], axis=1), turns


def _covariance_of_last(model: Model, nuisance: Nuisance, k: int) -> Floats:
    """Return the (k, k) covariance that the last k of the nuisances would have."""
    information = information_with(model, nuisance)
    rest, cross = information[:-k, :-k], information[:-k, -k:]
    own = information[-k:, -k:] - cross.T @ np.linalg.solve(rest, cross)
    values, vectors = np.linalg.eigh(own)
    return np.asarray(vectors / np.maximum(values, 1e-12) @ vectors.T)


def _significant(values: Floats, covariance: Floats, freedom: float) -> bool:
    square = float(values @ np.linalg.solve(covariance, values)) / len(values)
    return square > f_quantile(SIGNIFICANT, len(values), freedom)


def _not_told_apart(known: float, evidence: Evidence) -> str:
    cosines = (np.einsum("nij,mij->nm", evidence.flanges, evidence.flanges) - 1) / 2
    turn = np.degrees(np.arccos(np.clip(cosines.min(), -1, 1)))
    how = f"would be known to {known * 1e3:.1f} mm only" if known < 0.1 else "does not show"
    return (
        "a constant offset of the seen circle in the flange frame (tool frame, bias of the fit) "
        f"{how}, for orientations differ by {turn:.1f} deg at most: it stays in the camera's place"
    )
