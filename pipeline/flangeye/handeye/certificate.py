r"""Whether an answer is the best of all, not only of its neighbourhood. Arrays only.

Of two unknown places X and Y, ``A_i X M_i = B_i Y D_i``, the squared errors of rotation matrices
and translations, each sighting weighed by two numbers, are a quadratic in the entries of both.
Without the translations, which follow from the rotations, it is ``r' Q r`` with ``r`` both
rotations' entries and a one; that they are rotations is quadratic too, ``r' C_k r = 0``. Where
multipliers exist with

    L = Q - sum_k l_k C_k - f E,   L r = 0,   L positive semidefinite,

``f = r' Q r`` is the least value there is: Lagrangian duality, as used for robot and camera in
arXiv 2507.23045. An eigenvalue of ``-e`` bounds what may be missing by ``7 e``. Multipliers are
looked for by alternating projections: no solver of semidefinite programs.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import combinations_with_replacement

import numpy as np

from flangeye.handeye.components import SHIFT, TURN
from flangeye.handeye.likelihood import Problem, Solution
from flangeye.maths.geometry import hat, nearest_rotation, rotation_exp, rotation_log
from flangeye.types import Floats, Indices

STEPS, SETTLED = 50, 1e-12
"""Of the descent to the bottom of the valley; a step as small [rad] is the last."""
PROJECTIONS = 3000
"""Tries to find multipliers; most take a few dozen."""
NEAR = 5.0
"""Standard deviations by which errors weighed alike in all directions may move the answer."""
NOT_SHOWN = "not shown to be globally optimal"
GAP, ROUNDING = 1e-3, 1e-9
"""Share of the cost that may be missing; and of the size of ``Q``, where the cost is none."""


@dataclass(frozen=True, eq=False)
class Sightings:
    """N sightings of ``A X M = B Y D``, each (N, 4, 4).

    Attributes:
        a: Before X.
        m: After it.
        b: Before Y.
        d: After it.
        turning: (N,) weights of squared errors of rotation [1/rad^2].
        shifting: (N,) of translation [1/m^2].
    """

    a: Floats
    m: Floats
    b: Floats
    d: Floats
    turning: Floats
    shifting: Floats


@dataclass(frozen=True, eq=False)
class Certificate:
    """What could be shown.

    Attributes:
        rotations: (2, 3, 3) X's and Y's at the bottom of the valley.
        cost: What their squared errors come to.
        missing: By how much another answer may be better, at most.
        optimal: Whether that is next to nothing.
    """

    rotations: Floats
    cost: float
    missing: float
    optimal: bool


def certificate_note(problem: Problem, found: Solution) -> str:
    """Return in words whether the poses that agree have no better answer than the one found."""
    s, loop, kept = problem.measurements, problem.loop, found.inliers
    s = (s if found.at.course is None else found.at.course.applied(s)).where(kept)
    if not s.are_poses or loop.y == loop.z:
        return f"{NOT_SHOWN}: that can be done for whole poses and two unknown places alone"
    still = np.broadcast_to(np.eye(4), s.a.shape)
    turning, shifting = (
        np.trace(found.weights[kept][:, at, at], axis1=1, axis2=2) / 3 for at in (TURN, SHIFT)
    )
    others = (still, s.b @ loop.place) if loop.y else (s.b, still)
    sightings = Sightings(s.a, s.poses, *others, turning, shifting)
    other = found.at.y if loop.y else found.at.z
    shown = certify(sightings, found.at.x, other)
    away = rotation_log(shown.rotations[0] @ found.at.x[:3, :3].T[None])[0]
    sigma = np.sqrt(np.linalg.eigvalsh(found.covariance[:3, :3])[-1])
    if not shown.optimal:
        share = shown.missing / max(shown.cost, 1e-300)
        return f"{NOT_SHOWN}: another answer may leave squared errors less by {min(share, 1):.1%}"
    if np.linalg.norm(away) > NEAR * sigma + ROUNDING:
        return (
            f"{NOT_SHOWN}: with errors alike in all directions the best answer is "
            f"{np.degrees(np.linalg.norm(away)):.2g} deg from it"
        )
    return "globally optimal: nowhere is there an answer that fits the agreeing poses better"


def certify(sightings: Sightings, x: Floats, y: Floats) -> Certificate:
    """Return what can be shown of the valley in which X and Y (4, 4) lie."""
    quadratic = _quadratic(sightings)
    rotations = _descend(quadratic, np.array([x[:3, :3], y[:3, :3]]))
    at = _vector(rotations)
    cost = max(float(at @ quadratic @ at), 0.0)
    allowed = max(GAP * cost, ROUNDING * float(np.trace(quadratic)))
    missing = _missing(quadratic, at, cost, allowed)
    return Certificate(rotations, cost, missing, missing <= allowed)


def _quadratic(s: Sightings) -> Floats:
    """Return Q (19, 19), translations eliminated: each is the best for its rotations."""
    n = len(s.a)
    rows = np.zeros((n, 12, 25))
    # A rotation's entries, row by row: (A X M)_ik is the sum over j, l of A_ij X_jl M_lk.
    entries = "nij,nlk->nikjl"
    rows[:, :9, :9] = np.einsum(entries, s.a[:, :3, :3], s.m[:, :3, :3]).reshape(n, 9, 9)
    rows[:, :9, 9:18] = -np.einsum(entries, s.b[:, :3, :3], s.d[:, :3, :3]).reshape(n, 9, 9)
    rows[:, 9:, :9] = np.einsum("nij,nl->nijl", s.a[:, :3, :3], s.m[:, :3, 3]).reshape(n, 3, 9)
    rows[:, 9:, 9:18] = -np.einsum("nij,nl->nijl", s.b[:, :3, :3], s.d[:, :3, 3]).reshape(n, 3, 9)
    rows[:, 9:, 18] = s.a[:, :3, 3] - s.b[:, :3, 3]
    rows[:, 9:, 19:22], rows[:, 9:, 22:] = s.a[:, :3, :3], -s.b[:, :3, :3]
    # The squared difference of two rotation matrices is twice that of the angle.
    weights = np.concatenate([np.repeat(s.turning[:, None] / 2, 9, 1),
                              np.repeat(s.shifting[:, None], 3, 1)], axis=1)  # fmt: skip
    whole = np.einsum("nri,nr,nrj->ij", rows, weights, rows)
    kept, out = slice(0, 19), slice(19, 25)
    inner = np.linalg.pinv(whole[out, out], rcond=1e-12, hermitian=True)
    return np.asarray(whole[kept, kept] - whole[kept, out] @ inner @ whole[out, kept])


def _vector(rotations: Floats) -> Floats:
    return np.append(rotations.reshape(18), 1.0)


def _descend(quadratic: Floats, rotations: Floats) -> Floats:
    """Return the rotations (2, 3, 3) at the bottom of their valley (Gauss-Newton)."""
    values, vectors = np.linalg.eigh(quadratic)
    root = np.sqrt(np.maximum(values, 0.0))[:, None] * vectors.T
    for _ in range(STEPS):
        moves = np.zeros((19, 6))
        for k, turn in enumerate(rotations):
            # A turn on the left, about each axis.
            moves[9 * k : 9 * k + 9, 3 * k : 3 * k + 3] = (hat(np.eye(3)) @ turn).reshape(3, 9).T
        step = -np.linalg.lstsq(root @ moves, root @ _vector(rotations), rcond=None)[0]
        turned = rotation_exp(step.reshape(2, 3)) @ rotations
        rotations = np.array([nearest_rotation(each) for each in turned])
        if np.abs(step).max() < SETTLED:
            break
    return rotations


# --- multipliers ---------------------------------------------------------------------------------


def _constraints() -> Iterator[Floats]:
    """Give symmetric C (19, 19) with r' C r = 0 for every pair of rotations and a one."""
    for first in (0, 9):
        index = np.arange(first, first + 9).reshape(3, 3)
        for lines in (index, index.T):
            for i, j in combinations_with_replacement(range(3), 2):
                out = np.zeros((19, 19))
                for k in range(3):
                    out[lines[i, k], lines[j, k]] += 1.0
                out[18, 18] -= float(i == j)
                yield (out + out.T) / 2
            for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
                yield from _right_handed(lines, i, j, k)


def _right_handed(lines: Indices, i: int, j: int, k: int) -> Iterator[Floats]:
    """Give that line i cross line j is line k, one coordinate each."""
    for p, q, r in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        out = np.zeros((19, 19))
        out[lines[i, p], lines[j, q]] += 1.0
        out[lines[i, q], lines[j, p]] -= 1.0
        out[lines[k, r], 18] -= 1.0
        yield (out + out.T) / 2


def _missing(quadratic: Floats, at: Floats, cost: float, allowed: float) -> float:
    """Return a bound on what a better answer could gain, as small as was found."""
    constraints = np.array(list(_constraints()))
    bare = quadratic.copy()
    bare[18, 18] -= cost
    effects = np.einsum("kij,j->ik", constraints, at)
    multipliers = np.linalg.lstsq(effects, bare @ at, rcond=1e-10)[0]
    dual = bare - np.einsum("k,kij->ij", multipliers, constraints)
    free = _unchanging(constraints, effects)
    smallest = np.inf
    for _ in range(PROJECTIONS):
        values, vectors = np.linalg.eigh(dual)
        # What is left of L r is rounding, and counts against it.
        rest = 2 * float(np.linalg.norm(dual @ at)) * np.sqrt(7.0)
        smallest = min(smallest, 7.0 * max(-float(values[0]), 0.0) + rest)
        if smallest <= allowed:
            break
        towards = (vectors * np.maximum(values, 0.0)) @ vectors.T - dual
        dual = dual + np.tensordot(np.tensordot(free, towards, 2), free, 1)
    return smallest


def _unchanging(constraints: Floats, effects: Floats) -> Floats:
    """Return orthonormal (K, 19, 19) combinations of the constraints that leave L r as it is."""
    _, sizes, ways = np.linalg.svd(effects)
    rank = int((sizes > 1e-9 * sizes[0]).sum())
    combined = np.tensordot(ways[rank:], constraints, 1).reshape(-1, 361)
    _, sizes, basis = np.linalg.svd(combined, full_matrices=False)
    return np.asarray(basis[sizes > 1e-9 * sizes[0]].reshape(-1, 19, 19))
