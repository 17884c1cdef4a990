r"""Whether an answer is the best of all, not only of its neighbourhood. Arrays only.

Where every sighting says ``A U M = B V D``, with U and V any of K unknown places or none, its
errors are linear in the entries of both, and their squares, each weighed by its own covariance, a
quadratic. Without the translations, which follow from the rotations, it is ``r' Q r`` with ``r``
all rotations' entries and a one; that they are rotations is quadratic too, ``r' C_k r = 0``. Where
multipliers exist with

    L = Q - sum_k l_k C_k - f E,   L r = 0,   L positive semidefinite,

``f = r' Q r`` is the least value there is: Lagrangian duality, as used for many cameras and targets
in arXiv 2507.23045. An eigenvalue of ``-e`` bounds what may be missing by ``(1 + 3 K) e``: no
choice of rotations is longer. Multipliers are looked for by least squares, then by alternating
projections: no solver of semidefinite programs.

An error is the turn and shift that take one side to the other, in the frame of both. Far from the
answer a turn counts as its sine does, and what that misses as ``1 - cos``, with the mean weight.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import combinations_with_replacement

import numpy as np

from flangeye.maths.geometry import hat, nearest_rotation, rotation_exp
from flangeye.types import Floats, Indices

STEPS, SETTLED = 50, 1e-12
"""Of the descent to the bottom of the valley; a step as small [rad] is the last."""
PROJECTIONS = 3000
"""Tries to find multipliers; most take a few dozen."""
TOLD = 1e-7
"""How well a turn is known at least, of the best known one: a circle's about itself is not."""
GAP, ROUNDING = 1e-3, 1e-9
"""Share of the cost that may be missing; and of the size of ``Q``, where the cost is none."""


@dataclass(frozen=True, eq=False)
class Sightings:
    """N sightings of ``A U M = B V D``.

    Attributes:
        a: (N, 4, 4) before U.
        left: (N,) which of the unknowns U is; their number, where it is none of them.
        m: (N, 4, 4) after it.
        b: (N, 4, 4) before V.
        right: (N,) which V is.
        d: (N, 4, 4) after it.
        weights: (N, 6, 6) of squared errors, turns [1/rad^2] before shifts [1/m^2].
        freedoms: (N,) how many numbers were measured: 6 of a pose, 5 of a circle with its normal,
            which is its z, 3 of a centre.
    """

    a: Floats
    left: Indices
    m: Floats
    b: Floats
    right: Indices
    d: Floats
    weights: Floats
    freedoms: Floats


@dataclass(frozen=True, eq=False)
class Certificate:
    """What could be shown.

    Attributes:
        rotations: (K, 3, 3) at the bottom of the valley.
        cost: What their squared errors come to.
        missing: By how much another answer may be better, at most.
        optimal: Whether that is next to nothing.
    """

    rotations: Floats
    cost: float
    missing: float
    optimal: bool


def certify(sightings: Sightings, places: Floats) -> Certificate:
    """Return what can be shown of the valley in which the unknowns (K, 4, 4) lie."""
    quadratic = _quadratic(sightings, places)
    rotations = _descend(quadratic, places[:, :3, :3])
    at = _vector(rotations)
    cost = max(float(at @ quadratic @ at), 0.0)
    allowed = max(GAP * cost, ROUNDING * float(np.trace(quadratic)))
    missing = _missing(quadratic, at, cost, allowed)
    return Certificate(rotations, cost, missing, missing <= allowed)


# --- the quadratic -------------------------------------------------------------------------------


def _quadratic(s: Sightings, places: Floats) -> Floats:
    """Return Q (9 K + 1, 9 K + 1), translations eliminated: each is the best for its rotations."""
    k = len(places)
    every = np.concatenate([places, np.eye(4)[None]])
    weights = _of_entries(s, (s.b @ every[s.right] @ s.d)[:, :3, :3])
    left, right = _entries(s.a, s.m), -_entries(s.b, s.d)
    whole = np.zeros((12 * k + 13,) * 2)
    for pair in sorted(set(zip(s.left.tolist(), s.right.tolist(), strict=True))):
        of = (s.left == pair[0]) & (s.right == pair[1])
        rows = np.concatenate([left[of], right[of]], axis=2)
        columns = np.concatenate([np.append(np.arange(12) + 12 * i, 12 * k + 12) for i in pair])
        told = np.einsum("nri,nrs,nsj->ij", rows, weights[of], rows)
        np.add.at(whole, np.ix_(columns, columns), told)
    return _rotations_alone(whole, k)


def _entries(before: Floats, after: Floats) -> Floats:
    """Return (N, 12, 13): entries of ``before U after``, by those of U and a one.

    Nine of the rotation, row by row, and three of the translation.
    """
    out, turns = np.zeros((len(before), 12, 13)), before[:, :3, :3]
    # (A X M)_ik is the sum over j, l of A_ij X_jl M_lk.
    out[:, :9, :9] = np.einsum("nij,nlk->nikjl", turns, after[:, :3, :3]).reshape(-1, 9, 9)
    out[:, 9:, :9] = np.einsum("nij,nl->nijl", turns, after[:, :3, 3]).reshape(-1, 3, 9)
    out[:, 9:, 9:12], out[:, 9:, 12] = turns, before[:, :3, 3]
    return out


def _of_entries(s: Sightings, turned: Floats) -> Floats:
    """Return (N, 12, 12) weights of the entries by which one side differs from the other.

    Args:
        s: The sightings.
        turned: (N, 3, 3) rotation of either side, as found.
    """
    errors, beyond = np.zeros((len(turned), 6, 12)), np.zeros((len(turned), 9, 9))
    mean = np.trace(s.weights[:, :3, :3], axis1=1, axis2=2) / np.maximum(s.freedoms - 3, 1)
    whole, normal = s.freedoms == 6, s.freedoms == 5
    # The difference is that by a turn, hat(turn) @ turned, and symmetric beyond it.
    turns = 0.5 * (hat(np.eye(3)) @ turned[whole, None]).reshape(-1, 3, 9)
    errors[whole, :3, :9] = turns
    beyond[whole] = 0.5 * np.eye(9) - np.swapaxes(turns, 1, 2) @ turns
    axes = turned[normal, :, 2]
    errors[normal, :3, 2:9:3] = hat(axes)
    beyond[normal, 2:9:3, 2:9:3] = axes[:, :, None] * axes[:, None, :]
    errors[:, 3:, 9:] = np.eye(3)
    out = np.swapaxes(errors, 1, 2) @ s.weights @ errors
    out[:, :9, :9] += mean[:, None, None] * beyond
    return np.asarray(out)


def _rotations_alone(whole: Floats, k: int) -> Floats:
    """Return the quadratic of K rotations and a one, from that of all entries and no unknown's."""
    none = np.eye(12 * k + 13)[:, np.append(np.arange(12 * k), 12 * k + 12)]
    none[12 * k : 12 * k + 9, -1] = np.eye(3).ravel()
    whole = none.T @ whole @ none
    shifts = (12 * np.arange(k)[:, None] + [9, 10, 11]).ravel()
    kept = np.setdiff1d(np.arange(12 * k + 1), shifts)
    across = whole[np.ix_(kept, shifts)]
    inner = np.linalg.pinv(whole[np.ix_(shifts, shifts)], rcond=1e-12, hermitian=True)
    return np.asarray(whole[np.ix_(kept, kept)] - across @ inner @ across.T)


def _vector(rotations: Floats) -> Floats:
    return np.append(rotations.ravel(), 1.0)


def _descend(quadratic: Floats, rotations: Floats) -> Floats:
    """Return the rotations (K, 3, 3) at the bottom of their valley (Gauss-Newton)."""
    values, vectors = np.linalg.eigh(quadratic)
    root = np.sqrt(np.maximum(values, 0.0))[:, None] * vectors.T
    for _ in range(STEPS):
        moves = np.zeros((len(quadratic), 3 * len(rotations)))
        for k, turn in enumerate(rotations):
            # A turn on the left, about each axis.
            moves[9 * k : 9 * k + 9, 3 * k : 3 * k + 3] = (hat(np.eye(3)) @ turn).reshape(3, 9).T
        step = -np.linalg.lstsq(root @ moves, root @ _vector(rotations), rcond=TOLD)[0]
        turned = rotation_exp(step.reshape(-1, 3)) @ rotations
        rotations = np.array([nearest_rotation(each) for each in turned])
        if np.abs(step).max() < SETTLED:
            break
    return rotations


# --- multipliers ---------------------------------------------------------------------------------


def _constraints(count: int) -> Iterator[Floats]:
    """Give symmetric C with r' C r = 0 for all of so many rotations and a one."""
    size = 9 * count + 1
    for first in range(0, size - 1, 9):
        index = np.arange(first, first + 9).reshape(3, 3)
        for lines in (index, index.T):
            for i, j in combinations_with_replacement(range(3), 2):
                out = np.zeros((size, size))
                for k in range(3):
                    out[lines[i, k], lines[j, k]] += 1.0
                out[-1, -1] -= float(i == j)
                yield (out + out.T) / 2
            for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
                yield from _right_handed(lines, (i, j, k), size)


def _right_handed(lines: Indices, chosen: tuple[int, int, int], size: int) -> Iterator[Floats]:
    """Give that the first chosen line cross the second is the third, one coordinate each."""
    i, j, k = chosen
    for p, q, r in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        out = np.zeros((size, size))
        out[lines[i, p], lines[j, q]] += 1.0
        out[lines[i, q], lines[j, p]] -= 1.0
        out[lines[k, r], -1] -= 1.0
        yield (out + out.T) / 2


def _missing(quadratic: Floats, at: Floats, cost: float, allowed: float) -> float:
    """Return a bound on what a better answer could gain, as small as was found."""
    length = float(at @ at)  # of every choice of rotations
    constraints = np.array(list(_constraints(len(at) // 9)))
    bare = quadratic.copy()
    bare[-1, -1] -= cost
    effects = np.einsum("kij,j->ik", constraints, at)
    multipliers = np.linalg.lstsq(effects, bare @ at, rcond=1e-10)[0]
    dual = bare - np.einsum("k,kij->ij", multipliers, constraints)
    free = _unchanging(constraints, effects)
    smallest = np.inf
    for _ in range(PROJECTIONS):
        values, vectors = np.linalg.eigh(dual)
        # What is left of L r is rounding, and counts against it.
        rest = 2 * float(np.linalg.norm(dual @ at)) * np.sqrt(length)
        smallest = min(smallest, length * max(-float(values[0]), 0.0) + rest)
        if smallest <= allowed:
            break
        towards = (vectors * np.maximum(values, 0.0)) @ vectors.T - dual
        dual = dual + np.tensordot(np.tensordot(free, towards, 2), free, 1)
    return smallest


def _unchanging(constraints: Floats, effects: Floats) -> Floats:
    """Return orthonormal (m, n, n) combinations of the constraints that leave L r as it is."""
    _, sizes, ways = np.linalg.svd(effects)
    rank = int((sizes > 1e-9 * sizes[0]).sum())
    combined = np.tensordot(ways[rank:], constraints, 1).reshape(len(ways) - rank, -1)
    _, sizes, basis = np.linalg.svd(combined, full_matrices=False)
    return np.asarray(basis[sizes > 1e-9 * sizes[0]].reshape(-1, *constraints.shape[1:]))
