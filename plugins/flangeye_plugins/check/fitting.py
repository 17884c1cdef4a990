"""Fit many variants of a session at once, each with its likelihood; robust to a few bad samples.

Errors of a centre, of a normal and of a rotation are each taken as multivariate t with four
degrees of freedom and a scale of their own: close to normal in the middle, and a sample that is
far off costs the logarithm of its distance instead of its square. Fitted by
expectation-maximisation (Lange, Little & Taylor 1989), a Gauss-Newton step each.

Whether an alternative fits better than chance and a small error of the model can explain.

An alternative is held against the session as it is by the ratio of their likelihoods, as an F test
(for normal errors they are the same). Two things make it honest. Alternatives that were tried are
counted (Bonferroni). And no arm and no scanner is perfect: a session without a mistake still has
errors that an alternative with more freedom takes up. So the hypothesis that is tested is not that
an alternative changes nothing, but that it changes less than is negligible: a minimum-effect test
(Murphy & Myors 1999), by the non-central F distribution.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from math import erfc
from typing import NamedTuple

import numpy as np

from flangeye.estimation.readings import Pairs, estimated
from flangeye.types import Floats, Indices, Mask
from flangeye.types.geometry import hat, rotation_exp
from flangeye.workflow.doctor.diagnosis import Arms, Finding, Misfit, RecordedSession
from flangeye_plugins.check.equations import Equations, VariantUnknowns, equations_of, start_of

TAILS = 4.0
"""Degrees of freedom of the errors' distribution."""
FINEST_ANGLE = 1e-4
"""No scanner and no arm is better than this [rad]."""


class ErrorBlock(NamedTuple):
    """Errors of one kind: residuals (K, N, 3), their squares (K, N), derivatives (K, N, 3, P)."""

    residuals: Floats
    squares: Floats
    jacobian: Floats
    dimension: int
    finest: float


@dataclass(frozen=True, eq=False)
class VariantFits:
    """The best calibration of each of K variants.

    Attributes:
        likelihood: (K,) logarithm; minus infinity where no fit was found.
        residuals: (K, N, 3) of each kind of error, the centres' first [m, rad]; NaN where nothing
            was seen. In the carrier.
        scales: (K, B) standard deviation of each kind of error per coordinate [m, rad].
        count: (K,) coordinates that were measured.
        parameters: How many numbers were fitted.
        unknowns: What was fitted.
        information: (K, P, P) of the parameters.
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
        """(K, N, B) of every residual [m, rad]."""
        return np.stack([np.linalg.norm(r, axis=-1) for r in self.residuals], axis=-1)


def fit(equations: Equations) -> VariantFits:
    """Fit every variant: the camera, and the target where its place is not known."""
    unknowns = start_of(equations)
    blocks = _blocks(equations, unknowns)
    scales = [_first_scale(block) for block in blocks]
    fit_steps = 15
    for _ in range(fit_steps):
        weights = [_weights(b, s) for b, s in zip(blocks, scales, strict=True)]
        information, gradient = _normal_equations(blocks, weights, scales)
        unknowns = _moved(unknowns, _solved(information, gradient))
        blocks = _blocks(equations, unknowns)
        scales = [_scale(b, w) for b, w in zip(blocks, weights, strict=True)]
    return _score(blocks, scales, unknowns, information)


def errors_at(equations: Equations, unknowns: VariantUnknowns) -> Floats:
    """Return (K, N, B) lengths of every kind of error at given unknowns [m, rad]."""
    blocks = _blocks(equations, unknowns)
    lengths = [np.linalg.norm(block.residuals, axis=-1) for block in blocks]
    return np.stack(np.broadcast_arrays(*lengths), axis=-1)


def _blocks(equations: Equations, unknowns: VariantUnknowns) -> list[ErrorBlock]:
    """Return every kind of error and how the parameters move it.

    Parameters: rotation and position of the camera (left perturbation); where the target's place
    is not known, its position, and its rotation if it has one; the second arm's base, if any.
    """
    mounts = equations.carried(unknowns.other)
    blocks = [_centre_block(equations, unknowns, mounts)]
    if equations.has_rotations:
        blocks.append(_rotation_block(equations, unknowns, mounts))
    elif np.isfinite(equations.normals).any():
        blocks.append(_normal_block(equations, unknowns, mounts))
    return blocks


def _centre_block(equations: Equations, unknowns: VariantUnknowns, mounts: Floats) -> ErrorBlock:
    turned = equations.centres @ unknowns.rotation.swapaxes(-1, -2)
    expected = (mounts[..., :3, :3] @ unknowns.place[..., None])[..., 0] + mounts[..., :3, 3]
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
    residuals = log_of(seen @ expected.swapaxes(-1, -2))
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
    return _block(residuals, parts, 2, FINEST_ANGLE)


def _block(residuals: Floats, parts: Sequence[Floats], dimension: int, finest: float) -> ErrorBlock:
    """Return errors with what each group of parameters does to them."""
    jacobian = np.empty((*residuals.shape, 3 * len(parts)))
    for i, part in enumerate(parts):
        jacobian[..., 3 * i : 3 * i + 3] = part
    squares = np.asarray((residuals**2).sum(axis=-1))
    return ErrorBlock(residuals, squares, jacobian, dimension, finest)


def _first_scale(block: ErrorBlock) -> Floats:
    middle = np.nanmedian(block.squares, axis=-1)
    return np.asarray(np.sqrt(np.maximum(middle / block.dimension, block.finest**2)))


def _weights(block: ErrorBlock, scale: Floats) -> Floats:
    """(K, N) what each sample counts: 0 where it was not measured."""
    distances = block.squares / scale[:, None] ** 2
    weights = np.asarray((TAILS + block.dimension) / (TAILS + distances))
    weights[np.isnan(weights)] = 0.0
    return weights


def _scale(block: ErrorBlock, weights: Floats) -> Floats:
    seen = np.isfinite(block.squares)
    total = (weights * np.where(seen, block.squares, 0.0)).sum(axis=-1)
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
        turn = rotation_exp(step[:, 9:12]) @ turn
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
        squares, d = block.squares, block.dimension
        seen = np.isfinite(squares).sum(axis=-1)
        tails = np.nansum(np.log1p(squares / (TAILS * scale[:, None] ** 2)), axis=-1)
        likelihood = likelihood - d * seen * np.log(scale) - 0.5 * (TAILS + d) * tails
        count = count + d * seen
    return VariantFits(
        np.nan_to_num(likelihood, nan=-np.inf),
        tuple(block.residuals for block in blocks),
        np.stack(scales, axis=-1),
        count,
        information.shape[-1],
        unknowns,
        information,
    )


def log_of(rotations: Floats) -> Floats:
    """Return the rotation vectors (..., 3) [rad] of rotations (..., 3, 3).

    Their lengths are right at any angle; close to half a turn their direction is rough.
    """
    twice_sine_axis = np.stack(
        [
            rotations[..., 2, 1] - rotations[..., 1, 2],
            rotations[..., 0, 2] - rotations[..., 2, 0],
            rotations[..., 1, 0] - rotations[..., 0, 1],
        ],
        axis=-1,
    )
    length = np.linalg.norm(twice_sine_axis, axis=-1, keepdims=True)
    trace = np.trace(rotations, axis1=-2, axis2=-1)[..., None]
    angle = np.arctan2(length, trace - 1.0)
    away = np.broadcast_to([1.0, 0.0, 0.0], twice_sine_axis.shape)
    direction = np.where(length > 1e-9, twice_sine_axis / np.maximum(length, 1e-9), away)
    small = 0.5 * twice_sine_axis
    return np.asarray(np.where(angle < 1e-6, small, angle * direction))


@lru_cache(maxsize=2)
def fit_of(session: RecordedSession) -> VariantFits:
    """Return the best calibration of an unchanged session; cached by identity."""
    return fit(equations_of(session))


def called(arms: Arms) -> str:
    """Return what one of two arms, or both, are called in messages."""
    return "both arms" if arms == "both" else f"the {arms} arm"


def named(arms: Arms, session: RecordedSession) -> str:
    """Return whose poses are meant, in the words of messages."""
    if session.seconds is None:
        return "the robot's"
    return called(arms) + ("'" if arms == "both" else "'s")


HELPS = 0.7
"""A correction that explains the samples leaves at most this share of the errors held out."""


EXPLAINED = 0.2
"""And at most this share of how far the samples are apart."""


class Significance(NamedTuple):
    """Comparison of an alternative with the unchanged session.

    Attributes:
        which: Index of the alternative.
        before: Errors of the session as it is.
        after: Errors of the alternative.
        probability: Probability of so much better a fit without a mistake, alternatives counted.
        gain: Logarithm of the likelihood ratio less what further parameters cost (Schwarz 1978).
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
        """Return the mistake that the alternative is without; see :class:`Finding`."""
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
        null: The session as it is: once, or on several choices of its samples.
        alternatives: K variants of the same samples.
        further: Parameters an alternative has more than the session; 0 for another reading of
            the same numbers, which is tested as if it had twice as many (the model that holds
            both).
        tried: How many alternatives there were, where they were not all fitted.
        against: (K,) which of ``null`` has the samples of each alternative; the first if not given.
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
    """Return the (K,) starts about the likeliest, by a coarse-to-fine search; linear in samples.

    Evidence for a change grows from both sides towards where it was.

    Args:
        starts: Samples that a change may begin with, rising.
        ratios: Gives the logarithms of likelihood ratios of some of them.
    """
    at_once = 16  # starts that are tried at once; each round leaves an eighth of them
    while len(starts) > at_once:
        some = starts[np.linspace(0, len(starts) - 1, at_once).round().astype(int)]
        best = int(np.argmax(ratios(some)))
        first, last = some[max(best - 1, 0)], some[min(best + 1, at_once - 1)]
        starts = starts[(starts >= first) & (starts <= last)]
    return starts


def exceedance(ratio: float, count: float, further: int, freedom: float, effect: float) -> float:
    """Return the probability of so large a likelihood ratio where the effect is negligible.

    The non-central F distribution by Patnaik's approximation (1949).

    Args:
        ratio: Logarithm of the likelihood ratio.
        count: Coordinates that were measured.
        further: Number of additional parameters of the alternative.
        freedom: Residual degrees of freedom of the alternative.
        effect: Size of what it changes, in units of what is negligible.
    """
    from scipy.special import fdtrc

    if ratio <= 0 or freedom < 1 or effect <= 1:
        return 1.0
    f = np.expm1(min(2 * ratio / count, 500.0)) * freedom / further
    noncentral = f * further / effect**2
    shrunk = f / (1 + noncentral / further)
    equivalent = (further + noncentral) ** 2 / (further + 2 * noncentral)
    return float(fdtrc(equivalent, freedom, shrunk))


def negligible(kinds: int) -> Floats:
    """Return (B,) negligible sizes of each kind of error [m, rad]."""
    # What is negligible of a normal's or a marker's rotation: 4 mrad
    # Error that an arm's kinematics or a scanner may have without a mistake [m]
    return np.array([0.5e-3, *[4e-3] * (kinds - 1)])


def _effect(before: Misfit, after: Misfit) -> float:
    """Return by how much the errors shrink, in units of what is negligible; the largest kind."""
    shrunk = np.sqrt(np.clip(before.numbers**2 - after.numbers**2, 0.0, None))
    return float((shrunk / negligible(len(shrunk))).max())


def helps(session: RecordedSession, corrected: RecordedSession) -> bool:
    """Whether held-out samples are predicted better with the correction than without.

    Positions count by their share of how far the samples are apart: to divide all lengths by a
    thousand divides the errors too, and explains nothing.
    """
    before, after = _foretold(session), _foretold(corrected)
    # Errors that sound samples have, too: growing up to these is no loss [of the spread, rad]
    none_worse = (after <= np.maximum(1.2 * before, np.array([0.02, 0.01])[: len(after)])).all()
    better = (after <= HELPS * before).any() and none_worse
    return bool(better and after[0] <= EXPLAINED)


def explained(session: RecordedSession) -> bool:
    """Whether the samples predict each other, which unrelated ones do not."""
    return bool(_foretold(session)[0] <= EXPLAINED)


def moved_helps(session: RecordedSession, after: Mask) -> bool:
    """Whether two calibrations, before and after a move, foretell samples better than one."""
    equations = equations_of(session)
    whole = held_out_errors(equations, np.zeros_like(after))
    first, second = (held_out_errors(equations, mask) for mask in (after, ~after))
    halves = np.where(np.isfinite(first), first, second)
    one, two = (np.nanmedian(errors, axis=0) for errors in (whole, halves))
    return bool(two[0] <= min(HELPS * one[0], EXPLAINED * _spread(session)))


def held_out_errors(equations: Equations, ignored: Mask) -> Floats:
    """Return (N, B) errors [m, rad] of each sample by the calibration without its fold.

    Args:
        equations: One variant.
        ignored: (N,) samples that take no part at all; NaN.
    """
    seen = np.isfinite(equations.centres[0, :, 0]) & ~ignored
    folds_of = 4  # every fourth sample is held out in turn
    dealt = np.where(seen, np.cumsum(seen) % folds_of, -1)
    folds = dealt[None] == np.arange(folds_of)[:, None]
    found = fit(equations.without(folds | ignored))
    errors = errors_at(equations, found.unknowns)
    out = np.full((len(seen), errors.shape[-1]), np.nan)
    out[seen] = errors[dealt[seen], np.flatnonzero(seen)]
    return out


def _foretold(session: RecordedSession) -> Floats:
    """Return (B,) medians of the errors held out; positions as a share of the samples' spread."""
    errors = held_out_errors(equations_of(session), ~session.seen)
    middle = np.nanmedian(errors, axis=0)
    middle[0] /= max(_spread(session), 1e-12)
    return np.asarray(middle)


def _spread(session: RecordedSession) -> float:
    """Return how far the samples are apart [m]: the arm's places, or what was seen, if farther."""
    sides = (session.poses[session.seen, :3, 3], session.centres[session.seen])
    return max(float(np.linalg.norm(side.std(axis=0))) for side in sides)


def covariance_of(information: Floats) -> Floats:
    """Return the inverse; directions without information get a variance beyond all limits."""
    size = np.sqrt(np.maximum(np.diag(information), 1e-300))
    scaled = information / np.outer(size, size) + 1e-13 * np.eye(len(size))
    return np.asarray(np.linalg.inv(scaled) / np.outer(size, size))


def offset_left_open(session: RecordedSession) -> float:
    """Return how well the poses show a constant offset of the target from the flange [m].

    Returns:
        One sigma along the direction that they show least; 0 where that is below a millimetre, so
        that a tool set in the controller would show.
    """
    free = fit(equations_of(session).with_free_place())
    known = float(np.sqrt(np.linalg.eigvalsh(covariance_of(free.information[0])[6:9, 6:9])[-1]))
    return known if known >= 1e-3 else 0.0


def size_by_chance(session: RecordedSession) -> float:
    """Return the probability that errors of the arm show so wrong a marker's size by chance."""
    one_arm = session.seconds is None and session.links is None
    if not one_arm or np.isfinite(session.places).any():
        return 1.0
    if (found := estimated(pairs_of(session), session.robot)) is None:
        return 1.0
    ((_, mean, covariance),) = found.numbers("size")
    return float(erfc(abs(mean[0]) / np.sqrt(2 * covariance[0, 0])))


def pairs_of(session: RecordedSession) -> Pairs:
    """Return the poses of one arm and of what was seen: whole ones, or of centres turned by NaN."""
    turned = np.isfinite(session.rotations).all(axis=(1, 2))
    shown = turned if turned.any() else session.seen
    markers = np.tile(np.eye(4), (int(shown.sum()), 1, 1))
    markers[:, :3, :3], markers[:, :3, 3] = session.rotations[shown], session.centres[shown]
    return Pairs(session.poses[shown], markers, session.carried == "camera")
