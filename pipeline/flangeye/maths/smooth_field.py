r"""A smooth displacement of the flange over the workspace, linear in few weights. Arrays only.

The squared-exponential kernel is a sum over powers of the place (its Taylor expansion)::

    exp(-|u - v|^2 / 2) = sum_i f_i(u) f_i(v)
    f_i(u) = exp(-|u|^2 / 2) prod_j u_j^{p_j} / sqrt(p_j!)

with ``u`` the place from the middle in units of the length. Up to the second power it is as good on
recordings of real arms as the whole kernel, and costs linear time in the poses. Each feature is
taken along x, y and z of ``base``, less the rigid motion nearest to it over the calibration's
poses: that part cannot be told from the camera's pose, which so stays the best for the arm as
reported (restricted spatial regression, Hodges & Reich 2010).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import product
from math import factorial, prod

import numpy as np

from flangeye.maths.geometry import hat
from flangeye.types import Floats, SmoothField

POWERS = tuple(p for p in product(range(3), repeat=3) if sum(p) <= 2)
RADII = 1.5
"""The length over which a field changes, in radii of the workspace: arms differ little from each
other in it, for what bends their space are joints outside of it."""


def field_over(places: Floats) -> SmoothField:
    """Return a field without weights for poses at (N, 3) places in ``base`` [m]."""
    about = places.mean(axis=0)
    radius = float(np.linalg.norm(places - about, axis=1).max())
    k = 3 * len(POWERS)
    bare = SmoothField(about, RADII * max(radius, 1e-3), np.zeros((6, k)), np.zeros(k))
    motions, moved = _motions(bare, places).reshape(-1, 6), effects(bare, places)
    nearest = np.linalg.pinv(motions, rcond=1e-9) @ moved.reshape(-1, k)
    return replace(bare, rigid=nearest)


def effects(field: SmoothField, places: Floats) -> Floats:
    """Return (..., 3, K): how each weight moves a flange at (..., 3) places [m], in ``base``."""
    of_place = features((places - field.about) / field.length, POWERS)
    along = of_place[..., None, :, None] * np.eye(3)[:, None, :]
    along = along.reshape(*places.shape[:-1], 3, -1)
    return np.asarray(along - _motions(field, places) @ field.rigid)


def features(scaled: Floats, powers: Sequence[tuple[int, ...]]) -> Floats:
    """Return (..., K) values of the kernel's features at (..., 3) places in units of its length."""
    bell = np.exp(-0.5 * (scaled**2).sum(axis=-1))
    norms, each = np.sqrt([prod(map(factorial, p)) for p in powers]), np.array(powers)
    raised = scaled[..., None] ** np.arange(each.max() + 1)  # which few powers share
    of_place = raised[..., np.arange(scaled.shape[-1]), each].prod(axis=-1)
    return np.asarray(of_place / norms * bell[..., None])


def displacement(field: SmoothField, places: Floats) -> Floats:
    """Return (..., 3) by how much a flange reported at (..., 3) places is elsewhere [m]."""
    return np.asarray(effects(field, places) @ field.weights)


def _motions(field: SmoothField, places: Floats) -> Floats:
    """Return (..., 3, 6): how a rotation and a translation about the middle move places."""
    turned = -hat(places - field.about)
    still = np.broadcast_to(np.eye(3), turned.shape)
    return np.concatenate([turned, still], axis=-1)
