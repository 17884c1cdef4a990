"""The times between a cell's cameras' clocks and that of its arms, where these moved when seen."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from flangeye.handeye.arm import SIGNIFICANT
from flangeye.handeye.calibration import CLOCK_STEPS, EXACT_DELAY
from flangeye.handeye.candidates import Fit, by_folds, judged, rms
from flangeye.handeye.cell_arms import Sighted
from flangeye.handeye.graph import Solved, information_of, linear_of
from flangeye.maths.statistics import f_quantile
from flangeye.maths.streams import joints_at, later, pose_at, rates_of
from flangeye.models.cell import Cell
from flangeye.types import Floats, Motion, Observation


@dataclass(frozen=True, eq=False)
class Timed:
    """Sightings with the arms where they were when cameras saw them.

    Attributes:
        observations: N of them.
        sighted: The same, as the graph takes them.
        found: The unknowns, with what is left of the times in their covariance.
        notes: For the person.
    """

    observations: Sequence[Observation]
    sighted: Sighted
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
        error: What a fit to other sightings leaves of each [m], rms.
    """

    values: Floats
    covariance: Floats
    significant: bool
    followed: Floats
    error: float


def on_one_clock(
    observations: Sequence[Observation], cell: Cell, sighted: Sighted, found: Solved
) -> Timed:
    """Return the sightings with the arms at the times they were seen, if that helps.

    Each camera has a clock of its own; those of all that moves agree. A time is taken over when it
    is significant, and errors of sightings held out fall; else it is in the covariance.

    Args:
        observations: N of them; nothing is looked for unless all say how the arms passed.
        cell: What stands on what.
        sighted: The same, as the graph takes them.
        found: The answer for the times as they are.
    """
    as_paired, linked = Timed(observations, sighted, found), {x.arm for x in cell.links.values()}
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
    helps, told = judged(_error(as_paired, cell), left.error, _told(cell, total, left))
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
    sighted = replace(before.sighted, frames=cell.graph(moved), joints=cell.joints(moved))
    return Timed(moved, sighted, sighted.solved(before.found.places))


def _delays(timed: Timed, cell: Cell) -> _Delays:
    """Return what one more unknown for each camera's clock tells."""
    linear = timed.sighted.linear(timed.found)
    late = _lateness(timed, cell)
    rows, _, errors = linear.whitened
    clocks = linear.whiteners[linear.kept] @ late[linear.kept]
    both, p = np.concatenate([rows, clocks], axis=2), rows.shape[2]
    # A camera that nothing moved past tells nothing of its clock.
    information = information_of(both) + np.diag(np.repeat([0.0, 1e-6], [p, late.shape[2]]))
    covariance = np.asarray(np.linalg.inv(information), dtype=np.float64)
    values = -(covariance @ np.einsum("nij,ni->j", both, errors))[p:]
    freedom = max(linear.freedom - len(covariance), 1.0)
    left = float((errors**2).sum() - values @ np.linalg.solve(covariance[p:, p:], values))
    known = max(left / freedom, 1.0) * covariance[p:, p:]
    square = float(values @ np.linalg.solve(known, values)) / len(values)
    weights = linear.whiteners @ linear.whiteners
    jacobian = np.concatenate([linear.jacobian, late], axis=2)
    held = by_folds(Fit(linear.residuals, jacobian, weights, covariance, linear.kept))[0]
    return _Delays(
        values,
        known,
        square > f_quantile(SIGNIFICANT, len(values), freedom),
        np.linalg.solve(information_of(rows), np.einsum("nij,nik->jk", rows, clocks)),
        rms(held[linear.kept]),
    )


def _lateness(timed: Timed, cell: Cell) -> Floats:
    """Return (N, 6, c) what a second by which each camera's poses are too early does."""
    sighted, found = timed.sighted, timed.found
    motions = [cell.passing(o.motion) for o in timed.observations if o.motion is not None]
    noise = {name: found.movers * covariance for name, covariance in sighted.noise.items()}
    graph = sighted.frames, sighted.sightings, found.places, noise
    moved = np.zeros((len(motions), 6))
    for name in motions[0].others:
        effects = linear_of(*graph, moved=[name])[1]
        moved += np.einsum("nij,nj->ni", effects, rates_of(motions, name))
    whose = np.array([[o.camera == camera for camera in cell.cameras] for o in timed.observations])
    return np.asarray(moved[:, :, None] * whose[:, None, :])


def _error(timed: Timed, cell: Cell) -> float:
    """Return what a fit to other sightings leaves, the times taken as they are [m], rms."""
    linear = timed.sighted.linear(timed.found)
    weights = linear.whiteners @ linear.whiteners
    information = information_of(linear.whitened[0])
    covariance = np.asarray(np.linalg.inv(information), dtype=np.float64)
    fit = Fit(linear.residuals, linear.jacobian, weights, covariance, linear.kept)
    return rms(by_folds(fit)[0][linear.kept])


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
