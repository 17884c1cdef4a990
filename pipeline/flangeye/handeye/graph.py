r"""Any number of cameras, arms, rails and targets at once: one graph of frames. Arrays only.

Every frame stands on another, down to one root. What stands still on its parent is known or
unknown; what an arm or a rail moves is measured at each time. A sighting of a target by a camera
closes a loop:

    root_T_camera(t)^-1 · root_T_target(t) = camera_T_target

The unknowns are those for which the squared errors of all sightings, each weighed by its own
covariance, are least (Levenberg-Marquardt on SE(3), analytic Jacobians). Cameras that never see the
same thing are tied by the arms between them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from flangeye.errors import CalibrationRefused, StageError
from flangeye.maths.geometry import hat, invert, rigid, rotation_exp, rotation_log
from flangeye.types import Floats, Indices

ITERATIONS, STARTS = 60, 24
"""Of the descent, and random starts of it; the best counts."""
SOLVED = 1e-10
"""A step as small as this ends a descent [rad, m]."""
EXPLAINED = 3.0
"""A cost per degree of freedom, of which a descent that ended in the right valley has one."""
UNKNOWN = 1e-9
"""Directions of less information than this share of the most are not told."""


@dataclass(frozen=True, eq=False)
class Frame:
    """What stands on what.

    Attributes:
        parent: The frame it stands on.
        place: (4, 4) parent_T_frame where it is known and still; (M, 4, 4) where it is measured at
            M times; None where it is still and to be found.
    """

    parent: str
    place: Floats | None = None


@dataclass(frozen=True, eq=False)
class Sighting:
    """One camera saw one target.

    Attributes:
        time: Index of the measured poses.
        camera: Its frame.
        target: Its frame.
        pose: (4, 4) camera_T_target.
        covariance: (6, 6) of a left perturbation in ``camera``, rotation before translation.
    """

    time: int
    camera: str
    target: str
    pose: Floats
    covariance: Floats


@dataclass(frozen=True, eq=False)
class Solved:
    """The graph's unknowns.

    Attributes:
        places: (4, 4) parent_T_frame by frame.
        covariances: (6, 6) of each, a left perturbation in its parent.
        residuals: (N, 6) of the sightings, rotation before translation, in ``camera``.
    """

    places: Mapping[str, Floats]
    covariances: Mapping[str, Floats]
    residuals: Floats


@dataclass(frozen=True, eq=False)
class _Pair:
    """All sightings of one target by one camera: (M,), (M, 4, 4), and (M, 6, 6) to unit noise."""

    camera: str
    target: str
    times: Indices
    poses: Floats
    whiteners: Floats


def solve_graph(frames: Mapping[str, Frame], sightings: Sequence[Sighting]) -> Solved:
    """Find every frame whose place is unknown.

    Args:
        frames: By name; the root has no entry.
        sightings: N of them.

    Raises:
        StageError: A frame stands on nothing that leads to the root, or the graph has two roots.
        CalibrationRefused: The sightings leave something unknown: it says what.
    """
    _root(frames)
    unknown = [name for name, frame in frames.items() if frame.place is None]
    pairs = _pairs(sightings)
    places = _best(frames, pairs, unknown, 6 * (len(sightings) - len(unknown)))
    residuals, jacobian = _linearised(frames, pairs, places)
    information = np.einsum("nij,nik->jk", jacobian, jacobian)
    _refuse_unknown(information, unknown)
    covariance = np.linalg.inv(information)
    blocks = {n: covariance[6 * i : 6 * i + 6, 6 * i : 6 * i + 6] for i, n in enumerate(unknown)}
    plain = np.linalg.solve(np.concatenate([p.whiteners for p in pairs]), residuals[..., None])
    return Solved(places, blocks, plain[..., 0])


def _pairs(sightings: Sequence[Sighting]) -> list[_Pair]:
    """Return the sightings by who saw whom."""
    out = []
    for camera, target in dict.fromkeys((s.camera, s.target) for s in sightings):
        of = [s for s in sightings if (s.camera, s.target) == (camera, target)]
        whiteners = np.linalg.inv(np.linalg.cholesky(np.array([s.covariance for s in of])))
        times, poses = np.array([s.time for s in of]), np.array([s.pose for s in of])
        out.append(_Pair(camera, target, times, poses, whiteners))
    return out


def _best(
    frames: Mapping[str, Frame], pairs: Sequence[_Pair], unknown: Sequence[str], freedom: int
) -> dict[str, Floats]:
    """Return the lowest of many descents; the first that explains the sightings ends the search."""
    rng, best, least = np.random.default_rng(0), {}, np.inf
    for _ in range(STARTS):
        places = _descend(frames, pairs, {name: _anywhere(rng) for name in unknown})
        cost = _cost(frames, pairs, places)
        if cost < least:
            best, least = places, cost
        if cost < EXPLAINED * max(freedom, 1):
            break
    return best


def chain(frames: Mapping[str, Frame], name: str) -> list[str]:
    """Return the frames from the root to one, the root left out."""
    path: list[str] = []
    while name in frames:
        if name in path:
            raise StageError(f"frame '{name}' stands on itself; every frame leads to one root")
        path.insert(0, name)
        name = frames[name].parent
    return path


def _root(frames: Mapping[str, Frame]) -> str:
    roots = sorted({frames[chain(frames, name)[0]].parent for name in frames})
    if len(roots) != 1:
        raise StageError(
            f"the frames stand on {' and '.join(roots)}, which nothing ties; say on what they stand"
        )
    return roots[0]


def _anywhere(rng: np.random.Generator) -> Floats:
    turn = rotation_exp(rng.uniform(-np.pi, np.pi) * _unit(rng.standard_normal(3)))
    return rigid(turn, rng.uniform(-0.5, 0.5, 3))


def _unit(vector: Floats) -> Floats:
    return np.asarray(vector / np.linalg.norm(vector))


def _place(
    frames: Mapping[str, Frame], places: Mapping[str, Floats], name: str, times: Indices
) -> Floats:
    known = frames[name].place
    if known is None:
        return places[name]
    return known[times] if known.ndim == 3 else known


def _descend(
    frames: Mapping[str, Frame], pairs: Sequence[_Pair], places: dict[str, Floats]
) -> dict[str, Floats]:
    """Return the places at the bottom of the valley they start in (Levenberg-Marquardt)."""
    cost, damping = _cost(frames, pairs, places), 1e-2
    for _ in range(ITERATIONS):
        residuals, jacobian = _linearised(frames, pairs, places)
        normal = np.einsum("nij,nik->jk", jacobian, jacobian)
        gradient = np.einsum("nij,ni->j", jacobian, residuals)
        damped = normal + damping * np.diag(np.diag(normal) + 1e-12)
        step = -np.linalg.solve(damped, gradient)
        moved = _moved(places, step)
        after = _cost(frames, pairs, moved)
        if after > cost:
            damping = min(10 * damping, 1e12)
            continue
        places, cost, damping = moved, after, damping / 10
        if np.abs(step).max() < SOLVED:
            break
    return places


def _moved(places: Mapping[str, Floats], step: Floats) -> dict[str, Floats]:
    out = {}
    for i, (name, place) in enumerate(places.items()):
        turn, shift = step[6 * i : 6 * i + 3], step[6 * i + 3 : 6 * i + 6]
        turned = rotation_exp(turn)
        out[name] = rigid(turned @ place[:3, :3], place[:3, 3] + shift)
    return out


def _cost(
    frames: Mapping[str, Frame], pairs: Sequence[_Pair], places: Mapping[str, Floats]
) -> float:
    return float(sum((_residuals(frames, p, places) ** 2).sum() for p in pairs))


def _residuals(frames: Mapping[str, Frame], pair: _Pair, places: Mapping[str, Floats]) -> Floats:
    """Return the (M, 6) errors of a pair's sightings, of unit covariance."""
    camera = _composed(frames, places, pair.camera, pair.times)
    seen = invert(camera) @ _composed(frames, places, pair.target, pair.times)
    turn = rotation_log(seen[:, :3, :3] @ np.swapaxes(pair.poses[:, :3, :3], 1, 2))
    error = np.concatenate([turn, seen[:, :3, 3] - pair.poses[:, :3, 3]], axis=1)
    return np.asarray((pair.whiteners @ error[..., None])[..., 0])


def _composed(
    frames: Mapping[str, Frame], places: Mapping[str, Floats], name: str, times: Indices
) -> Floats:
    pose = np.tile(np.eye(4), (len(times), 1, 1))
    for each in chain(frames, name):
        pose = pose @ _place(frames, places, each, times)
    return pose


def _linearised(
    frames: Mapping[str, Frame], pairs: Sequence[_Pair], places: Mapping[str, Floats]
) -> tuple[Floats, Floats]:
    """Return (N, 6) residuals of unit covariance and their (N, 6, 6 K) Jacobian, pair by pair."""
    residuals = [_residuals(frames, pair, places) for pair in pairs]
    jacobians = [pair.whiteners @ _effects(frames, pair, places) for pair in pairs]
    return np.concatenate(residuals), np.concatenate(jacobians)


def _effects(frames: Mapping[str, Frame], pair: _Pair, places: Mapping[str, Floats]) -> Floats:
    """Return (M, 6, 6 K): how each unknown turns and moves the target in ``camera``."""
    out = np.zeros((len(pair.times), 6, 6 * len(places)))
    index = {name: 6 * i for i, name in enumerate(places)}
    back = np.swapaxes(_composed(frames, places, pair.camera, pair.times)[:, :3, :3], 1, 2)
    tip = _composed(frames, places, pair.target, pair.times)[:, :3, 3]
    for end, sign in ((pair.target, 1.0), (pair.camera, -1.0)):
        before = np.tile(np.eye(4), (len(pair.times), 1, 1))
        for name in chain(frames, end):
            after = before @ _place(frames, places, name, pair.times)
            if name in index:
                # A turn about the place's own origin, in its parent's axes, and a shift of it.
                turns, column = sign * back @ before[:, :3, :3], index[name]
                arm = hat((back @ (tip - after[:, :3, 3])[..., None])[..., 0])
                out[:, :3, column : column + 3] += turns
                out[:, 3:, column : column + 3] -= arm @ turns
                out[:, 3:, column + 3 : column + 6] += turns
            before = after
    return out


def _refuse_unknown(information: Floats, unknown: Sequence[str]) -> None:
    """Refuse when some motion of the unknowns changes no sighting; name what it moves most."""
    scale = 1 / np.sqrt(np.maximum(np.diag(information), 1e-300))
    values, vectors = np.linalg.eigh(information * np.outer(scale, scale))
    if values[0] > UNKNOWN * values[-1]:
        return
    moved = np.abs(vectors[:, 0].reshape(-1, 6))
    named = [name for name, row in zip(unknown, moved, strict=True) if row.max() > 0.1]
    turns = moved[:, :3].max() > moved[:, 3:].max()
    raise CalibrationRefused(
        f"the sightings do not tell where {' and '.join(named)} {'are' if len(named) > 1 else 'is'}"
        f": a common {'turn' if turns else 'shift'} changes none of them; move the arms about more "
        "axes, or let a camera see what ties them"
    )
