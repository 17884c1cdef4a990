"""Fit many variants of a session at once, each with its likelihood; robust to a few bad samples.

Errors of centres, normals and rotations have multivariate t distributions with four degrees of
freedom and separate scales: nearly normal in the middle, but an outlier costs the logarithm of its
distance instead of the square. They are fitted by expectation-maximisation (Lange, Little & Taylor
1989) with one Gauss-Newton step per iteration.

An alternative is compared with the unchanged session by their likelihood ratio, as an F test
(equivalent for normal errors). Two corrections keep the test valid. The number of alternatives is
taken into account (Bonferroni). And as arms and scanners are imperfect, even a correct session has
errors that an alternative with more parameters can absorb. The null hypothesis is therefore that
the alternative's effect is negligible, not zero: a minimum-effect test (Murphy & Myors 1999) by the
non-central F distribution.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from math import erfc
from typing import NamedTuple

import numpy as np

from flangeye.estimation.session.readings import Pairs, estimated
from flangeye.types import Floats, Indices, Mask
from flangeye.types.geometry import each_applied, hat, rotation_exp, rotation_log
from flangeye.workflow.doctor.diagnosis import Arms, Finding, Misfit, RecordedSession
from flangeye_plugins.check.equations import Equations, VariantUnknowns, equations_of, start_of

TAILS = 4.0
"""Degrees of freedom of the errors' distribution."""
FINEST_ANGLE = 1e-4
"""No scanner and no arm is better than this [rad]."""


class ErrorBlock(NamedTuple):
    """Errors of one kind: residuals (K, N, 3), squared norms (K, N), derivatives (K, N, 3, P)."""

    residuals: Floats
    squares: Floats
    jacobian: Floats
    dimension: int
    finest: float


@dataclass(frozen=True, eq=False)
class VariantFits:
    """The best calibration of each of K variants.

    Attributes:
        likelihood: (K,) log-likelihoods; minus infinity without a fit.
        residuals: (K, N, 3) residuals in the carrier for each kind of error, the centres' first [m,
            rad]; NaN if not seen.
        scales: (K, B) standard deviation of each kind of error per coordinate [m, rad].
        count: (K,) numbers of measured coordinates.
        parameters: Number of fitted parameters.
        unknowns: Fitted values of the unknowns.
        information: (K, P, P) information matrices of the parameters.
    """

    likelihood: Floats
    residuals: tuple[Floats, ...]
    scales: Floats
    count: Floats
    parameters: int
    unknowns: VariantUnknowns
    information: Floats

    def misfit(self, variant: int = 0) -> Misfit:
        """Return the errors of a variant."""
        rms = np.sqrt(np.nanmean(self.lengths[variant] ** 2, axis=0))
        return Misfit(float(rms[0]), float(rms[1]) if len(rms) > 1 else None)

    @property
    def lengths(self) -> Floats:
        """Length (K, N, B) of every residual [m, rad]."""
        return np.stack([np.linalg.norm(r, axis=-1) for r in self.residuals], axis=-1)


def fit(equations: Equations) -> VariantFits:
    """Return the fits of all variants: the camera's pose, and the target's if unknown."""
    unknowns = start_of(equations)
    blocks = _blocks(equations, unknowns)
    scales = [_first_scale(block) for block in blocks]
    fit_steps = 15
    for _ in range(fit_steps):
        # E step: each sample's expected precision given its residual. M step: one Gauss-Newton step
        # of the unknowns, then the scales.
        weights = [_weights(b, s) for b, s in zip(blocks, scales, strict=True)]
        information, gradient = _normal_equations(blocks, weights, scales)
        unknowns = _moved(unknowns, _solved(information, gradient))
        blocks = _blocks(equations, unknowns)
        scales = [_scale(b, w) for b, w in zip(blocks, weights, strict=True)]
    return _score(blocks, scales, unknowns, information)


def errors_at(equations: Equations, unknowns: VariantUnknowns) -> Floats:
    """Return (K, N, B) error magnitudes of K variants and N samples, by kind of error [m, rad]."""
    blocks = _blocks(equations, unknowns)
    lengths = [np.linalg.norm(block.residuals, axis=-1) for block in blocks]
    return np.stack(np.broadcast_arrays(*lengths), axis=-1)


def _blocks(equations: Equations, unknowns: VariantUnknowns) -> list[ErrorBlock]:
    """Return the errors of every kind with their derivatives.

    The parameters are rotation and position of the camera (left perturbation), the target's
    position if unknown and its rotation if measured, and the second arm's base if there is one.
    """
    mounts = equations.carried(unknowns.other)
    blocks = [_centre_block(equations, unknowns, mounts)]
    if equations.has_rotations:
        blocks.append(_rotation_block(equations, unknowns, mounts))
    elif np.isfinite(equations.normals).any():
        blocks.append(_normal_block(equations, unknowns, mounts))
    return blocks


def _centre_block(equations: Equations, unknowns: VariantUnknowns, mounts: Floats) -> ErrorBlock:
    # r = R c + t - M p. A small left rotation phi adds phi x (R c) = -hat(R c) phi.
    turned = equations.centres @ unknowns.rotation.swapaxes(-1, -2)
    expected = each_applied(mounts, unknowns.place)
    residuals = turned + unknowns.position[:, None] - expected
    parts = [-hat(turned), np.broadcast_to(np.eye(3), (*turned.shape, 3))]
    if unknowns.free_place:
        parts.append(-np.broadcast_to(mounts[..., :3, :3], (*turned.shape, 3)))
    if unknowns.free_turn:
        parts.append(np.zeros((*turned.shape, 3)))
    if equations.bases is not None:
        turns = equations.bases[..., :3, :3]
        arm = turns.swapaxes(-1, -2) @ (expected - equations.bases[..., :3, 3])[..., None]
        lever = arm[..., 0] - unknowns.other[:, None, :3, 3]
        parts += [turns @ hat(lever), -turns]
    # No scanner and no arm is better than this [m]
    return _block(residuals, parts, 3, 20e-6)


def _rotation_block(equations: Equations, unknowns: VariantUnknowns, mounts: Floats) -> ErrorBlock:
    turns = mounts[..., :3, :3]
    expected = turns @ unknowns.turn[:, None]
    seen = unknowns.rotation[:, None] @ equations.rotations
    # Taken on the left, in the carrier, so that the camera's rotation enters with derivative one.
    residuals = rotation_log(seen @ expected.swapaxes(-1, -2))
    eye = np.broadcast_to(np.eye(3), (*residuals.shape, 3))
    zero = np.zeros_like(eye)
    parts = [eye, zero, *([zero] if unknowns.free_place else [])]
    parts += [-turns] if unknowns.free_turn else []
    if equations.bases is not None:
        parts += [-equations.bases[..., :3, :3], zero]
    return _block(residuals, parts, 3, FINEST_ANGLE)


def _normal_block(equations: Equations, unknowns: VariantUnknowns, mounts: Floats) -> ErrorBlock:
    turned = equations.normals @ unknowns.rotation.swapaxes(-1, -2)
    expected = mounts[..., :3, 2]
    residuals = turned - expected
    zero = np.zeros((*turned.shape, 3))
    parts = [-hat(turned), zero, *([zero] if unknowns.free_place else [])]
    if equations.bases is not None:
        turns = equations.bases[..., :3, :3]
        lever = turns.swapaxes(-1, -2) @ expected[..., None]
        parts += [turns @ hat(lever[..., 0]), zero]
    # The difference of two unit vectors has two coordinates only: none along the normal.
    return _block(residuals, parts, 2, FINEST_ANGLE)


def _block(residuals: Floats, parts: Sequence[Floats], dimension: int, finest: float) -> ErrorBlock:
    """Return errors with their derivatives by all groups of parameters."""
    jacobian = np.empty((*residuals.shape, 3 * len(parts)))
    for i, part in enumerate(parts):
        jacobian[..., 3 * i : 3 * i + 3] = part
    squares = np.asarray((residuals**2).sum(axis=-1))
    return ErrorBlock(residuals, squares, jacobian, dimension, finest)


def _first_scale(block: ErrorBlock) -> Floats:
    # A median without NaN, as np.nanmedian finds it in eight times the time: NaN are sorted last
    rising = np.sort(block.squares, axis=-1)
    count = (~np.isnan(rising)).sum(axis=-1, keepdims=True)
    ends = np.concatenate([np.maximum(count - 1, 0) // 2, count // 2], axis=-1)
    middle = np.take_along_axis(rising, ends, -1).mean(axis=-1)
    return np.asarray(np.sqrt(np.maximum(middle / block.dimension, block.finest**2)))


def _weights(block: ErrorBlock, scale: Floats) -> Floats:
    """Return the weights (K, N) of the samples; 0 if not measured."""
    distances = block.squares / scale[:, None] ** 2
    # Mean of the hidden precision of a t distribution: (nu + d) / (nu + r^2 / s^2)
    weights = np.asarray((TAILS + block.dimension) / (TAILS + distances))
    weights[np.isnan(weights)] = 0.0
    return weights


def _scale(block: ErrorBlock, weights: Floats) -> Floats:
    seen = np.isfinite(block.squares)
    total = (weights * np.where(seen, block.squares, 0.0)).sum(axis=-1)
    # By the number of coordinates and not by the sum of the weights: that is the maximum of a t
    # distribution's likelihood.
    count = block.dimension * seen.sum(axis=-1)
    return np.asarray(np.sqrt(np.maximum(total / count, block.finest**2)))


def _normal_equations(
    blocks: list[ErrorBlock], weights: list[Floats], scales: list[Floats]
) -> tuple[Floats, Floats]:
    p = blocks[0].jacobian.shape[-1]
    information: Floats = np.zeros((1, p, p))
    gradient: Floats = np.zeros((1, p))
    for block, weight, scale in zip(blocks, weights, scales, strict=True):
        w = np.sqrt(weight)[..., None] / scale[:, None, None]
        rows, errors = block.jacobian * w[..., None], block.residuals * w
        unseen = ~(weight > 0)
        rows[unseen], errors[unseen] = 0.0, 0.0
        flat, errors = rows.reshape(len(rows), -1, p), errors.reshape(len(rows), -1, 1)
        information = information + flat.swapaxes(-1, -2) @ flat
        gradient = gradient + (flat.swapaxes(-1, -2) @ errors)[..., 0]
    return information, gradient


def _solved(information: Floats, gradient: Floats) -> Floats:
    diagonal = np.einsum("kii->ki", information)
    # Scaled to unit diagonal, because radians and metres differ by orders of magnitude and the
    # damping has to be fair to both.
    size = np.sqrt(np.maximum(diagonal, 1e-300))
    p = information.shape[-1]
    # Share of the information that is added to every direction, for those nothing is known of
    damping = 1e-9
    scaled = information / (size[:, :, None] * size[:, None, :]) + damping * np.eye(p)
    return np.asarray(-np.linalg.solve(scaled, (gradient / size)[..., None])[..., 0] / size)


def _moved(unknowns: VariantUnknowns, step: Floats) -> VariantUnknowns:
    turned = rotation_exp(step[:, :3]) @ unknowns.rotation
    place, turn = unknowns.place, unknowns.turn
    if unknowns.free_place:
        place = place + step[:, None, 6:9]
    if unknowns.free_turn:
        at = 9 if unknowns.free_place else 6
        turn = rotation_exp(step[:, at : at + 3]) @ turn
    other = _moved_base(unknowns.other, step[:, -6:]) if unknowns.free_other else unknowns.other
    return unknowns._replace(
        rotation=turned,
        position=unknowns.position + step[:, 3:6],
        place=place,
        turn=turn,
        other=other,
    )


def _moved_base(other: Floats, step: Floats) -> Floats:
    out = np.array(np.broadcast_to(other, (len(step), 4, 4)))
    out[:, :3, :3] = rotation_exp(step[:, :3]) @ out[:, :3, :3]
    out[:, :3, 3] += step[:, 3:]
    return out


def _score(
    blocks: list[ErrorBlock], scales: list[Floats], unknowns: VariantUnknowns, information: Floats
) -> VariantFits:
    likelihood = count = np.zeros(1)
    for block, scale in zip(blocks, scales, strict=True):
        # Log-density of a multivariate t: -d log s - (nu + d) / 2 log(1 + r^2 / (nu s^2)), without
        # the constants that all variants share.
        squares, d = block.squares, block.dimension
        seen = np.isfinite(squares).sum(axis=-1)
        tails = np.nansum(np.log1p(squares / (TAILS * scale[:, None] ** 2)), axis=-1)
        likelihood = likelihood - d * seen * np.log(scale) - 0.5 * (TAILS + d) * tails
        count = count + d * seen
    return VariantFits(
        # A variant whose start failed has NaN residuals: it must lose, not poison the maximum.
        np.nan_to_num(likelihood, nan=-np.inf),
        tuple(block.residuals for block in blocks),
        np.stack(scales, axis=-1),
        count,
        information.shape[-1],
        unknowns,
        information,
    )


@lru_cache(maxsize=2)
def fit_of(session: RecordedSession) -> VariantFits:
    """Return the best calibration of an unchanged session; cached by identity."""
    return fit(equations_of(session))


def arm_name(arms: Arms) -> str:
    """Return the name of one of two arms, or both, in messages."""
    return "both arms" if arms == "both" else f"the {arms} arm"


def arm_possessive(arms: Arms, session: RecordedSession) -> str:
    """Return the arms whose poses are concerned, such as ``the first arm's``."""
    if session.seconds is None:
        return "the robot's"
    return arm_name(arms) + ("'" if arms == "both" else "'s")


HELPS = 0.7
"""Largest ratio of held-out errors with and without a correction that counts as a cause."""


MISFIT_SHARE = 0.2
"""Largest held-out error that a correction may leave, as a share of the samples' spread."""


class Significance(NamedTuple):
    """Comparison of an alternative with the unchanged session.

    Attributes:
        which: Index of the alternative.
        before: Errors of the unchanged session.
        after: Errors of the alternative.
        probability: p-value: probability of such an improvement without a mistake, corrected for
            the number of alternatives.
        gain: Log-likelihood ratio minus the penalty for additional parameters (Schwarz 1978).
    """

    which: int
    before: Misfit
    after: Misfit
    probability: float
    gain: float

    def finding(
        self,
        name: str,
        what: str,
        corrected: RecordedSession,
        fix: str | None = None,
        samples: tuple[str, ...] = (),
    ) -> Finding:
        """Return a finding for the mistake that the alternative corrects; see :class:`Finding`."""
        return Finding(name, what, fix or corrected.step(), samples, *self[1:], corrected)


def best_of(
    null: VariantFits,
    alternatives: VariantFits,
    further: int = 0,
    tried: int | None = None,
    against: Indices | None = None,
) -> Significance:
    """Return the alternative with the largest likelihood ratio to the unchanged session.

    Args:
        null: Fits of the unchanged session, on all or on several subsets of its samples.
        alternatives: K variants of the same samples.
        further: Number of additional parameters of an alternative; 0 for another interpretation of
            the same numbers, which is tested with twice the parameters (those of the model that
            contains both).
        tried: Number of alternatives, if not all were fitted.
        against: (K,) index in ``null`` of the fit on each alternative's samples; None is the first.
    """
    if against is None:
        against = np.zeros(len(alternatives.likelihood), dtype=int)
    ratios = alternatives.likelihood - null.likelihood[against]
    # Of readings with the same effect, the first: they are listed by how common they are.
    # Equal but for rounding
    index = int(np.flatnonzero(ratios >= ratios.max() - 1e-3)[0])
    at = int(against[index])
    before, after = null.misfit(at), alternatives.misfit(index)
    freedom = float(null.count[at]) - alternatives.parameters - further
    counted = tried or len(ratios)
    p = exceedance(
        float(ratios[index]), float(null.count[at]), further or null.parameters, freedom,
        _effect(before, after),
    )  # fmt: skip
    gain = float(ratios[index]) - 0.5 * further * np.log(float(null.count[at])) - np.log(counted)
    return Significance(index, before, after, min(1.0, counted * p), gain)


def narrowed(starts: Indices, ratios: Callable[[Indices], Floats]) -> Indices:
    """Return the starts (K,) around the most likely one, by a coarse-to-fine search.

    The search works because the evidence for a change grows towards its position from both sides.

    Args:
        starts: Possible first samples of a change, ascending.
        ratios: Returns the log-likelihood ratios of some starts.
    """
    at_once = 16  # starts that are tried at once; each round leaves an eighth of them
    while len(starts) > at_once:
        some = starts[np.linspace(0, len(starts) - 1, at_once).round().astype(int)]
        best = int(np.argmax(ratios(some)))
        first, last = some[max(best - 1, 0)], some[min(best + 1, at_once - 1)]
        starts = starts[(starts >= first) & (starts <= last)]
    return starts


def exceedance(ratio: float, count: float, further: int, freedom: float, effect: float) -> float:
    """Return the probability of a likelihood ratio this large if the effect is negligible.

    The non-central F distribution is approximated by Patnaik's method (1949).

    Args:
        ratio: Log-likelihood ratio.
        count: Number of measured coordinates.
        further: Number of additional parameters of the alternative.
        freedom: Residual degrees of freedom of the alternative.
        effect: Size of the effect, in units of a negligible one.
    """
    from scipy.special import fdtrc

    if ratio <= 0 or freedom < 1 or effect <= 1:
        return 1.0
    # For normal errors the likelihood ratio is a function of F: ratio = n / 2 log(1 + F m /
    # freedom). The minimum keeps the exponential finite.
    f = np.expm1(min(2 * ratio / count, 500.0)) * freedom / further
    # If the effect were just negligible, F would be smaller by effect^2: that is the centre of the
    # distribution under the null hypothesis.
    noncentral = f * further / effect**2
    # Patnaik: a non-central F is a central one, scaled, with more degrees of freedom
    shrunk = f / (1 + noncentral / further)
    equivalent = (further + noncentral) ** 2 / (further + 2 * noncentral)
    return float(fdtrc(equivalent, freedom, shrunk))


def negligible(kinds: int) -> Floats:
    """Return the negligible size (B,) of each kind of error [m, rad]."""
    # What is negligible of a normal's or a marker's rotation: 4 mrad
    # Error that an arm's kinematics or a scanner may have without a mistake [m]
    return np.array([0.5e-3, *[4e-3] * (kinds - 1)])


def _effect(before: Misfit, after: Misfit) -> float:
    """Return the largest reduction of any kind of error, in units of the negligible size."""
    # Independent errors add in squares, so this is the error that the correction took away.
    shrunk = np.sqrt(np.clip(before.numbers**2 - after.numbers**2, 0.0, None))
    return float((shrunk / negligible(len(shrunk))).max())


def helps(session: RecordedSession, corrected: RecordedSession) -> bool:
    """Return whether the correction improves the prediction of held-out samples.

    Position errors are relative to the samples' spread, because dividing all lengths by 1000 also
    divides the errors without explaining anything.
    """
    before, after = _held_out_medians(session), _held_out_medians(corrected)
    # Errors that sound samples have, too: growing up to these is no loss [of the spread, rad]
    none_worse = (after <= np.maximum(1.2 * before, np.array([0.02, 0.01])[: len(after)])).all()
    better = (after <= HELPS * before).any() and none_worse
    return bool(better and after[0] <= MISFIT_SHARE)


def explained(session: RecordedSession) -> bool:
    """Return whether the samples predict each other, unlike unrelated ones."""
    return bool(_held_out_medians(session)[0] <= MISFIT_SHARE)


def moved_helps(session: RecordedSession, after: Mask) -> bool:
    """Return whether two calibrations, before and after a move, predict samples better than one."""
    equations = equations_of(session)
    whole = held_out_errors(equations, np.zeros_like(after))
    first, second = (held_out_errors(equations, mask) for mask in (after, ~after))
    halves = np.where(np.isfinite(first), first, second)
    one, two = (np.nanmedian(errors, axis=0) for errors in (whole, halves))
    return bool(two[0] <= min(HELPS * one[0], MISFIT_SHARE * _spread(session)))


def held_out_errors(equations: Equations, ignored: Mask) -> Floats:
    """Return the errors (N, B) [m, rad] of each sample, predicted without its own fold.

    Args:
        equations: Equations of one variant.
        ignored: (N,) mask of samples left out; their errors are NaN.
    """
    seen = np.isfinite(equations.centres[0, :, 0]) & ~ignored
    folds_of = 4  # every fourth sample is held out in turn
    # Dealt in turn among the seen samples, so that each fold covers the whole session.
    dealt = np.where(seen, np.cumsum(seen) % folds_of, -1)
    folds = dealt[None] == np.arange(folds_of)[:, None]
    found = fit(equations.without(folds | ignored))
    errors = errors_at(equations, found.unknowns)
    out = np.full((len(seen), errors.shape[-1]), np.nan)
    out[seen] = errors[dealt[seen], np.flatnonzero(seen)]
    return out


@lru_cache(maxsize=2)
def _held_out_medians(session: RecordedSession) -> Floats:
    """Return the medians (B,) of held-out errors, positions over the samples' spread; cached."""
    errors = held_out_errors(equations_of(session), ~session.seen)
    middle = np.nanmedian(errors, axis=0)
    middle[0] /= max(_spread(session), 1e-12)
    return np.asarray(middle)


def _spread(session: RecordedSession) -> float:
    """Return the samples' spread [m]: of the arm's or of the measured positions, if larger."""
    sides = (session.poses[session.seen, :3, 3], session.centres[session.seen])
    return max(float(np.linalg.norm(side.std(axis=0))) for side in sides)


def covariance_of(information: Floats) -> Floats:
    """Return the inverse of an information matrix; unobservable directions get a huge variance."""
    # Unit diagonal first: 1e-13 then means the same for radians and metres.
    size = np.sqrt(np.maximum(np.diag(information), 1e-300))
    scaled = information / np.outer(size, size) + 1e-13 * np.eye(len(size))
    return np.asarray(np.linalg.inv(scaled) / np.outer(size, size))


def offset_left_open(session: RecordedSession) -> float:
    """Return the uncertainty of a constant offset of the target from the flange [m].

    Returns:
        One sigma in the least certain direction; 0 below a millimetre, where a tool offset set in
        the controller would be detected.
    """
    free = fit(equations_of(session).with_free_place())
    known = float(np.sqrt(np.linalg.eigvalsh(covariance_of(free.information[0])[6:9, 6:9])[-1]))
    return known if known >= 1e-3 else 0.0


def size_by_chance(session: RecordedSession) -> float:
    """Return the probability that errors of the arm cause the apparent error of a marker's size."""
    one_arm = session.seconds is None and session.links is None
    if not one_arm or np.isfinite(session.places).any():
        return 1.0
    if (found := estimated(pairs_of(session), session.robot)) is None:
        return 1.0
    ((_, mean, covariance),) = found.numbers("size")
    return float(erfc(abs(mean[0]) / np.sqrt(2 * covariance[0, 0])))


def pairs_of(session: RecordedSession) -> Pairs:
    """Return the poses of one arm and of the target; centres have NaN as rotation."""
    turned = np.isfinite(session.rotations).all(axis=(1, 2))
    shown = turned if turned.any() else session.seen
    markers = np.tile(np.eye(4), (int(shown.sum()), 1, 1))
    markers[:, :3, :3], markers[:, :3, 3] = session.rotations[shown], session.centres[shown]
    return Pairs(session.poses[shown], markers, session.carried == "camera")
