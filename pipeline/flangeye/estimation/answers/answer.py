r"""The camera's poses for the true and for the reported arm, as linear functions of the posterior.

*True*: the true places, with the arm's errors in their covariance. *As reported*: the places that
fit the poses as the controller reports them. Commands are sent in reported coordinates, so the best
camera pose is the rigid map onto those: with d the arm's displacement over poses of the work and b
its least-squares rigid part,

.. math:: p_{reported} = p + A\,\delta, \qquad b = \arg\min \sum_{work} |d - b|^2

over positions and rotations. Rotations have a short lever; they alone determine the turn about the
line if the work is a line.

Errors common to all poses cancel, so this answer is known far better than the true pose.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import numpy as np

from flangeye.estimation.answers.work import Work
from flangeye.estimation.estimate import Estimate, model_at
from flangeye.estimation.graph import Linear, Problem
from flangeye.estimation.mixed import shares, spread_of
from flangeye.models.cell import chain, composed
from flangeye.types import ExpectedError, Floats
from flangeye.types.geometry import hat, invert


@dataclass(frozen=True, eq=False)
class Answer:
    """Estimated transforms, with the arm taken as it reports itself or as it truly is.

    Attributes:
        mean: (P,) moves of the places from their estimates.
        covariance: (P, P) covariance of these moves.
        shares: (P, P) part of the covariance by cause; the rest is from the uncertain sizes of the
            causes.
    """

    mean: Floats
    covariance: Floats
    shares: Mapping[str, Floats]

    def at(self, mean: Floats) -> Answer:
        """Return the answer at another mean (P,), with the mean squared error about it."""
        off = mean - self.mean  # a mean squared error is the covariance and the squared bias
        return replace(self, mean=mean, covariance=self.covariance + np.outer(off, off))


def functional(found: Estimate, a: Floats) -> Answer:
    """Return mean and covariance of p + A delta over the mixture and (B, P, K) matrices A."""
    p = found.posterior.model.p
    rows = np.concatenate([np.tile(np.eye(p), (len(a), 1, 1)), a], axis=2)
    each = rows @ found.posterior.mean
    within = rows @ found.posterior.covariance @ np.swapaxes(rows, 1, 2)
    # Law of total covariance over the boxes that may be meant
    apart = each - each.mean(axis=0)
    covariance = within.mean(axis=0) + apart.T @ apart / max(len(a) - 1, 1)
    of_effects, noise = shares(found.posterior, rows.mean(axis=0))
    # What is drawn anew at each sighting
    named = {"noise of single scans and poses": noise}
    for effect, share in zip(found.effects, of_effects, strict=True):
        named[effect.name] = named.get(effect.name, 0.0) + share
    return Answer(moves(found, a), 0.5 * (covariance + covariance.T), named)


def moves(found: Estimate, a: Floats) -> Floats:
    """Return the (P,) posterior mean of p + A delta."""
    p, mean = found.posterior.model.p, found.posterior.mean
    return np.asarray(mean[:p] + a.mean(axis=0) @ mean[p:])


def as_true(found: Estimate) -> Answer:
    """Return the places for the arms as they really are."""
    return functional(found, np.zeros((1, found.posterior.model.p, sum(found.counts))))


def as_reported(found: Estimate, work: Work) -> Answer:
    """Return the places for the arms as their controllers report them.

    Commands are sent to the work; each possible work box has an answer of its own.
    """
    return functional(found, commanded(found, work))


def commanded(found: Estimate, work: Work) -> Floats:
    """Return the derivatives (B, P, K) of the places by the effects, one matrix a work box.

    The places are those that are right in the coordinates that the arms report.
    """
    return _Commands(found, work.around, work.boxes).answer()


@dataclass(frozen=True, eq=False)
class _Commands:
    """How the effects' parameters move the places, at all poses where commands may be sent.

    Attributes:
        found: The posterior.
        work: W predicted sightings over the work.
        boxes: (B, W) weights with which the sightings stand for each possible work box.
    """

    found: Estimate
    work: Problem
    boxes: Floats

    def answer(self) -> Floats:
        """Return (B, P, K): how the effects' parameters move the places, fitted over each box."""
        world, out = self._world, [np.zeros((len(self.boxes), 0, self._of_arm.shape[2]))]
        for name in self.found.problem.unknown:
            carried = any(c.frame in chain(self.work.frames, name) for c in self.work.carriers)
            # Not only the target but what is seen within 50 mm of it is to be in its right place
            about = 0.05 if carried else 0.0
            by = self._linear.blocks[name]
            if carried:
                # What explains the displacements of a place on an arm best: a camera in hand must
                # see everything where reported coordinates have it
                of_world = self._explained(by, self._seen_of_world(name), about)
                out.append(self._explained(by, self._of_arm, about) + of_world @ world)
            else:
                out.append(self._fixed(name, world))
            # Its lasting errors move what it reports at the work as they did in the session
            if any(name == camera for camera, _ in self.work.ends):
                of_camera = self._columns(self._linear, "of_camera")
                out[-1] = out[-1] + self._explained(by, of_camera, about)
        return np.concatenate(out, axis=1)

    @cached_property
    def _linear(self) -> Linear:
        return self.work.linearised(self.found.places)

    @cached_property
    def _of_arm(self) -> Floats:
        """Twists (W, 6, K) of the sighted targets for unit weights of the arms' errors."""
        return self._columns(self._linear, "of_arm")

    def _columns(self, linear: Linear, whose: Literal["of_arm", "of_camera"]) -> Floats:
        still = np.zeros((len(self.work.seen), 6, 0))
        columns = [
            effect.block(self.work, linear)
            if getattr(effect, whose)
            else np.zeros((len(still), 6, count))
            for effect, count in zip(self.found.effects, self.found.counts, strict=True)
        ]
        return np.concatenate([still, *columns], axis=2)

    @cached_property
    def _rigid_parts(self) -> dict[str, Floats]:
        """Rigid motion (B, 6, K) of each carrier's frame, about its arm base's origin."""
        still, out = np.zeros((len(self.work.seen), 6, 6)), {}
        for carrier in self.work.carriers:
            twists = self._columns(self.work.following(carrier), "of_arm")
            places = np.asarray(self.work.frames[carrier.frame].place)[self.work.seen.times, :3, 3]
            motions = still + np.eye(6)
            motions[:, 3:, :3] = -hat(places)
            out[carrier.frame] = self._explained(motions, twists)
        return out

    def _explained(self, by: Floats, moved: Floats, about: float = 0.0) -> Floats:
        """Return (B, 6, K): twists ``moved`` (W, 6, K), fitted over each box by least squares.

        A turn counts by how far it moves the points of a cube, rms; ``about`` is half its edge [m].
        """
        # Two millimetres determine the turn about a line where the work is in one, and no more, for
        # the work is at positions. At 20 mm an arm of 3 mrad turned the answer by 0.15 mrad, as
        # much as 60 poses leave uncertain
        lever = np.hypot(0.002, about * np.sqrt(2 / 3))
        weight = np.repeat([lever, 1.0], 3)[:, None]
        across = np.swapaxes(weight**2 * by, 1, 2)
        gram, right = (np.tensordot(self.boxes, across @ each, axes=1) for each in (by, moved))
        return np.asarray(np.linalg.pinv(gram, rcond=1e-12, hermitian=True) @ right)

    @property
    def _world(self) -> Floats:
        """Rotation and shift (B, 6, K) of the root's reported coordinates."""
        parts = []
        for carrier in self.work.carriers:
            parent = self.work.frames[carrier.frame].parent
            path = [self.work.frames[name].place for name in chain(self.work.frames, parent)]
            if carrier.link is None and all(p is not None and p.ndim == 2 for p in path):
                base = composed(self.work.frames, parent)
                parts.append(adjoint(base) @ self._rigid_parts[carrier.frame])
        # Arms that disagree about the root share it: its reported coordinates are their mean's
        count = self._of_arm.shape[2]
        return np.asarray(
            sum(parts) / len(parts) if parts else np.zeros((len(self.boxes), 6, count))
        )

    def _fixed(self, name: str, world: Floats) -> Floats:
        """Return the (B, 6, K) rigid part of a place that no arm moves, about its own origin."""
        known, work = self.found.places, self.work
        parent = composed(work.frames_at(known, 0), work.frames[name].parent)
        gauge, place = -world, parent @ known[name]
        for carrier in work.carriers:
            if work.frames[carrier.frame].parent == name and carrier.link is None:
                gauge = gauge + adjoint(place) @ self._rigid_parts[carrier.frame]
        # Twists about the parent's origin, then about the place's own: tau + phi x t
        shift = np.eye(6)
        shift[3:, :3] = -hat(known[name][:3, 3])
        return np.asarray(shift @ adjoint(invert(parent)) @ gauge)

    def _seen_of_world(self, name: str) -> Floats:
        """Return (W, 6, 6): how a twist of reported root coordinates moves the sighted targets.

        A fixed point y has reported coordinates y - b(y). With a camera in hand the target is
        fixed, so the camera's pose takes up b; with a fixed camera the target's pose in the hand
        does.
        """
        work = self.work
        frames = work.frames_at(self.found.places, work.seen.times)
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


def adjoint(pose: Floats) -> Floats:
    """Return the adjoint (6, 6) that takes a twist at a frame's origin to its parent's."""
    out = np.zeros((6, 6))
    out[:3, :3] = out[3:, 3:] = pose[:3, :3]
    out[3:, :3] = hat(pose[:3, 3]) @ pose[:3, :3]
    return out


@dataclass(frozen=True, eq=False)
class PredictedWork:
    """Predicted sightings at new poses of the work, for F components of the mixture.

    Attributes:
        rows: (W, 3, P + K) derivatives of the predicted positions by places and effects [m].
        means: (F, W, 3) expected errors [m].
        drawn: (F, 8, W, 3) errors drawn about the means [m].
        squares: (F,) the exact mean square of the errors [m^2].
    """

    rows: Floats
    means: Floats
    drawn: Floats
    squares: Floats


def predicted_work(found: Estimate, work: Work) -> PredictedWork:
    """Return the prediction of sightings at new poses of the work.

    It covers what errors of held-out poses consist of: the calibration's error, the arm's non-rigid
    error, and the noise of a sighting.
    """
    known, rng, at = found.posterior, np.random.default_rng(0), work.poses
    model = model_at(at, found.places, found.effects, np.ones(len(at.seen)), of_session=False)
    rows = model.design[:, 3:]
    moved = np.flatnonzero(rows.any(axis=(0, 1)))
    lasting, drawn, squares = rows[:, :, moved], [], []
    for each in known.fits:
        noise = model.noise(each.sizes)[:, 3:, 3:]
        covariance = spread_of(lasting, each.covariance[np.ix_(moved, moved)]) + noise
        # A nanometre keeps the root real where a prediction has no error along an axis
        root = np.linalg.cholesky(covariance + 1e-18 * np.eye(3))
        # Eight of an error at each pose and each draw of the sizes, for its quantiles
        drawn.append((root @ rng.standard_normal((8, len(rows), 3, 1)))[..., 0])
        squares.append(np.trace(covariance, axis1=1, axis2=2).mean())
    means = np.array([rows @ each.mean for each in known.fits])
    return PredictedWork(rows, means, np.array(drawn), np.array(squares))


def expected_error(
    there: PredictedWork, answer: Floats, corrected_part: Floats | float = 0.0
) -> ExpectedError:
    """Return the predictive spread of an answer at new poses of the work.

    Args:
        there: The predicted sightings.
        answer: (P,) moves of the places.
        corrected_part: (K,) correction of the arms' errors, as parameters of the effects.
    """
    numbers = np.broadcast_to(corrected_part, there.rows.shape[2] - len(answer))
    bias = there.means - there.rows @ np.concatenate([answer, numbers])
    exact = (bias**2).sum(axis=2).mean(axis=1) + there.squares
    values = ((bias[:, None] + there.drawn) ** 2).sum(axis=3).reshape(len(exact), -1)
    # The draws are for the quantile alone; scaled so that their mean is the exact mean square
    values *= (exact / values.mean(axis=1))[:, None]
    p95 = float(np.sqrt(np.quantile(values, 0.95)))
    return ExpectedError(float(np.sqrt(exact.mean())), p95)
