"""The calibration of a cell: from observations to the transforms with their covariances."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from itertools import compress

import numpy as np

from flangeye.errors import FlangeyeError
from flangeye.estimation.answers.answer import (
    Answer,
    as_reported,
    as_true,
    commanded,
    expected_error,
    functional,
    moves,
    predicted_work,
)
from flangeye.estimation.answers.corrections import CORRECTED, corrected_part, corrections_of
from flangeye.estimation.answers.work import work_of
from flangeye.estimation.certify.certified import verdict_of
from flangeye.estimation.effects.arm import COMMON
from flangeye.estimation.estimate import Estimate, estimate
from flangeye.estimation.graph import Places, Problem
from flangeye.estimation.mixed import marginal
from flangeye.estimation.observability import symmetry_moves, unobservable
from flangeye.estimation.session.session import ModelOptions, Session, session_of
from flangeye.estimation.start.sightings import roll_note
from flangeye.maths.threads import on_one_thread
from flangeye.models.cell import Cell
from flangeye.models.configuration import mapped_and_expected
from flangeye.models.scanners import ScannerModel
from flangeye.types import (
    BASE,
    FLANGE,
    ArmCorrection,
    Box,
    CircleFeature,
    CorrectedArm,
    Floats,
    HandEye,
    Indices,
    Note,
    Observation,
    Pair,
    Transform,
    TransformEstimate,
    warnings_of,
)
from flangeye.types.geometry import adjoint_shift


@dataclass(frozen=True)
class Options:
    """Options of the calibration; see the parameters of ``solve.robust``.

    Attributes:
        limits: Largest standard deviations of a rotation [rad] and of a translation [m].
        mark: Whether unobservable translations are marked instead of refused.
        certify: Whether to try to prove the answer globally optimal.
        work: Where the expected error is evaluated; None for the session's own region.
        asked: Which unknowns to estimate.
    """

    limits: tuple[float, float] = (float(np.radians(2)), 20e-3)
    mark: bool = False
    certify: bool = False
    work: Box | None = None
    asked: ModelOptions = field(default_factory=ModelOptions)


@on_one_thread
def calibrate(
    observations: Sequence[Observation],
    cell: Cell,
    scanner: ScannerModel | None,
    options: Options,
    method: str,
) -> HandEye:
    """Return every unknown of a cell with its covariance, and the error to expect at the work.

    ``cell_of`` makes a cell from a configuration; ``method`` is the name of the stage.

    Raises:
        StageError: Too few sightings, all the same, or the pose of a moving frame is missing.
        CalibrationRefused: The sightings fit only when mirrored, fewer than half of them agree, the
            motion leaves something unknown (the message says which motion is missing), or a
            marker's size is not the configured one.
    """
    session = session_of(observations, cell, scanner, options.asked)
    if not options.certify:
        return answered(session, options, method)
    best, verdict = _certified(session)
    told = answered(best, options, method)
    return replace(told, notes=(*told.notes, verdict))


def answered(session: Session, options: Options, method: str) -> HandEye:
    """Return the calibration of a session that has been estimated.

    Raises:
        CalibrationRefused: The motion leaves something unknown.
    """
    found, weak = session.found, _weak(session, options)
    work = work_of(found.problem.where(found.inliers), found.places, options.work)
    left = np.repeat([not (e.of_arm and e.kind in CORRECTED) for e in found.effects], found.counts)
    # A corrected arm no longer has the errors that its correction takes: only the others displace
    # what it reports
    every = commanded(found, work)
    commands = every, every * left
    uncorrected, righted = (functional(found, each) for each in commands)
    reported, there = _reported(session, uncorrected, weak), predicted_work(found, work)
    expected = expected_error(there, uncorrected.mean)
    corrected = _corrected(session, righted, weak)
    if corrected is not None:
        then = expected_error(there, righted.mean, corrected_part(found))
        # It is given where it expects nine tenths of the error or less
        corrected = replace(corrected, expected=then) if then.rms <= 0.9 * expected.rms else None

    @on_one_thread
    def without(poses: Indices) -> HandEye:
        # Where commands lead is a property of cell and work: it stays without a few sightings
        rest = session.without(poses)
        weak = _weak(rest, options)
        of_arm, anew = (
            replace(answer, mean=moves(rest.found, each))
            for answer, each in zip((uncorrected, righted), commands, strict=True)
        )
        answer = _reported(rest, of_arm, weak)
        return replace(answer, corrected=corrected and _corrected(rest, anew, weak))

    return replace(
        reported,
        method=method,
        pairs=_pairs(session, reported),
        expected=expected,
        corrected=corrected,
        true=tuple(_estimates(session, as_true(found), weak)),
        notes=(*session.notes, *_notes(session, weak)),
        without=without,
    )


@on_one_thread
def calibrate_at(
    places: Places,
    observations: Sequence[Observation],
    cell: Cell,
    scanner: ScannerModel | None,
    options: Options,
    method: str,
) -> HandEye:
    """Return the calibration with places from another method, and the model's covariance.

    Every observation takes part. The covariance is about the given places, a pose (4, 4) of each
    unknown, so it includes their distance from the most likely ones.

    Raises:
        StageError: As of :func:`calibrate`.
        CalibrationRefused: As of :func:`calibrate`.
    """
    session = session_of(observations, cell, scanner, options.asked)
    found, weak = session.found, _weak(session, options)
    work = work_of(found.problem.where(found.inliers), found.places, options.work)
    there = found.problem.moves(found.places, places)
    answer = _reported(session, as_reported(found, work).at(there), weak)
    pairs = _pairs(session, answer)
    true = as_true(found).at(there)
    return replace(
        answer,
        pairs=tuple(replace(pair, used=True, reason=None) for pair in pairs),
        expected=expected_error(predicted_work(found, work), there),
        method=method,
        true=tuple(_estimates(session, true, weak)),
        notes=session.notes,
    )


def with_expected_error(
    calibration: HandEye, cell: Cell, scanner: ScannerModel | None, work: Box | None
) -> HandEye:
    """Return a calibration by any method with its expected error at the work, and warnings.

    The calibration is unchanged if the model refuses its observations, or has unknowns that the
    method does not estimate.
    """
    found = {x.transform.name: x.transform.matrix for x in calibration.transforms.values()}
    observations = [pair.observation for pair in calibration.pairs]
    with suppress(FlangeyeError, KeyError):
        places = {name: found[cell.name_of(name)] for name in cell.unknown_frames}
        answer = calibrate_at(places, observations, cell, scanner, Options(work=work), "")
        notes = tuple(dict.fromkeys((*calibration.notes, *warnings_of(answer.notes))))
        return replace(calibration, expected=answer.expected, notes=notes)
    return calibration


def _certified(session: Session) -> tuple[Session, Note]:
    """Return the session, at a better answer if one was found, and the verdict on it."""
    found, (verdict, start) = session.found, verdict_of(session.found)
    if start is None:
        return session, verdict
    there = estimate(found.problem, start, found.effects, found.inliers)
    if there.posterior.cost >= found.posterior.cost:
        return session, verdict
    moved = "the certificate found a likelier answer than the search; it is used"
    return replace(session, found=there).noted(moved), verdict_of(there)[0]


def _weak(session: Session, options: Options) -> Floats:
    """Return the unobservable moves (P, k) of the places; see ``unobservable``.

    The noise is the one estimated from the sightings, but no smaller than that of the best camera
    and arm. Arm errors common to all poses are left out.
    """
    found = session.found
    model, sizes = found.posterior.model, found.posterior.mode.sizes.copy()
    own = model.factors[:2, 0]
    # Noise of the best camera and arm [rad, m]: exact inputs must not seem observable
    sizes[own] = np.maximum(sizes[own], (1e-4, 2e-5))
    known = [k for k, effect in enumerate(found.effects) if effect.kind == COMMON]
    # Size of an effect that is left out [rad, m]
    sizes[known] = 1e-9
    agreeing = found.problem.where(found.inliers)
    return unobservable(
        agreeing,
        found.places,
        marginal(model, sizes),
        options.limits,
        options.mark,
        session.cell.freedoms,
    )


def _reported(session: Session, answer: Answer, weak: Floats) -> HandEye:
    """Return the answer for the arms as their controllers report them."""
    camera, *others = _estimates(session, answer, weak)
    tool = ArmCorrection(session.tool_offset) if session.tool_offset.any() else None
    shared = _shared(session.found)
    return HandEye(camera, (), "", correction=tool, others=tuple(others), shared=shared)


def _corrected(session: Session, answer: Answer, weak: Floats) -> CorrectedArm | None:
    """Return the answer for the arms with their errors corrected; None where no arm is known."""
    corrections = corrections_of(session.found, session.tool_offset)
    if not corrections:
        return None
    camera, *others = _estimates(session, answer, weak)
    alone = list(corrections) == [FLANGE]
    return CorrectedArm(
        camera,
        corrections[FLANGE] if alone else None,
        tuple(others),
        {} if alone else corrections,
        _shared(session.found),
    )


def _estimates(session: Session, answer: Answer, weak: Floats) -> list[TransformEstimate]:
    """Return the unknowns, cameras first, each with its covariance.

    A camera's covariance is about the middle of its sightings, any other's about its own origin.
    """
    problem, found = session.found.problem, session.found
    agreeing = list(compress(session.observations, found.inliers))
    moved = _without(problem, problem.moved(found.places, answer.mean), weak)
    rounds, out = symmetry_moves(problem, moved), {}
    for i, name in enumerate(problem.unknown):
        rows = slice(6 * i, 6 * i + 6)
        transform = Transform.named(session.cell.name_of(name), moved[name])
        # A turn of a round target is about its own axis.
        free = np.hstack([weak[rows], rounds[rows]])
        own = {cause: share[rows, rows] for cause, share in answer.shares.items()}
        seen = [o.feature.centre for o in agreeing if o.camera == transform.child]
        about = transform.apply(np.mean(seen, axis=0)) if seen else transform.translation
        out[name] = _estimate(transform, answer.covariance[rows, rows], own, about, free)
    order = [n for n in session.cell.unknown_frames if n in out]
    return [out[name] for name in order]


def _without(problem: Problem, places: Places, weak: Floats) -> Places:
    """Return the places moved along the null space until the camera's share of it is zero."""
    if not weak.shape[1]:
        return places
    i = problem.unknown.index(problem.ends[0][0])
    along = weak[6 * i + 3 : 6 * i + 6]
    at = places[problem.ends[0][0]][:3, 3]
    steps = np.linalg.lstsq(along.T @ along, -along.T @ at, rcond=None)[0]
    return problem.moved(places, weak @ steps)


def _estimate(
    transform: Transform,
    covariance: Floats,
    shares: Mapping[str, Floats],
    about: Floats,
    free: Floats,
) -> TransformEstimate:
    """Return an estimate, its covariance taken about a point (3,) in the parent [m].

    The covariance (6, 6), its shares by cause and the unobservable moves ``free`` (6, k) are given
    at the child's origin.
    """
    shift = adjoint_shift(about - transform.translation)
    sizes = np.linalg.norm(free, axis=0)
    kept = (shift @ free)[:, sizes > 1e-6]  # others move other places alone
    directions = np.linalg.qr(kept)[0].T if kept.shape[1] else np.zeros((0, 6))
    across = np.eye(6) - directions.T @ directions

    def moved(each: Floats) -> Floats:
        there = across @ shift @ each @ shift.T @ across
        return np.asarray(0.5 * (there + there.T))

    parts = {cause: moved(share) for cause, share in shares.items()}
    return TransformEstimate(transform, moved(covariance), about, directions, parts)


def _shared(found: Estimate) -> Floats:
    """Return each error common to all features, in its prior standard deviations."""
    return np.concatenate([np.zeros(0), *(mean for _, mean, _ in found.numbers("shared"))])


def _pairs(session: Session, answer: HandEye) -> tuple[Pair, ...]:
    """Return every observation with its residual in ``base``, and why it was not used."""
    found, observations = session.found, session.observations
    transforms = {name: x.transform for name, x in answer.transforms.items()}
    moved = session.cell.corrected(observations, answer)
    mapped, expected = mapped_and_expected(session.cell.ends(transforms, moved), moved)
    residuals, ranks = found.problem.residuals(found.places), found.problem.seen.ranks
    pairs = []
    for i, (o, used) in enumerate(zip(observations, found.inliers, strict=True)):
        turn, shift = np.linalg.norm(residuals[i].reshape(2, 3), axis=1)
        turned = f" and {np.degrees(turn):.1f} deg" if ranks[i] == 6 else ""
        sigma = np.sqrt(found.squares[i])
        reason = None if used else f"residual {shift * 1e3:.1f} mm{turned}, {sigma:.0f} sigma"
        pairs.append(Pair(o, mapped[i] - expected[i], bool(used), reason))
    return tuple(pairs)


def _noise_beyond(found: Estimate) -> tuple[float, float]:
    """Return the noise per axis beyond what the features' fits state: [rad] and [m]."""
    model, q = found.posterior.model, found.posterior.model.projectors
    every = (
        model.noise(found.posterior.mode.sizes) - (np.eye(6) - q) - found.problem.seen.covariances
    )
    # Per measured axis: the diagonal of a projector sums to how many of them there are
    squares = np.diagonal(q @ every @ q, axis1=1, axis2=2).reshape(-1, 2, 3).sum(axis=(0, 2))
    freedoms = np.diagonal(q, axis1=1, axis2=2).reshape(-1, 2, 3).sum(axis=(0, 2))
    turn, shift = np.sqrt(np.maximum(squares / np.maximum(freedoms, 1.0), 0.0))
    return float(turn), float(shift)


def _sees_flange(cell: Cell) -> bool:
    """Whether one camera stands on the root and sees the flange's own circle."""
    camera, target = cell.frames[cell.cameras[0]], cell.frames[cell.targets[0]]
    at_origin = target.place is not None and not np.abs(target.place - np.eye(4)).any()
    return camera.parent == BASE and target.parent == FLANGE and at_origin


def _notes(session: Session, weak: Floats) -> list[Note]:
    """Return the notes for the record."""
    found, cell = session.found, session.cell
    turn, shift = _noise_beyond(found)
    # An error of exactly nothing is never claimed
    mm, deg = (f"{x:.3f}" if x >= 5e-4 else "below 0.001" for x in (shift * 1e3, np.degrees(turn)))
    notes: list[Note] = [
        f"estimated noise of each pose, in addition to the noise of its fit: {mm} mm and {deg} deg "
        f"per axis"
    ]
    if len(found.problem.ends) > 1:
        who = Counter((o.camera, o.target) for o in session.observations)
        seen = ", ".join(f"{c} saw {t} {n} times" for (c, t), n in who.items())
        notes.append(f"solved at once: {seen}")
    agreeing = list(compress(session.observations, found.inliers))
    plates = [o for o in agreeing if isinstance(o.feature, CircleFeature) and o.feature.radii]
    if _sees_flange(cell) and plates and found.problem.seen.ranks.max() == 5:
        camera = found.places[found.problem.ends[0][0]]
        notes.append(roll_note(agreeing, camera[:3, :3], found.posterior.covariance[:3, :3]))
    if weak.shape[1]:
        notes.append(
            f"not observable from these poses, and set to zero: {weak.shape[1]} translation"
            f"{'s' if weak.shape[1] > 1 else ''} parallel to the only axis about which the arm "
            f"turned"
        )
    return notes
