"""The errors of a cell's arms: what they add to the covariance, and the answer for corrected arms.

They move neighbouring poses alike, so that the answer for the arms as reported follows them where
independent noise would average out. ("Consider" covariance, Schmidt 1966.)
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from flangeye.handeye.arm import MovedFlange
from flangeye.handeye.arm_sizes import Sizes, likely_sizes
from flangeye.handeye.bent import Bent, BentArm
from flangeye.handeye.candidates import Fit, by_folds, judged, rms
from flangeye.handeye.graph import Sighting, Solved, information_of, linear_of, solve_graph
from flangeye.maths.frame_graph import Frame
from flangeye.maths.kinematics import Arm
from flangeye.maths.statistics import covariance_inflation
from flangeye.models.cell import Axis, Cell
from flangeye.types import ArmCorrection, Floats, Mask

STEPS = 3
"""Of Gauss and Newton for joint zeros; each squares the error of the one before."""


@dataclass(frozen=True, eq=False)
class Sighted:
    """What was sighted of a cell.

    Attributes:
        frames: With the poses at the sightings' times.
        sightings: N of them.
        noise: (6, 6) covariance believed of what moves, by frame.
        limits: As for :func:`flangeye.handeye.graph.solve_graph`.
        freedoms: Likewise.
        joints: (N, n) of the arms that told them, by frame [rad].
    """

    frames: Mapping[str, Frame]
    sightings: Sequence[Sighting]
    noise: Mapping[str, Floats]
    limits: tuple[float, float]
    freedoms: Mapping[str, Floats] | None = None
    joints: Mapping[str, Floats] = field(default_factory=dict)

    def solved(self, start: Mapping[str, Floats] | None = None) -> Solved:
        """Return the unknowns."""
        graph = self.frames, self.sightings, self.noise, self.limits
        return solve_graph(*graph, start, self.freedoms)

    def with_arms(self, arms: Sequence[BentArm]) -> Sighted:
        """Return the same with the arms where their offsets put them."""
        poses = {name: places for arm in arms for name, places in arm.poses.items()}
        frames = {n: replace(f, place=poses.get(n, f.place)) for n, f in self.frames.items()}
        return replace(self, frames=frames)

    def linear(self, found: Solved, arms: Sequence[BentArm] = ()) -> Linear:
        """Return what the sightings tell of the unknowns, and of the arms' zeros."""
        noise = {name: found.movers * covariance for name, covariance in self.noise.items()}
        graph = self.frames, self.sightings, found.places, noise
        residuals, jacobian, whiteners = linear_of(*graph)
        moves = [(arm, linear_of(*graph, moved=[*arm.poses])[1]) for arm in arms]
        nothing = np.zeros((*residuals.shape, 0))
        zeros = np.concatenate([nothing, *(by @ arm.twists for arm, by in moves)], axis=2)
        kept = found.inliers
        freedom = sum(np.trace(s.projector) for s, k in zip(self.sightings, kept, strict=True) if k)
        return Linear(residuals, jacobian, zeros, moves, whiteners, kept, float(freedom))


@dataclass(frozen=True, eq=False)
class Linear:
    """Sightings, linear about an answer.

    Attributes:
        residuals: (N, 6).
        jacobian: (N, 6, P) by the unknowns.
        zeros: (N, 6, k) by the joint zeros, in units of their deviations.
        moves: Of each arm, (N, 6, 6 F) by turns and shifts of the F frames that it moves.
        whiteners: (N, 6, 6).
        kept: (N,) which count.
        freedom: How many numbers those are.
    """

    residuals: Floats
    jacobian: Floats
    zeros: Floats
    moves: Sequence[tuple[BentArm, Floats]]
    whiteners: Floats
    kept: Mask
    freedom: float

    @cached_property
    def others(self) -> list[Floats]:
        """(N, 6, m) by all else that is off in an arm, in such units, each kind by itself."""
        off = [[by @ kind for kind in arm.others] for arm, by in self.moves]
        return [np.concatenate(kind, axis=2) for kind in zip(*off, strict=True)]

    @property
    def whitened(self) -> tuple[Floats, Floats, Floats]:
        """Of those that count: rows of the unknowns, of the zeros, and errors (N, 6)."""
        w, kept = self.whiteners[self.kept], self.kept
        errors = (w @ self.residuals[kept][..., None])[..., 0]
        return w @ self.jacobian[kept], w @ self.zeros[kept], errors

    def following(self, covariance: Floats, errors: Floats) -> Floats:
        """Return (P, P) of the unknowns as they follow errors (N, 6, m) of unit size.

        Args:
            covariance: (q, q) of the first q of unknowns and zeros.
            errors: The errors.
        """
        rows, zeros, _ = self.whitened
        told = np.concatenate([rows, zeros], axis=2)[:, :, : len(covariance)]
        moved = self.whiteners[self.kept] @ errors[self.kept]
        followed = (covariance @ np.einsum("nij,nik->jk", told, moved))[: rows.shape[2]]
        return np.asarray(followed @ followed.T)

    def information(self, size: float) -> Floats:
        """Return (P + k, P + k) of the unknowns and of zeros expected to be of a size."""
        rows, zeros, _ = self.whitened
        p, k = rows.shape[2], zeros.shape[2]
        known = np.diag(np.repeat([0.0, size**-2], [p, k]))
        return information_of(np.concatenate([rows, zeros], axis=2)) + known

    def fit(self, size: float) -> Fit:
        """Return the fit that left the residuals, zeros of a size expected."""
        jacobian = np.concatenate([self.jacobian, self.zeros], axis=2)
        weights = self.whiteners @ self.whiteners
        return Fit(self.residuals, jacobian, weights, _inverse(self.information(size)), self.kept)


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


def branches_of(sighted: Sighted, cell: Cell) -> list[list[BentArm]]:
    """Return each arm whose model reaches its poses, with its joints, or those of every branch."""
    return [arms for name in cell.movers if (arms := _branches(name, sighted, cell))]


def likeliest(
    found: Solved, sighted: Sighted, branches: Sequence[Sequence[BentArm]]
) -> list[BentArm]:
    """Return each arm on the branch whose zeros explain most."""
    chosen = [arms[0] for arms in branches]
    size = float(_sizes(sighted.linear(found, chosen), zeros_alone=True).expected[0])
    for i, arms in enumerate(branches):
        tried = [[*chosen[:i], arm, *chosen[i + 1 :]] for arm in arms]
        chosen = max(tried, key=lambda arms: _explained(sighted.linear(found, arms), size))
    return chosen


def considering_zeros(
    found: Solved, sighted: Sighted, branches: Sequence[Sequence[BentArm]]
) -> tuple[Solved, Sizes | None]:
    """Return the solution with what its arms may be off by in its covariance, and how much it is.

    The sizes are in units of what the robots' files say: of joint zeros, then of each of
    :data:`flangeye.handeye.bent.KINDS`. None without an arm.
    """
    if not branches:
        return found, None
    linear = sighted.linear(found, likeliest(found, sighted, branches))
    sizes = _sizes(linear)
    off = [linear.following(found.joint, kind) for kind in (linear.zeros, *linear.others)]
    return found.with_joint(sizes.mixed([found.joint, *off])), sizes


def correcting_zeros(
    found: Solved, sighted: Sighted, branches: Sequence[Sequence[BentArm]], sizes: Sizes
) -> tuple[CorrectedArms | None, str]:
    """Return the answer for corrected arms if it helps on sightings held out, and what to say.

    Args:
        found: The answer for the arms as reported.
        sighted: What was sighted.
        branches: Of each arm, as its controller has it on every branch.
        sizes: Of the arms' errors, in units of what the robots' files say.
    """
    size = float(sizes.expected[0])
    begun = likeliest(found, sighted, branches)
    corrected, linear, arms = _corrected(found, sighted, begun, size)
    # What noise is left without the zeros tells branches apart that looked alike before.
    quieter = likeliest(replace(found, movers=corrected.movers), sighted, branches)
    if any(a is not b for a, b in zip(begun, quieter, strict=True)):
        corrected, linear, arms = _corrected(found, sighted, quieter, size)
    bare, either = sighted.linear(found), found.inliers | corrected.inliers
    before, after = (rms(by_folds(each.fit(size))[0][either]) for each in (bare, linear))
    helps, told = judged(before, after, _told(arms))
    return (CorrectedArms(_known(corrected, linear, sizes), arms) if helps else None), told


def _corrected(
    found: Solved, sighted: Sighted, arms: Sequence[BentArm], size: float
) -> tuple[Solved, Linear, Sequence[BentArm]]:
    linear = sighted.linear(found, arms)
    for _ in range(STEPS):
        arms = _stepped(linear, arms, size)
        moved = sighted.with_arms(arms)
        found = moved.solved(found.places)
        linear = moved.linear(found, arms)
    return found, linear, arms


def _branches(name: str, sighted: Sighted, cell: Cell) -> list[BentArm]:
    """Return an arm with its joints, or those of every branch; none of what is no arm."""
    mover = cell.movers[name]
    if isinstance(mover, Axis):
        return []
    arm = Arm(mover)
    place, joints = np.asarray(sighted.frames[name].place), sighted.joints.get(name)
    links = {n: link.number for n, link in cell.links.items() if link.arm == name}
    return [
        BentArm([
            Bent(frame, arm, each, mover.joint_accuracy, np.zeros(arm.n), link)
            for frame, link in ({name: None} | links).items()
        ])
        for each in MovedFlange(place, joints, False, arm).branches()
    ]  # fmt: skip


def _explained(linear: Linear, size: float) -> float:
    """Return how much of the squared errors the unknowns and zeros explain."""
    rows, zeros, errors = linear.whitened
    told = np.einsum("nij,ni->j", np.concatenate([rows, zeros], axis=2), errors)
    return float(told @ np.linalg.solve(linear.information(size), told))


def _stepped(linear: Linear, arms: Sequence[BentArm], size: float) -> list[BentArm]:
    """Return the arms with their offsets a step nearer to the likeliest."""
    rows, zeros, errors = linear.whitened
    told = np.einsum("nij,ni->j", np.concatenate([rows, zeros], axis=2), errors)
    so_far = np.concatenate([arm.offsets[1:] / arm.deviation for arm in arms])
    told[rows.shape[2] :] += so_far / size**2
    step = -np.linalg.solve(linear.information(size), told)[rows.shape[2] :]
    ends = np.cumsum([arm.twists.shape[2] for arm in arms])
    return [arm.moved(x) for arm, x in zip(arms, np.split(step, ends[:-1]), strict=True)]


def _known(found: Solved, linear: Linear, sizes: Sizes) -> Solved:
    """Return the solution with the covariance that it has together with the zeros."""
    size, p = float(sizes.expected[0]), linear.jacobian.shape[2]
    covariance = _inverse(linear.information(size))
    taken = linear.zeros.shape[2] - np.trace(covariance[p:, p:]) / size**2
    left = max(linear.freedom - p - taken, 1.0)
    scale = max(float((linear.whitened[2] ** 2).sum()) / left, 1.0)
    own = scale * covariance_inflation(left, 6) * covariance[:p, :p]
    off = [linear.following(covariance, kind) for kind in linear.others]
    return found.with_joint(sizes.mixed([own, *off], np.ones(len(sizes.weights))))


def _inverse(information: Floats) -> Floats:
    return np.asarray(np.linalg.inv(information), dtype=np.float64)


def _told(arms: Sequence[BentArm]) -> str:
    listed = (
        f"{arm.name} are off by ({', '.join(f'{x * 1e3:.2f}' for x in arm.offsets)}) mrad"
        for arm in arms
    )
    return f"the joints of {', of '.join(listed)}; the second answer is for them so corrected"


def _sizes(linear: Linear, zeros_alone: bool = False) -> Sizes:
    rows, zeros, errors = linear.whitened
    w, kept = linear.whiteners[linear.kept], linear.kept
    others = [] if zeros_alone else [w @ each[kept] for each in linear.others]
    return likely_sizes(rows, [zeros, *others], errors, linear.freedom)
