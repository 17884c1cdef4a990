"""Pivot calibration: a tool point in the flange, from poses that hold the point at one mark.

With the point ``p`` in the flange and the mark ``q`` in base, every pose gives ``R p + t = q``.
Subtracting the mean eliminates ``q``: ``(R_i - mean R) p = mean t - t_i``. If the tool was rotated
about one axis only, the position along that axis is not observable, and the poses are refused.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from flangeye.errors import StageError
from flangeye.types import Floats

TILTED = np.radians(12.0)
"""Smallest rms rotation of the tool about each of two axes [rad]."""


@dataclass(frozen=True, eq=False)
class Pivot:
    """A point of the tool.

    Attributes:
        point: (3,) the tool point in the flange [m].
        covariance: (3, 3) covariance of the point [m^2].
        mark: (3,) the mark in base [m].
        rms: Rms residual per axis [m].
    """

    point: Floats
    covariance: Floats
    mark: Floats
    rms: float


def pivot(what: str, poses: Sequence[Floats], displaced: Sequence[Floats] | None = None) -> Pivot:
    """Return the least-squares tool point that stays at one place in all poses.

    Args:
        what: Name of the point in messages.
        poses: (4, 4) poses of the flange in base.
        displaced: (3,) displacement of the point from its rest position at each pose, in the
            flange's axes [m]; None for a rigid tool.

    Raises:
        StageError: There are too few poses, too little rotation, or the point moved.
    """
    # Six unknowns, three equations a pose: nine are left to show what does not fit
    if len(poses) < 5:
        raise StageError(f"pivot of the {what}: {len(poses)} poses, at least 5 are needed")
    given = np.array(poses)
    rotations, places = given[:, :3, :3], given[:, :3, 3]
    if displaced is not None:
        places = places + np.einsum("kij,kj->ki", rotations, np.array(displaced))
    # R_k p + t_k = m at every pose k; less the mean over the poses, the mark m drops out
    rows = rotations - rotations.mean(axis=0)
    _require_turned(what, rows)
    information = np.einsum("kji,kjl->il", rows, rows)
    inverse = np.linalg.inv(information)
    moved = places.mean(axis=0) - places
    point = inverse @ np.einsum("kji,kj->i", rows, moved)
    left = moved - rows @ point
    _require_stayed(what, left)
    # Point and mark take three parameters each.
    free = 3 * len(poses) - 6
    rms = float(np.sqrt(np.sum(left**2) / free))
    # A tip is set into its mark to 0.05 mm at best.
    covariance = max(rms, 0.05e-3) ** 2 * inverse
    mark = rotations.mean(axis=0) @ point + places.mean(axis=0)
    return Pivot(point, covariance, mark, rms)


def _require_turned(what: str, rows: Floats) -> None:
    """Refuse poses from which a direction of the point is not observable."""
    # Turned about v by a, the columns across v move by about a, and the one along v does not.
    information = np.einsum("kji,kjl->il", rows, rows) / len(rows)
    values, vectors = np.linalg.eigh(information)
    turned = np.sqrt(np.maximum(values, 0.0))
    if turned[0] >= TILTED:
        return
    axis = "xyz"[int(np.abs(vectors[:, 0]).argmax())]
    across = " and ".join(each for each in "xyz" if each != axis)
    if turned[-1] < TILTED:
        raise StageError(
            f"pivot of the {what}: the tool was hardly turned; tilt it about the flange's x and y, "
            f"each to both sides, by {np.degrees(TILTED) * 1.5:.0f} deg or more"
        )
    raise StageError(
        f"pivot of the {what}: tilted by {np.degrees(turned[0]):.1f} deg only about {across}, so "
        f"the point's {axis} in the flange is not observable; tilt it about "
        f"{across}, each to both sides, by {np.degrees(TILTED) * 1.5:.0f} deg or more"
    )


def _require_stayed(what: str, left: Floats) -> None:
    off = np.linalg.norm(left, axis=1)
    worst = int(off.argmax())
    if off[worst] > 1e-3:
        raise StageError(
            f"pivot of the {what}: in pose {worst + 1} it was {off[worst] * 1e3:.2f} mm away "
            f"from where it was in the others, limit 1 mm; did it leave "
            "its mark?"
        )
