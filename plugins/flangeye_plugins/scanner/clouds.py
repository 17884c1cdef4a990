"""From what devices give to clouds: metres, and NaN where nothing was measured."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from flangeye.devices import DeviceError
from flangeye.models.cloud_unit import STATED_LIMIT, median_distance, times_outside
from flangeye.models.scanners import ScannerModel
from flangeye.types import CAMERA, PointCloud


def cloud_of(xyz: NDArray[Any], per_metre: float) -> PointCloud:
    """Return a cloud from (H, W, 3) or (N, 3) coordinates.

    Args:
        xyz: As the device gives them; a point at the device's own origin was not measured.
        per_metre: How many of the device's units are in a metre.
    """
    metres = xyz.astype(np.float32)
    metres /= np.float32(per_metre)  # exact to the last bit, which times 0.001 is not
    metres[~metres.any(axis=-1)] = np.nan
    return PointCloud(CAMERA, metres)


def require_in_range(name: str, cloud: PointCloud, model: ScannerModel | None) -> None:
    """Raise DeviceError where a cloud is so far out of the model's range that its unit is wrong."""
    if model is None:
        return
    distance = median_distance(cloud)
    if times_outside(distance, model) > STATED_LIMIT:
        raise DeviceError(
            f"{name}: median distance {distance:.3g} m, but {model.model} sees {model.near:.3f} "
            f"to {model.far:.3f} m; is it this scanner, and its unit as it says?"
        )
