"""What all open scanners share."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from numpy.typing import NDArray

from flangeye.devices import Device, Scan
from flangeye.models.scanners import ScannerModel
from flangeye.types import Image
from flangeye_plugins.scanner.clouds import cloud_of, require_in_range


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
