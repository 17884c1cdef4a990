"""The errors of a cell's arms: what they add to the covariance, and the answer for corrected arms.

They move neighbouring poses alike, so that the answer for the arms as reported follows them where
independent noise would average out, as one camera does (:mod:`flangeye.handeye.arm_errors`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import reduce

import numpy as np

from flangeye.handeye.arm import MovedFlange
from flangeye.handeye.arm_errors import sizes_of, with_errors
from flangeye.handeye.arm_sizes import Sizes
from flangeye.handeye.bent import Bent, BentArm
from flangeye.handeye.candidates import held_out, judged, rms
from flangeye.handeye.graph import GraphProblem, Solved, solved_of
from flangeye.handeye.likelihood import Solution, agreeing
from flangeye.handeye.nuisance import Nuisance, nuisance_seen
from flangeye.maths.kinematics import Arm
from flangeye.models.cell import Axis, Cell
from flangeye.models.robots import RobotModel
from flangeye.types import ArmCorrection, Floats

STEPS = 3
"""Of Gauss and Newton for joint zeros; each squares the error of the one before."""


@dataclass(frozen=True, eq=False)
class CorrectedArms:
    """The answer for arms corrected.

    Attributes:
        found: The unknowns, and their covariances.
        arms: The arms.
    """

    found: Solved
    arms: Sequence[BentArm]

    @property
    def corrections(self) -> dict[str, ArmCorrection]:
        """What to correct, by arm."""
        tool = np.zeros(3)
        return {arm.name: ArmCorrection(tool, arm.offsets, arm.joints[0]) for arm in self.arms}


def branches_of(
    problem: GraphProblem, cell: Cell, joints: Mapping[str, Floats]
) -> list[list[BentArm]]:
    """Return each arm whose model reaches its poses, with its joints, or those of every branch.

    Args:
        problem: The sightings, with the arms' poses.
        cell: What stands on what.
        joints: (N, n) of the arms that told them, by frame [rad].
    """
    arms = {name: mover for name, mover in cell.movers.items() if not isinstance(mover, Axis)}
    return [
        found
        for name, model in arms.items()
        if (found := _branches(name, model, problem, cell, joints.get(name)))
    ]


def _branches(
    name: str, model: RobotModel, problem: GraphProblem, cell: Cell, joints: Floats | None
) -> list[BentArm]:
    arm, place = Arm(model), np.asarray(problem.frames[name].place)
    parts = {name: None} | {n: link.number for n, link in cell.links.items() if link.arm == name}
    return [
        BentArm([
            Bent(frame, arm, each, model.joint_accuracy, np.zeros(arm.n), link)
            for frame, link in parts.items()
        ])
        for each in MovedFlange(place, joints, False, arm).branches()
    ]  # fmt: skip


def likeliest(found: Solved, branches: Sequence[Sequence[BentArm]]) -> list[BentArm]:
    """Return each arm on the branch whose zeros make the residuals likeliest."""
    chosen = [arms[0] for arms in branches]
    for i, arms in enumerate(branches):
        tried = [[*chosen[:i], arm, *chosen[i + 1 :]] for arm in arms]
        chosen = max(tried, key=lambda arms: _gain(found, arms)) if len(tried) > 1 else tried[0]
    return chosen


def _gain(found: Solved, arms: Sequence[BentArm]) -> float:
    problem, fit = found.problem, found.found
    return sizes_of(problem, fit, [_zeros(problem, fit, arms)]).gain


def considering_errors(
    found: Solved, branches: Sequence[Sequence[BentArm]]
) -> tuple[Solved, Sizes | None]:
    """Return the solution with what its arms may be off by in its covariance, and how much it is.

    The sizes are in units of what the robots' files say: of joint zeros, then of each of
    :data:`flangeye.handeye.bent.KINDS`. None without an arm.
    """
    if not branches:
        return found, None
    kinds = _kinds(found.problem, found.found, likeliest(found, branches))
    joint, sizes = with_errors(found.problem, found.found, kinds, found.inflation)
    # What was considered before stays: noise that moments share, and clocks.
    return found.with_joint(joint + found.joint - found.own), sizes


def correcting_zeros(
    found: Solved, branches: Sequence[Sequence[BentArm]], sizes: Sizes
) -> tuple[CorrectedArms | None, str]:
    """Return the answer for corrected arms if it helps on sightings held out, and what to say.

    Args:
        found: The answer for the arms as reported.
        branches: Of each arm, as its controller has it on every branch.
        sizes: Of the arms' errors, in units of what the robots' files say.
    """
    size = float(sizes.expected[0])
    begun = likeliest(found, branches)
    corrected = _corrected(found, begun, size)
    # What noise is left without the zeros tells branches apart that looked alike before.
    noise = corrected.found.found.noise
    quieter = likeliest(replace(found, found=replace(found.found, noise=noise)), branches)
    if any(a is not b for a, b in zip(begun, quieter, strict=True)):
        corrected = _corrected(found, quieter, size)
    fits = found.found, corrected.found.found
    either = fits[0].inliers | fits[1].inliers
    before, after = (rms(held_out(fit)[0][either]) for fit in fits)
    helps, told = judged(before, after, _told(corrected.arms))
    return (_considering(corrected) if helps else None), told


def _corrected(found: Solved, arms: Sequence[BentArm], size: float) -> CorrectedArms:
    """Return the answer with the arms' zeros found, each step about those before."""
    problem, fit = found.problem, found.found
    for _ in range(STEPS):
        problem = _with_zeros(found.problem, fit, arms, size)
        fit = agreeing(problem, fit)
        arms = _stepped(arms, fit)
    return CorrectedArms(solved_of(problem, fit), arms)


def _with_zeros(
    problem: GraphProblem, fit: Solution, arms: Sequence[BentArm], size: float
) -> GraphProblem:
    """Return the problem with arms where their offsets put them, and what is left as nuisances."""
    poses = {name: places for arm in arms for name, places in arm.poses.items()}
    frames = {n: replace(f, place=poses.get(n, f.place)) for n, f in problem.frames.items()}
    moved = replace(problem, frames=frames)
    so_far = np.concatenate([arm.offsets[1:] / arm.deviation for arm in arms])
    left = replace(_zeros(moved, fit, arms), mean=-so_far, prior=np.full(len(so_far), size))
    return moved.beside(left)


def _stepped(arms: Sequence[BentArm], fit: Solution) -> list[BentArm]:
    """Return the arms with the offsets that a fit found of them."""
    counts = [arm.twists.shape[2] for arm in arms]
    values = np.split(fit.at.nuisance[-sum(counts) :], np.cumsum(counts)[:-1])
    return [arm.moved(x) for arm, x in zip(arms, values, strict=True)]


def _considering(corrected: CorrectedArms) -> CorrectedArms:
    """Return the same with what is still unknown of the arms in its covariance."""
    found = corrected.found
    kinds = _kinds(found.problem, found.found, corrected.arms)
    joint, _ = with_errors(found.problem, found.found, kinds, found.inflation)
    return replace(corrected, found=found.with_joint(joint + found.shared))


def _zeros(problem: GraphProblem, fit: Solution, arms: Sequence[BentArm]) -> Nuisance:
    return _seen(problem, fit, arms, [arm.twists for arm in arms])


def _kinds(problem: GraphProblem, fit: Solution, arms: Sequence[BentArm]) -> list[Nuisance]:
    """Return the errors of each kind, as large as the robots' files say: zeros', then others'."""
    others = zip(*(arm.others for arm in arms), strict=True)
    return [_zeros(problem, fit, arms), *(_seen(problem, fit, arms, kind) for kind in others)]


def _seen(
    problem: GraphProblem, fit: Solution, arms: Sequence[BentArm], twists: Sequence[Floats]
) -> Nuisance:
    """Return what (M, 6 F, k) twists of what each arm moves, at all times, do to what is seen."""
    moves = [problem.effects(fit.at, [*arm.poses])[1] for arm in arms]
    times = problem.measurements.times
    each = (by @ twist[times] for by, twist in zip(moves, twists, strict=True))
    return reduce(Nuisance.and_also, (nuisance_seen(effect, 1.0) for effect in each))


def _told(arms: Sequence[BentArm]) -> str:
    listed = (
        f"{arm.name} are off by ({', '.join(f'{x * 1e3:.2f}' for x in arm.offsets)}) mrad"
        for arm in arms
    )
    return f"the joints of {', of '.join(listed)}; the second answer is for them so corrected"
