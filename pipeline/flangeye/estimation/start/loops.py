r"""Robust initial guess: places that most sightings agree on, without any prior guess.

The loop of one camera and one target is a product of unknown places U and known places K:

.. math:: U_1 K_1 U_2 K_2 \cdots = 1

Up to three unknowns have closed forms. A loop is solved from all its sightings and from small
random subsets, and the answer with the most agreement is taken. Its places are then known in the
next loop. If no further loop can be solved, descents start from random places.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from typing import NamedTuple

import numpy as np

from flangeye.errors import CalibrationRefused
from flangeye.estimation.graph import Places, Problem, Sightings
from flangeye.estimation.start.closed import motions_of, park_martin, place_of, two_arms
from flangeye.models.cell import chain
from flangeye.types import Floats, Indices, Mask
from flangeye.types.geometry import (
    basis_of_plane,
    each_applied,
    invert,
    kabsch,
    nearest_rotation,
    rigid,
    rotation_exp,
    stack_rows,
)

SETS = 80
"""Number of small subsets drawn: with 40 % outliers, one subset of four in eight has none."""
LEVER = 0.3
"""Lever that converts rotations to lengths [m]: a typical distance of a target."""
START_NOISE = 0.2e-3, 0.1e-3
"""Noise of an arm's poses beyond the features' own while nothing is known of it: [rad] and [m]."""
GOOD = 25.0
"""Multiple of the median square up to which a sighting agrees with the initial guess. Generous, as
the estimate judges again."""


def initial_guess(problem: Problem, search: bool = True) -> tuple[Places, Floats]:
    """Return an initial guess of the unknowns, and (N,) squared distances in units of the noise.

    Args:
        problem: The sightings.
        search: Whether to search from random places if the closed forms give nothing plausible,
            which takes ten times as long.

    Raises:
        CalibrationRefused: No initial guess is found.
    """
    rng = np.random.default_rng(0)
    places = _solve_loops(problem, rng)
    if places is not None:
        found = _descended(problem, places)
        if len(problem.ends) == 1 or _plausible(problem, found[1]):
            return found
    if not search:
        raise CalibrationRefused(
            "the closed forms give no plausible start", "spread the poses, and tilt them more"
        )
    elsewhere = _anywhere(problem, rng)
    if places is None or _cost(problem, elsewhere[1]) < _cost(problem, found[1]):
        return elsewhere
    return found


def agreeing(problem: Problem, squares: Floats) -> Mask:
    """Return the mask (N,) of sightings consistent with a guess, by squared distances."""
    return np.asarray(squares <= GOOD * np.maximum(_middles(problem, squares), 1.0))


def _plausible(problem: Problem, squares: Floats) -> bool:
    """Whether the better half of every pair agrees to 1 %, which mixed-up frames would not."""
    middles = _middles(problem, squares) * START_NOISE[1] ** 2
    extent = problem.seen.centres.var(axis=0).sum()
    return bool(middles.max() < 0.01 * max(extent, 1e-4))


def size_of(problem: Problem) -> float:
    """Return a rough ratio of the target's true size to the stated one; 1 without poses.

    Rotations do not depend on the size; with known rotations the loop's translations are linear in
    the places and the size (Andreff et al. 2001). Of small random subsets, the one that explains
    the better half of all poses best is taken. Only loops of two unknown places are used.
    """
    (names, known), rng = loop_of(problem), np.random.default_rng(0)
    n, least, size = len(problem.seen), np.inf, 1.0
    if len(names) != 2:
        return size
    seen, carried = known
    turns, still = carried[:, :3, :3], np.broadcast_to(-np.eye(3), (n, 3, 3))
    right = -carried[:, :3, 3]
    largest = 100.0  # factor on a target's size
    for _ in range(SETS):
        rows = rng.choice(n, min(8, n), replace=False)
        with suppress(np.linalg.LinAlgError, CalibrationRefused):
            turn = park_martin(motions_of(carried[rows], seen[rows]))[:3, :3]
            # Of the loop G X M = Z: two unknown translations, and the scale of M's
            sized = turns @ (seen[:, :3, 3] @ turn.T)[..., None]
            left = np.concatenate([turns, still, sized], axis=2)
            equations = stack_rows(left[rows]), right[rows].ravel()
            found = np.asarray(np.linalg.lstsq(*equations, rcond=None)[0], dtype=np.float64)
            median = float(np.median(np.linalg.norm(left @ found - right, axis=1)))
            if median < least and 1 / largest < found[-1] < largest:
                least, size = median, float(found[-1])
    return size


# --- from loop to loop ---------------------------------------------------------------------------


def _solve_loops(problem: Problem, rng: np.random.Generator) -> dict[str, Floats] | None:
    """Solve loop by loop, fewest unknowns first; return the places, or None if stuck."""
    known: dict[str, Floats] = {}
    left = set(range(len(problem.ends)))
    while len(known) < len(problem.unknown):
        each = {k: loop for k in left if (loop := _loop_of(problem, k, known)).unknown}
        if not each:  # the others are on no way: nothing ties them
            return known | {n: np.eye(4) for n in problem.unknown if n not in known}
        order = sorted(each, key=lambda k: (len(each[k].unknown), -len(each[k].seen)))
        for k in order:
            found = _solved(each[k], rng)
            if found is not None:
                known |= found
                left.discard(k)
                break
        else:
            return None
    return known


class _Loop(NamedTuple):
    """The sightings of one target by one camera, with the paths to both.

    Attributes:
        problem: Problem of these sightings only; all other poses are known.
        camera: Known poses (N, 4, 4) and names of unknown frames, in order from the root to the
            camera.
        target: Path from the root to the target.
    """

    problem: Problem
    camera: Sequence[Floats | str]
    target: Sequence[Floats | str]

    @property
    def seen(self) -> Sightings:
        """The sightings."""
        return self.problem.seen

    @property
    def unknown(self) -> list[str]:
        """Names of the unknown frames on both paths."""
        return [x for x in (*self.camera, *self.target) if isinstance(x, str)]


def _loop_of(problem: Problem, k: int, known: Places) -> _Loop:
    part = problem.where(np.flatnonzero(problem.seen.pairs == k)).placed(known)
    ends = problem.ends[k]
    ways = [chain(part.frames, end) for end in ends]
    shared = sum(1 for a, b in zip(*ways, strict=False) if a == b)
    on_way = {name for way in ways for name in way[shared:]}
    part = part.placed({n: np.eye(4) for n in part.unknown if n not in on_way})
    return _Loop(part, *(_way(part, way[shared:]) for way in ways))


def _way(problem: Problem, names: Sequence[str]) -> list[Floats | str]:
    still = np.tile(np.eye(4), (len(problem.seen), 1, 1))
    out: list[Floats | str] = [still]
    for name in names:
        place = problem.frames[name].at(problem.seen.times).place
        if place is None:
            out += [name, still]
        else:
            out[-1] = np.asarray(out[-1]) @ place
    return out


def _solved(loop: _Loop, rng: np.random.Generator) -> dict[str, Floats] | None:
    """Return the places that most sightings of a loop agree with.

    The better half of the sightings only gives the scale; larger squares are truncated (MSAC, Torr
    & Zisserman 2000). That half must not decide alone: if an arm stood still in half of the
    sightings, many places fit those.
    """
    fewest = _fewest(loop)
    if fewest is None or len(loop.seen) < fewest:
        return None
    n = len(loop.seen)
    most = 40  # one closed form takes so many: more cost time and change the start little
    everyone = np.arange(n) if n <= most else rng.choice(n, most, replace=False)
    size = min(fewest + (1 if n > fewest else 0), n)
    tried: list[tuple[dict[str, Floats], Floats]] = []
    least, of_all = np.inf, np.inf
    for draw in range(-1, SETS):
        # All sightings agree where no small set leaves a median a third smaller
        if draw == 10 and of_all <= 1.5 * least:
            break
        chosen = everyone if draw < 0 else rng.choice(n, size, replace=False)
        with suppress(np.linalg.LinAlgError, CalibrationRefused):
            places = _closed(loop, chosen, rng)
            tried.append((places, distances(loop.problem, places)))
            least = min(least, float(np.median(tried[-1][1])))
        if draw < 0:
            of_all = least
    floor = (LEVER * START_NOISE[0]) ** 2 + START_NOISE[1] ** 2
    scale = GOOD * max(least, floor)
    best = min(tried, key=lambda each: float(np.minimum(each[1], scale).sum()), default=None)
    return None if best is None else best[0]


def distances(problem: Problem, places: Places) -> Floats:
    """Return (N,) squared residuals; rotations count by their lever [m^2]."""
    r = problem.residuals(places)
    return np.asarray((LEVER**2 * r[:, :3] ** 2).sum(axis=1) + (r[:, 3:] ** 2).sum(axis=1))


def _fewest(loop: _Loop) -> int | None:
    """Return how many sightings the closed form of a loop needs; None where there is none."""
    ranks, count = loop.seen.ranks, len(loop.unknown)
    if (ranks == 6).all() and count <= 3:
        return {1: 1, 2: 3, 3: 6}[count]
    if count == 1:
        of_point = len(loop.target) > 1 and loop.unknown[0] == loop.target[-2]
        return 1 if of_point else 3
    if count == 2 and len(loop.camera) == len(loop.target) == 3:
        return 5 if (ranks >= 5).all() else 8
    return None


def _closed(loop: _Loop, rows: Indices, rng: np.random.Generator) -> dict[str, Floats]:
    """Return the places of a loop with a closed form, from some of its sightings."""
    if (loop.seen.ranks == 6).all():
        return _of_poses(loop, rows, rng)
    return _of_points(loop, rows) if len(loop.unknown) == 1 else _linear(loop, rows)


def loop_of(problem: Problem) -> tuple[list[tuple[str, bool]], list[Floats]]:
    """Return the unknowns along the loop of one camera and one target, and the known poses between.

    Each name comes with whether it is inverted; the (N, 4, 4) poses follow the unknowns in order.
    """
    return _circle(_loop_of(problem, 0, {}))


def start_of_circles(problem: Problem) -> dict[str, Floats]:
    """Return the unknowns of one camera and one circle by the closed form of all sightings.

    Raises:
        CalibrationRefused: The loop has no closed form.
    """
    loop = _loop_of(problem, 0, {})
    if _fewest(loop) is None:
        raise CalibrationRefused(
            "two arms with a circle at an unknown place cannot be solved",
            "state its place, which is known for the flange's own circle, or use a marker",
        )
    return _closed(loop, np.arange(len(loop.seen)), np.random.default_rng(0))


# --- closed forms of a loop ----------------------------------------------------------------------


def _of_poses(loop: _Loop, rows: Indices, rng: np.random.Generator) -> dict[str, Floats]:
    """Return the unknowns of a loop whose sightings are whole poses."""
    names, known = _circle(loop)
    k = [each[rows] for each in known]
    if len(names) == 1:
        each = invert(k[0])
        turn = nearest_rotation(each[:, :3, :3].mean(axis=0))
        found = [rigid(turn, np.median(each[:, :3, 3], axis=0))]
    elif len(names) == 2:
        x = park_martin(motions_of(k[1], k[0]))
        found = [x, invert(place_of(k[1], x, k[0]))]
    else:
        x, y, z = two_arms((k[2], k[0], invert(k[1])), rng)
        found = [x, invert(z), invert(y)]
    return by_name(names, found)


def by_name(names: Sequence[tuple[str, bool]], found: Sequence[Floats]) -> dict[str, Floats]:
    """Return the places of the unknowns along a loop; see :func:`loop_of`."""
    each = zip(names, found, strict=True)
    return {name: invert(place) if back else place for (name, back), place in each}


def _circle(loop: _Loop) -> tuple[list[tuple[str, bool]], list[Floats]]:
    """Return the loop's unknowns with whether each is inverted, and the known pose after each."""
    back = [x if isinstance(x, str) else invert(x) for x in reversed(loop.target)]
    names: list[tuple[str, bool]] = [(x, False) for x in loop.camera if isinstance(x, str)]
    names += [(x, True) for x in back if isinstance(x, str)]
    known = [np.asarray(x) for x in loop.camera if not isinstance(x, str)]
    behind = [np.asarray(x) for x in back if not isinstance(x, str)]
    known = [*known[:-1], known[-1] @ loop.seen.poses @ behind[0], *behind[1:]]
    # The last leads on into the first: they are one.
    return names, [*known[1:-1], known[-1] @ known[0]]


def _of_points(loop: _Loop, rows: Indices) -> dict[str, Floats]:
    """Return the only unknown place of a loop of centres, by a rigid fit to known points."""
    name, s = loop.unknown[0], loop.seen
    on_camera = len(loop.camera) > 1
    moved, other = (loop.camera, loop.target) if on_camera else (loop.target, loop.camera)
    own, across = (s.centres, s.offsets) if on_camera else (s.offsets, s.centres)
    before, after = (np.asarray(moved[i])[rows] for i in (0, 2))
    there = each_applied(np.asarray(other[0])[rows], across[rows])
    points, seen = each_applied(after, own[rows]), each_applied(invert(before), there)
    if (s.ranks[rows] >= 5).all():  # an axis counts as a second point, so far out along it
        far = LEVER * np.array([0.0, 0.0, 1.0])
        tips = own[rows] + s.rotations[rows] @ far if on_camera else own[rows] + far
        ends = across[rows] + far if on_camera else across[rows] + s.rotations[rows] @ far
        ends = each_applied(invert(before), each_applied(np.asarray(other[0])[rows], ends))
        points, seen = np.vstack([points, each_applied(after, tips)]), np.vstack([seen, ends])
    if np.abs(points - points[0]).max() > 1e-6:
        return {name: rigid(*kabsch(points, seen))}
    # All at one point, as the origin of a target is: only its place follows, and z from the axes
    turn = np.eye(3)
    if (s.ranks[rows] == 5).all():
        axes = (np.asarray(other[0])[rows, :3, :3] @ s.rotations[rows, :, 2, None])[..., 0]
        axes = (np.swapaxes(before[:, :3, :3], 1, 2) @ axes[..., None])[..., 0]
        turn = _facing(axes.mean(axis=0))
    return {name: rigid(turn, np.median(seen, axis=0) - turn @ points[0])}


def _linear(loop: _Loop, rows: Indices) -> dict[str, Floats]:
    """Return the camera's and another unknown place from centres, with normals if all have one.

    ``R_X c + t_X`` is the target's centre, before the camera's carrier. It is linear in the entries
    of R_X and t_X, and in those of the target's centre and axis in its carrier, or of R_Y and t_Y
    of a second base. The rotations are then made orthonormal and the translations fitted again.
    """
    s = loop.seen.where(rows)
    between = invert(np.asarray(loop.camera[0])[rows]) @ np.asarray(loop.target[0])[rows]
    b, c = np.asarray(loop.target[2])[rows], np.asarray(loop.camera[2])[rows]
    own, points = each_applied(c, s.centres), each_applied(b, s.offsets)
    normals = (c[:, :3, :3] @ s.rotations[:, :, 2, None])[..., 0]
    of_place = np.abs(points - points[0]).max() < 1e-6
    eye, turns, right = np.eye(3)[None, None], between[None, :, :3, :3], between[None, :, :3, 3]
    of_centres = [entries(eye, own[None]), eye, -turns]
    of_normals = [entries(eye, normals[None]), 0 * eye, 0 * turns]
    if of_place:
        of_centres, of_normals = [*of_centres, 0 * turns], [*of_normals, -turns]
    else:
        of_centres.append(-entries(turns, points[None]))
        of_normals.append(-entries(turns, b[None, :, :3, 2]))
    has_normals = bool((s.ranks == 5).all())
    systems = [(of_centres, right), (of_normals, 0 * right)]
    found = least_squares(*systems[: 1 + has_normals])[0]
    x = nearest_rotation(found[:9].reshape(3, 3))
    if not of_place:
        y = nearest_rotation(found[15:].reshape(3, 3))
    else:
        y = _facing(found[15:]) if has_normals else np.eye(3)
    onward = (turns @ (points @ y.T)[..., None])[..., 0]
    moved = least_squares(([eye, -turns], right + onward - own @ x.T))[0]
    return {str(loop.camera[1]): rigid(x, moved[:3]), str(loop.target[1]): rigid(y, moved[3:])}


def _facing(axis: Floats) -> Floats:
    """Return a rotation (3, 3) whose z is along an axis."""
    return basis_of_plane(axis / np.linalg.norm(axis)).T


def entries(before: Floats, points: Floats) -> Floats:
    """Return the rows (K, N, 3, 9) by which the entries of R move points: ``before R point``."""
    rows = before[..., None] * np.nan_to_num(points)[..., None, None, :]
    return np.asarray(rows.reshape(*rows.shape[:-2], 9))


def least_squares(*systems: tuple[list[Floats], Floats]) -> Floats:
    """Return the least-squares solutions (K, .) of K systems of equations.

    The rows are in blocks (K, N, 3, .), one block for each group of unknowns; right sides are (K,
    N, 3). A row whose right side is NaN does not count.
    """
    leads = [each.shape[:2] for parts, right in systems for each in (*parts, right)]
    k, n = np.broadcast_shapes(*leads)
    rows, sides = [], []
    for parts, right in systems:
        wide = [np.broadcast_to(each, (k, n, *each.shape[2:])) for each in parts]
        known = np.broadcast_to(np.isfinite(right), (k, n, 3))
        rows.append((np.concatenate(wide, axis=-1) * known[..., None]).reshape(k, 3 * n, -1))
        sides.append(np.broadcast_to(np.nan_to_num(right), (k, n, 3)).reshape(k, 3 * n, 1))
    solved = np.linalg.pinv(np.concatenate(rows, axis=1), rcond=1e-8)
    return np.asarray((solved @ np.concatenate(sides, axis=1))[..., 0])


# --- descents ------------------------------------------------------------------------------------


def _anywhere(problem: Problem, rng: np.random.Generator) -> tuple[Places, Floats]:
    """Return the best local minimum from random starts: rotations first, then all unknowns."""
    best: tuple[Places, Floats] | None = None
    least, since = np.inf, 0
    for _ in range(60):
        start: dict[str, Floats] = {}
        for name in problem.unknown:
            axis = rng.standard_normal(3)
            turn = rotation_exp(rng.uniform(-np.pi, np.pi) * axis / np.linalg.norm(axis))
            start[name] = rigid(turn, rng.uniform(-0.5, 0.5, 3))
        with suppress(np.linalg.LinAlgError):
            places, _ = _descended(problem, start, turns_alone=True)
            found = _descended(problem, places)
            cost = _cost(problem, found[1])
            # Two of one cost ended in one valley
            if best is not None and abs(cost - least) <= 1e-3 * cost + 1e-12:
                return best
            since += 1
            if cost < least:
                best, least, since = found, cost, 0
        # Twelve starts in turn that find nothing lower end the search
        if since >= 12:
            break
    if best is None:
        raise CalibrationRefused(
            "no closed form gives a start for these poses",
            "spread them, and turn the arm about two axes at least",
        )
    return best


def _descended(
    problem: Problem, places: Places, turns_alone: bool = False
) -> tuple[Places, Floats]:
    """Return the local minimum of a robust loss, from a start, and the squared errors there.

    Weights are those of Geman & McClure (1987) with each pair's median as scale, so they narrow as
    the fit improves. Steps are Levenberg-Marquardt.
    """
    s, q = problem.seen, problem.seen.projectors.copy()
    if turns_alone:
        q[:, 3:, 3:] = 0.0
    further = np.diag(np.repeat(np.square(START_NOISE), 3))
    weights = q @ np.linalg.inv(q @ (s.covariances + further) @ q + (np.eye(6) - q)) @ q
    damping, before = 1e-6, np.inf
    linear = problem.linearised(places)
    for _ in range(40):
        squares = np.einsum("na,nab,nb->n", linear.residuals, weights, linear.residuals)
        # Sightings beyond so many times the median square of their pair hardly count
        widths = 4.0 * np.maximum(_middles(problem, squares), 1.0)
        shares = (1 + squares / widths) ** -2.0
        g = np.concatenate([linear.blocks[name] for name in problem.unknown], axis=2)
        weighted = (shares[:, None, None] * weights) @ g
        information = np.einsum("nai,naj->ij", g, weighted)
        right = np.einsum("nai,na->i", weighted, linear.residuals)
        cost = float((squares / (1 + squares / widths)).sum())
        if abs(before - cost) <= 1e-6 * cost:
            break
        before = cost
        for _ in range(8):
            # Marquardt's scaling damps radians and metres alike
            scale = np.diag(information) + 1e-12 * np.trace(information) + 1e-12
            step = np.linalg.solve(information + damping * np.diag(scale), right)
            moved = problem.moved(places, step)
            after = problem.linearised(moved)
            there = np.einsum("na,nab,nb->n", after.residuals, weights, after.residuals)
            if (there / (1 + there / widths)).sum() <= cost:
                places, linear, damping = moved, after, max(damping / 10, 1e-9)
                break
            damping *= 10
    squares = np.einsum("na,nab,nb->n", linear.residuals, weights, linear.residuals)
    return places, squares / np.maximum(s.ranks, 1)


def _middles(problem: Problem, squares: Floats) -> Floats:
    """Return (N,) the median square of the sightings of the same camera and target."""
    out, pairs = np.zeros(len(squares)), problem.seen.pairs
    for k in range(len(problem.ends)):
        if (pairs == k).any():
            out[pairs == k] = np.median(squares[pairs == k])
    return out


def _cost(problem: Problem, squares: Floats) -> float:
    return float(_middles(problem, squares).sum())
