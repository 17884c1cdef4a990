r"""Any number of cameras, arms, rails and targets at once: one graph of frames. Arrays only.

Every frame stands on another, down to one root. What stands still on its parent is known or
unknown; what an arm or a rail moves is measured at each time. A sighting of a target by a camera
closes a loop in that graph:

    root_T_camera(t)^-1 · root_T_target(t) = camera_T_target

The unknowns are the most likely ones (:mod:`flangeye.handeye.likelihood`), as those of one camera
are, whose loop is a graph as well. Cameras that never see the same thing are tied by the arms
between them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial

import numpy as np

from flangeye.errors import CalibrationRefused
from flangeye.handeye.components import Noise
from flangeye.handeye.consensus import LARGEST_NOISE, plausible, spread
from flangeye.handeye.inliers import geman_mcclure
from flangeye.handeye.likelihood import (
    Problem,
    Solution,
    agreeing,
    climb,
    first_noise,
    gates,
    settle,
    weigh,
)
from flangeye.handeye.measurements import Seen
from flangeye.handeye.missing import Loops, Move
from flangeye.handeye.moments import alike, moves_of, shared_noise
from flangeye.handeye.observability import weak_moves
from flangeye.handeye.unknowns import Linear, Unknowns, weights_of
from flangeye.maths.frame_graph import Frame, chain, composed, root_of
from flangeye.maths.geometry import (
    hat,
    invert,
    rigid,
    rotation_between,
    rotation_exp,
    rotation_log,
)
from flangeye.maths.statistics import covariance_inflation
from flangeye.types import Floats, Indices

STARTS, ROUNDS, STEPS = 60, 12, 6
"""Random starts at most, widths of what counts in a descent of each, and steps with one width."""
PATIENCE = 12
"""Starts in turn that find nothing lower end the search: where places are not told no two agree."""
AGREE = 1e-3
"""Two starts whose costs differ by this share ended in one valley, which then is the answer."""
SETTLED = 1e-4
"""A descent towards most sightings ends where their squares change by no more than this share:
places may go on along what nothing tells."""
MOST = 4.0
"""Sightings beyond so many times the median square of their pair hardly count there."""
LIMITS = float(np.radians(2)), 20e-3
"""Largest standard deviations of an unknown's rotation [rad] and translation [m]."""
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
class Sightings(Seen):
    """N sightings.

    Attributes:
        times: (N,) index of the measured poses.
        pairs: (N,) which camera saw which target.
    """

    times: Indices
    pairs: Indices


@dataclass(frozen=True, eq=False, kw_only=True)
class GraphProblem(Problem):
    """What is given of a graph.

    Attributes:
        measurements: N sightings.
        frames: By name; the root has no entry.
        ends: Each camera and target, by the sightings' ``pairs``.
        noise: (6, 6) covariance that is believed of the measured place of what moves, by frame.
    """

    measurements: Sightings
    frames: Mapping[str, Frame]
    ends: Sequence[tuple[str, str]]
    noise: Mapping[str, Floats]

    @property
    def unknown(self) -> list[str]:
        """Frames whose place is to be found."""
        return [name for name, frame in self.frames.items() if frame.place is None]

    @property
    def moments(self) -> Indices:
        """(N,) at which moment each sighting was: where controllers had everything alike."""
        s, moving = self.measurements, [np.asarray(self.frames[name].place) for name in self.noise]
        if not moving:
            return np.arange(len(s))
        return alike(np.hstack([place[s.times].reshape(len(s), -1) for place in moving]))

    def linearised(self, at: Unknowns) -> Linear:
        """Return what is predicted at some values of the unknowns."""
        s, unknown = self.measurements, self.unknown
        residuals, effects = self.effects(at, [*unknown, *self.noise])
        jacobian = np.zeros((len(s), 6, at.before_nuisance + len(at.nuisance)))
        jacobian[:, :, : at.of_places] = effects[:, :, : at.of_places]
        if len(at.nuisance):
            moves = s.projectors @ self.nuisance.seen
            jacobian[:, :, at.before_nuisance :] = moves
            residuals = residuals - moves @ at.nuisance
        carried = _carried(effects[:, :, at.of_places :], list(self.noise.values()))
        return Linear(residuals, jacobian, carried, np.zeros((len(s), 6, 0)))

    def free(self, at: Unknowns) -> Floats:
        """Return a basis of the moves that anything could be known of: all but the tilt's."""
        eye = np.eye(at.before_nuisance + len(at.nuisance))
        return np.delete(eye, np.s_[at.of_places : at.before_nuisance], axis=1)

    def effects(self, at: Unknowns, moved: Sequence[str]) -> tuple[Floats, Floats]:
        """Return (N, 6) errors of what was seen, and (N, 6, 6 K) how K frames move what is.

        In ``camera``, across what was measured alone. A frame turns about its own origin, in its
        parent's axes, and shifts.
        """
        s = self.measurements
        errors, effects = np.zeros((len(s), 6)), np.zeros((len(s), 6, 6 * len(moved)))
        for k, ends in enumerate(self.ends):
            rows = s.pairs == k
            frames = self._at(at, s.times[rows])
            errors[rows] = _errors(frames, ends, s.where(rows))
            effects[rows] = _effects(frames, ends, moved)
        return (s.projectors @ errors[..., None])[..., 0], s.projectors @ effects

    def turns(self, at: Unknowns) -> Floats:
        """Return (N, 3, 3) camera_R_target, as predicted."""
        s = self.measurements
        out = np.zeros((len(s), 3, 3))
        for k, (camera, target) in enumerate(self.ends):
            rows = s.pairs == k
            frames = self._at(at, s.times[rows])
            seen = invert(composed(frames, camera)) @ composed(frames, target)
            out[rows] = seen[..., :3, :3]
        return out

    def _at(self, at: Unknowns, times: Indices) -> dict[str, Frame]:
        """Return the frames at some times, all places known."""
        places, out = dict(zip(self.unknown, at.places, strict=True)), {}
        for name, frame in self.frames.items():
            place = np.asarray(places.get(name, frame.place))
            out[name] = replace(frame, place=place if place.ndim == 2 else place[times])
        return out


@dataclass(frozen=True, eq=False)
class Solved:
    """The graph's unknowns.

    Attributes:
        problem: What was given.
        found: The fit.
        joint: (6 K, 6 K) covariance of all, in the order of ``places``.
    """

    problem: GraphProblem
    found: Solution
    joint: Floats

    @cached_property
    def places(self) -> dict[str, Floats]:
        """(4, 4) parent_T_frame by frame."""
        return dict(zip(self.problem.unknown, self.found.at.places, strict=True))

    @cached_property
    def covariances(self) -> dict[str, Floats]:
        """(6, 6) of each: a turn about its origin, in its parent, and a shift."""
        return {
            name: self.joint[6 * i : 6 * i + 6, 6 * i : 6 * i + 6]
            for i, name in enumerate(self.places)
        }

    @property
    def inflation(self) -> float:
        """Factor on a covariance whose noise was estimated with the unknowns."""
        return covariance_inflation(self.found.freedom, 6)

    @property
    def own(self) -> Floats:
        """(6 K, 6 K) covariance that the fit itself leaves, sightings being independent."""
        count = self.found.at.of_places
        return np.asarray(self.inflation * self.found.covariance[:count, :count])

    @cached_property
    def shared(self) -> Floats:
        """(6 K, 6 K) that the noise which sightings of one moment share adds to a covariance."""
        problem, found = self.problem, self.found
        effects = problem.effects(found.at, [*problem.noise])[1]
        moves = moves_of(effects, [*problem.noise.values()], found.noise)
        return self.inflation * shared_noise(found, moves, problem.moments)

    def with_joint(self, joint: Floats) -> Solved:
        """Return the same with another (6 K, 6 K) covariance."""
        return replace(self, joint=joint)

    def told_by(
        self, frames: Mapping[str, Frame], sightings: Sequence[Sighting]
    ) -> tuple[Floats, Floats]:
        """Return (M, 6, 6 K) rows of other sightings, and (M, 6) their errors, of unit covariance.

        Args:
            frames: With the movers' places at the sightings' times.
            sightings: M of them.
        """
        problem = problem_of(frames, sightings, self.problem.noise)
        linear = problem.linearised(Unknowns(self.found.at.places))
        roots = roots_of(weights_of(problem.measurements, linear, self.found.noise))
        of_places = linear.jacobian[:, :, : len(self.joint)]
        return roots @ of_places, (roots @ linear.residuals[..., None])[..., 0]


def problem_of(
    frames: Mapping[str, Frame],
    sightings: Sequence[Sighting],
    noise: Mapping[str, Floats] | None = None,
) -> GraphProblem:
    """Return what is given; see :func:`solve_graph`."""
    ends = list(dict.fromkeys((s.camera, s.target) for s in sightings))
    poses = np.array([s.pose for s in sightings]).reshape(-1, 4, 4)
    projectors = np.array([s.projector for s in sightings]).reshape(-1, 6, 6)
    seen = Sightings(
        rotations=poses[:, :3, :3],
        centres=poses[:, :3, 3],
        covariances=np.array([s.covariance for s in sightings]).reshape(-1, 6, 6),
        projectors=projectors,
        freedoms=np.trace(projectors, axis1=1, axis2=2).round(),
        times=np.array([s.time for s in sightings], dtype=np.intp),
        pairs=np.array([ends.index((s.camera, s.target)) for s in sightings], dtype=np.intp),
    )
    # Of many unknowns and few sightings little is left that could tell of less noise.
    return GraphProblem(
        measurements=seen,
        frames=frames,
        ends=ends,
        noise=noise or {},
        overstated=False,
        stated=noise is None,
    )


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
            origin and a shift, alike in all directions. Its ratios are believed; its size, and what
            noise there is beside it, are found from the residuals. Without it the sightings' own
            covariances are all there is.
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
    problem = problem_of(frames, sightings, noise)
    at = _anywhere(problem) if start is None else _started(problem, start)
    problem, found = _agreed(problem, at)
    scale = np.tile(np.repeat(limits, 3), len(problem.unknown))
    weak = bool(weak_moves(found.information, scale))
    _require_agreement(problem, at, found, weak)
    if weak:
        raise CalibrationRefused(_told_unknown(problem, found, scale, freedoms))
    return solved_of(problem, found)


def solved_from(problem: GraphProblem, start: Mapping[str, Floats]) -> Solved:
    """Return the unknowns near a start (4, 4) of each."""
    return solved_of(*_agreed(problem, _started(problem, start)))


def solved_of(problem: GraphProblem, found: Solution) -> Solved:
    """Return the unknowns of a fit, with the covariance that it leaves."""
    solved = Solved(problem, found, np.zeros((0, 0)))
    return solved.with_joint(solved.own + solved.shared)


def _started(problem: GraphProblem, start: Mapping[str, Floats]) -> Unknowns:
    return Unknowns(np.array([start[name] for name in problem.unknown]).reshape(-1, 4, 4))


def _agreed(problem: GraphProblem, start: Unknowns) -> tuple[GraphProblem, Solution]:
    """Return the fit that most sightings agree on, near a start that most of them do.

    What noise there is in depth comes last, as of one camera; the problem says if it does.
    """
    noise = _first_noise(problem, start)
    begun = weigh(problem, start, noise, np.ones(len(problem.measurements)))
    agree = begun.squares <= gates(problem, np.inf)
    found = settle(problem, start, noise, agree if agree.mean() >= 0.5 else None)
    if problem.stated or not problem.measurements.are_poses:
        return problem, found
    problem = replace(problem, in_depth=True)
    return problem, agreeing(problem, found)


def _first_noise(problem: GraphProblem, start: Unknowns) -> Noise:
    """Return the noise at which of every pair the better half agrees: each has outliers alone."""
    noises = _noises(problem, start)
    return Noise(max(noise.pose for noise in noises), max(noise.tilt for noise in noises))


def _noises(problem: GraphProblem, start: Unknowns) -> list[Noise]:
    """Return the noise of each pair that the better half of its residuals speaks for."""
    pairs = problem.measurements.pairs
    return [first_noise(problem.where(pairs == k), start) for k in range(len(problem.ends))]


def _require_agreement(problem: GraphProblem, start: Unknowns, found: Solution, weak: bool) -> None:
    """Refuse sightings whose noise is too large for one answer, or hides what is unknown."""
    shift, turn = spread(found)
    hidden = weak and (shift > LARGEST_NOISE[0] or turn > LARGEST_NOISE[1])
    if problem.stated or (plausible(problem.measurements, found) and not hidden):
        return
    sizes = [noise.pose for noise in _noises(problem, start)]
    camera, target = problem.ends[int(np.argmax(sizes))]
    raise CalibrationRefused(
        f"the sightings agree with one answer to {shift * 1e3:.1f} mm and {np.degrees(turn):.1f} "
        f"deg only, those of {target} by {camera} least: check that each belongs to the poses "
        f"beside it (join: clock_offset, where the clock of {camera} is another), and that the "
        "cell stands as the recipe says"
    )


def _told_unknown(
    problem: GraphProblem, found: Solution, scale: Floats, freedoms: Mapping[str, Floats] | None
) -> str:
    """Return which places stay unknown, by their names, and what would tell them."""
    agree = problem.where(found.inliers)
    seen = [problem.ends[k] for k in dict.fromkeys(agree.measurements.pairs.tolist())]
    again = _seen_again(agree, found, freedoms)
    loops = Loops(problem.frames, seen, problem.unknown, scale)
    return loops.told_unknown(found.information, again)


# --- what is predicted ---------------------------------------------------------------------------


def _errors(frames: Mapping[str, Frame], ends: tuple[str, str], seen: Seen) -> Floats:
    """Return (M, 6): what takes the predicted targets of a pair to the measured ones."""
    camera, target = (composed(frames, end) for end in ends)
    predicted = np.broadcast_to(invert(camera) @ target, (len(seen), 4, 4))
    turns = rotation_between(predicted[:, :3, 2], seen.rotations[:, :, 2])
    whole = seen.freedoms == 6
    turned = seen.rotations[whole] @ np.swapaxes(predicted[whole, :3, :3], 1, 2)
    turns[whole] = rotation_log(turned)
    return np.concatenate([turns, seen.centres - predicted[:, :3, 3]], axis=1)


def _effects(frames: Mapping[str, Frame], ends: tuple[str, str], moved: Sequence[str]) -> Floats:
    """Return (M, 6, 6 K): how each frame turns and moves the target in ``camera``."""
    index = {name: 6 * i for i, name in enumerate(moved)}
    camera, target = (composed(frames, end) for end in ends)
    back, tip = np.swapaxes(camera[..., :3, :3], -1, -2), target[..., :3, 3]
    blocks = dict[int, Floats]()
    for end, sign in zip(ends, (-1.0, 1.0), strict=True):
        before = np.eye(4)
        for name in chain(frames, end):
            after = before @ np.asarray(frames[name].place)
            if name in index:
                # A turn about the place's own origin, in its parent's axes, and a shift of it.
                turns = sign * back @ before[..., :3, :3]
                arm = hat((back @ (tip - after[..., :3, 3])[..., None])[..., 0])
                block = _block(turns, -arm @ turns)
                blocks[index[name]] = blocks.get(index[name], 0.0) + block
            before = after
    count = max((block.shape[0] for block in blocks.values() if block.ndim == 3), default=1)
    out = np.zeros((count, 6, 6 * len(moved)))
    for column, block in blocks.items():
        out[:, :, column : column + 6] = block
    return out


def _block(turns: Floats, lever: Floats) -> Floats:
    """Return (..., 6, 6) of a turn and a shift."""
    shape = np.broadcast_shapes(turns.shape, lever.shape)
    out = np.zeros((*shape[:-2], 6, 6))
    out[..., :3, :3], out[..., 3:, :3], out[..., 3:, 3:] = turns, lever, turns
    return out


def _carried(effects: Floats, noise: Sequence[Floats]) -> Floats:
    """Return the (N, 6, 6) covariance that the movers' noise has in the camera."""
    out = np.zeros((len(effects), 6, 6))
    for i, covariance in enumerate(noise):
        moves = effects[:, :, 6 * i : 6 * i + 6]
        out += moves @ covariance @ np.swapaxes(moves, 1, 2)
    return out


def roots_of(weights: Floats) -> Floats:
    """Return the (N, 6, 6) roots of weights: they make errors of unit covariance."""
    values, vectors = np.linalg.eigh(weights)
    roots = np.sqrt(np.maximum(values, 0.0))
    return np.asarray((vectors * roots[:, None, :]) @ np.swapaxes(vectors, 1, 2))


# --- what would tell more ------------------------------------------------------------------------


def _seen_again(
    problem: GraphProblem, found: Solution, freedoms: Mapping[str, Floats] | None
) -> dict[Move, Floats]:
    """Return the (P, P) that all would tell with one thing moved, by its frame and twist."""
    again, weights = {}, found.weights[found.inliers]
    for name, twists in (freedoms or _every_freedom(problem.frames)).items():
        for twist in np.transpose(twists):
            told = [_moved_tells(problem, found.at, weights, (name, x)) for x in (twist, -twist)]
            again[name, tuple(map(float, twist))] = np.sum(told, axis=0)
    return again


def _every_freedom(frames: Mapping[str, Frame]) -> dict[str, Floats]:
    moving = [n for n, f in frames.items() if f.place is not None and f.place.ndim == 3]
    return {name: np.eye(6) for name in moving}


def _moved_tells(
    problem: GraphProblem, at: Unknowns, weights: Floats, move: tuple[str, Floats]
) -> Floats:
    name, (turn, shift) = move[0], np.split(move[1] * FURTHER, 2)
    place = np.array(problem.frames[name].place)
    place[..., :3, :3] = rotation_exp(turn) @ place[..., :3, :3]
    place[..., :3, 3] += shift
    frame = replace(problem.frames[name], place=place)
    moved = replace(problem, frames={**problem.frames, name: frame})
    # What is not measured of a circle turns with it.
    back = np.kron(np.eye(2), problem.turns(at) @ np.swapaxes(moved.turns(at), 1, 2))
    whole = replace(problem.measurements, projectors=np.tile(np.eye(6), (len(weights), 1, 1)))
    rows = back @ replace(moved, measurements=whole).effects(at, problem.unknown)[1]
    return np.asarray(np.einsum("nai,nab,nbj->ij", rows, weights, rows, optimize=True))


# --- where to begin ------------------------------------------------------------------------------


def _anywhere(problem: GraphProblem) -> Unknowns:
    """Return the lowest of many descents that leave outliers behind.

    Two that agree end it, and so many in turn that find nothing lower.

    Rotations go first: without the places they have far fewer valleys to end in.
    """
    rng, best, least = np.random.default_rng(0), Unknowns(np.zeros((0, 4, 4))), np.inf
    turns_alone, since = _turns_alone(problem), 0
    for _ in range(STARTS):
        start = Unknowns(np.array([_drawn(rng) for _ in problem.unknown]).reshape(-1, 4, 4))
        found = _descended(problem, _descended(turns_alone, start).at)
        cost = float(_middles(problem, found.squares).sum())
        if abs(cost - least) <= AGREE * cost + 1e-12:
            return found.at
        if cost < least:
            best, least, since = found.at, cost, 0
            continue
        since += 1
        if since >= PATIENCE:
            break
    return best


def _turns_alone(problem: GraphProblem) -> GraphProblem:
    projectors = problem.measurements.projectors.copy()
    projectors[:, 3:, 3:] = 0.0
    return replace(problem, measurements=replace(problem.measurements, projectors=projectors))


def _drawn(rng: np.random.Generator) -> Floats:
    axis = rng.standard_normal(3)
    turn = rotation_exp(rng.uniform(-np.pi, np.pi) * axis / np.linalg.norm(axis))
    return rigid(turn, rng.uniform(-0.5, 0.5, 3))


def _descended(problem: GraphProblem, start: Unknowns) -> Solution:
    """Return where a start leads, sightings counting less the further they are beyond most.

    The width of what counts follows each pair's median, so that it narrows as the fit improves.
    Weights are the features' own: those of the arms' noise change with their levers.
    """
    noise, every = Noise(0.0, 0.0, arms=0.0), np.ones(len(problem.measurements))
    found = weigh(problem, start, noise, every)
    for _ in range(ROUNDS):
        middles = _middles(problem, found.squares)
        widths = np.maximum(MOST * middles, 1e-12)
        kernel = partial(geman_mcclure, widths)
        found = climb(problem, found, noise, kernel(found.squares)[0], STEPS, kernel)
        after = _middles(problem, found.squares)
        if abs(after.sum() - middles.sum()) <= SETTLED * middles.sum() + 1e-12:
            break
    return found


def _middles(problem: GraphProblem, squares: Floats) -> Floats:
    """Return (N,) the median over the sightings of the same pair: each pair has outliers alone."""
    out, pairs = np.zeros(len(squares)), problem.measurements.pairs
    for k in range(len(problem.ends)):
        out[pairs == k] = np.median(squares[pairs == k])
    return out
