"""Predicted sightings at poses over the workspace, at which the expected error is evaluated."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from itertools import product

import numpy as np

from flangeye.estimation.effects.arm import joints_known, kinematics_and_joints
from flangeye.estimation.graph import Carrier, Places, Problem
from flangeye.maths.arm_correction import reached_from
from flangeye.maths.statistics import spread_evenly
from flangeye.types import Box, Floats, Indices
from flangeye.types.geometry import each_applied, skew_parts

COUNT = 256
"""Number of simulated poses; twice as many change the expected error by less than a tenth."""


@dataclass(frozen=True, eq=False)
class Work:
    """The poses of the work, at which the calibration will be used.

    Attributes:
        poses: Predicted sightings at new poses, at which the expected error is evaluated.
        around: Predicted sightings all over the widest possible work box.
        boxes: (B, W) weights with which sightings of ``around`` stand for each possible work box.
    """

    poses: Problem
    around: Problem
    boxes: Floats


def work_of(problem: Problem, places: Places, box: Box | None = None) -> Work:
    """Return simulated sightings over the work, of the same targets by the same cameras.

    The session's poses are too few to show the arm's error between them. So the boxes are filled
    evenly, with the flange oriented as in the session, where the arm reaches; with unknown joint
    angles, everywhere. With several arms, or a rail, the poses are those of the session.

    Args:
        problem: The session's sightings that agree.
        places: Pose (4, 4) of each unknown.
        box: Where the flange works, along the axes of the root; None for the session's region,
            known from its poses to one spacing between neighbours.
    """
    n = len(problem.seen)
    chosen = np.unique(np.linspace(0, n - 1, min(n, COUNT)).round().astype(int))
    session = _simulated(problem.where(chosen), places)
    carrier = problem.carriers[0] if len(problem.carriers) == 1 else None
    # One arm's flange can be sent to new poses; a rail goes along its line, and all else stays
    if carrier is None or carrier.link is not None or carrier.axis:
        return Work(session, session, np.full((1, len(session.seen)), 1 / len(session.seen)))
    poses = np.asarray(problem.frames[carrier.frame].place)[problem.seen.times]
    rotations = poses[:, :3, :3]
    if box is not None:
        sides = np.asarray(box.centre) + np.array([[-0.5], [0.5]]) * box.size
        filled = _simulated(_in_box(problem, carrier, sides), places)
        return Work(filled, filled, _weights(filled, rotations, sides[None]))
    inner = np.array([poses[:, :3, 3].min(axis=0), poses[:, :3, 3].max(axis=0)])
    outward = (inner[1] - inner[0]) / max(n - 1, 1) * np.array([[-1.0], [1.0]])
    widest = 2.5  # spacings of poses that a box reaches beyond these
    wide = _simulated(_in_box(problem, carrier, inner + widest * outward), places)
    # Eight boxes that the poses may have been drawn from, equally likely: from the outermost of n
    # evenly drawn poses to the box's side the distance is exponential, with the spacing as mean
    beyond = np.random.default_rng(0).exponential(size=(8, 2, 3)).clip(max=widest)
    return Work(session, wide, _weights(wide, rotations, inner + beyond * outward))


def _weights(work: Problem, rotations: Floats, boxes: Floats) -> Floats:
    """Return weights (B, W) with which sightings stand for all poses in each of (B, 2, 3) boxes.

    A box has each orientation of the session (N, 3, 3) at each place. The sightings in it are
    weighted evenly, and then as little otherwise as gives the products of up to three numbers of
    places and turns the means that they have over the box.
    """
    poses = np.asarray(work.frames[work.carriers[0].frame].place)[work.seen.times]
    at, centres, halves = poses[:, :3, 3], boxes.mean(axis=1), np.ptp(boxes, axis=1) / 2
    inside = (np.abs(at - centres[:, None]) < halves[:, None] + 1e-9).all(axis=2)
    # A box without any reachable pose must still give a mean
    inside = np.where(inside.any(axis=1, keepdims=True), inside, True)
    even = inside / inside.sum(axis=1, keepdims=True)
    middle, turned = centres.mean(axis=0), rotations.mean(axis=0)
    wide = halves.max(axis=0)
    wide[wide == 0] = np.inf
    turns, every = (_products(skew_parts(r @ turned.T)) for r in (poses[:, :3, :3], rotations))
    places = _products((at - middle) / wide)
    means = even @ places
    if len(poses) == COUNT:  # the arm reaches all places: their means are those of Gauss's points
        gauss = np.array(list(product((-1, 1), repeat=3))) / np.sqrt(3)
        points = centres[:, None] + halves[:, None] * gauss
        means = _products((points - middle) / wide).mean(axis=1)
    # Of both, those with three factors at most
    factors = np.add.outer(_factors().sum(axis=1), _factors().sum(axis=1))
    some = factors <= 3
    products = (places[:, :, None] * turns[:, None])[:, some]
    off = (means[:, :, None] * every.mean(axis=0))[:, some] - even @ products
    gram = np.swapaxes(products * even[..., None], 1, 2) @ products
    # Few sightings in a box cannot have all these means: the more factors, the less of an arm's
    # error a product is, and the sooner it is given up
    ridge = 1e-5 * np.diag(10.0 ** factors[some]) / inside.sum(axis=1)[:, None, None]
    shares = np.linalg.solve(gram + ridge, off[..., None])
    weights = even * (1 + (products @ shares)[..., 0])
    return np.asarray(weights / weights.sum(axis=1, keepdims=True))


def _products(numbers: Floats) -> Floats:
    """Return (..., 20) the products of up to three of (..., 3) numbers."""
    return np.asarray(np.prod(numbers[..., None, :] ** _factors(), axis=-1))


@cache
def _factors() -> Indices:
    """Return (20, 3) how often each of three numbers is a factor of each product of up to three."""
    return np.array([each for each in product(range(4), repeat=3) if sum(each) <= 3])


def _in_box(problem: Problem, carrier: Carrier, box: Floats) -> Problem:
    """Return the session's sightings with the flange spread evenly over a box (2, 3), if reachable.

    The sightings are unchanged if the arm reaches no pose in the box.
    """
    evenly = spread_evenly(COUNT, 4)
    # The fourth coordinate of the sequence chooses whose orientation a pose takes
    like = (evenly[:, 3] * len(problem.seen)).astype(int)
    session = np.asarray(problem.frames[carrier.frame].place)
    poses = session[problem.seen.times[like]].copy()
    poses[:, :3, 3] = box[0] + (box[1] - box[0]) * evenly[:, :3]
    reached, joints = np.ones(len(poses), dtype=bool), None
    if joints_known(carrier):
        apart = np.linalg.norm(poses[:, None, :3, 3] - session[:, :3, 3], axis=2)
        arm, joints = kinematics_and_joints(carrier)
        # Started at the nearest recorded posture, the arm keeps its branch (elbow up or down)
        joints, reached = reached_from(arm, poses, joints[apart.argmin(axis=1)])
        joints = joints[reached]
    if not reached.any():
        return problem
    frame = replace(problem.frames[carrier.frame], place=poses[reached])
    seen = problem.seen.where(like[reached])
    return replace(
        problem,
        frames={**problem.frames, carrier.frame: frame},
        carriers=[replace(carrier, joints=joints, rates=None)],
        seen=replace(seen, times=np.arange(len(seen))),
    )


def _simulated(problem: Problem, places: Places) -> Problem:
    """Return a problem with predicted sightings, each with its noise rotated accordingly."""
    s, count = problem.seen, len(problem.seen)
    out = problem.predicted(places)
    rotations, ranks = out[:, :3, :3], s.ranks
    normals, projectors = rotations[:, :, 2], s.projectors.copy()
    across = np.eye(3) - normals[:, :, None] * normals[:, None, :]
    projectors[ranks == 5, :3, :3] = across[ranks == 5]
    # A fit's noise belongs to the target: it rotates with it in the camera's frame
    turn = rotations @ np.swapaxes(s.rotations, 1, 2)
    turn[ranks < 5] = np.eye(3)
    both = np.zeros((count, 6, 6))
    both[:, :3, :3] = both[:, 3:, 3:] = turn
    seen = replace(
        s,
        rotations=rotations,
        centres=each_applied(out, s.offsets),
        covariances=projectors @ both @ s.covariances @ np.swapaxes(both, 1, 2) @ projectors,
        projectors=projectors,
    )
    return replace(problem, seen=seen)
