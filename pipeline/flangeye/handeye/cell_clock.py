"""The times between a cell's cameras' clocks and that of its arms, where these moved when seen."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from flangeye.handeye.arm import SIGNIFICANT
from flangeye.handeye.calibration import CLOCK_STEPS, EXACT_DELAY
from flangeye.handeye.candidates import following, held_out, judged, rms
from flangeye.handeye.graph import Solved, solved_of
from flangeye.handeye.likelihood import Solution, agreeing
from flangeye.handeye.nuisance import nuisance_seen
from flangeye.maths.statistics import f_quantile
from flangeye.maths.streams import joints_at, later, pose_at, rates_of
from flangeye.models.cell import Cell
from flangeye.types import Floats, Motion, Observation

UNKNOWN = 1e3
"""Standard deviation of a time of which nothing is known [s]."""


@dataclass(frozen=True, eq=False)
class Timed:
    """Sightings with the arms where they were when cameras saw them.

    Attributes:
        observations: N of them.
        found: The unknowns, with what is left of the times in their covariance.
        notes: For the person.
    """

    observations: Sequence[Observation]
    found: Solved
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class _Delays:
    """What is left of the times between clocks, as a fit tells them.

    Attributes:
        values: (c,) by which the poses of each camera's sightings are too early [s].
        covariance: (c, c) of them.
        significant: Whether they are, all together.
        followed: (P, c) how the unknowns follow them.
        fit: With them among the unknowns.
    """

    values: Floats
    covariance: Floats
    significant: bool
    followed: Floats
    fit: Solution


def on_one_clock(observations: Sequence[Observation], cell: Cell, found: Solved) -> Timed:
    """Return the sightings with the arms at the times they were seen, if that helps.

    Each camera has a clock of its own; those of all that moves agree. A time is taken over when it
    is significant, and errors of sightings held out fall; else it is in the covariance.

    Args:
        observations: N of them; nothing is looked for unless all say how the arms passed.
        cell: What stands on what.
        found: The answer for the times as they are.
    """
    as_paired, linked = Timed(observations, found), {x.arm for x in cell.links.values()}
    if not all(_tells(o.motion, linked) for o in observations):
        return as_paired
    first = _delays(as_paired, cell)
    total, moved, left = np.zeros(len(first.values)), as_paired, first
    for _ in range(CLOCK_STEPS if first.significant else 0):
        total = total + left.values
        stepped = _delayed(observations, cell, as_paired, total)
        if stepped is None:
            far = f"left out, for no pose was recorded so far away: {_told(cell, total, left)}"
            return replace(_considering(as_paired, first, first.values), notes=(far,))
        moved = stepped
        left = _delays(moved, cell)
        if np.abs(left.values).max() < EXACT_DELAY:
            break
    if moved is as_paired:
        return _considering(as_paired, first, first.values)
    helps, told = _judged(found.found, left.fit, _told(cell, total, left))
    chosen = (
        _considering(moved, left, 0 * total)
        if helps
        else _considering(as_paired, first, first.values)
    )
    return replace(chosen, notes=(told,))


def _tells(motion: Motion | None, linked: set[str]) -> bool:
    """Return whether a motion says how everything passed; a link passed by its arm's joints."""
    if motion is None or not motion.others:
        return False
    return not linked or linked <= {*motion.joints}


def _delayed(
    observations: Sequence[Observation], cell: Cell, before: Timed, delays: Floats
) -> Timed | None:
    """Return the sightings with the arms so much later [s]; None beyond what was recorded."""
    moved = []
    for o in observations:
        delay = float(delays[cell.cameras.index(o.camera)])
        motion = o.motion and later(cell.passing(o.motion), delay)
        if motion is None:
            return None
        told = {n: x for n, x in o.poses.items() if n in motion.others}
        at = {n: replace(x, matrix=pose_at(motion, 0.0, n)) for n, x in told.items()}
        joints = {n: q for n in o.arm_joints if (q := joints_at(motion, 0.0, n)) is not None}
        moved.append(replace(o, poses={**o.poses, **at}, motion=motion, arm_joints=joints))
    problem = replace(before.found.problem, frames=cell.graph(moved))
    return Timed(moved, solved_of(problem, agreeing(problem, before.found.found)))


def _delays(timed: Timed, cell: Cell) -> _Delays:
    """Return what one more unknown for each camera's clock tells."""
    found = timed.found
    # A camera that nothing moved past tells nothing of its clock: a second is as good as many.
    late = nuisance_seen(_lateness(timed, cell), UNKNOWN)
    fit, count = agreeing(found.problem.beside(late), found.found), len(late)
    values = fit.at.nuisance[-count:]
    covariance = fit.covariance[-count:, -count:]
    square = float(values @ np.linalg.solve(covariance, values)) / count
    return _Delays(
        values,
        covariance,
        square > f_quantile(SIGNIFICANT, count, fit.freedom),
        following(found.problem, found.found, late)[: len(found.joint)],
        fit,
    )


def _lateness(timed: Timed, cell: Cell) -> Floats:
    """Return (N, 6, c) what a second by which each camera's poses are too early does."""
    motions = [cell.passing(o.motion) for o in timed.observations if o.motion is not None]
    moved = np.zeros((len(motions), 6))
    for name in motions[0].others:
        _, effects = timed.found.problem.effects(timed.found.found.at, [name])
        moved += np.einsum("nij,nj->ni", effects, rates_of(motions, name))
    whose = np.array([[o.camera == camera for camera in cell.cameras] for o in timed.observations])
    return np.asarray(moved[:, :, None] * whose[:, None, :])


def _judged(before: Solution, after: Solution, what: str) -> tuple[bool, str]:
    """Return whether sightings held out, all that agree with either, speak for the times."""
    either = before.inliers | after.inliers
    without, with_them = (rms(held_out(fit)[0][either]) for fit in (before, after))
    return judged(without, with_them, what)


def _considering(timed: Timed, delays: _Delays, off: Floats) -> Timed:
    """Return the same with the times in the covariance, known so well and off by so much [s]."""
    spread = delays.covariance + np.outer(off, off)
    joint = timed.found.joint + delays.followed @ spread @ delays.followed.T
    return replace(timed, found=timed.found.with_joint(joint))


def _told(cell: Cell, delays: Floats, left: _Delays) -> str:
    sigmas = np.sqrt(np.diag(left.covariance))
    each = (
        f"{abs(delay) * 1e3:.1f} +- {sigma * 1e3:.1f} ms {'after' if delay > 0 else 'before'} "
        f"the times that {camera} gives"
        for camera, delay, sigma in zip(cell.cameras, delays, sigmas, strict=True)
    )
    return f"the arms were at the poses {', '.join(each)}"
