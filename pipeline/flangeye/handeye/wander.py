"""What wanders during a session: a drifting camera or target, a scale that creeps. Arrays only.

Residuals that are alike in poses near in time are no independent noise: many of them know no more
than few. A wander is one more smooth error, over time in place of the workspace: cosines that are
the modes of a random walk, the k-th of size 1/k, their common size estimated along.
"""

from __future__ import annotations

import numpy as np

from flangeye.handeye.candidates import Model, better, held_out, rms, with_nuisance
from flangeye.handeye.loop import COLUMNS
from flangeye.handeye.nuisance import Nuisance, nuisance_of
from flangeye.handeye.target_size import longer_distances
from flangeye.types import Floats

MODES, POSES_A_MODE = 16, 4
"""Modes at most, and how many poses there are to each at least."""
FEWEST = 24
"""Poses below which no wander is looked for: its folds would hold too few to compare."""


def with_wander(model: Model, scale_too: bool = False) -> Model:
    """Estimate how camera and target wander against each other in time, if that helps.

    Only where one of them rests and the target's place is unknown, so that nothing but the mean of
    that place is taken for still. Poses are in order of time.

    Args:
        model: What was found without.
        scale_too: Whether the camera's distances may creep as well, for a target of unknown size.
    """
    loop, kept = model.problem.loop, model.found.inliers
    if loop.y or not loop.z or kept.sum() < FEWEST or loop.camera_moves == loop.target_moves:
        return model
    found = [(frame, with_nuisance(model, n)) for frame, n in _wanders(model, scale_too).items()]
    candidates = [(frame, candidate) for frame, candidate in found if candidate is not None]
    if not candidates:
        return model
    frame, best = min(candidates, key=lambda each: rms(held_out(each[1].found)[0][kept]))
    size = rms(shifts(best)[kept]) * 1e3
    chosen = better(model, best, f"the {frame} wandered during the session, by {size:.3f} mm rms")
    return model if chosen.found is model.found else chosen


def shifts(model: Model) -> Floats:
    """Return (N, 3) by how much the sized errors move what is predicted, in ``camera`` [m]."""
    sized, found = model.problem.nuisance.sized, model.found
    moves = found.linear.jacobian[:, 3:, COLUMNS:][:, :, sized]
    return np.asarray(moves @ found.at.nuisance[sized])


def _wanders(model: Model, scale_too: bool) -> dict[str, Nuisance]:
    """Return what may wander: the camera where it is fixed, or what rests in the base."""
    s = model.problem.measurements
    modes = _modes(len(s), min(MODES, int(model.found.inliers.sum()) // POSES_A_MODE))
    twists = _each(modes, np.broadcast_to(np.eye(6), (len(s), 6, 6)))
    still = np.zeros_like(twists)
    of_camera = nuisance_of(still, still, 1.0, sized=True, seen=twists)
    if model.problem.loop.camera_moves:
        resting, of_resting = "target", nuisance_of(still, twists, 1.0, sized=True)
    else:
        resting, of_resting = "base", nuisance_of(twists, still, 1.0, sized=True)
    wanders = {"camera": of_camera, resting: of_resting}
    if not scale_too:
        return wanders
    creep = _each(modes, longer_distances(s))
    still = np.zeros_like(creep)
    scale = nuisance_of(still, still, 1.0, sized=True, seen=creep)
    return {frame: wander.and_also(scale) for frame, wander in wanders.items()}


def _modes(count: int, modes: int) -> Floats:
    """Return (N, 1 + K) modes of a random walk over N poses: its mean, and cosines.

    The mean cannot be told from the place of what wanders, which so is known no better than that.
    """
    time, k = (np.arange(count) + 0.5) / count, np.arange(1, modes + 1)
    cosines = np.cos(np.pi * time[:, None] * k) / k
    return np.hstack([np.full((count, 1), np.pi / np.sqrt(6)), cosines])


def _each(modes: Floats, effects: Floats) -> Floats:
    """Return (N, 6, m K): (N, 6, m) effects, each of them in every mode."""
    return np.asarray(np.einsum("nk,nij->nijk", modes, effects).reshape(len(modes), 6, -1))
