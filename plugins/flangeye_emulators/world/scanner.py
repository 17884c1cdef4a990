"""Where a simulated scanner stands, and what it is by its principle."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from pydantic import Field

from flangeye.models.scanners import ScannerModel
from flangeye.plugin.stage import Params, PlaceParams
from flangeye.types import BASE, CAMERA, Floats, Transform
from flangeye.units import Angle, Length, param

if TYPE_CHECKING:
    from flangeye_emulators.world.raycast import RaycastScene, SolidBody
    from flangeye_emulators.world.structured_light import StructuredLight
    from flangeye_emulators.world.time_of_flight import TimeOfFlight


class CameraPose(PlaceParams):
    """Where the scanner stands, in ``base``."""

    position: tuple[Length, Length, Length] = param(
        ("600 mm", "-12.5 mm", "1000 mm"), description="The paper's (17): 1 m above the table."
    )
    rpy: tuple[Angle, Angle, Angle] = param(
        ("180 deg", "0 deg", "-90 deg"), description="Roll, pitch, yaw; the default looks down."
    )


class ScannerQuality(Params):
    """How good a simulated scanner is, beside its model."""

    noise: float = Field(1.0, ge=0, description="Scale of the scanner's noise and distortion.")
    resolution: float = Field(
        1.0, gt=0, le=1, description="Scale of the scanner's columns and rows."
    )


def scanner_of(
    scanner: ScannerModel, resolution: float, noise: float, rng: np.random.Generator
) -> StructuredLight | TimeOfFlight:
    """Return the scanner, with the distortion that ``rng`` draws for it."""
    from flangeye_emulators.world.structured_light import StructuredLight
    from flangeye_emulators.world.time_of_flight import TimeOfFlight

    kind = StructuredLight if scanner.principle == "structured light" else TimeOfFlight
    return kind(scanner, resolution, noise, rng)


def before_camera(bodies: Sequence[SolidBody], base_T_camera: Floats) -> RaycastScene:
    """Return the bodies, given in ``base``, as they stand before the camera."""
    from flangeye_emulators.world.raycast import RaycastScene

    camera_T_base = Transform(BASE, CAMERA, base_T_camera).inverse().matrix
    return RaycastScene([body.moved(camera_T_base) for body in bodies])
