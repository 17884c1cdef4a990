r"""Certify a local minimum as the global one. Arrays only.

Squared errors are a quadratic form ``r' Q r`` in features ``r`` of the unknown places
(:mod:`flangeye.estimation.certify.lifted`). Other quadratic forms vanish for all places, because
rotation matrices are orthonormal and a product of features may be written in several ways. If one
of these, C, makes

    L = Q - C - f E   positive semidefinite,

where E selects the square of the constant feature 1, then no places cost less than ``f``:
Lagrangian duality, as used for many cameras and targets in arXiv 2507.23045. The features of
rotations have a fixed length, so that L may lack ``e`` on their diagonal: then no places cost less
than ``f`` by more than ``e`` times the square of that length. Translations have any length, and
allow no such slack. A Cholesky factorisation proves that L is semidefinite, to its rounding.

The forms that vanish are orthogonal to all products of features. These are spanned by products of
two bases, one of either place, so that projecting onto the forms takes small matrices only. C is
sought by quasi-Newton steps that bring L to the semidefinite matrices that vanish at the answer;
there is no solver of semidefinite programs. Where no C is found, eigenvectors of the negative part
of L resemble the features of better places: a descent from these is tried.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import NamedTuple

import numpy as np

from flangeye.estimation.certify.lifted import LiftedSightings, Pattern, Quadratic, squares_of
from flangeye.types import Floats, Indices
from flangeye.types.geometry import nearest_rotation, rotation_exp

GAP = 1e-3
"""Largest relative gap between the cost and its certified lower bound."""


@dataclass(frozen=True, eq=False)
class Certificate:
    """Result of :func:`certify`: a local minimum, and a bound on the cost of any better one.

    Attributes:
        places: (K, 4, 4) unknown transforms at the local minimum.
        cost: Sum of squared errors there.
        missing: Largest possible decrease of the cost by any other transforms.
        optimal: Whether that decrease is negligible.
        better: (K, 4, 4) transforms with a lower cost than ``places``; None if none were found.
    """

    places: Floats
    cost: float
    missing: float
    optimal: bool
    better: Floats | None = None


def certify(sightings: LiftedSightings, places: Floats) -> Certificate:
    """Return a certificate for the local minimum near the unknowns (K, 4, 4)."""
    squares = squares_of(sightings, places)
    found = squares.descend(np.tile(np.eye(4), (len(places), 1, 1)))
    cost = squares.cost(found)
    # The unit of all shares is the cost; of exact data, whose cost is zero, it is the rounding
    size = max(cost, 1e-12 / GAP * float(np.trace(squares.quadratic)))
    bare = squares.quadratic / size
    bare[0, 0] -= cost / size
    dual = _Dual.of(bare, squares.families)
    # The matrix has to vanish along the features of the minimum, and of places with its cost
    _, sizes, ways = np.linalg.svd(squares.alike(found), full_matrices=False)
    along = ways[sizes > 1e-6 * sizes[0]]
    across = np.eye(along.shape[1]) - along.T @ along
    # Most certificates take twenty
    multipliers = dual.find_multipliers(across, 150)
    share = dual.missing(multipliers)
    if share <= GAP:
        return Certificate(places @ found, cost, share * size, True)
    elsewhere = _elsewhere(squares, dual.lacks(multipliers), len(places))
    lower = squares.cost(elsewhere) < cost - GAP * size
    better = places @ elsewhere if lower else None
    return Certificate(places @ found, cost, share * size, False, better)


def _elsewhere(squares: Quadratic, lack: Floats, count: int) -> Floats:
    """Return the best places found from the eigenvectors of the dual matrix's negative part."""
    tried = []
    # The three directions that lack most
    for way in np.linalg.eigh(lack)[1][:, -3:].T:
        start = np.tile(np.eye(4), (count, 1, 1))
        features = way * np.copysign(1.0, way[0])
        for family in squares.families:
            start[family.first, :3, :3] = nearest_rotation(features[family.at[1:, 0]].reshape(3, 3))
            for other in family.after:
                turn = features[family.of(other)[0, :9]].reshape(3, 3)
                start[other, :3, :3] = nearest_rotation(turn)
        tried.append(squares.descend(start))
    return min(tried, key=squares.cost)


# --- multipliers ---------------------------------------------------------------------------------


class _Block(NamedTuple):
    """A family's feature indices, and bases of the space that products of its features span."""

    at: Indices
    first: Floats
    others: Floats

    def project(self, matrix: Floats) -> Floats:
        """Project a matrix onto the matrices whose quadratic form vanishes for all places."""
        size = len(matrix) // 10
        pairs = matrix.reshape(10, size, 10, size).swapaxes(1, 2).reshape(100, -1)
        told = self.first @ (self.first.T @ pairs @ self.others) @ self.others.T
        return matrix - told.reshape(10, 10, size, size).swapaxes(1, 2).reshape(matrix.shape)


class _Dual(NamedTuple):
    """The matrices L whose quadratic form has the same value for all places.

    Attributes:
        bare: (n, n) one such matrix.
        blocks: The blocks in which the matrices differ.
        bounded: (n,) inverse squared length of each feature that has rotations alone.
    """

    bare: Floats
    blocks: Sequence[_Block]
    bounded: Floats

    @classmethod
    def of(cls, bare: Floats, families: Sequence[Pattern]) -> _Dual:
        """Return the matrices of a quadratic form over the features of some families."""
        bounded = np.ones(len(bare))
        for family in families:
            for other in family.after:
                bounded[family.of(other)[:, 9:]] = 0.0
        # Squared length of these: (1, R) has 1 + 3, times (1, R', ...) with 1 + 3 for each other
        # place; the 1 is shared by the families
        length = 1 + sum(4 * (1 + 3 * len(family.after)) - 1 for family in families)
        blocks = [_Block(f.at.ravel(), _of_first(), _of_others(len(f.after))) for f in families]
        return cls(bare, blocks, bounded / length)

    def at(self, multipliers: Floats) -> Floats:
        """Return the matrix L at given multipliers."""
        out, start = self.bare.copy(), 0
        for block in self.blocks:
            end = start + len(block.at) ** 2
            matrix = multipliers[start:end].reshape(len(block.at), -1)
            out[np.ix_(block.at, block.at)] += block.project(matrix)
            start = end
        return out

    def parts(self, matrix: Floats) -> Floats:
        """Return the multipliers' derivative along a matrix."""
        parts = (block.project(matrix[np.ix_(block.at, block.at)]) for block in self.blocks)
        return np.concatenate([part.ravel() for part in parts])

    def find_multipliers(self, still: Floats, tries: int, start: Floats | None = None) -> Floats:
        """Return dual multipliers whose matrix is positive semidefinite, or nearly so.

        ``still`` is the (n, n) projector across the directions in which the matrix has to vanish.
        """
        from scipy.optimize import minimize

        def apart(multipliers: Floats) -> tuple[float, Floats]:
            matrix = self.at(multipliers)
            # Half the squared distance from a convex set has the distance itself as gradient
            off = matrix - _nearest(still @ matrix @ still)
            return 0.5 * float((off**2).sum()), self.parts(off)

        def ended(multipliers: Floats) -> None:
            if self.shows(multipliers, GAP):
                raise StopIteration

        none = np.zeros(sum(len(block.at) ** 2 for block in self.blocks))
        begin = none if start is None else start
        options = {"maxiter": tries, "ftol": 0.0, "gtol": 0.0}
        found = minimize(apart, begin, jac=True, method="L-BFGS-B", callback=ended, options=options)
        return np.asarray(found.x)

    def shows(self, multipliers: Floats, share: float) -> bool:
        """Whether multipliers prove a relative gap of at most ``share``."""
        try:
            np.linalg.cholesky(self.at(multipliers) + share * np.diag(self.bounded))
        except np.linalg.LinAlgError:
            return False
        return True

    def missing(self, multipliers: Floats) -> float:
        """Return the smallest relative gap that the multipliers prove, 1 at most."""
        # Shares of the cost that may be missing, as they are tried
        return next(
            (float(each) for each in np.geomspace(GAP, 1.0, 31) if self.shows(multipliers, each)),
            1.0,
        )

    def lacks(self, multipliers: Floats) -> Floats:
        """Return the (n, n) distance of the dual matrix from the nearest semidefinite one."""
        # Where there is no certificate, so many for a better place
        matrix = self.at(self.find_multipliers(np.eye(len(self.bare)), 50, multipliers))
        return np.asarray(_nearest(matrix) - matrix)


def _nearest(matrix: Floats) -> Floats:
    """Return the nearest matrix that is positive semidefinite."""
    values, vectors = np.linalg.eigh(matrix)
    return np.asarray((vectors * np.maximum(values, 0.0)) @ vectors.T)


@cache
def _of_first() -> Floats:
    """Return a (100, 35) basis of the products of 1 and a rotation's entries."""
    # 55 products of ten features, less 11 by R R' = R' R = 1 and 9 by rows being cross products
    return _spanned(_any_places(1, 100)[:, :10])


@cache
def _of_others(count: int) -> Floats:
    """Return a ((1 + 12 C)^2, m) basis of the products of 1 and the entries of C places."""
    spanned = 1 + 70 * count + 144 * (count * (count - 1) // 2)
    return _spanned(_any_places(count, 2 * spanned))


def _any_places(count: int, draws: int) -> Floats:
    """Return (draws, 1 + 12 C): 1 and the entries of C random places in each row."""
    rng = np.random.default_rng(0)
    places = rng.standard_normal((draws, count, 12))
    turns = rotation_exp(rng.uniform(-np.pi, np.pi, (draws * count, 3)))
    places[:, :, :9] = turns.reshape(draws, count, 9)
    return np.concatenate([np.ones((draws, 1)), places.reshape(draws, -1)], axis=1)


def _spanned(features: Floats) -> Floats:
    """Return an orthonormal basis of the products of any two of (N, f) features."""
    products = np.einsum("ni,nj->nij", features, features).reshape(len(features), -1)
    _, sizes, basis = np.linalg.svd(products, full_matrices=False)
    return np.asarray(basis[sizes > 1e-9 * sizes[0]].T)
