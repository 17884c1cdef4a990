"""Certify that a calibration is the global optimum, for any graph of frames.

A sighting is an equation ``C M = T``, with C the places from a root to the camera and T those to
the target. A certificate (:mod:`flangeye.estimation.certify.certificate`) takes at most two unknown
places on either side. Any frame may be the root: the places on the way to it are then replaced by
their inverses. The root with the smallest certificate is taken.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import fields, replace

import numpy as np

from flangeye.estimation.certify.certificate import certify
from flangeye.estimation.certify.lifted import Factors, LiftedSightings, families_of
from flangeye.estimation.estimate import Estimate
from flangeye.estimation.graph import Places, Problem
from flangeye.models.cell import Frame, chain
from flangeye.types import Floats, Indices
from flangeye.types.geometry import invert, rotation_exp, rotation_log

OPTIMAL = "globally optimal: no other answer fits the inlier poses better"
NOT_CERTIFIED = "not certified as globally optimal"


def verdict_of(found: Estimate) -> tuple[str, Places | None]:
    """Return whether the answer is proven optimal for the inlying sightings, or a better one.

    The effects are kept at their estimates.

    Returns:
        The verdict in words, and (4, 4) poses of the unknown frames that fit better, if such were
        found.
    """
    problem = _agreeing(found)
    root = _seen_from(problem, list(found.places))
    if root is None:
        return _not_certifiable(problem), None
    back = chain(problem.frames, root)

    def named(places: Floats) -> Places:
        return _turned(dict(zip(found.places, places, strict=True)), back)

    start = _array(_turned(found.places, back))
    shown = certify(_sightings(found, problem, root), start)
    if not shown.optimal:
        share = min(shown.missing / max(shown.cost, 1e-300), 1)
        note = (
            f"{NOT_CERTIFIED} (gap {share:.1%}): another answer may have squared errors "
            "smaller by that share"
        )
        return note, None if shown.better is None else named(shown.better)
    away = _far_away(found, start, shown.places)
    return (away, named(shown.places)) if away else (OPTIMAL, None)


def _agreeing(found: Estimate) -> Problem:
    """Return the inlying sightings; a point seen beside a target's origin is a frame of its own."""
    problem = found.problem
    if problem.seen.offsets.any():
        points = np.tile(np.eye(4), (len(problem.seen), 1, 1))
        points[problem.seen.times, :3, 3] = problem.seen.offsets
        own = {f"{target}_point": Frame(target, points) for _, target in problem.ends}
        ends = [(camera, f"{target}_point") for camera, target in problem.ends]
        problem = replace(problem, frames={**problem.frames, **own}, ends=ends)
    return problem.where(found.inliers)


def _far_away(found: Estimate, start: Floats, certified: Floats) -> str | None:
    """Return a note if the answer is not at the certified minimum; None if it is."""
    turns = certified[:, :3, :3] @ invert(start)[:, :3, :3]
    away = np.linalg.norm(rotation_log(turns), axis=1)
    covariance = found.posterior.mode.covariance
    known = [
        np.linalg.eigvalsh(covariance[i : i + 3, i : i + 3])[-1] for i in range(0, 6 * len(away), 6)
    ]
    # The certificate's weights are those at the answer, which moves its minimum a little: by five
    # standard deviations at most, and rounding [rad]
    beyond = away > 5.0 * np.sqrt(known) + 1e-9
    if not beyond.any():
        return None
    far = np.degrees(away[beyond].max())
    return f"{NOT_CERTIFIED}: the optimum for this answer's weights is {far:.2g} deg away from it"


def _not_certifiable(problem: Problem) -> str:
    def between(k: int) -> list[str]:
        return [name for way in _unknown(problem, k) for name in way]

    most = max(_pairs(problem), key=lambda k: len(between(k)))
    camera, target = problem.ends[most]
    return (
        f"not certifiable: where {camera} saw {target}, too many unknown places lie between them: "
        f"{', '.join(between(most))}"
    )


# --- from where the graph is looked at -----------------------------------------------------------


PathStep = tuple[str, bool]
"""One frame on the path between camera and target, and whether it is inverted."""


def _pairs(problem: Problem) -> list[int]:
    """Return which camera saw which target, in the order of the sightings."""
    return list(dict.fromkeys(problem.seen.pairs.tolist()))


def _ways(problem: Problem, k: int, root: str = "") -> list[list[PathStep]]:
    """Return the paths to a camera and to a target, from their last common frame.

    ``root`` is the frame taken as the graph's root, its own by default.
    """
    first, second = (_way(problem.frames, root, end) for end in problem.ends[k])
    shared = sum(1 for a, b in zip(first, second, strict=False) if a == b)
    return [first[shared:], second[shared:]]


def _way(frames: Mapping[str, Frame], root: str, end: str) -> list[PathStep]:
    up, down = chain(frames, root), chain(frames, end)
    shared = sum(1 for a, b in zip(up, down, strict=False) if a == b)
    back = [(name, True) for name in reversed(up[shared:])]
    return [*back, *((name, False) for name in down[shared:])]


def _unknown(problem: Problem, k: int, root: str = "") -> list[list[str]]:
    """Return the unknown frames on the paths to a camera and to a target."""
    ways = _ways(problem, k, root)
    return [[name for name, _ in way if name in problem.unknown] for way in ways]


def _seen_from(problem: Problem, names: Sequence[str]) -> str | None:
    """Return the root frame with the smallest certificate; None if there is none.

    The graph's own root is an empty name.
    """
    sizes = {root: _size(problem, names, root) for root in ("", *names)}
    possible = {root: size for root, size in sizes.items() if size}
    return min(possible, key=possible.__getitem__) if possible else None


def _size(problem: Problem, names: Sequence[str], root: str) -> int:
    """Return the size of the certificate's matrix for a root; 0 if the errors are not quadratic."""
    ways = [way for k in _pairs(problem) for way in _unknown(problem, k, root)]
    pairs = {(names.index(w[0]), names.index(w[1])) for w in ways if len(w) == 2}
    nested = {u for u, _ in pairs} & {v for _, v in pairs}
    if nested or any(len(way) > 2 for way in ways):
        return 0
    return families_of(pairs, len(names))[1]


def _turned(places: Places, back: Collection[str]) -> Places:
    """Return places by name; those against the direction from the root are inverted."""
    return {name: invert(place) if name in back else place for name, place in places.items()}


def _array(places: Places) -> Floats:
    return np.array(list(places.values()))


# --- the sightings -------------------------------------------------------------------------------


def _sightings(found: Estimate, problem: Problem, root: str) -> LiftedSightings:
    model, mode = found.posterior.model, found.posterior.mode
    left = model.residuals - model.design[..., model.p :] @ mode.mean[model.p :]
    errors, weights = left[found.inliers], model.weights(mode.sizes)[found.inliers]
    places = _turned(found.places, chain(problem.frames, root))
    cameras, targets, turned, order = [], [], [], []
    for k in _pairs(problem):
        rows = np.flatnonzero(problem.seen.pairs == k)
        times = problem.seen.times[rows]
        ways = _ways(problem, k, root)
        camera, target = (_side(problem, list(places), way, times) for way in ways)
        there, seen = camera.at(_array(places)), target.at(_array(places))
        # Errors are in the camera; the equation has them where the ways to camera and target part
        turn = np.kron(np.eye(2), there[:, :3, :3])
        turned.append(turn @ weights[rows] @ np.swapaxes(turn, 1, 2))
        measured = _measured(invert(there) @ seen, errors[rows])
        cameras.append(replace(camera, c=camera.c @ measured))
        targets.append(target)
        order.append(rows)
    freedoms = problem.seen.ranks[np.concatenate(order)].astype(np.float64)
    return LiftedSightings(_joined(cameras), _joined(targets), np.concatenate(turned), freedoms)


def _joined(sides: Sequence[Factors]) -> Factors:
    return Factors(*(np.concatenate([getattr(s, f.name) for s in sides]) for f in fields(Factors)))


def _side(
    problem: Problem, names: Sequence[str], way: Sequence[PathStep], times: Indices
) -> Factors:
    """Return a path as one side of the equations: it has at most two unknown places."""
    still = np.tile(np.eye(4), (len(times), 1, 1))
    known, unknown = [still], list[int]()
    for name, back in way:
        if name in names:
            unknown.append(names.index(name))
            known.append(still)
            continue
        place = np.asarray(problem.frames[name].at(times).place)
        known[-1] = known[-1] @ (invert(place) if back else place)
    # The last is after the last unknown; what is not there is none of them, and nothing between.
    lacking = 2 - len(unknown)
    (u, v), (a, b, c) = [len(names)] * lacking + unknown, [still] * lacking + known
    return Factors(a, np.full(len(times), u), b, np.full(len(times), v), c)


def _measured(predicted: Floats, errors: Floats) -> Floats:
    """Return the (M, 4, 4) measured poses; a circle's turn about its z is as predicted."""
    out = predicted.copy()
    out[:, :3, :3] = rotation_exp(errors[:, :3]) @ predicted[:, :3, :3]
    out[:, :3, 3] += errors[:, 3:]
    return out
