"""Certify that a calibration is the global optimum, for any graph of frames.

A sighting is an equation ``C M = T``, with C the places from a root to the camera and T those to
the target. A certificate (:mod:`flangeye.estimation.certify.certificate`) takes at most two unknown
places on either side. Any frame may be the root: the places on the way to it are then replaced by
their inverses. The root with the smallest certificate is taken.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import NamedTuple

import numpy as np

from flangeye.estimation.certify.certificate import Certificate, certify
from flangeye.estimation.certify.lifted import Factors, LiftedSightings, families_of
from flangeye.estimation.estimate import Estimate
from flangeye.models.cell import Frame, chain
from flangeye.types import Floats, Indices
from flangeye.types.geometry import invert, rotation_exp, rotation_log

OPTIMAL = "globally optimal: no other answer fits the inlier poses better"
NOT_CERTIFIED = "not certified as globally optimal"


class CertificateVerdict(NamedTuple):
    """Whether an answer is certified as optimal, and a better one if found.

    Attributes:
        note: The verdict in words.
        better: (4, 4) poses of the unknown frames that fit better, if such were found.
    """

    note: str
    better: Mapping[str, Floats] | None = None


class PathStep(NamedTuple):
    """One frame on the path between camera and target, forwards or inverted."""

    name: str
    back: bool


@dataclass(frozen=True, eq=False)
class CertifiedAnswer:
    """The answer for N sightings that agree.

    Attributes:
        frames: Frames by name; an unknown frame has no place, a moving frame one for each time.
        ends: (N,) camera and target of each sighting.
        times: (N,) index into the places of moving frames.
        places: Poses (4, 4) of the K unknown frames.
        covariances: Covariances (6, 6) of these places.
        errors: (N, 6) twists from predicted to measured targets, in ``camera``.
        weights: (N, 6, 6) inverse covariances of the errors.
        freedoms: (N,) how many numbers were measured: 6 of a pose, 5 of a circle with its normal, 3
            of a centre.
    """

    frames: Mapping[str, Frame]
    ends: Sequence[tuple[str, str]]
    times: Indices
    places: Mapping[str, Floats]
    covariances: Mapping[str, Floats]
    errors: Floats
    weights: Floats
    freedoms: Floats

    def of_pair(self, ends: tuple[str, str]) -> Indices:
        """Return the indices (M,) of the sightings of one target by one camera."""
        return np.flatnonzero([each == ends for each in self.ends])

    def ways(self, ends: tuple[str, str], root: str = "") -> tuple[list[PathStep], list[PathStep]]:
        """Return the paths to a camera and to a target, from their last common frame.

        Args:
            ends: The camera and the target.
            root: Frame taken as the graph's root; its own root by default.
        """
        first, second = (self._way(root, end) for end in ends)
        shared = sum(1 for a, b in zip(first, second, strict=False) if a == b)
        return first[shared:], second[shared:]

    def _way(self, root: str, end: str) -> list[PathStep]:
        up, down = chain(self.frames, root), chain(self.frames, end)
        shared = sum(1 for a, b in zip(up, down, strict=False) if a == b)
        back = [PathStep(name, True) for name in reversed(up[shared:])]
        return [*back, *(PathStep(name, False) for name in down[shared:])]

    def unknown(
        self, ends: tuple[str, str], root: str = ""
    ) -> tuple[list[PathStep], list[PathStep]]:
        """Return the unknown frames on the paths to a camera and to a target."""
        first, second = ([s for s in w if s.name in self.places] for w in self.ways(ends, root))
        return first, second

    def place(self, step: PathStep, times: Indices) -> Floats:
        """Return a known frame's pose (M, 4, 4) at each time, or its inverse on a backward step."""
        place = np.asarray(self.frames[step.name].place)
        every = np.broadcast_to(place, (len(times), 4, 4)) if place.ndim == 2 else place[times]
        return invert(every) if step.back else every


def answer_of(found: Estimate) -> CertifiedAnswer:
    """Return the answer for the inlying sightings, with the effects kept at their estimates."""
    problem, model, kept = found.problem, found.posterior.model, found.inliers
    s = problem.seen.where(kept)
    frames, ends = dict(problem.frames), list(problem.ends)
    if problem.seen.offsets.any():  # what was seen stands beside the target's origin
        points = np.tile(np.eye(4), (len(problem.seen), 1, 1))
        points[problem.seen.times, :3, 3] = problem.seen.offsets
        frames |= {f"{target}_point": Frame(target, points) for _, target in problem.ends}
        ends = [(camera, f"{target}_point") for camera, target in problem.ends]
    mode = found.posterior.mode
    left = model.residuals - model.design[..., model.p :] @ mode.mean[model.p :]
    return CertifiedAnswer(
        frames,
        [ends[k] for k in s.pairs],
        s.times,
        dict(found.places),
        {
            name: mode.covariance[6 * i : 6 * i + 6, 6 * i : 6 * i + 6]
            for i, name in enumerate(problem.unknown)
        },
        left[kept],
        model.weights(mode.sizes)[kept],
        s.ranks.astype(np.float64),
    )


def verdict_of(answer: CertifiedAnswer) -> CertificateVerdict:
    """Return whether the answer is proven optimal for the inlying sightings, or a better one."""
    root = _seen_from(answer)
    if root is None:
        return CertificateVerdict(_not_certifiable(answer))
    shown = certify(_sightings(answer, root), _array(_turned(answer.places, root, answer)))
    if not shown.optimal:
        share = min(shown.missing / max(shown.cost, 1e-300), 1)
        note = (
            f"{NOT_CERTIFIED} (gap {share:.1%}): another answer may have squared errors "
            "smaller by that share"
        )
        return CertificateVerdict(note, _named(shown.better, root, answer))
    away = _far_away(shown, root, answer)
    return (
        CertificateVerdict(away, _named(shown.places, root, answer))
        if away
        else CertificateVerdict(OPTIMAL)
    )


def certificate_notes(answer: CertifiedAnswer) -> tuple[str, ...]:
    """Return in words whether there is a better answer."""
    return (verdict_of(answer).note,)


def moved_note() -> str:
    """Return the note for an answer that the certificate has improved."""
    return "the certificate found a likelier answer than the search; it is used"


def _named(places: Floats | None, root: str, answer: CertifiedAnswer) -> dict[str, Floats] | None:
    if places is None:
        return None
    return _turned(dict(zip(answer.places, places, strict=True)), root, answer)


def _far_away(shown: Certificate, root: str, answer: CertifiedAnswer) -> str | None:
    """Return a note if the answer is not at the certified minimum; None if it is."""
    places = _array(_turned(answer.places, root, answer))
    turns = shown.places[:, :3, :3] @ invert(places)[:, :3, :3]
    away = np.linalg.norm(rotation_log(turns), axis=1)
    known = [np.linalg.eigvalsh(each[:3, :3])[-1] for each in answer.covariances.values()]
    # The certificate's weights are those at the answer, which moves its minimum a little: by five
    # standard deviations at most, and rounding [rad]
    beyond = away > 5.0 * np.sqrt(known) + 1e-9
    if not beyond.any():
        return None
    far = np.degrees(away[beyond].max())
    return f"{NOT_CERTIFIED}: the optimum for this answer's weights is {far:.2g} deg away from it"


def _not_certifiable(answer: CertifiedAnswer) -> str:
    def between(ends: tuple[str, str]) -> list[str]:
        return [step.name for way in answer.unknown(ends) for step in way]

    camera, target = most = max(dict.fromkeys(answer.ends), key=lambda ends: len(between(ends)))
    return (
        f"not certifiable: where {camera} saw {target}, too many unknown places lie between them: "
        f"{', '.join(between(most))}"
    )


# --- from where the graph is looked at -----------------------------------------------------------


def _seen_from(answer: CertifiedAnswer) -> str | None:
    """Return the root frame with the smallest certificate; None if there is none.

    The root is an empty name.
    """
    sizes = {root: _size(answer, root) for root in ("", *answer.places)}
    possible = {root: size for root, size in sizes.items() if size}
    return min(possible, key=possible.__getitem__) if possible else None


def _size(answer: CertifiedAnswer, root: str) -> int:
    """Return the size of the certificate's matrix for a root; 0 if the errors are not quadratic."""
    ways = [way for ends in dict.fromkeys(answer.ends) for way in answer.unknown(ends, root)]
    index = {name: i for i, name in enumerate(answer.places)}
    pairs = {(index[way[0].name], index[way[1].name]) for way in ways if len(way) == 2}
    nested = {u for u, _ in pairs} & {v for _, v in pairs}
    if nested or any(len(way) > 2 for way in ways):
        return 0
    return families_of(pairs, len(index))[1]


def _turned(places: Mapping[str, Floats], root: str, answer: CertifiedAnswer) -> dict[str, Floats]:
    """Return places by name; those against the direction from the root are inverted."""
    back = chain(answer.frames, root)
    return {name: invert(place) if name in back else place for name, place in places.items()}


def _array(places: Mapping[str, Floats]) -> Floats:
    return np.array(list(places.values()))


# --- the sightings -------------------------------------------------------------------------------


def _sightings(answer: CertifiedAnswer, root: str) -> LiftedSightings:
    pairs = [_of_pair(answer, ends, root) for ends in dict.fromkeys(answer.ends)]
    return LiftedSightings(
        _joined([p.camera for p in pairs]),
        _joined([p.target for p in pairs]),
        np.concatenate([p.weights for p in pairs]),
        np.concatenate([p.freedoms for p in pairs]),
    )


def _joined(sides: Sequence[Factors]) -> Factors:
    return Factors(*(np.concatenate([getattr(s, f.name) for s in sides]) for f in fields(Factors)))


def _of_pair(answer: CertifiedAnswer, ends: tuple[str, str], root: str) -> LiftedSightings:
    rows = answer.of_pair(ends)
    camera, target = (_side(answer, way, answer.times[rows]) for way in answer.ways(ends, root))
    places = _array(_turned(answer.places, root, answer))
    there, seen = camera.at(places), target.at(places)
    # Errors are in the camera; the equation has them where the ways to camera and target part
    turn = np.kron(np.eye(2), there[:, :3, :3])
    weights = turn @ answer.weights[rows] @ np.swapaxes(turn, 1, 2)
    measured = _measured(invert(there) @ seen, answer.errors[rows])
    return LiftedSightings(
        replace(camera, c=camera.c @ measured), target, weights, answer.freedoms[rows]
    )


def _side(answer: CertifiedAnswer, way: Sequence[PathStep], times: Indices) -> Factors:
    """Return a path as one side of the equations: it has at most two unknown places."""
    index = {name: i for i, name in enumerate(answer.places)}
    still = np.tile(np.eye(4), (len(times), 1, 1))
    known, unknown = [still], list[int]()
    for step in way:
        if step.name in index:
            unknown.append(index[step.name])
            known.append(still)
        else:
            known[-1] = known[-1] @ answer.place(step, times)
    # The last is after the last unknown; what is not there is none of them, and nothing between.
    lacking = 2 - len(unknown)
    (u, v), (a, b, c) = [len(index)] * lacking + unknown, [still] * lacking + known
    return Factors(a, np.full(len(times), u), b, np.full(len(times), v), c)


def _measured(predicted: Floats, errors: Floats) -> Floats:
    """Return the (M, 4, 4) measured poses; a circle's turn about its z is as predicted."""
    out = predicted.copy()
    out[:, :3, :3] = rotation_exp(errors[:, :3]) @ predicted[:, :3, :3]
    out[:, :3, 3] += errors[:, 3:]
    return out
