"""Symmetric block tridiagonal systems, their cost linear in the number of blocks. Arrays only.

By cyclic reduction (Hockney 1965): every second block is taken out, which leaves a system of the
same kind and half the size; all blocks of a level at once.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from flangeye.types import Floats


@dataclass(frozen=True, eq=False)
class Tridiagonal:
    """What is known of a positive definite matrix of N x N blocks; its inverse when asked for.

    Attributes:
        solution: (N, s, m) of the equations.
        taken: (M, s, s) inverses of the blocks that were taken out; of the last one at the end.
        before: (M, s, s) how those follow their neighbours before them.
        after: (R, s, s) how they follow those after them, of which the last may have none.
        rest: What was left; None at the end.
    """

    solution: Floats
    taken: Floats
    before: Floats
    after: Floats
    rest: Tridiagonal | None = None

    @property
    def diagonal(self) -> Floats:
        """(N, s, s) blocks on the diagonal of the inverse."""
        return self._inverse[0]

    @property
    def below(self) -> Floats:
        """(N - 1, s, s) blocks below them."""
        return self._inverse[1]

    @property
    def logdet(self) -> float:
        """Logarithm of the determinant."""
        own = -float(np.linalg.slogdet(self.taken)[1].sum())
        return own if self.rest is None else self.rest.logdet + own

    @cached_property
    def _inverse(self) -> tuple[Floats, Floats]:
        """The inverse's blocks on and below the diagonal."""
        taken, before, after, rest = self.taken, self.before, self.after, self.rest
        if rest is None:
            return taken, before
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


def solve_tridiagonal(diagonal: Floats, below: Floats, right: Floats) -> Tridiagonal:
    """Solve for all right sides.

    Args:
        diagonal: (N, s, s) blocks.
        below: (N - 1, s, s) blocks, the k-th in row k + 1 and column k.
        right: (N, s, m).
    """
    return _reduced(np.concatenate([diagonal, right], axis=2), below)


def _reduced(rows: Floats, below: Floats) -> Tridiagonal:
    """Solve where the right sides stand beside the diagonal, (N, s, s + m)."""
    s = rows.shape[1]
    if len(rows) == 1:
        last: Floats = np.asarray(np.linalg.inv(rows[:, :, :s]), dtype=np.float64)
        return Tridiagonal(last @ rows[:, :, s:], last, below, below)
    taken: Floats = np.asarray(np.linalg.inv(rows[1::2, :, :s]), dtype=np.float64)
    m, r = len(taken), (len(rows) - 1) // 2
    # What is taken out follows its neighbours before and after it, of which the last has none.
    follows = taken @ np.concatenate([below[0::2], rows[1::2, :, s:]], axis=2)
    before, own = follows[:, :, :s], follows[:, :, s:]
    after = taken[:r] @ _turned(below[1::2])
    kept = rows[0::2].copy()
    kept[:m] -= _turned(below[0::2]) @ follows
    kept[1 : r + 1] -= below[1::2] @ np.concatenate([after, own[:r]], axis=2)
    rest = _reduced(kept, -below[1::2] @ before[:r])
    solution = np.empty_like(rows[:, :, s:], dtype=np.float64)
    solution[0::2], solution[1::2] = rest.solution, own - before @ rest.solution[:m]
    solution[1::2][:r] -= after @ rest.solution[1 : r + 1]
    return Tridiagonal(solution, taken, before, after, rest)


def _turned(blocks: Floats) -> Floats:
    return np.swapaxes(blocks, 1, 2)
