"""Linear equations in the entries of rotations and in translations, for K problems at once."""

from __future__ import annotations

import numpy as np

from flangeye.types import Floats


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
