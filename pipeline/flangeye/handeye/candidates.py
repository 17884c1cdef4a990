"""Models of the same measurements, compared on poses held out; ties go to the simpler."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from flangeye.errors import CalibrationRefused
from flangeye.handeye.consensus import Consensus, again
from flangeye.handeye.likelihood import Problem, Solution, weigh
from flangeye.handeye.loop import LoopProblem
from flangeye.handeye.nuisance import Nuisance
from flangeye.maths.geometry import stack_rows
from flangeye.types import ArmCorrection, Floats

LEAST_KEPT = 1e-9
"""Singular values below this share of the largest are left out."""

FOLDS, LARGEST_FOLD = 5, 20
"""More folds where there are many poses, so that the cost stays linear in them."""
HELPFUL = 0.9
"""An error of the arm is kept when it brings the held-out error to this share or less."""


@dataclass(frozen=True, eq=False)
class Model:
    """What the measurements agree on, and what was found wrong with the arm.

    Attributes:
        consensus: The measurements and the fit.
        correction: The arm's error, if any helped.
        notes: For the person.
    """

    consensus: Consensus
    correction: ArmCorrection | None = None
    notes: tuple[str, ...] = ()

    @property
    def problem(self) -> LoopProblem:
        """What was given."""
        return self.consensus.problem

    @property
    def found(self) -> Solution:
        """The fit."""
        return self.consensus.found

    @property
    def corrects_joints(self) -> bool:
        """Whether joint offsets are corrected."""
        return self.correction is not None and self.correction.joint_offsets is not None

    def noted(self, note: str) -> Model:
        """Return the model with one more note."""
        return replace(self, notes=(*self.notes, note))

    def residuals(self, as_reported: bool = False) -> Floats:
        """Return the (N, 3) mapped centres minus where they are expected, in ``base`` [m].

        Args:
            as_reported: By the arm as its controller reports it, without a smooth error.
        """
        found, sized = self.found, self.problem.nuisance.sized
        left = found.linear.residuals[:, 3:]
        if as_reported and found.at.course is not None:
            resting = replace(self.problem, walk=None)
            left = weigh(
                resting, found.at, found.noise, found.inliers.astype(float)
            ).linear.residuals[:, 3:]
        if as_reported and sized.any():
            moves = found.linear.jacobian[:, 3:, found.at.before_nuisance :][:, :, sized]
            left = left + moves @ found.at.nuisance[sized]
        turns = self.problem.measurements.a[:, :3, :3] @ found.at.x[:3, :3]
        return np.asarray((turns @ left[..., None])[..., 0])

    def with_problem(self, problem: LoopProblem) -> Model | None:
        """Return the model of another problem; None when no answer of it can be trusted."""
        try:
            return replace(self, consensus=again(self.consensus, problem))
        except (CalibrationRefused, np.linalg.LinAlgError):
            return None


def with_nuisance(model: Model, nuisance: Nuisance) -> Model | None:
    """Return the model with more nuisances, those sized begun at the size of the residuals."""
    problem, found = model.problem, model.found
    size = max(rms(found.linear.residuals[found.inliers][:, 3:]), 1e-7)
    noise = replace(found.noise, size=size) if nuisance.sized.any() else found.noise
    started = replace(model.consensus, found=replace(found, noise=noise))
    return replace(model, consensus=started).with_problem(problem.beside(nuisance))


def considered(model: Model, further: Nuisance) -> Floats:
    """Return what unknown common errors add to the (18, 18) covariance of the transforms.

    They move neighbouring poses alike, so that the answer follows them where independent noise
    would average out; residuals do not show that. ("Consider" covariance, Schmidt 1966.)

    Args:
        model: What was found without them; it stays.
        further: The errors, with what is known of their sizes.
    """
    places = following(model.problem, model.found, further)[: model.found.at.of_places]
    moved = places * further.prior
    return np.asarray(moved @ moved.T)


def following(problem: Problem, found: Solution, further: Nuisance) -> Floats:
    """Return (6 K + 2 + k, m) by how much a fit's unknowns follow m further errors.

    A smooth error of the arm and a walk are found with them, and take their part.
    """
    m = len(further)
    fit = weighed_with(problem, found, further)
    moved = np.linalg.solve(fit.information[:-m, :-m], fit.information[:-m, -m:])
    return np.asarray(fit.basis[:-m, :-m] @ moved)


def weighed_with(problem: Problem, found: Solution, further: Nuisance) -> Solution:
    """Return what the agreeing measurements of a fit say of a model with further nuisances."""
    joined = problem.beside(further)
    at = replace(found.at, nuisance=np.zeros(len(joined.nuisance)))
    return weigh(joined, at, found.noise, found.inliers.astype(float))


def better(model: Model, candidate: Model, what: str) -> Model:
    """Return the candidate if it helps on poses held out, else the model; either says so."""
    kept = model.found.inliers | candidate.found.inliers
    before, after = (rms(held_out(m.found)[0][kept]) for m in (model, candidate))
    helps, told = judged(before, after, what)
    return (candidate if helps else model).noted(told)


def judged(before: float, after: float, what: str) -> tuple[bool, str]:
    """Return whether held-out errors [m] speak for a candidate, and the note that says so."""
    compared = f"held-out error {after * 1e3:.3f} mm with it, {before * 1e3:.3f} mm without"
    if not after <= HELPFUL * before:
        return False, f"left out, for it does not help: {what} ({compared})"
    return True, f"{what} ({compared})"


def held_out(found: Solution) -> tuple[Floats, Floats]:
    """Return (N, 3) errors of the centres, each of a fit to the other folds, in ``camera`` [m].

    With them their (N, 3, 3) covariances, as such a fit states them; zero for those that took no
    part. In closed form, the fit being as good as linear and its noise known. Where the base walks
    each is left out alone: those beside it tell where the base was.
    """
    if found.course is not None:
        return _each_left_out(found)
    errors = found.linear.residuals.copy()
    covariances, kept = np.zeros((len(errors), 3, 3)), np.flatnonzero(found.inliers)
    folds = max(FOLDS, len(kept) // LARGEST_FOLD)
    order = np.random.default_rng(0).permutation(kept)
    for fold in range(min(folds, len(kept))):
        part = np.sort(order[fold::folds])
        error, covariance = _without(found, part)
        errors[part], n = error, len(part)
        covariances[part] = covariance.reshape(n, 6, n, 6)[np.arange(n), 3:, np.arange(n), 3:]
    return errors[:, 3:], covariances


def _each_left_out(found: Solution) -> tuple[Floats, Floats]:
    kept = found.inliers[:, None, None]
    noise = np.linalg.pinv(found.weights, rcond=1e-12, hermitian=True)
    share = np.linalg.pinv(np.eye(6) - kept * (found.spread @ found.weights), rcond=1e-9)
    errors = (share @ found.linear.residuals[..., None])[:, 3:, 0]
    return errors, np.where(kept, share @ noise, 0.0)[:, 3:, 3:]


def _without(found: Solution, part: NDArray[np.intp]) -> tuple[Floats, Floats]:
    """Return (n, 6) errors of a part by a fit to the rest, and their (6 n, 6 n) covariance."""
    size = 6 * len(part)
    linear, weights = found.linear, found.weights[part]
    jacobian = stack_rows(linear.jacobian[part])
    weighted = stack_rows(weights @ linear.jacobian[part])
    noise = np.linalg.pinv(weights, rcond=1e-12, hermitian=True)
    own = np.zeros((len(part), 6, len(part), 6))
    own[np.arange(len(part)), :, np.arange(len(part))] = noise
    right = np.column_stack([linear.residuals[part].ravel(), own.reshape(size, size)])
    share = np.eye(size) - jacobian @ found.covariance @ weighted.T
    left = _solved(share, right)
    return left[:, 0].reshape(-1, 6), left[:, 1:]


def _solved(square: Floats, right: Floats) -> Floats:
    """Return the least solution (n, k) of ``square @ x = right``, by the inverse if there is one.

    Singular values are only asked for, at ten times the cost, where they may be too small to keep.
    """
    try:
        inverse = np.linalg.inv(square)
    except np.linalg.LinAlgError:
        pass
    else:
        # Of n rows, the ratio of the singular values is at most n times that of the sums.
        if len(square) * np.linalg.norm(square, 1) * np.linalg.norm(inverse, 1) < 1 / LEAST_KEPT:
            return np.asarray(inverse @ right)
    return np.asarray(np.linalg.lstsq(square, right, rcond=LEAST_KEPT)[0], dtype=np.float64)


def understated(found: Solution) -> float:
    """Return by what factor stated covariances fall short of errors on poses held out, at least 1.

    Sizes of noise and of smooth errors are themselves estimated: that shows here alone.
    """
    errors, covariances = held_out(found)
    kept = found.inliers
    # Of three poses, two leave the third unknown in a direction: nothing is held against that.
    known = np.linalg.pinv(covariances[kept], rcond=1e-12, hermitian=True)
    squares = np.einsum("na,nab,nb->n", errors[kept], known, errors[kept])
    return max(1.0, float(squares.mean()) / 3)


def rms(errors: Floats) -> float:
    """Return the root mean square length of (N, 3) errors."""
    return float(np.sqrt((errors**2).sum(axis=1).mean()))
