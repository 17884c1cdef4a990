"""What is said of an answer of which somebody asks if it is the best: for any graph of frames.

Between a camera and what it saw the graph has known places and unknown ones. Where one is unknown
on either way, from where both part, or two on the same, ``C M = T`` can be written as certificates
take it (:mod:`flangeye.handeye.certificate`): of two on the same way the nearer to the root goes
over as its inverse. Of three, such as two arms with a marker anywhere, it cannot.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from typing import NamedTuple

import numpy as np

from flangeye.handeye.certificate import Certificate, Sightings, certify
from flangeye.handeye.likelihood import Solution
from flangeye.handeye.loop import LoopProblem
from flangeye.maths.frame_graph import Frame, chain
from flangeye.maths.geometry import invert, rotation_exp, rotation_log
from flangeye.types import BASE, BASE2, CAMERA, TARGET, Floats, Indices

NEAR, ROUNDING = 5.0, 1e-9
"""Standard deviations by which what weights that stay as they are change may move an answer, and
rounding [rad]."""
OPTIMAL = "globally optimal: nowhere is there an answer that fits the agreeing poses better"
NOT_CERTIFIED = "not certified as globally optimal"


@dataclass(frozen=True, eq=False)
class Answer:
    """The answer for N sightings that agree.

    Attributes:
        frames: By name; those to be found have no place, what moves has one at each time.
        ends: (N,) each one's camera and target.
        times: (N,) index of the places of what moves.
        places: (4, 4) of the K unknown frames.
        covariances: (6, 6) of them.
        errors: (N, 6) what takes predicted targets to measured ones, in ``camera``.
        weights: (N, 6, 6) inverse covariances of them.
        freedoms: (N,) how many numbers were measured: 6, 5 with a normal, 3.
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
        """Return (M,) the sightings of one target by one camera."""
        return np.flatnonzero([each == ends for each in self.ends])

    def ways(self, ends: tuple[str, str]) -> tuple[list[str], list[str]]:
        """Return the frames that lead to a camera and to a target, from where both ways part."""
        first, second = (chain(self.frames, end) for end in ends)
        shared = sum(1 for a, b in zip(first, second, strict=False) if a == b)
        return first[shared:], second[shared:]

    def unknown(self, ends: tuple[str, str]) -> tuple[list[str], list[str]]:
        """Return the unknown ones of those."""
        first, second = ([n for n in way if n in self.places] for way in self.ways(ends))
        return first, second


def answer_of(problem: LoopProblem, found: Solution) -> Answer:
    """Return the answer for one camera and one target; what else was found stays as it is."""
    s, loop, kept = problem.measurements, problem.loop, found.inliers
    s = (s if found.at.course is None else found.at.course.applied(s)).where(kept)
    point = np.tile(np.eye(4), (len(s), 1, 1))
    point[:, :3, 3] = s.offsets
    frames = {
        "camera_carrier": Frame(BASE, s.a),
        CAMERA: Frame("camera_carrier"),
        BASE2: Frame(BASE, None if loop.y else np.eye(4)),
        "target_carrier": Frame(BASE2, s.b),
        TARGET: Frame("target_carrier", None if loop.z else loop.place),
        "target_point": Frame(TARGET, point),
    }
    at = {CAMERA: (found.at.x, 0), BASE2: (found.at.y, 6), TARGET: (found.at.z, 12)}
    at = {name: each for name, each in at.items() if frames[name].place is None}
    return Answer(
        frames,
        [(CAMERA, "target_point")] * len(s),
        np.arange(len(s)),
        {name: place for name, (place, _) in at.items()},
        {name: found.covariance[i : i + 6, i : i + 6] for name, (_, i) in at.items()},
        found.linear.residuals[kept],
        found.weights[kept],
        s.freedoms,
    )


def certificate_note(answer: Answer) -> str:
    """Return in words whether the sightings that agree have no better answer than the one found."""
    inverse = _inverse_in(answer)
    for ends in dict.fromkeys(answer.ends):
        if not _is_quadratic(answer.unknown(ends), inverse):
            return _not_certifiable(ends, answer)
    places = np.array([invert(x) if n in inverse else x for n, x in answer.places.items()])
    shown = certify(_sightings(answer, inverse), places)
    if not shown.optimal:
        share = min(shown.missing / max(shown.cost, 1e-300), 1)
        return (
            f"{NOT_CERTIFIED} (gap {share:.1%}): another answer may leave squared errors less by "
            "so much"
        )
    return _far_away(shown, places, answer) or OPTIMAL


def _far_away(shown: Certificate, places: Floats, answer: Answer) -> str | None:
    """Return what is said where the bottom of the valley is not the answer."""
    away = np.linalg.norm(rotation_log(shown.rotations @ invert(places)[:, :3, :3]), axis=1)
    known = [np.linalg.eigvalsh(each[:3, :3])[-1] for each in answer.covariances.values()]
    beyond = away > NEAR * np.sqrt(known) + ROUNDING
    if not beyond.any():
        return None
    far = np.degrees(away[beyond].max())
    return f"{NOT_CERTIFIED}: with its weights the best answer is {far:.2g} deg from it"


def _not_certifiable(ends: tuple[str, str], answer: Answer) -> str:
    camera, target = ends
    between = [name for way in answer.unknown(ends) for name in way]
    return (
        f"not certifiable: where {camera} saw {target}, squared errors are no quadratic of the "
        f"{len(between)} unknown places between them: {', '.join(between)}"
    )


# --- which sides unknowns stand on ---------------------------------------------------------------


def _inverse_in(answer: Answer) -> frozenset[str]:
    """Return the unknowns that go over as their inverses."""
    ways = (way for ends in dict.fromkeys(answer.ends) for way in answer.unknown(ends))
    return frozenset(way[0] for way in ways if len(way) == 2)


def _is_quadratic(unknown: tuple[list[str], list[str]], inverse: frozenset[str]) -> bool:
    """Whether either side gets one unknown at most, each the way round that it has elsewhere."""
    first, second = unknown
    if inverse.isdisjoint(first + second):
        return len(first) <= 1 and len(second) <= 1
    leads, *others = first or second
    return not (first and second) and len(others) <= 1 and inverse & {leads, *others} == {leads}


class _Way(NamedTuple):
    """A way from the root: one more (M, 4, 4) known places than unknown frames between them."""

    known: list[Floats]
    unknown: list[str]

    @property
    def side(self) -> tuple[Floats, str | None, Floats]:
        """What is known before the one unknown, or none, and after it."""
        if self.unknown:
            return self.known[0], self.unknown[0], self.known[1]
        return self.known[0], None, np.broadcast_to(np.eye(4), self.known[0].shape)


def _way(way: Sequence[str], answer: Answer, times: Indices) -> _Way:
    known, unknown = [np.tile(np.eye(4), (len(times), 1, 1))], list[str]()
    for name in way:
        if name in answer.places:
            unknown.append(name)
            known.append(np.tile(np.eye(4), (len(times), 1, 1)))
        else:
            place = np.asarray(answer.frames[name].place)
            known[-1] = known[-1] @ (place if place.ndim == 2 else place[times])
    return _Way(known, unknown)


def _sides(
    camera: _Way, target: _Way, inverse: frozenset[str]
) -> Iterator[tuple[Floats, str | None, Floats]]:
    """Give what leads to the camera and to the target, from one frame, one unknown in each."""
    if inverse.isdisjoint(camera.unknown + target.unknown):
        yield from (camera.side, target.side)
        return
    leads, other = (camera, target) if camera.unknown else (target, camera)
    rest = _Way(leads.known[1:], leads.unknown[1:])
    still = np.broadcast_to(np.eye(4), leads.known[0].shape)
    back = still, leads.unknown[0], invert(leads.known[0]) @ other.known[0]
    yield from (rest.side, back) if leads is camera else (back, rest.side)


# --- the sightings -------------------------------------------------------------------------------


def _sightings(answer: Answer, inverse: frozenset[str]) -> Sightings:
    each = [_of_pair(answer, ends, inverse) for ends in dict.fromkeys(answer.ends)]
    columns = ([getattr(part, f.name) for part in each] for f in fields(Sightings))
    return Sightings(*map(np.concatenate, columns))


def _of_pair(answer: Answer, ends: tuple[str, str], inverse: frozenset[str]) -> Sightings:
    rows = answer.of_pair(ends)
    first, second = (_way(way, answer, answer.times[rows]) for way in answer.ways(ends))
    (a, u, c), (b, v, d) = _sides(first, second, inverse)
    camera, target = (
        before @ _place(name, answer, inverse) @ after
        for before, name, after in ((a, u, c), (b, v, d))
    )
    turn = np.kron(np.eye(2), camera[:, :3, :3])
    weights = turn @ answer.weights[rows] @ np.swapaxes(turn, 1, 2)
    seen = _measured(invert(camera) @ target, answer.errors[rows])
    index = {name: i for i, name in enumerate(answer.places)}
    of = (np.full(len(rows), index.get(name or "", len(index))) for name in (u, v))
    return Sightings(a, next(of), c @ seen, b, next(of), d, weights, answer.freedoms[rows])


def _place(name: str | None, answer: Answer, inverse: frozenset[str]) -> Floats:
    if name is None:
        return np.eye(4)
    return invert(answer.places[name]) if name in inverse else answer.places[name]


def _measured(predicted: Floats, errors: Floats) -> Floats:
    """Return (M, 4, 4) what was measured; of a circle the turn about its z is as predicted."""
    out = predicted.copy()
    out[:, :3, :3] = rotation_exp(errors[:, :3]) @ predicted[:, :3, :3]
    out[:, :3, 3] += errors[:, 3:]
    return out
