"""The calibration of a cell: what its measurements agree on, with the arm's error in it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import chain
from typing import NamedTuple

import numpy as np

from flangeye.errors import CalibrationRefused
from flangeye.handeye.arm import (
    SIGNIFICANT,
    unknown_zeros,
    with_field,
    with_joint_offsets,
    with_tool_offset,
)
from flangeye.handeye.arm_errors import evidence, note_of_errors, with_arm_errors
from flangeye.handeye.candidates import (
    Model,
    better,
    considered,
    following,
    understated,
    with_nuisance,
)
from flangeye.handeye.certificate import GAP
from flangeye.handeye.certified import answer_of, certificate_notes, moved_note, verdict_of
from flangeye.handeye.consensus import Consensus, begun_at, find_consensus
from flangeye.handeye.distortion import distortion_of, edges_of
from flangeye.handeye.estimates import (
    columns_of,
    estimate_at,
    noise_beyond,
    noise_note,
    points_of_interest,
    transforms_of,
)
from flangeye.handeye.flange_roll import roll_note
from flangeye.handeye.likelihood import Solution, freedom_of_sizes, weigh
from flangeye.handeye.loop import ArmNoise, LoopProblem, meaningless_turns
from flangeye.handeye.measurements import by_depth, loop_of, measurements_of, shared_errors
from flangeye.handeye.nuisance import Nuisance, nuisance_seen
from flangeye.handeye.observability import (
    ObservabilityLimits,
    require_enough,
    require_turns,
    unobservable,
)
from flangeye.handeye.observed import Cell
from flangeye.handeye.starts import size_of
from flangeye.handeye.target_size import estimated_factor, longer_distances, require_size
from flangeye.handeye.unknowns import Unknowns
from flangeye.handeye.wander import with_walk
from flangeye.maths.geometry import stack_rows
from flangeye.maths.statistics import covariance_inflation, f_quantile
from flangeye.models.scanners import ScannerModel
from flangeye.types import (
    BASE2,
    CAMERA,
    FLANGE,
    TARGET,
    CorrectedArm,
    Floats,
    HandEye,
    Observation,
    Pair,
    ScatterNoise,
    TransformEstimate,
)

CLOCK_STEPS, EXACT_DELAY = 6, 1e-5
"""Steps to find the time between two clocks, and how small the last one is [s]."""
SIZES, EXACT_SIZE, LOOSEST_SIZE = 10, 1e-6, 0.1
"""Steps to find a target's size, the share by which the last one changes it, and the largest
standard deviation of what is taken for found."""
TYPICAL_ARM = ArmNoise(np.radians(0.01), 0.05e-3)
"""Noise of the poses of an arm of which nothing is known: what else is found is in its ratio."""


@dataclass(frozen=True)
class Options:
    """What a solver takes into account; see the parameters of ``solve.robust``.

    Attributes:
        normals: Whether circles' normals count.
        normal_bias: Standard deviation of a tilt common to all normals [rad].
        robot_noise: Standard deviations of the poses the arm reports, where it is known.
        pose_noise: Standard deviation of the arm's position per axis, where it is known [m].
        limits: What has to be known, and how well.
        tool_offset: Whether an offset of the seen circle is looked for.
        joint_offsets: Whether joint offsets are looked for.
        joint_prior: Standard deviation of one [rad].
        joint_zeros: Whether the covariance includes what zeros may be off by.
        smooth_error: Whether a smooth error of the arm is looked for.
        scanner_distortion: Whether the scanner's smooth distortion is part of the model.
        size_limit: Share by which a marker may be of another size.
        finds_size: Whether its size is found instead, from the arm's motion.
        certify: Whether to say if the answer is the best of all, and to look for a better one.
    """

    normals: bool
    normal_bias: float
    robot_noise: ArmNoise | None
    pose_noise: float | None
    limits: ObservabilityLimits
    tool_offset: bool
    joint_offsets: bool
    joint_prior: float
    joint_zeros: bool
    smooth_error: bool
    scanner_distortion: bool
    size_limit: float
    finds_size: bool
    certify: bool


def calibrate(cell: Cell, options: Options, method: str) -> HandEye:
    """Return every unknown of a cell with its covariance, and what is wrong with the arm.

    Raises:
        StageError: Too few poses, all the same, those of a mirrored camera, or a carrier's pose
            is missing.
        CalibrationRefused: Fewer than half of the poses agree, the motion leaves something unknown
            (it says which motion is missing), or a marker has another size than its fit was told.
    """
    problem = _problem(cell, options)
    require_enough(problem)
    require_turns(problem)
    size = 1.0
    if options.finds_size and problem.measurements.are_poses:
        size = size_of(problem.measurements, problem.loop, np.random.default_rng(0))
        cell = cell.resized(size)
        problem = _problem(cell, options)
    cell, model = _with_clock(cell, _agreed(cell, options, problem), options)
    weak = unobservable(model.problem, model.found, options.limits)
    model, weak = _with_shared(model, cell, weak)
    if options.finds_size and model.problem.measurements.are_poses:
        cell, model = _with_size(cell, model, options, size)
    else:
        require_size(model, options.size_limit, cell.arms if options.joint_zeros else ())
    model = _with_depth(model)
    reported, model = (
        (_without(model, weak),) * 2 if weak.shape[1] else _with_arm(model, cell, options)
    )
    stated = _stated(reported, cell, options, weak)
    distortion = _distortion(reported, cell, options, weak)
    camera, *others = _estimates(reported, cell, weak, stated.covariance, distortion)
    scatter = replace(
        _scatter(model.found), pose=_scattered(reported, cell, weak, stated, distortion)
    )
    told = *stated.notes, *_note_of_shared(_shared_of(reported))
    notes = (*_noise_notes(model, cell, weak), *told)
    if cell.scanner is not None and distortion is not None:
        notes = (*notes, note_of_distortion(cell.scanner))
    if options.certify:
        corrected = answer_of(model.problem, model.found) if model.corrects_joints else None
        told = certificate_notes(answer_of(reported.problem, reported.found), corrected)
        notes = (*notes, *told)
    return HandEye(
        camera,
        _pairs(reported, model, cell),
        method,
        model.consensus.notes + notes + model.notes,
        reported.correction,
        tuple(others),
        _corrected(model, cell, options, weak),
        scatter,
        shared=_shared_of(reported),
    )


def _with_size(cell: Cell, model: Model, options: Options, size: float) -> tuple[Cell, Model]:
    """Return the cell as it is with the target's size found, and what is then agreed on.

    Args:
        cell: The cell, its target so many times as large as was said already.
        model: What is agreed on there.
        options: How to solve it.
        size: That factor.
    """
    for _ in range(SIZES):
        longer = longer_distances(model.problem.measurements)
        told = estimated_factor(model, longer)
        if not told.is_believable or told.sigma > LOOSEST_SIZE:
            raise CalibrationRefused(
                f"the target's size is told to {told.sigma:.1%} only: move the arm further between "
                "poses, or say target_size: known"
            )
        size, cell = size * (1 + told.share), cell.resized(1 + told.share)
        model = _agreed(cell, options)
        if abs(told.share) < EXACT_SIZE:
            break
    longer = longer_distances(model.problem.measurements)
    known = with_nuisance(model, nuisance_seen(longer, np.inf)) or model
    sigma = size * told.sigma
    digits = max(4, 1 - int(np.floor(np.log10(sigma)))) if sigma > 0 else 4
    return cell, known.noted(
        f"by the arm's own motion the target is {size:.{digits}f} +- {sigma:.{digits}f} times as "
        "large as was said where it was fitted, and is taken to be"
    )


def _agreed(cell: Cell, options: Options, problem: LoopProblem | None = None) -> Model:
    """Return what the measurements agree on, with the time between two clocks if it was found."""
    consensus = find_consensus(problem or _problem(cell, options), options.limits.rotation)
    model = Model(_at_best(consensus) if options.certify else consensus)
    unknown = None if cell.delay is None else cell.unknown_delay()
    return model if unknown is None else with_nuisance(model, unknown) or model


def _at_best(consensus: Consensus) -> Consensus:
    """Return what is agreed on where the certificate leads, if that fits better, and say so."""
    problem, found = consensus.problem, consensus.found
    start = verdict_of(answer_of(problem, found)).better
    if start is None:
        return consensus
    places = zip((CAMERA, BASE2, TARGET), found.at.places, strict=True)
    there = begun_at(consensus, Unknowns.of_loop(*(start.get(*place) for place in places)))
    before, after = (
        weigh(problem, at, found.noise, found.inliers.astype(float)).cost
        for at in (found.at, there.found.at)
    )
    if after >= (1 - GAP) * before:
        return consensus
    return replace(there, notes=(*there.notes, moved_note(after / before)))


def _with_clock(cell: Cell, model: Model, options: Options) -> tuple[Cell, Model]:
    """Return the cell with the flange where it was when it was seen, if that helps, and its model.

    Where the arm moved and a stream of its poses was recorded by a clock of its own. What is left
    of the time between the clocks is part of the model; where it does not help, of the covariance.
    """
    unknown = cell.unknown_delay()
    told = None if unknown is None else with_nuisance(model, unknown)
    if told is None:
        return cell, model
    delay, sigma = _delay_of(told)
    kept = replace(cell, clock_deviation=float(np.hypot(delay, sigma)))
    if (delay / sigma) ** 2 < f_quantile(SIGNIFICANT, 1, told.found.freedom):
        return kept, model
    moved, candidate = cell, told
    for _ in range(CLOCK_STEPS):
        later = moved.delayed(delay)
        if later is None:
            return kept, model.noted("left out: " + _clock_told(moved, delay, sigma))
        moved = later
        candidate = _agreed(moved, options)
        delay, sigma = _delay_of(candidate)
        if abs(delay) < EXACT_DELAY:
            break
    chosen = better(model, candidate, _clock_told(moved, 0.0, sigma))
    return (moved if chosen.found is candidate.found else kept), chosen


def _delay_of(model: Model) -> tuple[float, float]:
    """Return the first of the nuisances, and its standard deviation."""
    found = model.found
    first = found.at.before_nuisance
    return float(found.at.nuisance[0]), float(np.sqrt(found.covariance[first, first]))


def _clock_told(cell: Cell, further: float, sigma: float) -> str:
    delay = (cell.delay or 0.0) + further
    which = "after" if delay > 0 else "before"
    carrier = "flange" if cell.flange else "arm"
    return (
        f"the {carrier} was at the poses {abs(delay) * 1e3:.1f} +- {sigma * 1e3:.1f} ms {which} "
        "the times they are paired by"
    )


def _with_shared(model: Model, cell: Cell, weak: Floats) -> tuple[Model, Floats]:
    """Return the model with the errors that all features share; the weak moves get as many more."""
    seen = shared_errors(cell.observations)
    if not seen.any():
        return model, weak
    moved = with_nuisance(model, nuisance_seen(seen, 1.0, shared=True))
    if moved is None:
        return model, weak
    return moved, np.pad(weak, ((0, seen.shape[2]), (0, 0)))


def _shared_of(model: Model) -> Floats:
    """Return how much there is of each error that the features share [standard deviations]."""
    return np.asarray(model.found.at.nuisance[model.problem.nuisance.shared])


def _note_of_shared(found: Floats) -> tuple[str, ...]:
    if not len(found):
        return ()
    numbers = f"{len(found)} number{'s' if len(found) > 1 else ''}"
    return (
        "what the features share, such as the errors of a camera found by its own views, is found "
        f"with the poses: {numbers}, the largest {np.abs(found).max():.1f} standard deviations; "
        "held-out errors are measured with it corrected",
    )


def _with_depth(model: Model) -> Model:
    """Return the model with as much noise in depth as whole poses show: most cameras have more.

    Only now, when most agree: before, one that is mistaken in depth alone would agree as well.
    """
    problem = model.problem
    if problem.stated or not problem.measurements.are_poses:
        return model
    return model.with_problem(replace(problem, in_depth=True)) or model


def _problem(cell: Cell, options: Options) -> LoopProblem:
    s = measurements_of(cell.observations, cell.configuration, cell.arm, normals=options.normals)
    loop, noise = loop_of(cell.configuration), options.robot_noise
    typical = TYPICAL_ARM if loop.y or loop.z or s.are_poses else None
    return LoopProblem(
        measurements=s,
        loop=loop,
        arms=noise or typical,
        tilt=options.normal_bias,
        stated=noise is not None,
        pose_noise=None if options.pose_noise is None else options.pose_noise**2,
    )


def _with_arm(model: Model, cell: Cell, options: Options) -> tuple[Model, Model]:
    """Return the models of the arm as reported, and with what helps of the arm's error."""
    flange = cell.flange
    if flange is None or model.problem.stated:
        return model, model
    if options.smooth_error:
        walking, gain = with_walk(model, options.finds_size)
        if gain and gain > (evidence(model, cell.arms) if options.joint_zeros else 0.0):
            return walking, walking
    if options.tool_offset and cell.configuration.target == FLANGE and not model.problem.loop.z:
        considered = flange if options.joint_zeros else replace(flange, deviation=0.0)
        model = with_tool_offset(model, considered)
    if options.joint_offsets and flange.kinematics is not None:
        candidate = with_joint_offsets(model, flange, options.joint_prior)
        if candidate.corrects_joints:
            return model, with_field(candidate, flange) if options.smooth_error else candidate
        model = candidate
    if options.smooth_error:
        model = with_field(model, flange)
    return model, model


def _corrected(model: Model, cell: Cell, options: Options, weak: Floats) -> CorrectedArm | None:
    """Return the answer for the arm with its joint offsets corrected, if they were found."""
    if model.correction is None or not model.corrects_joints:
        return None
    distortion = _distortion(model, cell, options, weak)
    stated = _stated(model, cell, options, weak)
    camera, *others = _estimates(model, cell, weak, stated.covariance, distortion)
    together = stated._replace(of_scatter=_together(model, distortion))
    return CorrectedArm(
        camera,
        model.correction,
        tuple(others),
        shared=_shared_of(model),
        scatter=_scattered(model, cell, weak, together, None),
    )


def _together(model: Model, distortion: Nuisance | None) -> Floats:
    """Return the (18, 18) covariance of the camera's pose with the offsets that go with it.

    The pose alone is known worse: offsets take back what it is off by. What is left of both at the
    poses is a rigid motion and little else; this is the covariance of that.
    """
    found, out = model.found, np.zeros((18, 18))
    rows = stack_rows(found.linear.jacobian[found.inliers][:, 3:])
    together = np.linalg.pinv(rows[:, :6]) @ rows
    spread = found.covariance * _inflation(model)
    if distortion is not None:
        moved = following(model.problem, found, distortion) * distortion.prior
        spread = spread + moved @ moved.T
    out[:6, :6] = together @ spread @ together.T
    return out


def _inflation(model: Model) -> float:
    """Return by how much a covariance is larger whose noise was itself estimated."""
    alone = not (model.problem.loop.y or model.problem.loop.z)
    freedom = freedom_of_sizes(model.problem, model.found)
    return covariance_inflation(freedom, 6 if alone else model.found.parameters)


def _covariance(model: Model) -> Floats:
    """Return the (18, 18) covariance of the transforms that the fit itself leaves."""
    return np.asarray(model.found.covariance[:18, :18] * _inflation(model))


class _Stated(NamedTuple):
    """What is stated of the transforms.

    Attributes:
        covariance: (18, 18) with what the arm does wrong alike at all poses.
        of_scatter: (18, 18) as scatter leaves it, and zeros as the robot's file has them.
        notes: What is to be said of it.
    """

    covariance: Floats
    of_scatter: Floats
    notes: tuple[str, ...] = ()


def _stated(model: Model, cell: Cell, options: Options, weak: Floats) -> _Stated:
    """Return the covariance with what the arm does wrong alike at all poses, and say so.

    That moves the answer, and held-out errors do not show it. What is found of it with the pose,
    such as offsets of joints, is so no more.
    """
    own, flange = _covariance(model), cell.flange
    if not cell.arms or not options.joint_zeros:
        return _Stated(own, own)
    if any(moved.kinematics is None for moved in chain(*cell.arms)):
        return _Stated(own, own, (note_of_unknown_arm(cell),))
    deviation = cell.arms[0][0].deviation * 1e3
    each = f"unknown joint zeros ({deviation:g} mrad each)"
    if any(moved.some_joints is None for moved in chain(*cell.arms)):
        return _Stated(own, own, (f"{each} not considered: the arm's model misses these poses",))
    notes: tuple[str, ...] = ()
    if flange is not None and cell.configuration.is_default:
        own = own + unknown_zeros(model, flange)
        notes = (
            f"{each} are in the covariance: they move all poses alike, which held-out errors do "
            "not show",
        )
    if weak.shape[1]:
        return _Stated(own, own, notes)
    covariance, sizes = with_arm_errors(model, cell.arms, _inflation(model))
    return _Stated(covariance, own, (note_of_errors(cell.arms, sizes),))


def _scattered(
    model: Model, cell: Cell, weak: Floats, stated: _Stated, distortion: Nuisance | None
) -> Floats | None:
    """Return the (6, 6) of the camera's pose as scatter leaves it; see :class:`ScatterNoise`."""
    if not cell.configuration.is_default or stated.of_scatter is stated.covariance:
        return None
    return _estimates(model, cell, weak, stated.of_scatter, distortion)[0].covariance


def note_of_unknown_arm(cell: Cell) -> str:
    """Say that what the arm does wrong is not in the covariance."""
    which, where = ("arm", "robot") if cell.robot is None else ("second arm", "second_robot")
    return (
        f"what the {which} does wrong alike at all poses is not in the covariance, for its "
        f"kinematics are not known: name them in the recipe ({where}: model, or urdf)"
    )


def _estimates(
    model: Model, cell: Cell, weak: Floats, covariance: Floats, distortion: Nuisance | None
) -> list[TransformEstimate]:
    """Return the transforms with their covariances, begun at the (18, 18) given."""
    configuration, at = cell.configuration, model.found.at
    transforms = transforms_of(configuration, at.x, at.y, at.z)
    points = points_of_interest(configuration, transforms, _agreeing(model, cell), cell.arm)
    if distortion is not None:
        covariance = covariance + considered(model, distortion)
    clock = cell.unknown_delay() if cell.clock_deviation else None
    if clock is not None:
        known = replace(clock, prior=np.array([cell.clock_deviation]))
        covariance = covariance + considered(model, known)
    turns = meaningless_turns(model.problem.measurements, model.problem.loop, at)
    arbitrary = np.hstack([weak[:18], turns[:18]])
    columns = {name: columns_of(name, configuration) for name in transforms}
    return [
        estimate_at(
            transform,
            covariance[columns[name], columns[name]],
            points[name],
            arbitrary[columns[name]],
        )
        for name, transform in transforms.items()
    ]


def _distortion(model: Model, cell: Cell, options: Options, weak: Floats) -> Nuisance | None:
    """Return the scanner's distortion where it is asked for; worse is what is not observable."""
    asked = options.scanner_distortion and not weak.shape[1]
    return distortion_seen(model, cell) if asked else None


def distortion_seen(model: Model, cell: Cell) -> Nuisance | None:
    """Return the scanner's distortion; None where nothing is known of it, or none is seen.

    With what it does to edges, where a circle's place is unknown: elsewhere that is a few percent.
    """
    seen = np.array([by_depth(o.feature) for o in cell.observations])
    if cell.scanner is None or not seen.any():
        return None
    s = model.problem.measurements
    distortion = distortion_of(cell.scanner, s, seen)
    return distortion.and_also(edges_of(s, seen)) if model.problem.loop.z else distortion


def note_of_distortion(scanner: ScannerModel) -> str:
    """Say that the scanner's distortion is in the covariance."""
    return (
        f"the scanner's smooth distortion ({scanner.calibration_error * 1e3:g} mm rms over "
        "its volume, by its file) is in the covariance: it is the same at every pose, which "
        "held-out errors do not show"
    )


def _scatter(found: Solution) -> ScatterNoise:
    """Return what differs from pose to pose, at the place where the target is seen."""
    of_arms = np.diagonal(found.linear.of_arms, axis1=1, axis2=2)[:, 3:].mean() * found.noise.arms
    arm = float(of_arms + found.noise.pose + found.noise.depth / 3)
    unknown = covariance_inflation(found.freedom, 3) if np.isfinite(found.freedom) else 1.0
    return ScatterNoise(arm, found.noise.centre_scale, unknown * understated(found))


def _agreeing(model: Model, cell: Cell) -> list[Observation]:
    return [o for o, kept in zip(cell.observations, model.found.inliers, strict=True) if kept]


def _without(model: Model, weak: Floats) -> Model:
    """Return the fit moved to where the camera has no part along unobservable moves."""
    found, along = model.found, weak[3:6]
    steps = np.linalg.lstsq(along.T @ along, -along.T @ found.at.x[:3, 3], rcond=None)[0]
    # What is left of the basis is what the poses tell: the covariance is of that.
    kept = found.basis - weak @ (weak.T @ found.basis)
    u, sizes, _ = np.linalg.svd(kept, full_matrices=False)
    basis = u[:, sizes > 1e-6]
    change = np.linalg.pinv(found.basis) @ basis
    information = change.T @ found.information @ change
    moved = replace(found, at=found.at.moved(weak @ steps), basis=basis, information=information)
    return replace(model, consensus=replace(model.consensus, found=moved))


def _pairs(reported: Model, model: Model, cell: Cell) -> tuple[Pair, ...]:
    """Return every observation with its residual for the arm as reported, in ``base``.

    What is set aside, and why, the whole model says.
    """
    found, residuals, left = model.found, reported.residuals(as_reported=True), model.residuals()
    turns = np.degrees(np.linalg.norm(found.linear.residuals[:, :3], axis=1))
    pairs = []
    for i, (o, used) in enumerate(zip(cell.observations, found.inliers, strict=True)):
        turn = f" and {turns[i]:.1f} deg" if model.problem.measurements.freedoms[i] == 6 else ""
        far = f"{np.linalg.norm(left[i]) * 1e3:.1f} mm{turn}"
        reason = None if used else f"residual {far}, {np.sqrt(found.squares[i]):.0f} sigma"
        pairs.append(Pair(o, residuals[i], bool(used), reason))
    return tuple(pairs)


def _noise_notes(model: Model, cell: Cell, weak: Floats) -> tuple[str, ...]:
    notes, found = [], model.found
    if not model.problem.stated:
        notes += _beyond(found, model.problem)
    agreeing = _agreeing(model, cell)
    plates = not model.problem.measurements.are_poses and any(
        o.circle.normal is not None for o in agreeing
    )
    if cell.configuration.is_default and plates:  # a sphere, or a point, has no holes
        notes.append(roll_note(agreeing, found.at.x[:3, :3], found.covariance[:3, :3]))
    if weak.shape[1]:
        notes.append(
            f"not observable from these poses, and set to zero: {weak.shape[1]} translation"
            f"{'s' if weak.shape[1] > 1 else ''} along which the arm's axes do not tilt"
        )
    return tuple(notes)


def _beyond(found: Solution, problem: LoopProblem) -> list[str]:
    """Say what noise there is beyond the features' own."""
    if problem.measurements.are_poses or problem.arms is not None:
        return [noise_note(found)]
    shift, turn = noise_beyond(found)
    notes = [f"noise beyond the centres' own: {shift:.3f} mm per axis"]
    if problem.measurements.has_normal.any():
        notes.append(f"noise beyond the normals' own: {turn:.3f} deg per axis")
    return notes
