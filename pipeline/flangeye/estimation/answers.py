r"""The answers that people ask for: each a linear functional of the posterior.

*True*: where the places are, with the arm's own errors in their covariance. *As reported*: the
places for the arm as its controller reports it. Commands are sent in reported coordinates, so the
best camera pose is the rigid map onto those: with d the arm's displacement over poses of the work
and b its least-squares rigid part,

.. math:: p_{reported} = p + A\,\delta, \qquad b = \arg\min \sum_{work} |d - b|^2

over positions and turns, these at a short lever: of work in a line they tell the turn about it.

What is common to all poses cancels, so that it is known far better than the true pose.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from flangeye.estimation.estimate import Estimate, model_at
from flangeye.estimation.graph import Carrier, Linear, Problem
from flangeye.estimation.work import Work
from flangeye.maths.frame_graph import chain, composed
from flangeye.maths.geometry import hat, invert
from flangeye.types import ExpectedError, Floats

DRAWS = 8
"""Of an error at each pose and each draw of the sizes, for its quantiles."""
LEVER = 0.02
"""Turns count like what they do so far from the flange [m]: enough to tell the turn about a line
where the work is in one, and no more, for the work is a matter of positions."""


@dataclass(frozen=True, eq=False)
class Answer:
    """Places for one arm: as it is reported, or true.

    Attributes:
        mean: (P,) moves of the places from those of the estimate.
        covariance: (P, P) of them.
    """

    mean: Floats
    covariance: Floats

    def at(self, mean: Floats) -> Answer:
        """Return other moves (P,), with the covariance about them."""
        off = mean - self.mean
        return Answer(mean, self.covariance + np.outer(off, off))


def functional(found: Estimate, a: Floats) -> Answer:
    """Return the answer p + A delta over the mixture, and over (B, P, K) matrices A alike."""
    p = found.posterior.model.p
    rows = np.concatenate([np.tile(np.eye(p), (len(a), 1, 1)), a], axis=2)
    each = rows @ found.posterior.mean
    within = rows @ found.posterior.covariance @ np.swapaxes(rows, 1, 2)
    apart = each - each.mean(axis=0)
    covariance = within.mean(axis=0) + apart.T @ apart / max(len(a) - 1, 1)
    return Answer(each.mean(axis=0), 0.5 * (covariance + covariance.T))


def as_true(found: Estimate) -> Answer:
    """Return the places for the arms as they really are."""
    return functional(found, np.zeros((1, found.posterior.model.p, sum(found.counts))))


def as_reported(found: Estimate, work: Work, without: frozenset[str] = frozenset()) -> Answer:
    """Return the places for the arms as their controllers report them.

    Args:
        found: The posterior.
        work: Where commands are sent: each box that may be meant has an answer of its own.
        without: Kinds of the arms' errors that are corrected, and so are no part of what they
            report.
    """
    return functional(found, np.array([_as_reported(found, each, without) for each in work.boxes]))


def _as_reported(found: Estimate, work: Problem, without: frozenset[str]) -> Floats:
    """Return (P, K): what the effects' numbers add to the places."""
    linear = work.linearised(found.places)
    columns = [
        e.block(work, linear)
        if e.of_arm and e.kind not in without
        else np.zeros((len(work.seen), 6, n))
        for e, n in zip(found.effects, found.counts, strict=True)
    ]
    of_arm = np.concatenate([np.zeros((len(work.seen), 6, 0)), *columns], axis=2)
    world = _world(found, work, without)
    out = []
    for name in found.problem.unknown:
        if any(c.frame in chain(work.frames, name) for c in work.carriers):
            out.append(_carried(work, linear, name, (of_arm, world), found))
        else:
            out.append(_fixed(found, work, name, world, without))
    return np.concatenate([np.zeros((0, of_arm.shape[2])), *out])


def _columns_of_arm(
    found: Estimate, work: Problem, carrier: Carrier, without: frozenset[str]
) -> Floats:
    """Return (T, 6, K) twists of what one carrier moves, by every effect's numbers."""
    still = np.zeros((len(work.seen), 6, 6))
    blocks = {c.frame: still + np.eye(6) if c is carrier else still for c in work.carriers}
    one = Linear(np.zeros(0), np.zeros(0), blocks)
    columns = [
        e.block(work, one)
        if e.of_arm and e.kind not in without
        else np.zeros((len(work.seen), 6, n))
        for e, n in zip(found.effects, found.counts, strict=True)
    ]
    return np.concatenate([np.zeros((len(work.seen), 6, 0)), *columns], axis=2)


def _rigid_part(
    found: Estimate, work: Problem, carrier: Carrier, without: frozenset[str]
) -> Floats:
    """Return (6, K) the rigid motion, about the arm base's origin, of its displacements."""
    places = np.asarray(work.frames[carrier.frame].place)[work.seen.times, :3, 3]
    weight = np.repeat([LEVER, 1.0], 3)[:, None]
    moved = weight * _columns_of_arm(found, work, carrier, without)
    motions = np.tile(np.eye(6), (len(places), 1, 1))
    motions[:, 3:, :3] = -hat(places)
    return np.asarray(
        np.linalg.pinv((weight * motions).reshape(-1, 6), rcond=1e-6)
        @ moved.reshape(-1, moved.shape[2])
    )


def _world(found: Estimate, work: Problem, without: frozenset[str]) -> Floats:
    """Return (6, K) by how much reported coordinates of the root are turned and shifted."""
    parts = []
    for carrier in work.carriers:
        path = chain(work.frames, carrier.frame)[:-1]
        places = [np.asarray(work.frames[n].place) for n in path]
        if carrier.link is None and all(place.shape == (4, 4) for place in places):
            base = np.eye(4)
            for place in places:
                base = base @ place
            parts.append(adjoint(base) @ _rigid_part(found, work, carrier, without))
    count = len(found.posterior.model.sizes.effect)
    return np.asarray(sum(parts) / len(parts)) if parts else np.zeros((6, count))


def _fixed(
    found: Estimate, work: Problem, name: str, world: Floats, without: frozenset[str]
) -> Floats:
    """Return (6, K) of a place that no arm moves: the rigid part, seen from its own origin."""
    frames = {n: replace(f, place=found.places.get(n, f.place)) for n, f in work.frames.items()}
    parent = np.eye(4)
    for each in chain(frames, name)[:-1]:
        place = np.asarray(frames[each].place)
        parent = parent @ (place if place.ndim == 2 else place[0])
    gauge = -world
    bases = [c for c in work.carriers if work.frames[c.frame].parent == name and c.link is None]
    place = parent @ found.places[name]
    for carrier in bases:
        gauge = gauge + adjoint(place) @ _rigid_part(found, work, carrier, without)
    turned = adjoint(invert(parent)) @ gauge
    shift = np.eye(6)
    shift[3:, :3] = -hat(found.places[name][:3, 3])
    return np.asarray(shift @ turned)


def _carried(
    work: Problem, linear: Linear, name: str, parts: tuple[Floats, Floats], found: Estimate
) -> Floats:
    """Return (6, K) of a place that an arm moves: what explains its displacements best.

    A camera in hand is to see everything where reported coordinates have it.
    """
    of_arm, world = parts
    weight = np.repeat([LEVER, 1.0], 3)[:, None]
    moved = of_arm + _seen_of_world(work, found, name) @ world
    rows = (weight * linear.blocks[name]).reshape(-1, 6)
    return np.asarray(
        np.linalg.pinv(rows, rcond=1e-6) @ (weight * moved).reshape(-1, moved.shape[2])
    )


def _seen_of_world(work: Problem, found: Estimate, name: str) -> Floats:
    """Return (W, 6, 6) how a twist of reported root coordinates moves what is seen.

    What stands at y is at y - b(y) in reported coordinates: seen through the reported arm, the
    target stays where it is and the camera's chain is to make up for b; and likewise a target in
    the hand before a camera that stands.
    """
    frames = {}
    for each, frame in work.frames.items():
        place = np.asarray(found.places.get(each, frame.place))
        frames[each] = replace(frame, place=place if place.ndim == 2 else place[work.seen.times])
    out = np.zeros((len(work.seen), 6, 6))
    for k, (camera, target) in enumerate(work.ends):
        rows = np.flatnonzero(work.seen.pairs == k)
        if not len(rows):
            continue
        back = np.broadcast_to(composed(frames, camera), (len(work.seen), 4, 4))[rows]
        tip = np.broadcast_to(composed(frames, target), (len(work.seen), 4, 4))[rows]
        turned = np.swapaxes(back[:, :3, :3], 1, 2)
        places = (tip[:, :3, :3] @ work.seen.offsets[rows][..., None])[..., 0] + tip[:, :3, 3]
        in_hand = name in chain(work.frames, camera)
        sign = 1.0 if in_hand else -1.0
        out[rows, :3, :3] = out[rows, 3:, 3:] = sign * turned
        out[rows, 3:, :3] = sign * turned @ -hat(places)
    return out


def adjoint(pose: Floats) -> Floats:
    """Return (6, 6) that takes a twist about a frame's origin to its parent's, in its axes."""
    out = np.zeros((6, 6))
    out[:3, :3] = out[3:, 3:] = pose[:3, :3]
    out[3:, :3] = hat(pose[:3, 3]) @ pose[:3, :3]
    return out


def expected_error(
    found: Estimate, work: Work, answer: Floats, corrected: bool = False
) -> ExpectedError:
    """Return the predictive spread of an answer at new poses of the work.

    Of the pose's own error, of what the arm does beyond the rigid part, and of the noise of a
    sighting: what errors of poses held out consist of.

    Args:
        found: The posterior.
        work: Where it is taken.
        answer: (P,) moves of the places.
        corrected: Whether the arms' errors are corrected by their posterior mean.
    """
    known, rng, at = found.posterior, np.random.default_rng(0), work.poses
    model = model_at(at, found.places, found.effects, np.ones(len(at.seen)), of_session=False)
    p = model.p
    of_places, of_effects = model.places[:, 3:], model.effects[:, 3:]
    put_right = np.repeat([corrected and e.of_arm for e in found.effects], found.counts)
    expected = of_places @ answer + of_effects @ (put_right * known.mean[p:])
    rows = np.concatenate([of_places, of_effects], axis=2)
    squares, chances = [], []
    for chance, each in zip(known.chances, known.fits, strict=True):
        bias = rows @ each.mean - expected
        noise = model.noise(each.sizes)[:, 3:, 3:]
        covariance = rows @ each.covariance @ np.swapaxes(rows, 1, 2) + noise
        root = np.linalg.cholesky(covariance + 1e-18 * np.eye(3))
        drawn = bias + (root @ rng.standard_normal((DRAWS, len(bias), 3, 1)))[..., 0]
        exact = float(((bias**2).sum(axis=1) + np.trace(covariance, axis1=1, axis2=2)).mean())
        square = (drawn**2).sum(axis=2).ravel()
        squares.append(square * exact / square.mean())
        chances.append(np.full(square.size, chance))
    values, weights = np.concatenate(squares), np.concatenate(chances)
    order = np.argsort(values)
    share = np.cumsum(weights[order]) / weights.sum()
    p95 = float(np.sqrt(values[order][np.searchsorted(share, 0.95)]))
    return ExpectedError(float(np.sqrt(np.average(values, weights=weights))), p95)
