"""Drift that accumulates from sighting to sighting, as that of visual odometry does."""

from dataclasses import replace

import numpy as np

from flangeye.estimation.graph import Problem
from flangeye.estimation.mixed import LinearModel
from flangeye.models.cell import chain
from flangeye.types.geometry import hat


def innovations(problem: Problem, model: LinearModel) -> LinearModel:
    """Return the model after subtracting the drift predicted from earlier sightings.

    A random walk under white noise is predicted by exponential smoothing (Muth 1960): the share
    ``problem.walk`` of each innovation stays. Innovations are independent, and their likelihood is
    that of the sightings. Each step is a turn and a shift about the camera's origin; if the camera
    is carried, its world drifts, otherwise the camera. An outlier's share of 0 leaves the
    prediction as it was. The problem has poses of one target in one camera.
    """
    s, stays = problem.seen, np.repeat(problem.walk, 3)[:, None]
    # From the camera's origin to the target's, and back
    out, home = np.tile(np.eye(6), (2, len(s), 1, 1))
    out[:, 3:, :3], home[:, 3:, :3] = -hat(s.centres), hat(s.centres)
    rows = home @ np.concatenate([model.residuals[..., None], model.design], axis=2)
    # From where the drift stands still to the camera's axes, and back
    forth = back = np.tile(np.eye(6), (len(s), 1, 1))
    if set(chain(problem.frames, problem.ends[0][0])) & set(problem.moving):
        turns = np.kron(np.eye(2), s.rotations)
        forth, back = home @ turns, np.swapaxes(turns, 1, 2) @ out
    drift = np.zeros(rows.shape[1:])
    for k in np.argsort(s.times):
        predicted = forth[k] @ drift
        rows[k] -= predicted
        drift = back[k] @ (predicted + model.shares[k] * stays * rows[k])
    rows = out @ rows
    return replace(model, residuals=rows[..., 0], design=rows[..., 1:])
