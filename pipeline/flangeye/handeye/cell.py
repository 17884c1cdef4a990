"""The calibration of a cell of many cameras, arms, rails and targets, all of it at once."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress

import numpy as np

from flangeye.errors import CalibrationRefused, FlangeyeError, StageError
from flangeye.handeye.arm_sizes import Sizes
from flangeye.handeye.bent import KINDS
from flangeye.handeye.calibration import TYPICAL_ARM
from flangeye.handeye.cell_arms import (
    CorrectedArms,
    branches_of,
    considering_errors,
    correcting_zeros,
)
from flangeye.handeye.cell_clock import on_one_clock
from flangeye.handeye.certificate import GAP
from flangeye.handeye.certified import Answer, certificate_notes, moved_note, verdict_of
from flangeye.handeye.estimates import estimate_at, noise_note
from flangeye.handeye.graph import Sighting, Solved, solve_graph, solved_from, solved_of
from flangeye.handeye.likelihood import Solution, agreeing, weigh
from flangeye.handeye.measurements import measured, shared_errors
from flangeye.handeye.nuisance import nuisance_seen
from flangeye.maths.geometry import rigid
from flangeye.models.cell import Cell
from flangeye.models.configuration import mapped_and_expected
from flangeye.types import (
    CorrectedArm,
    Floats,
    HandEye,
    Observation,
    Pair,
    Transform,
    TransformEstimate,
)

NOWHERE = np.zeros((6, 0))


def calibrate_cell(
    observations: Sequence[Observation],
    cell: Cell,
    limits: tuple[float, float],
    method: str,
    joint_offsets: bool = True,
    certify: bool = False,
) -> HandEye:
    """Return every unknown of a cell with its covariance; the first camera's pose comes first.

    The noise of what moves, and what noise there is beside it, is found from the residuals, and
    sightings beyond that are set aside.

    Args:
        observations: The sightings.
        cell: What stands on what.
        limits: Largest standard deviations of a rotation [rad] and of a translation [m].
        method: Stage that solves it.
        joint_offsets: Whether to look for the zeros of the arms' joints, and to give the answer
            for arms so corrected, where that helps on sightings held out.
        certify: Whether to say if the answer is the best of all, and to look for a better one.

    Raises:
        StageError: No sighting, or one without the pose of something that moves.
        CalibrationRefused: The sightings leave something unknown (it says what), or fewer than half
            of them agree.
    """
    found = solve_cell(observations, cell, limits)
    found, moved = _at_best(found) if certify else (found, ())
    _require_agreement(found, len(observations))
    timed = on_one_clock(observations, cell, _with_shared(found, observations))
    observations, found = timed.observations, timed.found
    branches = branches_of(found.problem, cell, cell.joints(observations))
    known, sizes = considering_errors(found, branches)
    notes = (*_notes(observations, found, sizes), *timed.notes)
    corrected = None
    if sizes and joint_offsets:
        corrected, told = correcting_zeros(found, branches, sizes)
        notes = (*notes, told)
    if certify:
        better = None if corrected is None else answer_of(corrected.found)
        notes = (*notes, *moved, *certificate_notes(answer_of(found), better))
    camera, *others = _estimates(known, observations, cell)
    return HandEye(
        camera,
        _pairs(observations, cell, known),
        method,
        notes,
        others=tuple(others),
        corrected=None if corrected is None else _answer(corrected, observations, cell),
    )


def solve_cell(
    observations: Sequence[Observation],
    cell: Cell,
    limits: tuple[float, float],
    start: Mapping[str, Floats] | None = None,
) -> Solved:
    """Return the places of a cell's unknown frames, as its graph has them.

    Args:
        observations: The sightings.
        cell: What stands on what.
        limits: Largest standard deviations of a rotation [rad] and of a translation [m].
        start: The places, where most of the sightings were solved already.

    Raises:
        StageError: No sighting, or one without the pose of something that moves.
        CalibrationRefused: The sightings leave something unknown: it says what.
    """
    if not observations:
        raise StageError("no sighting to solve with: every capture was set aside, for its reason")
    sightings = [sighting_of(i, o) for i, o in enumerate(observations)]
    noise = {name: TYPICAL_ARM.covariance for name in cell.measured}
    return solve_graph(cell.graph(observations), sightings, noise, limits, start, cell.freedoms)


def solve_so_far(
    observations: Sequence[Observation],
    cell: Cell,
    limits: tuple[float, float],
    before: Solved | None,
) -> Solved | None:
    """Return the solution, begun at that before; None as long as something stays unknown."""
    start = None if before is None else before.places
    with suppress(FlangeyeError, np.linalg.LinAlgError):
        return solve_cell(observations, cell, limits, start)
    return None


def sighting_of(i: int, observation: Observation) -> Sighting:
    """Return an observation as the graph takes it, at the i-th of its times."""
    rotation, covariance, projector = measured(observation, normals=True)
    pose = rigid(rotation, observation.feature.centre)
    return Sighting(i, observation.camera, observation.target, pose, covariance, projector)


def answer_of(found: Solved) -> Answer:
    """Return the answer for the sightings that agree, as certificates take it."""
    problem, kept = found.problem, found.found.inliers
    seen = problem.measurements.where(kept)
    return Answer(
        problem.frames,
        [problem.ends[k] for k in seen.pairs],
        seen.times,
        found.places,
        found.covariances,
        found.found.linear.residuals[kept],
        found.found.weights[kept],
        seen.freedoms,
    )


def _at_best(found: Solved) -> tuple[Solved, tuple[str, ...]]:
    """Return the answer to which the certificate leads, if that fits better, and what to say."""
    start = verdict_of(answer_of(found)).better
    if start is None:
        return found, ()
    there, fit = solved_from(found.problem, start), found.found
    before, after = (
        weigh(found.problem, each.found.at, fit.noise, fit.inliers.astype(float)).cost
        for each in (found, there)
    )
    return (there, (moved_note(after / before),)) if after < (1 - GAP) * before else (found, ())


def _with_shared(found: Solved, observations: Sequence[Observation]) -> Solved:
    """Return the solution with the errors that all features of a camera share found along."""
    seen = shared_errors(observations)
    if not seen.any():
        return found
    cameras = dict.fromkeys(o.camera for o in observations)
    whose = np.array([[o.camera == camera for camera in cameras] for o in observations])
    each = np.concatenate([seen * of[:, None, None] for of in whose.T], axis=2)
    shared = nuisance_seen(each, 1.0, shared=True)
    problem = found.problem.beside(shared)
    return solved_of(problem, agreeing(problem, found.found))


def _require_agreement(found: Solved, count: int) -> None:
    agree = int(found.found.inliers.sum())
    if 2 * agree < count:
        raise CalibrationRefused(
            f"only {agree} of {count} sightings agree with one another: check that each belongs to "
            "the poses beside it, and that the cell stands as the recipe says"
        )


def _answer(
    corrected: CorrectedArms, observations: Sequence[Observation], cell: Cell
) -> CorrectedArm:
    camera, *others = _estimates(corrected.found, observations, cell)
    return CorrectedArm(camera, None, tuple(others), corrected.corrections)


def _estimates(
    found: Solved, observations: Sequence[Observation], cell: Cell
) -> list[TransformEstimate]:
    """Return the unknowns, the first camera's first."""
    transforms = _transforms(found, cell).values()
    return [_estimate(transform, found, observations) for transform in transforms]


def _transforms(found: Solved, cell: Cell) -> dict[str, Transform]:
    return {
        cell.name_of(name): Transform.named(cell.name_of(name), found.places[name])
        for name in cell.unknown_frames
    }


def _estimate(
    transform: Transform, found: Solved, observations: Sequence[Observation]
) -> TransformEstimate:
    """Return an estimate: a camera's about the middle of what it saw, else about its origin."""
    seen = [o.feature.centre for o in observations if o.camera == transform.child]
    about = transform.apply(np.mean(seen, axis=0)) if seen else transform.translation
    return estimate_at(transform, found.covariances[transform.child], about, NOWHERE)


def _pairs(observations: Sequence[Observation], cell: Cell, found: Solved) -> tuple[Pair, ...]:
    ends = cell.ends(_transforms(found, cell), observations)
    mapped, expected = mapped_and_expected(ends, observations)
    pairs = []
    for i, (o, used) in enumerate(zip(observations, found.found.inliers, strict=True)):
        reason = None if used else _aside(found.found, i)
        pairs.append(Pair(o, mapped[i] - expected[i], bool(used), reason))
    return tuple(pairs)


def _aside(fit: Solution, i: int) -> str:
    """Return how far a sighting is from what the others say."""
    turn, shift = np.linalg.norm(fit.linear.residuals[i].reshape(2, 3), axis=1)
    sigma = np.sqrt(fit.squares[i])
    return f"residual {shift * 1e3:.1f} mm and {np.degrees(turn):.1f} deg, {sigma:.0f} sigma"


def _notes(
    observations: Sequence[Observation], found: Solved, sizes: Sizes | None
) -> tuple[str, ...]:
    who = Counter((o.camera, o.target) for o in observations)
    sightings = ", ".join(f"{camera} saw {target} {n} times" for (camera, target), n in who.items())
    return f"solved at once: {sightings}", noise_note(found.found), *_note_of_sizes(sizes)


def _note_of_sizes(sizes: Sizes | None) -> tuple[str, ...]:
    if sizes is None:
        return ()
    zeros, *others = sizes.expected
    each = ", ".join(f"{kind} {size:.1f}" for kind, size in zip(KINDS, others, strict=True))
    return (
        f"the covariance counts joint zeros {zeros:.1f} times as large as the robots' files say "
        f"(joint_accuracy), and what goes with them: {each} times: all that is likely by the "
        "residuals",
    )
