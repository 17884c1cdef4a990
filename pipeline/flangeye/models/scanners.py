"""3D scanners: field of view, resolution, errors, and the unit of their files."""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Literal, Self

import numpy as np
from pydantic import Field, model_validator

from flangeye.errors import StageError
from flangeye.files.clouds import PER_METRE, FileUnit
from flangeye.models.model import Model
from flangeye.types import Floats, PointCloud
from flangeye.units import Angle, Length, param


class ScannerData(Model):
    """What reading an archive needs of a scanner: its name and, if known, its range."""

    model: str
    near: Length | None = None
    far: Length | None = None

    @model_validator(mode="after")
    def _near_before_far(self) -> Self:
        if self.near is not None and self.far is not None and not 0 <= self.near < self.far:
            raise ValueError("near must be below far")
        return self

    @property
    def range(self) -> tuple[float, float]:
        """Nearest and farthest distance that it measures [m]; if unknown, those of any scanner."""
        # Range in which any 3D scanner of a work cell measures [m]
        near, far = (0.1, 10.0)
        return (near if self.near is None else self.near, far if self.far is None else self.far)


class ScannerModel(ScannerData):
    """A 3D scanner: field of view, resolution and errors."""

    maker: str
    principle: Literal["structured light", "active stereo", "time of flight", "laser line"]
    columns: int = Field(gt=0)
    rows: int = Field(gt=0)
    field_of_view: tuple[Angle, Angle]
    """Horizontal, vertical; full angles."""
    near: Length
    far: Length
    baseline: Length = param("0 mm")
    """Camera to projector, along the image's x."""
    convergence: Angle = param("0 deg")
    """From the baseline's normal to the camera's axis, towards the projector."""
    projection: tuple[Angle, Angle] | None = None
    """The projector's field, horizontal and vertical; all of space if not given."""
    temporal_noise: Length
    """Standard deviation of depth at mid range."""
    noise_grain: float = Field(0.0, ge=0)
    """Filter that correlates neighbouring noise, standard deviation [px]."""
    edge_loss: float = Field(0.0, ge=0)
    """Width lost along a step in depth [px]."""
    calibration_error: Length
    """Smooth distortion over the volume, rms."""
    source: str


def middle_of_view(scanner: ScannerModel, base_T_camera: Floats) -> Floats:
    """Return (3,) in ``base`` [m]: ahead of the scanner, at its working distance."""
    # From the scanner to the middle of the workspace, where its range allows: the paper's [m]
    distance = min(0.7, (scanner.near + scanner.far) / 2)
    return np.asarray(base_T_camera[:3, 3] + distance * base_T_camera[:3, 2])


STATED_LIMIT = 20.0
"""Factor by which the median distance must be outside the scanner's range to refute a stated unit.
No wall behind the robot is that far away, and a wrong unit is off by a factor of 1,000."""
DETECTED_LIMIT = 5.0
"""Largest factor by which the median distance may be outside the range to detect a unit."""

NAMES: Mapping[FileUnit, str] = {
    "m": "metres", "mm": "millimetres", "cm": "centimetres", "in": "inches",
}  # fmt: skip


def median_distance(cloud: PointCloud) -> float:
    """Return the median distance of the finite points from the scanner [m], NaN without any."""
    flat = cloud.xyz.reshape(-1, 3)
    # 50,000 points give the median well enough: it is compared by factors of five and more
    # Every n-th point and not the first ones: an organised cloud begins with one edge of the view.
    flat = flat[:: max(1, len(flat) // 50_000)]
    distances = np.linalg.norm(flat.astype(np.float64), axis=1)
    finite = distances[np.isfinite(distances)]
    return float(np.median(finite)) if len(finite) else math.nan


def times_outside(distance: float, scanner: ScannerData) -> float:
    """Return by which factor a distance is outside the range; 1 or less is inside."""
    near, far = scanner.range
    return max(near / max(distance, 1e-12), distance / far)


def check_unit(path: Path, distance: float, unit: FileUnit, scanner: ScannerData) -> None:
    """Refuse a unit that the scanner's range contradicts.

    Args:
        path: The cloud's file.
        distance: Median distance of its points [m], if they are in ``unit``.
        unit: Unit that was stated or detected.
        scanner: Scanner that recorded the cloud.

    Raises:
        StageError: The range contradicts it; the message names the likely unit.
    """
    # Written with "not" so that a NaN, of a cloud without points, passes: it says nothing of the
    # unit.
    if not times_outside(distance, scanner) > STATED_LIMIT:
        return
    raw = distance * PER_METRE[unit]
    others: list[FileUnit] = [other for other in NAMES if other != unit]
    best = min(others, key=lambda other: times_outside(raw / PER_METRE[other], scanner))
    metres = raw / PER_METRE[best]
    if times_outside(metres, scanner) <= DETECTED_LIMIT:
        cure = f"these look like {NAMES[best]}: set unit: {best}"
    else:
        cure = f"and {metres:.3g} m with unit {best} does not fit either; is it this scanner?"
    raise StageError(
        f"{path}: median distance {distance:.3g} m with unit {unit}, but {_range(scanner)}; {cure}"
    )


def detect_unit(path: Path, raw: float, scanner: ScannerData) -> FileUnit:
    """Return the unit in which a median distance fits the scanner's range: metres or millimetres.

    Centimetres and inches lie between the two and are rare, so they have to be stated.

    Args:
        path: The cloud's file.
        raw: Median distance of its points, in the file's unknown unit.
        scanner: Scanner that recorded the cloud.

    Raises:
        StageError: Neither metres nor millimetres fit.
    """
    units: tuple[FileUnit, ...] = ("m", "mm")
    outside = {unit: times_outside(raw / PER_METRE[unit], scanner) for unit in units}
    unit = min(units, key=lambda u: outside[u])
    if outside[unit] > DETECTED_LIMIT:
        others: tuple[FileUnit, ...] = ("cm", "in")
        fitting = [u for u in others if times_outside(raw / PER_METRE[u], scanner) <= 1.0]
        named = " or ".join(f"unit: {u}" for u in fitting or units)
        cure = f"{named}, which fits," if fitting else f"{named},"
        raise StageError(
            f"{path}: median distance {raw:.3g} fits neither m nor mm: {_range(scanner)}; state "
            f"{cure} or the right scanner"
        )
    return unit


def unit_note(unit: FileUnit, how: str, distance: float, scanner: ScannerData) -> str:
    """Return the note about the unit."""
    return (
        f"clouds in {unit} ({how}): the first has its median point at {distance:.3f} m; "
        f"{_range(scanner)}"
    )


def _range(scanner: ScannerData) -> str:
    near, far = scanner.range
    known = "sees" if scanner.near and scanner.far else "has no range stated and may see"
    return f"{scanner.model} {known} {near:.3f} to {far:.3f} m"
