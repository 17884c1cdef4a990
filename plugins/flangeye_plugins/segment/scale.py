"""Check whether a cloud's coordinates can be in metres."""

import numpy as np
from numpy.typing import NDArray

from flangeye import Params, StageError
from flangeye.maths.statistics import median
from flangeye.units import Length, param


class RangeParams(Params):
    """Range of distances from the scanner in which the target is searched."""

    near: Length = param("100 mm", ge=0)
    """Points nearer to the scanner are left out."""
    far: Length = param("3 m", gt=0)
    """Points farther from the scanner are left out."""


def check_scale(xyz: NDArray[np.float32], where: str) -> None:
    """Refuse a cloud whose median depth cannot be metres.

    Args:
        xyz: (..., 3) points; missing ones are NaN.
        where: Name of the cloud for the message.

    Raises:
        StageError: The median depth is not plausible; the message names the likely unit.
    """
    # Coordinates that settle the median depth.
    depths = np.abs(xyz[..., 2].ravel()[:: 1 + xyz.size // 100_000])
    depth = float(median(depths[~np.isnan(depths)]))
    # No scanner for such work sees farther than 30 m or nearer than 10 mm.
    farthest, nearest = 30.0, 0.01
    if nearest <= depth <= farthest:
        return
    looks = (
        "millimetres read as metres: state unit mm where the clouds are read"
        if depth > farthest
        else "metres read as millimetres: state unit m where the clouds are read"
    )
    raise StageError(
        f"capture '{where}': half of the points are {depth:.3g} m away; looks like {looks}"
    )
