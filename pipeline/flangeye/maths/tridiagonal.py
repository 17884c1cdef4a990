"""Symmetric block tridiagonal systems, their cost linear in the number of blocks. Arrays only.

By cyclic reduction (Hockney 1965): every second block is taken out, which leaves a system of the
same kind and half the size; all blocks of a level at once.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from flangeye.types import Floats


@dataclass(frozen=True, eq=False)
class Tridiagonal:
    """What is known of a positive definite matrix of N x N blocks.

    Attributes:
        solution: (N, s, m) of the equations.
        diagonal: (N, s, s) blocks on the diagonal of the inverse.
        below: (N - 1, s, s) blocks below them.
        logdet: Logarithm of the determinant.
    """

    solution: Floats
    diagonal: Floats
    below: Floats
    logdet: float


def solve_tridiagonal(diagonal: Floats, below: Floats, right: Floats) -> Tridiagonal:
    """Solve for all right sides, with the blocks of the inverse that lie on the three diagonals.

    Args:
        diagonal: (N, s, s) blocks.
        below: (N - 1, s, s) blocks, the k-th in row k + 1 and column k.
        right: (N, s, m).
    """
    taken: Floats = np.asarray(np.linalg.inv(diagonal[1::2]), dtype=np.float64)
    if not len(taken):
        inverse: Floats = np.asarray(np.linalg.inv(diagonal), dtype=np.float64)
        return Tridiagonal(inverse @ right, inverse, below, _logdet(diagonal))
    m, r = len(taken), (len(diagonal) - 1) // 2
    # What is taken out follows its neighbours before and after it, of which the last has none.
    before, after = taken @ below[0::2], taken[:r] @ _turned(below[1::2])
    own = taken @ right[1::2]
    kept, sides = diagonal[0::2].copy(), right[0::2].copy()
    kept[:m] -= _turned(below[0::2]) @ before
    kept[1 : r + 1] -= below[1::2] @ after
    sides[:m] -= _turned(below[0::2]) @ own
    sides[1 : r + 1] -= below[1::2] @ own[:r]
    rest = solve_tridiagonal(kept, -below[1::2] @ before[:r], sides)
    solution = np.empty_like(right, dtype=np.float64)
    solution[0::2], solution[1::2] = rest.solution, own - before @ rest.solution[:m]
    solution[1::2][:r] -= after @ rest.solution[1 : r + 1]
    logdet = rest.logdet + _logdet(diagonal[1::2])
    return Tridiagonal(solution, *_inverse(taken, before, after, rest), logdet)


def _inverse(
    taken: Floats, before: Floats, after: Floats, rest: Tridiagonal
) -> tuple[Floats, Floats]:
    """Return the inverse's blocks on and below the diagonal, with those that were taken out."""
    m, r, s = len(taken), len(after), taken.shape[1]
    to_before = -before @ rest.diagonal[:m]
    to_before[:r] -= after @ rest.below
    to_after = -before[:r] @ _turned(rest.below) - after @ rest.diagonal[1 : r + 1]
    own = taken - to_before @ _turned(before)
    own[:r] -= to_after @ _turned(after)
    diagonal, below = np.empty((m + len(rest.diagonal), s, s)), np.empty((m + r, s, s))
    diagonal[0::2], diagonal[1::2] = rest.diagonal, own
    below[0::2], below[1::2] = to_before, _turned(to_after)
    return diagonal, below


def _turned(blocks: Floats) -> Floats:
    return np.swapaxes(blocks, 1, 2)


def _logdet(blocks: Floats) -> float:
    return float(np.linalg.slogdet(blocks)[1].sum())
