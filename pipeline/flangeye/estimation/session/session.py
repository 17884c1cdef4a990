"""From observations to the posterior: initial guess, effects, and outlier rejection."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import product

import numpy as np

from flangeye.errors import CalibrationRefused, StageError
from flangeye.estimation.effects.arm import arm_effects
from flangeye.estimation.effects.camera import camera_effects, drift_effects
from flangeye.estimation.effects.clock import clock_effects, delayed
from flangeye.estimation.effects.effect import Effect
from flangeye.estimation.effects.scanner import scanner_effects
from flangeye.estimation.effects.target import offset_shown_to, target_effects, wrong_offset
from flangeye.estimation.effects.walk import innovations
from flangeye.estimation.estimate import Estimate, estimate, model_at
from flangeye.estimation.graph import Carrier, Places, Problem
from flangeye.estimation.mixed import fit, mode_of
from flangeye.estimation.observability import (
    fewest_sightings,
    require_enough,
    require_turns,
    spread_of,
)
from flangeye.estimation.start.loops import agreeing, distances, initial_guess, size_of
from flangeye.estimation.start.sightings import branches_of, problem_of
from flangeye.maths.arm_correction import reached_from
from flangeye.maths.kinematics import Arm
from flangeye.maths.statistics import MISFIT, chi2_quantile
from flangeye.maths.threads import on_one_thread
from flangeye.models.cell import Cell
from flangeye.models.scanners import ScannerModel
from flangeye.types import Floats, Indices, Mask, Note, Observation, PoseFeature, Warn
from flangeye.types.geometry import rigid

CONFIGURED = (
    "check that each scan belongs to its robot pose, and that the recipe's configuration is the "
    "cell's (write place: unknown, or for a body target: {at: unknown}, if the target's mounting "
    "was not measured)"
)
"""Advice if no single answer fits the poses."""


@dataclass(frozen=True)
class ModelOptions:
    """Options of a solver that change the model.

    Attributes:
        normals: Whether the normals of circles are used.
        size_unknown: Whether the sizes of markers are estimated from the arm's motion.
        size_limit: Largest relative difference of a marker's size from the configured one.
    """

    normals: bool = True
    size_unknown: bool = False
    size_limit: float = 0.005


@dataclass(frozen=True, eq=False)
class Session:
    """Observations of a cell with the estimate from them.

    Attributes:
        observations: Observations, with estimated clock delays and marker sizes corrected.
        cell: The graph of frames.
        scanner: The scanner's model, if it is known.
        asked: Options that change the model.
        found: The posterior.
        notes: Notes for the report.
        tool_offset: (3,) estimated offset of the seen circle in its carrier, if its mount or the
            controller's tool frame is not as configured [m].
    """

    observations: Sequence[Observation]
    cell: Cell
    scanner: ScannerModel | None
    asked: ModelOptions
    found: Estimate
    notes: tuple[Note, ...] = ()
    tool_offset: Floats = field(default_factory=lambda: np.zeros(3))

    def noted(self, *notes: Note) -> Session:
        """Return the session with more notes."""
        return replace(self, notes=(*self.notes, *notes))

    def refit(self, observations: Sequence[Observation]) -> Session:
        """Return the estimate from changed observations, started at the present one."""
        joints = {c.frame: c.joints for c in self.found.problem.carriers}
        problem = problem_of(observations, self.cell, self.asked.normals)
        carriers = [
            replace(c, joints=joints[c.frame] if c.joints is None else c.joints)
            for c in problem.carriers
        ]
        problem = replace(problem, carriers=carriers, walk=self.found.problem.walk)
        found = estimate(problem, self.found.places, self.found.effects, self.found.inliers)
        return replace(self, observations=observations, found=found)

    def without(self, rows: Indices) -> Session:
        """Return the estimate without some observations, in closed form.

        Raises:
            StageError: Too few observations are left.
        """
        found = self.found.without(rows)
        _require_enough(found.problem.where(found.inliers))
        return replace(self, found=found)


@on_one_thread
def session_of(
    observations: Sequence[Observation],
    cell: Cell,
    scanner: ScannerModel | None,
    asked: ModelOptions = ModelOptions(),
) -> Session:
    """Return the estimate from a cell's observations.

    Raises:
        StageError: Too few sightings, all the same, or the pose of a moving frame is missing.
        CalibrationRefused: The sightings fit only when mirrored, fewer than half agree, no initial
            guess is found, a clock delay exceeds the recorded motion, or a marker's size is not the
            configured one.
    """
    problem = problem_of(observations, cell, asked.normals)
    _require_enough(problem)
    require_turns(problem)
    factor = 1.0
    if asked.size_unknown and len(problem.ends) == 1:
        factor = size_of(problem)
        observations = _resized(observations, factor)
        problem = problem_of(observations, cell, asked.normals)
    problem, places, agree, notes = _begun(problem)
    problem, branch_notes = _on_branches(problem, places, agree)
    effects = effects_of(problem, scanner, asked)
    found = estimate(problem, places, effects, agree)
    session = Session(observations, cell, scanner, asked, found, (*notes, *branch_notes))
    session = _with_walk(_with_bad_normals_left_out(session))
    agreed, given = int(session.found.inliers.sum()), len(observations)
    if agreed < max(3, given / 2):
        raise CalibrationRefused(f"only {agreed} of {given} poses fit one calibration", CONFIGURED)
    return _with_offset(_with_size(_on_one_clock(session), factor))


def effects_of(problem: Problem, scanner: ScannerModel | None, asked: ModelOptions) -> list[Effect]:
    """Return all error sources of a cell."""
    arms = dict.fromkeys(carrier.arm for carrier in problem.carriers)
    return [
        *(effect for arm in arms for effect in arm_effects(problem, arm)),
        *target_effects(problem),
        *scanner_effects(problem, scanner),
        *camera_effects(problem, asked.size_unknown),
        *clock_effects(problem),
        *drift_effects(problem),
    ]


def _require_enough(problem: Problem) -> None:
    if len(problem.ends) == 1:
        require_enough(problem, fewest_sightings(problem))


# --- where to begin ------------------------------------------------------------------------------


def _begun(problem: Problem) -> tuple[Problem, Places, Mask, tuple[Note, ...]]:
    """Return the problem, an initial guess, the mask of sightings that agree with it, and notes."""
    placed = all(problem.frames[target].place is not None for _, target in problem.ends)
    circles = problem.seen.ranks == 5
    in_line = spread_of(problem.seen.centres).in_line
    bare = problem.without_normals(circles) if placed and not in_line else problem
    places, squares = initial_guess(bare)
    _require_agreement(bare, places, agreeing(bare, squares))
    if not (placed and circles.any()) or in_line:
        return problem, places, agreeing(problem, squares), ()
    turns = problem.linearised(places).residuals[:, :3]
    tilt = float(np.median(np.linalg.norm(turns[circles & agreeing(bare, squares)], axis=1)))
    # Normals further from the target's axis, at the median, belong to another frame
    far = np.radians(10.0)
    if not tilt > far:
        return problem, places, agreeing(bare, squares), ()
    stand = f"the measured normals stand {np.degrees(tilt):.0f} deg from the robot's flange axis"
    if tilt < np.pi - far:  # a flange whose z points inwards is no mistake of its poses
        raise CalibrationRefused(
            f"{stand}: the orientations of the poses are wrong, or belong to another tool frame",
            "'flangeye doctor' tries the orders of quaternions and angles",
        )
    note = (
        f"{stand}, so they are left out: check the orientation of the poses, and the tool frame "
        "they are in"
    )
    return bare, places, agreeing(bare, squares), (note,)


def _require_agreement(problem: Problem, places: Places, agree: Mask) -> None:
    """Refuse sightings that agree no better than scans paired with wrong poses."""
    r, s = problem.residuals(places)[agree], problem.seen
    # Of the agreeing sightings [m] and [rad], rms
    shift, turn = (
        float(np.sqrt((r[:, at] ** 2).sum(axis=1).mean())) for at in (slice(3, 6), slice(3))
    )
    extent = float(np.sqrt(s.centres.var(axis=0).sum()))
    axes = s.rotations[s.ranks >= 5, :, 2]
    turned = float(np.sqrt(axes.var(axis=0).sum())) if len(axes) else 0.0
    # Scans that belong to other poses show noise as large as their extent.
    if shift < max(0.02, 0.4 * extent) and turn < max(np.radians(5.0), 0.4 * turned):
        return
    if len(problem.ends) == 1:
        _require_right_handed(problem, places)
        raise CalibrationRefused(
            f"the poses fit one calibration to {shift * 1e3:.1f} mm and {np.degrees(turn):.1f} "
            "deg only",
            CONFIGURED,
        )
    squares, pairs = distances(problem, places), problem.seen.pairs
    sizes = [np.median(squares[pairs == k]) for k in range(len(problem.ends))]
    camera, target = problem.ends[int(np.argmax(sizes))]
    raise CalibrationRefused(
        f"the sightings fit one calibration to {shift * 1e3:.1f} mm and {np.degrees(turn):.1f} "
        f"deg only, worst where {camera} saw {target}",
        "check that each sighting belongs to the poses in its row (join: clock_offset, if "
        f"{camera} has another clock), and that the cell is set up as the recipe states",
    )


def _require_right_handed(problem: Problem, places: Places) -> None:
    """Refuse sightings that agree far better in a mirror."""
    # Rotations as S R S, S the mirror, which is a rotation again; S R alone is not
    flip, s = np.array([1.0, 1.0, -1.0]), problem.seen
    mirrored = replace(
        problem,
        seen=replace(s, centres=s.centres * flip, rotations=s.rotations * np.outer(flip, flip)),
    )
    try:
        there, _ = initial_guess(mirrored)
    except CalibrationRefused:
        return
    ours = float(np.median(distances(problem, places)))
    theirs = float(np.median(distances(mirrored, there)))
    # Distances are squares: the mirrored fit leaves a tenth of the residuals
    if theirs < 0.1**2 * ours:
        raise CalibrationRefused(
            "what the camera saw fits the poses only when mirrored "
            f"({np.sqrt(theirs) * 1e3:.1f} mm instead of {np.sqrt(ours) * 1e3:.1f} mm)",
            "flip one axis of the scanner's or the robot's frame",
        )


# --- joints that were not recorded ---------------------------------------------------------------


def _on_branches(problem: Problem, places: Places, agree: Mask) -> tuple[Problem, tuple[Note, ...]]:
    """Return the problem with every arm's joint angles, on the most likely branch.

    If an arm's model does not reach its poses, its joint angles stay unknown.
    """
    notes: list[Note] = []
    for carrier in problem.carriers:
        arm = carrier.kinematics
        if arm is None or carrier.link is not None:
            continue
        joints = _likeliest(problem, carrier, arm, places, agree)
        problem = problem.with_joints(carrier.arm, joints)
        if joints is None:
            notes.append(
                f"the kinematic model of {carrier.arm} does not reproduce the reported poses: "
                f"errors of its joints are not estimated"
            )
    return problem, tuple(notes)


def _likeliest(
    problem: Problem, carrier: Carrier, arm: Arm, places: Places, agree: Mask
) -> Floats | None:
    """Return an arm's joint angles (T, n) on the branch that is most likely by some sightings."""
    if carrier.joints is not None:
        return next(branches_of(problem, carrier), None)
    kept = problem.seen.times[agree]
    # Forty tell as much as hundreds: branches differ by a few numbers of the arm's errors
    times = np.unique(kept[np.linspace(0, len(kept) - 1, 40).astype(int)])
    some = problem.where(agree).at(times)
    tried = list(branches_of(some, carrier))
    if tried[1:]:
        tried.sort(key=lambda near: _cost(some.with_joints(carrier.arm, near), places))
    poses = np.asarray(problem.frames[carrier.frame].place)
    for near in tried:
        joints, reached = reached_from(arm, poses, near[0])
        if reached.all():
            return joints
    return None


def _cost(problem: Problem, places: Places) -> float:
    """Return -2 log of the restricted likelihood at the prior medians of the sizes."""
    effects = [effect for effect in effects_of(problem, None, ModelOptions()) if effect.lasting]
    model = model_at(problem, places, effects, np.ones(len(problem.seen)))
    return fit(model, model.sizes.median).cost


# --- mistakes that are put right -----------------------------------------------------------------


def _with_bad_normals_left_out(session: Session) -> Session:
    """Return the session with circles reduced to centres where only the normals disagree."""
    found = session.found
    out = ~found.inliers & (found.problem.seen.ranks == 5)
    if not out.any():
        return session
    problem = found.problem.without_normals(out)
    again = estimate(problem, found.places, found.effects, found.inliers)
    kept = int((out & again.inliers).sum())
    if not kept:
        return session
    note = f"normals left out because they disagree with the others: {kept}"
    return replace(session, found=again).noted(note)


def _with_walk(session: Session) -> Session:
    """Return the session with the camera's drift as a random walk, if that is far likelier."""
    found = session.found
    problem, model = found.problem, found.posterior.model
    if len(problem.ends) > 1 or (problem.seen.ranks < 6).any():
        return session
    # At the sizes found without a walk, which is quick; only where one is likelier, all are tried
    still, *walks = (
        fit(each.subsampled(), found.fit.sizes).cost
        for each in (model, *(innovations(replace(problem, walk=(w, w)), model) for w in (0.4, 1)))
    )
    if still < min(walks):
        return session
    mode, costs = mode_of(model), {}
    for walk in product((0.0, 0.4, 0.7, 0.9, 1.0), repeat=2):
        walked = innovations(replace(problem, walk=walk), model)
        mode = mode_of(walked, mode.z)
        costs[walk] = fit(walked.subsampled(), model.sizes.at(mode.z)).cost + mode.z @ mode.z
    walk = min(costs, key=costs.__getitem__)
    if costs[0.0, 0.0] - costs[walk] < chi2_quantile(1 - MISFIT, len(walk)):
        return session
    again = estimate(replace(problem, walk=walk), found.places, found.effects, found.inliers)
    return replace(session, found=again).noted(
        Warn(
            "the measured poses drift from one to the next, as visual odometry does: each is "
            "compared with the ones before it",
            "check that camera and target do not move by themselves, or look at a fixed target",
        )
    )


def _on_one_clock(session: Session) -> Session:
    """Return the session with estimated clock delays applied to the arms' poses."""
    total: dict[str, float] = {}
    moved = session
    for _ in range(6):
        left = {
            e.name.removeprefix("clock of "): float(mean[0])
            for e, mean, _ in moved.found.numbers("clock")
        }
        # Far less than any exposure [s]
        if max(map(abs, left.values()), default=0.0) < 1e-5:
            break
        total = {camera: total.get(camera, 0.0) + x for camera, x in left.items()}
        later = delayed(session.observations, session.cell, total)
        if later is None:
            camera = max(total, key=lambda name: abs(total[name]))
            raise CalibrationRefused(
                f"the clock of {camera} seems {total[camera] * 1e3:.1f} ms off, but the recording "
                f"has no arm poses at the corrected times",
                "record more before and after each capture, or let the arm stand still",
            )
        moved = replace(moved.refit(later), notes=session.notes)
    sigmas = [float(np.sqrt(cov[0, 0])) for _, _, cov in moved.found.numbers("clock")]
    told = [
        f"{abs(x) * 1e3:.1f} +- {sigma * 1e3:.1f} ms {'after' if x > 0 else 'before'} the times "
        f"that {camera} gives"
        for (camera, x), sigma in zip(total.items(), sigmas, strict=False)
    ]
    return (
        moved.noted(f"estimated time offset: the arms reached the recorded poses {', '.join(told)}")
        if told
        else moved
    )


def _with_size(session: Session, factor: float) -> Session:
    """Return the session with the markers scaled to the size estimated from the arm's motion."""
    if not session.asked.size_unknown:
        _require_size(session)
        return session
    for _ in range(6):
        shares = [float(mean[0]) for _, mean, _ in session.found.numbers("size")]
        if max(map(abs, shares), default=0.0) < 1e-6:
            break
        factor *= 1 + shares[0]
        session = session.refit(_resized(session.observations, 1 + shares[0]))
    known = float(np.sqrt(session.found.numbers("size")[0][2][0, 0]))
    # Taken for found when it is known to half the prior's deviation
    if known > 0.05:
        raise CalibrationRefused(
            f"the target's size is known to {known:.1%} only",
            "move the arm further between poses, or write target_size: known",
        )
    sigma = known * factor
    digits = max(4, 1 - int(np.floor(np.log10(max(sigma, 1e-9)))))
    return session.noted(
        f"by the arm's motion the target is {factor:.{digits}f} +- {sigma:.{digits}f} times the "
        "size that its fit step states; this estimate is used"
    )


def _resized(observations: Sequence[Observation], factor: float) -> list[Observation]:
    """Return observations with the targets' distances from the camera multiplied by a factor."""
    scale, out = np.repeat([1.0, factor], 3), []
    for o in observations:
        if isinstance(o.feature, PoseFeature):
            seen = o.feature.camera_T_target
            pose = rigid(seen.rotation, factor * seen.translation)
            moved = replace(
                o.feature,
                camera_T_target=replace(seen, matrix=pose),
                covariance=o.feature.covariance * np.outer(scale, scale),
            )
            o = replace(o, feature=moved)
        out.append(o)
    return out


def _require_size(session: Session) -> None:
    """Refuse a marker size or focal length that contradicts the arm's motion."""
    found, kinds = session.found, ("size", "focal")
    likeliest = [abs(found.fit.mean[at][0]) for kind in kinds for _, at in found.rows(kind)]
    if not likeliest:
        return
    if gross := _size_far_off(session):
        raise CalibrationRefused(
            f"the target fits the arm's motion far better if it is {gross:.3g} times as large as "
            "its fit step states",
            "measure the print (target_size: unknown finds it)",
        )
    if max(likeliest) <= session.asked.size_limit:
        return
    told = [
        (float(mean[0]), float(np.sqrt(covariance[0, 0])), kind)
        for kind in kinds
        for _, mean, covariance in found.numbers(kind)
    ]
    share, sigma, kind = max(told, key=lambda each: abs(each[0]) / each[1])
    if (share / sigma) ** 2 < chi2_quantile(1 - MISFIT, 1):
        return
    factor = f"{1 + share:.4f} +- {sigma:.4f} times as"
    if kind == "size":
        raise CalibrationRefused(
            f"the arm's motion shows that the target is {factor} large as the fit step states, or "
            "the camera's focal length wrong by as much",
            "measure the print (size_limit allows more, target_size: unknown estimates it)",
        )
    raise CalibrationRefused(
        f"the arm's motion shows that the camera's focal length is {factor} long as its "
        "calibration says: distances along its axis are off, those across it are not",
        "calibrate the camera (acquire.images: {board: …} does; size_limit allows more)",
    )


def _size_far_off(session: Session) -> float | None:
    """Return the factor of the marker size that removes an implausibly large arm error, else None.

    A very wide prior on the arm's error also explains a marker of twice the size, and then leaves
    the camera's pose unknown.
    """
    found, observations = session.found, session.observations
    # Beyond six deviations a marker's share of its size is none that can be linearised
    worse = any(found.outgrown(kind) for kind in ("zeros", "field")) or found.outgrown("size", 6.0)
    if not worse or len(found.problem.ends) > 1 or not (found.problem.seen.ranks == 6).all():
        return None
    try:
        factor = size_of(found.problem)
        problem = problem_of(_resized(observations, factor), session.cell, session.asked.normals)
        problem, places, agree, _ = _begun(problem)
    except (StageError, CalibrationRefused):
        return None
    effects = effects_of(problem, session.scanner, session.asked)
    other = estimate(problem, places, effects, agree).posterior.cost
    # Likelihoods are densities per length: with coordinates times `factor`, -2 log of one grows by
    # 2 log(factor) for each of three coordinates, which is no evidence against the factor
    better = found.posterior.cost - other + 6 * len(observations) * np.log(factor)
    return factor if better > chi2_quantile(1 - MISFIT, 1) else None


def _with_offset(session: Session) -> Session:
    """Return the session with the circle's estimated offset, if it contradicts the configuration.

    The controller's tool frame or the circle's mount then differs from the recipe by millimetres;
    the offset of a correct circle is a fraction of one.
    """
    found = session.found
    wrong = wrong_offset(found.problem, found.effects)
    if wrong is None:
        return session
    if not found.outgrown("offset"):
        known = offset_shown_to(found.problem.where(found.inliers), found.places)
        # The shortest tools are five times as long [m]
        if known <= 0.01:
            return session
        told = f"known to {known * 1e3:.0f} mm only" if known < 1 else "not known at all"
        return session.noted(
            Warn(
                "the poses hardly turn the flange, so a tool set in the controller would not show: "
                f"an offset of the flange from the reported poses is {told}",
                "check that the controller's tool is zero, or add poses turned by 20 deg about two "
                "axes",
            )
        )
    again = estimate(found.problem, found.places, wrong, found.inliers)
    _, mean, covariance = again.numbers("offset")[0]
    if mean @ np.linalg.solve(covariance, mean) < chi2_quantile(1 - MISFIT, 3):
        return session
    listed = ", ".join(f"{value * 1e3:.3f}" for value in mean)
    what = f"the centre of the seen circle is at ({listed}) mm in the flange frame"
    return replace(session, found=again, tool_offset=mean).noted(what)
