r"""Squared errors of sightings as one quadratic in lifted features of the unknowns. Arrays only.

A sighting is an equation ``A U B V C = A' U' B' V' C'``, in which each of U, V, U' and V' is one of
K unknown places, or none. Either side is linear in the features: the entries of V and of U, and the
products of U's rotation with V's entries. With each error weighted by its own covariance, the sum
of squared errors is a quadratic ``r' Q r``, where ``r`` consists of 1 and all features. Several V
may follow the same U, but no place may be U in one equation and V in another. Without a U the
features are the entries of V's rotation. Translations that are in no product are eliminated by
their best values.

An error is the rotation and translation from one side to the other, in their common frame. Far from
the solution a rotation error counts by its sine, and the remainder by ``1 - cos`` with the mean
weight.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from typing import NamedTuple

import numpy as np

from flangeye.types import Floats, Indices, Mask
from flangeye.types.geometry import hat, nearest_rotation, rigid, rotation_exp

OBSERVABLE = 1e-7
"""Smallest singular value of an observable move, as a share of the largest: a circle's turn about
its own axis has a smaller one."""


@dataclass(frozen=True, eq=False)
class Factors:
    """One side of the N equations, ``A U B V C``; ``u`` is None if it has at most one unknown.

    Attributes:
        a: (N, 4, 4) before U.
        u: (N,) index of the unknown U; K if there is none.
        b: (N, 4, 4) between U and V.
        v: (N,) index of the unknown V; K if there is none.
        c: (N, 4, 4) after V.
    """

    a: Floats
    u: Indices
    b: Floats
    v: Indices
    c: Floats

    def about(self, places: Floats) -> Factors:
        """Return the same side with its unknowns as changes from places (K, 4, 4)."""
        every = np.concatenate([places, np.eye(4)[None]])
        return Factors(self.a @ every[self.u], self.u, self.b @ every[self.v], self.v, self.c)

    def at(self, places: Floats) -> Floats:
        """Evaluate this side of the N equations, (N, 4, 4), at values (K, 4, 4) of the unknowns."""
        moved = self.about(places)
        return np.asarray(moved.a @ moved.b @ moved.c)

    @property
    def unknowns(self) -> Indices:
        """Return (N, 2) the indices of the unknown transforms U and V."""
        return np.stack([self.u, self.v], axis=1)

    def where(self, which: Mask) -> Factors:
        """Return the side for a subset of the sightings."""
        return Factors(*(getattr(self, f.name)[which] for f in fields(self)))


@dataclass(frozen=True, eq=False)
class LiftedSightings:
    """N sightings as equations: camera side equals target side.

    Attributes:
        camera: Left side: the path to the camera, and the measured pose.
        target: Right side: the path to the target.
        weights: (N, 6, 6) weights of squared errors, turns [1/rad^2] before shifts [1/m^2].
        freedoms: (N,) how many numbers were measured: 6 of a pose, 5 of a circle with its normal
            (its z), 3 of a centre.
    """

    camera: Factors
    target: Factors
    weights: Floats
    freedoms: Floats


class Pattern(NamedTuple):
    """An unknown, the unknowns multiplied with it, and the indices of their features.

    Attributes:
        first: Index of the unknown.
        after: Indices of the C unknowns multiplied with it.
        at: (10, 1 + 12 C) feature indices of the products of (1, the first's rotation) with (1, the
            entries of the others); feature 0 is the constant 1.
        shift: (3,) indices of the first's translation, which follows all features, from the end.
    """

    first: int
    after: tuple[int, ...]
    at: Indices
    shift: Indices

    def columns(self, u: int, v: int) -> Indices:
        """Return feature indices of v's entries and 1 (13,), or of their products with u (169,)."""
        if v == self.first:
            return np.concatenate([self.at[1:, 0], self.shift, [0]])
        last = self.of(v)
        if u != self.first:
            return np.append(last[0], 0)
        out = np.zeros((13, 13), dtype=np.intp)
        out[:9, :12], out[:9, 12], out[9:12, 12], out[12, :12] = (
            last[1:], self.at[1:, 0], self.shift, last[0]
        )  # fmt: skip
        return out.ravel()

    def of(self, other: int) -> Indices:
        """Return the (10, 12) feature indices of products with another unknown's entries."""
        k = self.after.index(other)
        return self.at[:, 1 + 12 * k : 13 + 12 * k]

    def factors(self, places: Floats) -> tuple[Floats, Floats]:
        """Return (1, rotation entries of U) and (1, all entries of each V multiplied with U)."""
        each = [np.append(p[:3, :3], p[:3, 3]) for p in places[list(self.after)]]
        return np.append(1.0, places[self.first, :3, :3]), np.concatenate([np.ones(1), *each])


def families_of(pairs: Collection[tuple[int, int]], count: int) -> tuple[list[Pattern], int]:
    """Return the families of K unknowns by their multiplied pairs, and the number of features."""
    firsts = {v: u for u, v in pairs}
    out, size, shifts = list[Pattern](), 1, 3 * (count - len(firsts))
    for k in sorted({*range(count)} - firsts.keys()):
        after = tuple(sorted(v for v, u in firsts.items() if u == k))
        more = 10 * (1 + 12 * len(after)) - 1
        at = np.append(0, size + np.arange(more)).reshape(10, -1)
        out.append(Pattern(k, after, at, 3 * len(out) - shifts + np.arange(3)))
        size += more
    return out, size


@dataclass(frozen=True, eq=False)
class Quadratic:
    """The sum of squared errors as a quadratic form of n features, about given places.

    Attributes:
        quadratic: (n, n) form at the best translations of the families' first places.
        shifts: (3 F, n) derivatives of these translations by the features.
        families: The F families.
    """

    quadratic: Floats
    shifts: Floats
    families: Sequence[Pattern]

    def features(self, places: Floats) -> Floats:
        """Return the features (n,) of places (K, 4, 4)."""
        out = np.ones(len(self.quadratic))
        for family in self.families:
            out[family.at] = np.outer(*family.factors(places))
        return out

    def cost(self, places: Floats) -> float:
        """Return the sum of squared errors at places (K, 4, 4)."""
        at = self.features(places)
        return max(float(at @ self.quadratic @ at), 0.0)

    def moves(self, places: Floats) -> Floats:
        """Return the (n, 6 K) derivatives of the features by turns and shifts of places."""
        out = np.zeros((len(self.quadratic), len(places), 6))
        for family in self.families:
            u, v = family.factors(places)
            by = _moves(places[family.first])[:, :9]
            out[family.at[1:].ravel(), family.first] = (by[:, :, None] * v).reshape(6, -1).T
            for other in family.after:
                by = _moves(places[other])
                out[family.of(other).ravel(), other] = (u[:, None] * by[:, None]).reshape(6, -1).T
        return out.reshape(len(out), -1)

    def with_shifts(self, places: Floats) -> Floats:
        """Return places (K, 4, 4) with the best translations of each family's first."""
        out = places.copy()
        firsts = [family.first for family in self.families]
        out[firsts, :3, 3] = (self.shifts @ self.features(places)).reshape(-1, 3)
        return out

    @cached_property
    def root(self) -> Floats:
        """Square root (n, n): matrix R with R'R equal to the quadratic."""
        values, vectors = np.linalg.eigh(self.quadratic)
        return np.asarray(np.sqrt(np.maximum(values, 0.0))[:, None] * vectors.T)

    def alike(self, places: Floats) -> Floats:
        """Return the features (m, n) of a minimum and of other places with the same cost.

        There are others where a target is symmetric: a circle may turn about its axis, and a
        point about any axis.
        """
        moves = self.moves(places)
        able = np.flatnonzero(np.abs(moves).max(axis=0))
        _, sizes, ways = np.linalg.svd(self.root @ moves[:, able])
        # Directions in which the cost does not grow to second order
        flat = ways[int((sizes > OBSERVABLE * sizes[0]).sum()) :]
        # Places that may be alike
        steps = np.zeros((20 if len(flat) else 0, len(places), 6))
        drawn = np.random.default_rng(0).uniform(-np.pi, np.pi, (len(steps), len(flat)))
        steps.reshape(-1, 6 * len(places))[:, able] = drawn @ flat
        others = [self.descend(_moved(places, step)) for step in steps]
        # The share by which costs of alike places differ at most
        most = self.cost(places) * (1 + 1e-6)
        return np.array([self.features(p) for p in (places, *others) if self.cost(p) <= most])

    def descend(self, places: Floats) -> Floats:
        """Return the places (K, 4, 4) at the nearest local minimum (Gauss-Newton)."""
        for _ in range(50):
            slopes, errors = self.root @ self.moves(places), self.root @ self.features(places)
            step = -np.asarray(np.linalg.lstsq(slopes, errors, rcond=OBSERVABLE)[0]).reshape(-1, 6)
            places = _moved(places, step)
            if np.abs(step).max() < 1e-12:
                break
        return self.with_shifts(places)


def _moved(places: Floats, step: Floats) -> Floats:
    turned = rotation_exp(step[:, :3]) @ places[:, :3, :3]
    shifted = places[:, :3, 3] + step[:, 3:]
    return np.array([rigid(nearest_rotation(r), t) for r, t in zip(turned, shifted, strict=True)])


def _moves(place: Floats) -> Floats:
    """Return the (6, 12) derivatives of a place's entries by its turns and shifts."""
    out = np.zeros((6, 12))
    out[:3, :9] = (hat(np.eye(3)) @ place[:3, :3]).reshape(3, 9)
    out[3:, 9:] = np.eye(3)
    return out


# --- the quadratic -------------------------------------------------------------------------------


def squares_of(sightings: LiftedSightings, places: Floats) -> Quadratic:
    """Return the squared errors as a quadratic in the change from places (K, 4, 4)."""
    sides = [side.about(places) for side in (sightings.camera, sightings.target)]
    index = np.concatenate([side.unknowns for side in sides], axis=1)
    pairs = {(u, v) for u, v in index.reshape(-1, 2).tolist() if u < len(places)}
    families, size = families_of(pairs, len(places))
    weights = _of_entries(sightings, sightings.target.at(places)[:, :3, :3])
    whole = np.zeros((size + 3 * len(families),) * 2)
    for each in np.unique(index, axis=0):
        of = (index == each).all(axis=1)
        (left, right), columns = zip(*(_linear(s.where(of), families) for s in sides), strict=True)
        rows, at = np.concatenate([left, -right], axis=2), np.concatenate(columns)
        told = np.einsum("nri,nrs,nsj->ij", rows, weights[of], rows, optimize=True)
        np.add.at(whole, np.ix_(at, at), told)
    # The form at the best translations, and their derivatives by the features
    across = whole[:size, size:]
    shifts = -np.linalg.pinv(whole[size:, size:], rcond=1e-12, hermitian=True) @ across.T
    quadratic = whole[:size, :size] + across @ shifts
    return Quadratic((quadratic + quadratic.T) / 2, shifts, families)


def _linear(side: Factors, families: Sequence[Pattern]) -> tuple[Floats, Indices]:
    """Return (N, 12, m) entries of one side by m features or translations, and their indices."""
    u, v = (int(each) for each in side.unknowns[0])
    family = next((f for f in families if v in (f.first, *f.after)), None)
    if family is not None and u == family.first:
        return _by_both(side.a, _entries(side.b, side.c)), family.columns(u, v)
    by_last = _entries(side.a @ side.b, side.c)
    if family is not None:
        return by_last, family.columns(u, v)
    still = np.append(np.append(np.eye(3), np.zeros(3)), 1.0)  # nothing is unknown
    return (by_last @ still)[:, :, None], np.zeros(1, dtype=np.intp)


def _entries(before: Floats, after: Floats) -> Floats:
    """Return (N, 12, 13): entries of ``before V after`` by V's entries and 1.

    Nine of the rotation, row by row, and three of the translation.
    """
    out, turns = np.zeros((len(before), 12, 13)), before[:, :3, :3]
    # (A X M)_ik is the sum over j, l of A_ij X_jl M_lk.
    out[:, :9, :9] = np.einsum("nij,nlk->nikjl", turns, after[:, :3, :3]).reshape(-1, 9, 9)
    out[:, 9:, :9] = np.einsum("nij,nl->nijl", turns, after[:, :3, 3]).reshape(-1, 3, 9)
    out[:, 9:, 9:12], out[:, 9:, 12] = turns, before[:, :3, 3]
    return out


def _by_both(before: Floats, entries: Floats) -> Floats:
    """Return (N, 12, 169): entries of ``before U W`` by products of (U's entries, 1) with W's."""
    out, turns = np.zeros((len(before), 12, 13, 13)), before[:, :3, :3]
    turned = np.einsum("nij,nlks->nikjls", turns, entries[:, :9].reshape(-1, 3, 3, 13))
    out[:, :9, :9] = turned.reshape(-1, 9, 9, 13)
    out[:, 9:, :9] = np.einsum("nij,nls->nijls", turns, entries[:, 9:]).reshape(-1, 3, 9, 13)
    out[:, 9:, 9:12, 12], out[:, 9:, 12, 12] = turns, before[:, :3, 3]
    return out.reshape(-1, 12, 169)


def _of_entries(s: LiftedSightings, turned: Floats) -> Floats:
    """Return the (N, 12, 12) weights of the difference of both sides' entries.

    ``turned`` is the rotation (N, 3, 3) of either side, as found.
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
