r"""Any number of cameras, arms, rails and targets at once: one graph of frames. Arrays only.

Every frame stands on another, down to one root. What stands still on its parent is known or
unknown; what an arm or a rail moves is measured at each time. A sighting of a target by a camera
closes a loop in that graph:

    root_T_camera(t)^-1 · root_T_target(t) = camera_T_target

The unknowns are those for which the squared errors of all sightings, each weighed by its own
covariance and that of what carried its ends, are least (Levenberg-Marquardt on SE(3), analytic
Jacobians). Cameras that never see the same thing are tied by the arms between them.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from flangeye.errors import CalibrationRefused
from flangeye.handeye.missing import Loops, Move
from flangeye.handeye.observability import weak_moves
from flangeye.maths.frame_graph import Frame, chain, composed, root_of
from flangeye.maths.geometry import (
    hat,
    invert,
    rigid,
    rotation_between,
    rotation_exp,
    rotation_log,
)
from flangeye.maths.statistics import chi2_quantile, covariance_inflation
from flangeye.types import Floats, Indices, Mask

ITERATIONS, STARTS = 60, 60
"""Of the descent, and random starts of it at most."""
AGREE = 1e-3
"""Two starts whose costs differ by this share ended in one valley, which then is the answer."""
SOLVED = 1e-10
"""A step as small as this ends a descent [rad, m]."""
LIMITS = float(np.radians(2)), 20e-3
"""Largest standard deviations of an unknown's rotation [rad] and translation [m]."""
ROUNDS = 4
"""Of finding the movers' noise, and what it makes of the sightings."""
GATE = 0.9995
"""A good sighting is set aside with one in two thousand's probability."""
TURNS = np.diag([1.0, 1.0, 1.0, 0.0, 0.0, 0.0])
"""Onto the rotation of a residual."""
SIZES = np.logspace(-3, 4, 141)
"""Factors on the movers' variances that are compared."""
FURTHER = np.repeat([np.radians(20), 0.1], 3)
"""By how much what moves is turned [rad] or moved [m] to find out what that would show."""


@dataclass(frozen=True, eq=False)
class Sighting:
    """One camera saw one target.

    Attributes:
        time: Index of the measured poses.
        camera: Its frame.
        target: Its frame.
        pose: (4, 4) camera_T_target; of a circle's the turn about z means nothing.
        covariance: (6, 6) of a left perturbation in ``camera``, rotation before translation.
        projector: (6, 6) onto what was measured.
    """

    time: int
    camera: str
    target: str
    pose: Floats
    covariance: Floats
    projector: Floats = field(default_factory=lambda: np.eye(6))


@dataclass(frozen=True, eq=False)
class Solved:
    """The graph's unknowns.

    Attributes:
        places: (4, 4) parent_T_frame by frame.
        covariances: (6, 6) of each: a turn about its origin, in its parent, and a shift.
        joint: (6 K, 6 K) covariance of all, in the order of ``places``.
        residuals: (N, 6) of the sightings, rotation before translation, in ``camera``.
        squares: (N,) of the residuals, in units of their covariance.
        inliers: (N,) which sightings count.
        movers: Factor on the stated variances of what moves, as the residuals show it.
    """

    places: Mapping[str, Floats]
    covariances: Mapping[str, Floats]
    joint: Floats
    residuals: Floats
    squares: Floats
    inliers: Mask
    movers: float

    def with_joint(self, joint: Floats) -> Solved:
        """Return the same with another (6 K, 6 K) covariance."""
        blocks = {n: joint[6 * i : 6 * i + 6, 6 * i : 6 * i + 6] for i, n in enumerate(self.places)}
        return replace(self, joint=joint, covariances=blocks)


@dataclass(frozen=True, eq=False)
class _Pair:
    """All sightings of one target by one camera.

    Attributes:
        camera: Its frame.
        target: Its frame.
        rows: (M,) which of all sightings.
        times: (M,) of each.
        poses: (M, 4, 4).
        whole: (M,) whether the turn about the target's z was measured.
    """

    camera: str
    target: str
    rows: Indices
    times: Indices
    poses: Floats
    whole: Mask


def solve_graph(
    frames: Mapping[str, Frame],
    sightings: Sequence[Sighting],
    noise: Mapping[str, Floats] | None = None,
    limits: tuple[float, float] = LIMITS,
    start: Mapping[str, Floats] | None = None,
    freedoms: Mapping[str, Floats] | None = None,
) -> Solved:
    """Find every frame whose place is unknown.

    Args:
        frames: By name; the root has no entry.
        sightings: N of them.
        noise: (6, 6) covariance of the measured place of what moves, by frame: a turn about its
            origin and a shift, alike in all directions. Its ratios are believed; its size is found
            from the residuals, and what then lies beyond is set aside. Without it the sightings'
            own covariances are all there is, and all count.
        limits: Largest standard deviations of an unknown's rotation [rad] and translation [m].
        start: (4, 4) of every unknown, where a solution of most of the sightings is known already;
            without it none is needed.
        freedoms: (6, k) unit twists, in its parent, that what moves can do, by frame; by default
            all that are measured can turn about, and move along, every axis.

    Raises:
        StageError: A frame stands on nothing that leads to the root, or the graph has two roots.
        CalibrationRefused: The sightings leave something unknown: it says what, and which motion
            or sighting would tell.
    """
    root_of(frames)
    graph = _Graph.of(frames, sightings, freedoms)
    own = _whiteners(graph.covariances, graph.projectors)
    places = _descend(graph, start, own, robust=True) if start else _best(graph, own)
    every = np.ones(len(sightings), bool)
    if noise is None:
        return _solved(graph, _descend(graph, places, own), (own, every, 1.0), limits)
    for _ in range(ROUNDS):
        carried = graph.carried(places, noise)
        size, kept, whiteners = _weighed(graph, graph.residuals(places), carried)
        places = _descend(graph, places, whiteners * kept[:, None, None])
    return _solved(graph, places, (whiteners, kept, size), limits)


def _solved(
    graph: _Graph,
    places: Mapping[str, Floats],
    weighed: tuple[Floats, Mask, float],
    limits: tuple[float, float],
) -> Solved:
    whiteners, kept, size = weighed
    residuals, jacobian = graph.linearised(places)
    information = information_of(whiteners[kept] @ jacobian[kept])
    scale = np.tile(np.repeat(limits, 3), len(places))
    if weak_moves(information, scale):
        agreeing = [pair for pair in graph.pairs if kept[pair.rows].any()]
        seen = dict.fromkeys((pair.camera, pair.target) for pair in agreeing)
        again = graph.seen_again(places, whiteners * kept[:, None, None])
        loops = Loops(graph.frames, list(seen), list(places), scale)
        raise CalibrationRefused(loops.told_unknown(information, again))
    freedom = float(graph.freedoms[kept].sum()) - len(information)
    wider = covariance_inflation(max(freedom, 1.0), 6)
    joint = np.asarray(np.linalg.inv(information) * wider, dtype=np.float64)
    blocks = {n: joint[6 * i : 6 * i + 6, 6 * i : 6 * i + 6] for i, n in enumerate(places)}
    squares = _squares(whiteners, residuals)
    return Solved(places, blocks, joint, residuals, squares, kept, size)


def information_of(jacobian: Floats) -> Floats:
    """Return J^T J of (N, 6, P) rows of unit covariance."""
    return np.asarray(np.einsum("nij,nik->jk", jacobian, jacobian))


def rows_of(
    frames: Mapping[str, Frame],
    sightings: Sequence[Sighting],
    places: Mapping[str, Floats],
    noise: Mapping[str, Floats],
) -> tuple[Floats, Floats]:
    """Return (N, 6, 6 K) what sightings tell of K unknowns, and their (N, 6) errors, whitened.

    See :func:`linear_of`; the sightings need not have taken part.
    """
    residuals, jacobian, whiteners = linear_of(frames, sightings, places, noise)
    return whiteners @ jacobian, (whiteners @ residuals[..., None])[..., 0]


def linear_of(
    frames: Mapping[str, Frame],
    sightings: Sequence[Sighting],
    places: Mapping[str, Floats],
    noise: Mapping[str, Floats],
    moved: Sequence[str] | None = None,
) -> tuple[Floats, Floats, Floats]:
    """Return (N, 6) residuals, their (N, 6, 6 K) Jacobian, and (N, 6, 6) whiteners of both.

    Args:
        frames: As for :func:`solve_graph`, with the movers' places at the sightings' times.
        sightings: N of them.
        places: (4, 4) of the unknowns.
        noise: (6, 6) covariance of the movers' places, by frame.
        moved: Other frames to tell of than the unknowns, such as what moves.
    """
    graph = _Graph.of(frames, sightings)
    residuals, jacobian = graph.linearised(places, moved)
    spread = graph.covariances + graph.carried(places, noise)
    return residuals, jacobian, _whiteners(spread, graph.projectors)


@dataclass(frozen=True, eq=False)
class _Graph:
    """Frames and what was sighted, and what moves can do."""

    frames: Mapping[str, Frame]
    pairs: Sequence[_Pair]
    covariances: Floats
    projectors: Floats
    freedoms_of: Mapping[str, Floats]

    @classmethod
    def of(
        cls,
        frames: Mapping[str, Frame],
        sightings: Sequence[Sighting],
        freedoms: Mapping[str, Floats] | None = None,
    ) -> _Graph:
        shape = len(sightings), 6, 6
        projectors = np.array([s.projector for s in sightings]).reshape(shape)
        covariances = np.array([s.covariance for s in sightings]).reshape(shape)
        measured = [n for n, f in frames.items() if f.place is not None and f.place.ndim == 3]
        able = freedoms or {name: np.eye(6) for name in measured}
        return cls(frames, _pairs(sightings), covariances, projectors, able)

    @property
    def unknown(self) -> list[str]:
        return [name for name, frame in self.frames.items() if frame.place is None]

    @property
    def freedoms(self) -> Floats:
        return np.asarray(np.trace(self.projectors, axis1=1, axis2=2).round())

    def residuals(self, places: Mapping[str, Floats]) -> Floats:
        """Return the (N, 6) errors of the sightings, across what was measured alone."""
        out = np.zeros((len(self.projectors), 6))
        for pair in self.pairs:
            out[pair.rows] = _residuals(self._at(pair, places), pair)
        return np.asarray((self.projectors @ out[..., None])[..., 0])

    def linearised(
        self, places: Mapping[str, Floats], moved: Sequence[str] | None = None
    ) -> tuple[Floats, Floats]:
        """Return (N, 6) residuals and their (N, 6, 6 K) Jacobian, by the unknowns or others."""
        effects = self._effects(places, list(places) if moved is None else moved)
        return self.residuals(places), self.projectors @ effects

    def carried(self, places: Mapping[str, Floats], noise: Mapping[str, Floats]) -> Floats:
        """Return the (N, 6, 6) covariance that the movers' noise has in the camera."""
        effects = self._effects(places, list(noise))
        stated = np.zeros((6 * len(noise),) * 2)
        for i, covariance in enumerate(noise.values()):
            stated[6 * i : 6 * i + 6, 6 * i : 6 * i + 6] = covariance
        return np.asarray(effects @ stated @ np.swapaxes(effects, 1, 2))

    def seen_again(self, places: Mapping[str, Floats], whiteners: Floats) -> dict[Move, Floats]:
        """Return the (P, P) that all would tell with one thing moved, by its frame and twist."""
        again = {}
        for name, twists in self.freedoms_of.items():
            for twist in np.transpose(twists):
                told = [self._moved_tells(places, whiteners, name, x) for x in (twist, -twist)]
                again[name, tuple(map(float, twist))] = np.sum(told, axis=0)
        return again

    def _moved_tells(
        self, places: Mapping[str, Floats], whiteners: Floats, name: str, twist: Floats
    ) -> Floats:
        turn, shift = (twist * FURTHER)[:3], (twist * FURTHER)[3:]
        at = np.array(self.frames[name].place)
        at[..., :3, :3], at[..., :3, 3] = (
            rotation_exp(turn) @ at[..., :3, :3],
            at[..., :3, 3] + shift,
        )
        moved = replace(self, frames={**self.frames, name: replace(self.frames[name], place=at)})
        before, after = (graph._turns(places) for graph in (self, moved))
        # What is not measured of a circle turns with it.
        back = np.kron(np.eye(2), before @ np.swapaxes(after, 1, 2))
        return information_of(whiteners @ back @ moved._effects(places, list(places)))

    def _turns(self, places: Mapping[str, Floats]) -> Floats:
        """Return (N, 3, 3) camera_R_target, as predicted."""
        out = np.zeros((len(self.projectors), 3, 3))
        for pair in self.pairs:
            frames = self._at(pair, places)
            camera, target = (_each(frames, end, pair) for end in (pair.camera, pair.target))
            out[pair.rows] = np.swapaxes(camera[:, :3, :3], 1, 2) @ target[:, :3, :3]
        return out

    def _at(self, pair: _Pair, places: Mapping[str, Floats]) -> dict[str, Frame]:
        """Return the frames at the times of a pair, all places known."""
        out = {}
        for name, frame in self.frames.items():
            place = np.asarray(places.get(name, frame.place))
            out[name] = replace(frame, place=place if place.ndim == 2 else place[pair.times])
        return out

    def _effects(self, places: Mapping[str, Floats], moved: Sequence[str]) -> Floats:
        """Return (N, 6, 6 K): how K frames turn and move what is seen, in ``camera``."""
        out = np.zeros((len(self.projectors), 6, 6 * len(moved)))
        for pair in self.pairs:
            out[pair.rows] = _effects(self._at(pair, places), pair, moved)
        return out


def _pairs(sightings: Sequence[Sighting]) -> list[_Pair]:
    """Return the sightings by who saw whom."""
    out = []
    for camera, target in dict.fromkeys((s.camera, s.target) for s in sightings):
        rows = [i for i, s in enumerate(sightings) if (s.camera, s.target) == (camera, target)]
        of = [sightings[i] for i in rows]
        times, poses = np.array([s.time for s in of]), np.array([s.pose for s in of])
        whole = np.array([np.trace(s.projector) > 5.5 for s in of])
        out.append(_Pair(camera, target, np.array(rows), times, poses, whole))
    return out


def _residuals(frames: Mapping[str, Frame], pair: _Pair) -> Floats:
    """Return (M, 6): what takes the measured targets of a pair to the predicted ones."""
    seen = _each(frames, pair.camera, pair)
    seen = invert(seen) @ _each(frames, pair.target, pair)
    whole = rotation_log(seen[:, :3, :3] @ np.swapaxes(pair.poses[:, :3, :3], 1, 2))
    turns = rotation_between(pair.poses[:, :3, 2], seen[:, :3, 2])
    turns[pair.whole] = whole[pair.whole]
    return np.concatenate([turns, seen[:, :3, 3] - pair.poses[:, :3, 3]], axis=1)


def _each(frames: Mapping[str, Frame], name: str, pair: _Pair) -> Floats:
    return np.broadcast_to(composed(frames, name), (len(pair.times), 4, 4))


def _effects(frames: Mapping[str, Frame], pair: _Pair, moved: Sequence[str]) -> Floats:
    """Return (M, 6, 6 K): how each frame turns and moves the target in ``camera``."""
    out = np.zeros((len(pair.times), 6, 6 * len(moved)))
    index = {name: 6 * i for i, name in enumerate(moved)}
    back = np.swapaxes(_each(frames, pair.camera, pair)[:, :3, :3], 1, 2)
    tip = _each(frames, pair.target, pair)[:, :3, 3]
    for end, sign in ((pair.target, 1.0), (pair.camera, -1.0)):
        before = np.eye(4)
        for name in chain(frames, end):
            after = before @ np.asarray(frames[name].place)
            if name in index:
                # A turn about the place's own origin, in its parent's axes, and a shift of it.
                turns, column = sign * back @ before[..., :3, :3], index[name]
                arm = hat((back @ (tip - after[..., :3, 3])[..., None])[..., 0])
                out[:, :3, column : column + 3] += turns
                out[:, 3:, column : column + 3] -= arm @ turns
                out[:, 3:, column + 3 : column + 6] += turns
            before = after
    return out


# --- noise ---------------------------------------------------------------------------------------


def _whiteners(covariances: Floats, projectors: Floats) -> Floats:
    """Return (N, 6, 6) that make errors of unit covariance, none across what was not measured."""
    values, vectors = np.linalg.eigh(projectors @ covariances @ projectors)
    roots = np.where(values > 1e-16, 1 / np.sqrt(np.maximum(values, 1e-16)), 0.0)
    return np.asarray((vectors * roots[:, None, :]) @ np.swapaxes(vectors, 1, 2))


def _squares(whiteners: Floats, residuals: Floats) -> Floats:
    return np.asarray(((whiteners @ residuals[..., None])[..., 0] ** 2).sum(axis=1))


def _weighed(graph: _Graph, residuals: Floats, carried: Floats) -> tuple[float, Mask, Floats]:
    """Return the size of the movers' noise, the sightings within it, and the whiteners with it.

    The size at which of each pair half of the sightings lie within the half they should; then, of
    those within the gate, that at which their squares come to their freedoms.
    """
    freedoms = graph.freedoms
    half = np.array([chi2_quantile(0.5, int(f)) for f in freedoms])
    gates = np.array([chi2_quantile(GATE, int(f)) for f in freedoms])

    def weighed(size: float) -> tuple[Floats, Floats]:
        whiteners = _whiteners(graph.covariances + size * carried, graph.projectors)
        return whiteners, _squares(whiteners, residuals)

    rough = _first_below(lambda size: _middles(graph, weighed(size)[1] / half).max(), 1.0)
    kept = weighed(rough)[1] < gates
    wanted = max(freedoms[kept].sum() - 6 * len(graph.unknown), 1.0)
    best = _first_below(lambda size: weighed(size)[1][kept].sum(), wanted)
    whiteners, squares = weighed(best)
    return best, squares < gates, whiteners


def _middles(graph: _Graph, squares: Floats) -> Floats:
    """Return (N,) the median over the sightings of the same pair: each pair has outliers alone."""
    out = np.zeros(len(squares))
    for pair in graph.pairs:
        out[pair.rows] = np.median(squares[pair.rows])
    return out


def _first_below(falling: Callable[[float], float], level: float) -> float:
    """Return the smallest of :data:`SIZES` at which a falling function is below a level."""
    first = bisect_left(SIZES, True, key=lambda size: bool(falling(float(size)) <= level))
    return float(SIZES[min(first, len(SIZES) - 1)])


# --- descent -------------------------------------------------------------------------------------


def _best(graph: _Graph, whiteners: Floats) -> dict[str, Floats]:
    """Return the lowest of many descents that leave outliers behind; two that agree end it.

    Rotations go first: without the places they have far fewer valleys to end in.
    """
    rng, best, least = np.random.default_rng(0), {}, np.inf
    for _ in range(STARTS):
        start = {name: _anywhere(rng) for name in graph.unknown}
        turned = _descend(graph, start, whiteners @ TURNS, robust=True)
        places = _descend(graph, turned, whiteners, robust=True)
        cost = float(_middles(graph, _squares(whiteners, graph.residuals(places))).sum())
        if abs(cost - least) <= AGREE * cost + 1e-12:
            return places
        if cost < least:
            best, least = places, cost
    return best


def _anywhere(rng: np.random.Generator) -> Floats:
    axis = rng.standard_normal(3)
    turn = rotation_exp(rng.uniform(-np.pi, np.pi) * axis / np.linalg.norm(axis))
    return rigid(turn, rng.uniform(-0.5, 0.5, 3))


def _descend(
    graph: _Graph, places: Mapping[str, Floats], whiteners: Floats, robust: bool = False
) -> dict[str, Floats]:
    """Return the places at the bottom of the valley they start in (Levenberg-Marquardt).

    Args:
        graph: What was sighted.
        places: Where to start.
        whiteners: (N, 6, 6) weights of the residuals.
        robust: Whether sightings count less the further they are beyond most (Geman-McClure, its
            width from each pair's median, so that it narrows as the fit improves).
    """
    damping, places = 1e-2, dict(places)
    for _ in range(ITERATIONS):
        residuals, jacobian = graph.linearised(places)
        squares = _squares(whiteners, residuals)
        width = np.maximum(4 * _middles(graph, squares), 1e-12) if robust else np.inf
        weights = whiteners / (1 + squares / width)[:, None, None]
        rows, errors = weights @ jacobian, (weights @ residuals[..., None])[..., 0]
        normal, gradient = information_of(rows), np.einsum("nij,ni->j", rows, errors)
        damped = normal + damping * np.diag(np.diag(normal) + 1e-12)
        step = -np.linalg.solve(damped, gradient)
        moved = _moved(places, step)
        after = _squares(whiteners, graph.residuals(moved))
        if (after / (1 + after / width)).sum() > (squares / (1 + squares / width)).sum():
            damping = min(10 * damping, 1e12)
            continue
        places, damping = moved, max(damping / 10, 1e-10)
        if np.abs(step).max() < SOLVED:
            break
    return places


def _moved(places: Mapping[str, Floats], step: Floats) -> dict[str, Floats]:
    out = {}
    for i, (name, place) in enumerate(places.items()):
        turn, shift = step[6 * i : 6 * i + 3], step[6 * i + 3 : 6 * i + 6]
        out[name] = rigid(rotation_exp(turn) @ place[:3, :3], place[:3, 3] + shift)
    return out
