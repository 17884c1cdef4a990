"""What all open scanners share."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from flangeye.devices import Device, DeviceError, Scan
from flangeye.models.cloud_unit import STATED_LIMIT, median_distance, times_outside
from flangeye.models.scanners import ScannerModel
from flangeye.plugin.stage import Params
from flangeye.types import CAMERA, Image, PointCloud


class SerialParams(Params):
    """Which of several cameras."""

    serial: str | None = Field(
        None, description="Serial number of the camera, if there are several."
    )


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


class OpenScanner(Device):
    """A scanner that is in use; a driver adds ``expose``, and ``close`` where there is a device."""

    def __init__(
        self, name: str, facts: Mapping[str, str], model: ScannerModel | None = None
    ) -> None:
        """Say who it is, see :class:`flangeye.devices.Scanner`, and what it can see."""
        self.name = name
        self.facts = dict(facts)
        self._model = model

    def close(self) -> None:
        """Let go of the device; safe to call twice."""

    def _scan(
        self,
        xyz: NDArray[Any],
        per_metre: float,
        times: tuple[int, int],
        image: Image | None = None,
    ) -> Scan:
        """Return what an exposure gave, coordinates as :func:`cloud_of` takes them.

        Raises:
            DeviceError: It is far out of the model's range.
        """
        cloud = cloud_of(xyz, per_metre)
        require_in_range(self.name, cloud, self._model)
        return Scan(cloud, *times, image)
