"""Sightings of one moment share the noise of the places that controllers have then. Arrays only."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.linalg import block_diag

from flangeye.handeye.components import Noise
from flangeye.handeye.likelihood import Solution
from flangeye.types import Floats, Indices


def shared_noise(found: Solution, moves: Floats, moments: Indices) -> Floats:
    """Return the (6 K, 6 K) that is added where N sightings share the noise of what moves.

    A fit that takes them for independent is hardly less accurate, and thinks too well of what they
    all see. How much of the noise they share, residuals of one moment tell by how alike they are.

    Args:
        found: The fit.
        moves: (N, 6, q) what errors of unit size do to what is seen.
        moments: (N,) of each.
    """
    p = found.at.of_places
    if moments.max(initial=-1) + 1 == len(moments):
        return np.zeros((p, p))
    moves = moves * found.inliers[:, None, None]
    told = np.swapaxes(found.weights @ moves, 1, 2)
    alike = float(np.trace(between(moments, told @ found.linear.residuals[..., None])))
    most = float(np.trace(between(moments, told @ moves)))
    share = min(max(alike / most, 0.0) + np.sqrt(2 / most), 1.0) if most > 0 else 0.0
    followed = told @ found.linear.jacobian @ found.covariance
    return share * between(moments, followed[:, :, :p])


def between(moments: Indices, each: Floats) -> Floats:
    """Return the (p, p) sum of A^T B over all two of (N, q, p) that are of one moment."""
    together = np.zeros((moments.max() + 1, *each.shape[1:]))
    np.add.at(together, moments, each)
    both, alone = (np.einsum("nij,nik->jk", x, x) for x in (together, each))
    return np.asarray(both - alone)


def moves_of(effects: Floats, stated: Sequence[Floats], noise: Noise) -> Floats:
    """Return (N, 6, 12 m) what errors of unit size of m places do to what is seen.

    As it is taken for them, and evenly: that is of all alike that a sighting depends on.

    Args:
        effects: (N, 6, 6 m) of their turns and shifts.
        stated: m (6, 6) covariances that are believed of them.
        noise: As it was found.
    """
    roots = block_diag(np.zeros((0, 0)), *(np.linalg.cholesky(each) for each in stated))
    blocks = effects.reshape(len(effects), 6, -1, 6)
    even = np.zeros_like(blocks)
    even[:, :3, :, :3] = np.sqrt(noise.tilt) * blocks[:, :3, :, :3]
    even[:, 3:, :, 3:] = np.sqrt(noise.pose) * blocks[:, 3:, :, 3:]
    moving = np.maximum((blocks != 0).any(axis=(1, 3)).sum(axis=1), 1)
    even /= np.sqrt(moving)[:, None, None, None]
    return np.concatenate([np.sqrt(noise.arms) * effects @ roots, even.reshape(effects.shape)], 2)


def alike(places: Floats) -> Indices:
    """Return (N,) which of (N, k) are alike, each kind by a number from 0."""
    return np.unique(places, axis=0, return_inverse=True)[1].reshape(-1)
