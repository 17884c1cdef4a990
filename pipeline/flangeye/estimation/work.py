"""Sightings as they would be at new poses of the work: where the error to expect is taken."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from flangeye.estimation.graph import Places, Problem, Sightings
from flangeye.maths.arm_correction import reached_from
from flangeye.maths.frame_graph import composed
from flangeye.maths.geometry import invert
from flangeye.types import Box

COUNT = 64
"""New poses: twice as many change the error to expect by less than 2 %."""


def work_of(problem: Problem, places: Places, box: Box | None = None) -> Problem:
    """Return sightings that nobody measured, of the same targets by the same cameras.

    At poses like those of the session; with a box, with the flange anywhere in it, as far as the
    arm gets there near the session's poses.

    Args:
        problem: The session's sightings that agree.
        places: (4, 4) of each unknown.
        box: Where the flange is to be, in the root's frame.
    """
    n = len(problem.seen)
    chosen = np.unique(np.linspace(0, n - 1, min(n, COUNT)).round().astype(int))
    work = problem.where(chosen)
    if box is not None and len(problem.carriers) == 1:
        work = _in_box(problem, box)
    return replace(work, seen=_predicted(work, places))


def _in_box(problem: Problem, box: Box) -> Problem:
    """Return the session's sightings with the flange elsewhere: anywhere in a box."""
    carrier, rng = problem.carriers[0], np.random.default_rng(0)
    if carrier.link is not None or carrier.kinematics is None or carrier.joints is None:
        return problem
    session = np.asarray(problem.frames[carrier.frame].place)
    like = rng.integers(len(problem.seen), size=COUNT)
    poses = session[problem.seen.times[like]].copy()
    poses[:, :3, 3] = box.centre + box.size * (rng.random((COUNT, 3)) - 0.5)
    apart = np.linalg.norm(poses[:, None, :3, 3] - session[:, :3, 3], axis=2)
    near = carrier.joints[apart.argmin(axis=1)]
    joints, reached = reached_from(carrier.kinematics, poses, near)
    if not reached.any():
        return problem
    frame = replace(problem.frames[carrier.frame], place=poses[reached])
    seen = problem.seen.where(like[reached])
    return replace(
        problem,
        frames={**problem.frames, carrier.frame: frame},
        carriers=[replace(carrier, joints=joints[reached], rates=None)],
        seen=replace(seen, times=np.arange(len(seen))),
    )


def _predicted(problem: Problem, places: Places) -> Sightings:
    """Return a problem's sightings as they are predicted, each with its noise turned along."""
    s, count = problem.seen, len(problem.seen)
    frames = {
        name: replace(frame, place=np.asarray(places.get(name, frame.place)))
        for name, frame in problem.frames.items()
    }
    frames = {
        n: replace(f, place=f.place[s.times]) if f.place is not None and f.place.ndim == 3 else f
        for n, f in frames.items()
    }
    out = np.zeros((count, 4, 4))
    for k, (camera, target) in enumerate(problem.ends):
        rows = s.pairs == k
        seen = invert(composed(frames, camera)) @ composed(frames, target)
        out[rows] = np.broadcast_to(seen, (count, 4, 4))[rows]
    rotations, ranks = out[:, :3, :3], s.ranks
    normals, projectors = rotations[:, :, 2], s.projectors.copy()
    across = np.eye(3) - normals[:, :, None] * normals[:, None, :]
    projectors[ranks == 5, :3, :3] = across[ranks == 5]
    turn = rotations @ np.swapaxes(s.rotations, 1, 2)
    turn[ranks < 5] = np.eye(3)
    both = np.zeros((count, 6, 6))
    both[:, :3, :3] = both[:, 3:, 3:] = turn
    return replace(
        s,
        rotations=rotations,
        centres=(rotations @ s.offsets[..., None])[..., 0] + out[:, :3, 3],
        covariances=projectors @ both @ s.covariances @ np.swapaxes(both, 1, 2) @ projectors,
        projectors=projectors,
    )
