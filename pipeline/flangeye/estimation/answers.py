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

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from flangeye.estimation.estimate import Estimate, model_at
from flangeye.estimation.graph import Carrier, Linear, Problem
from flangeye.estimation.mixed import shares, spread_of
from flangeye.estimation.work import Work
from flangeye.maths.frame_graph import chain, composed
from flangeye.maths.geometry import hat, invert
from flangeye.types import ExpectedError, Floats, Mask

# Turns count like what they do so far from the flange [m]: enough to tell the turn about a line
# where the work is in one, and no more, for the work is a matter of positions.
WEIGHT = np.repeat([0.02, 1.0], 3)[:, None]
"""Of each number of a twist in the rigid part."""


@dataclass(frozen=True, eq=False)
class Answer:
    """Places for one arm: as it is reported, or true.

    Attributes:
        mean: (P,) moves of the places from those of the estimate.
        covariance: (P, P) of them.
        shares: (P, P) of it by what causes it; the rest is that few poses tell how large each is.
    """

    mean: Floats
    covariance: Floats
    shares: Mapping[str, Floats]

    def at(self, mean: Floats) -> Answer:
        """Return other moves (P,), with the covariance about them."""
        off = mean - self.mean
        return replace(self, mean=mean, covariance=self.covariance + np.outer(off, off))


def functional(found: Estimate, a: Floats) -> Answer:
    """Return the answer p + A delta over the mixture, and over (B, P, K) matrices A alike."""
    p = found.posterior.model.p
    rows = np.concatenate([np.tile(np.eye(p), (len(a), 1, 1)), a], axis=2)
    each = rows @ found.posterior.mean
    within = rows @ found.posterior.covariance @ np.swapaxes(rows, 1, 2)
    apart = each - each.mean(axis=0)
    covariance = within.mean(axis=0) + apart.T @ apart / max(len(a) - 1, 1)
    of_effects, noise = shares(found.posterior, rows.mean(axis=0))
    # What is drawn anew at each sighting
    named = {"scans and poses, one by one": noise}
    for effect, share in zip(found.effects, of_effects, strict=True):
        named[effect.name] = named.get(effect.name, 0.0) + share
    return Answer(each.mean(axis=0), 0.5 * (covariance + covariance.T), named)


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
    return functional(found, commanded(found, work, without))


def commanded(found: Estimate, work: Work, without: frozenset[str] = frozenset()) -> Floats:
    """Return (B, P, K) what the effects' numbers add to the places, right over each box."""
    commands = _Commands(found, work.around, without)
    return np.array([commands.answer(box) for box in work.boxes])


@dataclass(frozen=True, eq=False)
class _Commands:
    """What the effects' numbers do wherever commands may be sent.

    Attributes:
        found: The posterior.
        work: Sightings as they would be there.
        without: Kinds of the arms' errors that are corrected.
    """

    found: Estimate
    work: Problem
    without: frozenset[str]

    def answer(self, box: Mask) -> Floats:
        """Return (P, K): what the effects' numbers add to the places, right over one box (W,)."""
        world, out = self._world(box), [np.zeros((0, self._of_arm.shape[2]))]
        for name in self.found.problem.unknown:
            carried = any(c.frame in chain(self.work.frames, name) for c in self.work.carriers)
            out.append((self._carried if carried else self._fixed)(name, world, box))
        return np.concatenate(out)

    @cached_property
    def _linear(self) -> Linear:
        return self.work.linearised(self.found.places)

    @cached_property
    def _of_arm(self) -> Floats:
        """(W, 6, K) how the arms' errors move what is seen."""
        return self._columns(self._linear)

    def _columns(self, linear: Linear) -> Floats:
        still = np.zeros((len(self.work.seen), 6, 0))
        columns = [
            effect.block(self.work, linear)
            if effect.of_arm and effect.kind not in self.without
            else np.zeros((len(still), 6, count))
            for effect, count in zip(self.found.effects, self.found.counts, strict=True)
        ]
        return np.concatenate([still, *columns], axis=2)

    @cached_property
    def _twists(self) -> dict[str, Floats]:
        """(W, 6, K) twists of what each carrier moves, by its frame, at the weight of turns."""
        still, out = np.zeros((len(self.work.seen), 6, 6)), {}
        for carrier in self.work.carriers:
            blocks = {c.frame: still + np.eye(6) * (c is carrier) for c in self.work.carriers}
            out[carrier.frame] = WEIGHT * self._columns(Linear(np.zeros(0), np.zeros(0), blocks))
        return out

    def _rigid_part(self, carrier: Carrier, box: Mask) -> Floats:
        """Return (6, K) the rigid motion, about the arm base's origin, of its displacements."""
        places = np.asarray(self.work.frames[carrier.frame].place)[self.work.seen.times, :3, 3]
        motions = np.tile(np.eye(6), (int(box.sum()), 1, 1))
        motions[:, 3:, :3] = -hat(places[box])
        return _explained(WEIGHT * motions, self._twists[carrier.frame][box])

    def _world(self, box: Mask) -> Floats:
        """Return (6, K) by how much reported coordinates of the root are turned and shifted."""
        parts = []
        for carrier in self.work.carriers:
            path = chain(self.work.frames, carrier.frame)[:-1]
            places = [np.asarray(self.work.frames[n].place) for n in path]
            if carrier.link is None and all(place.shape == (4, 4) for place in places):
                base = np.eye(4)
                for place in places:
                    base = base @ place
                parts.append(adjoint(base) @ self._rigid_part(carrier, box))
        count = self._of_arm.shape[2]
        return np.asarray(sum(parts) / len(parts)) if parts else np.zeros((6, count))

    def _fixed(self, name: str, world: Floats, box: Mask) -> Floats:
        """Return (6, K) of a place that no arm moves: the rigid part, seen from its own origin."""
        known, work = self.found.places, self.work
        frames = {n: replace(f, place=known.get(n, f.place)) for n, f in work.frames.items()}
        parent = np.eye(4)
        for each in chain(frames, name)[:-1]:
            place = np.asarray(frames[each].place)
            parent = parent @ (place if place.ndim == 2 else place[0])
        gauge, place = -world, parent @ known[name]
        for carrier in work.carriers:
            if work.frames[carrier.frame].parent == name and carrier.link is None:
                gauge = gauge + adjoint(place) @ self._rigid_part(carrier, box)
        shift = np.eye(6)
        shift[3:, :3] = -hat(known[name][:3, 3])
        return np.asarray(shift @ adjoint(invert(parent)) @ gauge)

    def _carried(self, name: str, world: Floats, box: Mask) -> Floats:
        """Return (6, K) of a place that an arm moves: what explains its displacements best.

        A camera in hand is to see everything where reported coordinates have it.
        """
        moved = self._of_arm[box] + self._seen_of_world(name)[box] @ world
        return _explained(WEIGHT * self._linear.blocks[name][box], WEIGHT * moved)

    def _seen_of_world(self, name: str) -> Floats:
        """Return (W, 6, 6) how a twist of reported root coordinates moves what is seen.

        What stands at y is at y - b(y) in reported coordinates: seen through the reported arm, the
        target stays where it is and the camera's chain is to make up for b; and likewise a target
        in the hand before a camera that stands.
        """
        work, frames = self.work, {}
        for each, frame in work.frames.items():
            place = np.asarray(self.found.places.get(each, frame.place))
            at = place if place.ndim == 2 else place[work.seen.times]
            frames[each] = replace(frame, place=at)
        out = np.zeros((len(work.seen), 6, 6))
        for k, (camera, target) in enumerate(work.ends):
            rows = np.flatnonzero(work.seen.pairs == k)
            if not len(rows):
                continue
            back = np.broadcast_to(composed(frames, camera), (len(work.seen), 4, 4))[rows]
            tip = np.broadcast_to(composed(frames, target), (len(work.seen), 4, 4))[rows]
            turned = np.swapaxes(back[:, :3, :3], 1, 2)
            places = (tip[:, :3, :3] @ work.seen.offsets[rows][..., None])[..., 0] + tip[:, :3, 3]
            sign = 1.0 if name in chain(work.frames, camera) else -1.0
            out[rows, :3, :3] = out[rows, 3:, 3:] = sign * turned
            out[rows, 3:, :3] = sign * turned @ -hat(places)
        return out


def _explained(by: Floats, moved: Floats) -> Floats:
    """Return (6, K) the least-squares amounts of (W, 6, 6) in (W, 6, K)."""
    return np.asarray(
        np.linalg.pinv(by.reshape(-1, 6), rcond=1e-6) @ moved.reshape(-1, moved.shape[2])
    )


def adjoint(pose: Floats) -> Floats:
    """Return (6, 6) that takes a twist about a frame's origin to its parent's, in its axes."""
    out = np.zeros((6, 6))
    out[:3, :3] = out[3:, 3:] = pose[:3, :3]
    out[3:, :3] = hat(pose[:3, 3]) @ pose[:3, :3]
    return out


def expected_error(
    found: Estimate, work: Work, answer: Floats, put_right: Floats | float = 0.0
) -> ExpectedError:
    """Return the predictive spread of an answer at new poses of the work.

    Of the pose's own error, of what the arm does beyond the rigid part, and of the noise of a
    sighting: what errors of poses held out consist of.

    Args:
        found: The posterior.
        work: Where it is taken.
        answer: (P,) moves of the places.
        put_right: (K,) what is corrected of the arms' errors, in numbers of the effects.
    """
    known, rng, at = found.posterior, np.random.default_rng(0), work.poses
    model = model_at(at, found.places, found.effects, np.ones(len(at.seen)), of_session=False)
    of_places, of_effects = model.places[:, 3:], model.effects[:, 3:]
    expected = of_places @ answer + of_effects @ np.broadcast_to(put_right, of_effects.shape[2])
    rows = np.concatenate([of_places, of_effects], axis=2)
    squares, chances = [], []
    for chance, each in zip(known.chances, known.fits, strict=True):
        bias = rows @ each.mean - expected
        noise = model.noise(each.sizes)[:, 3:, 3:]
        covariance = spread_of(rows, each.covariance) + noise
        root = np.linalg.cholesky(covariance + 1e-18 * np.eye(3))
        # Eight of an error at each pose and each draw of the sizes, for its quantiles
        drawn = bias + (root @ rng.standard_normal((8, len(bias), 3, 1)))[..., 0]
        exact = float(((bias**2).sum(axis=1) + np.trace(covariance, axis1=1, axis2=2)).mean())
        square = (drawn**2).sum(axis=2).ravel()
        squares.append(square * exact / square.mean())
        chances.append(np.full(square.size, chance))
    values, weights = np.concatenate(squares), np.concatenate(chances)
    order = np.argsort(values)
    share = np.cumsum(weights[order]) / weights.sum()
    p95 = float(np.sqrt(values[order][np.searchsorted(share, 0.95)]))
    return ExpectedError(float(np.sqrt(np.average(values, weights=weights))), p95)
