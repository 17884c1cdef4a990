"""Common parts of scanner drivers."""

from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from flangeye.devices import Device, DeviceError, Scan
from flangeye.models.scanners import (
    DETECTED_LIMIT,
    STATED_LIMIT,
    ScannerModel,
    median_distance,
    times_outside,
)
from flangeye.plugin.stage import Params
from flangeye.types import CAMERA, Image, PointCloud

AnyArray = NDArray[Any]


class ColourCamera(NamedTuple):
    """The colour camera beside a depth camera; ``colour = rotation @ depth + translation`` [m].

    Attributes:
        matrix: 3 x 3 pinhole matrix [px].
        distortion: OpenCV's eight coefficients.
        rotation: 3 x 3 rotation from the depth camera.
        translation: 3-vector of the translation from the depth camera [m].
    """

    matrix: list[list[float]]
    distortion: list[float]
    rotation: list[list[float]]
    translation: list[float]


class DepthView:
    """Calibration of a depth camera and of the colour camera beside it."""

    def __init__(
        self,
        matrix: list[list[float]],
        distortion: list[float],
        colour: dict[str, Any] | None = None,
    ) -> None:
        """Store camera matrix [px], OpenCV's 8 coefficients, and a :class:`ColourCamera`."""
        self.matrix, self.distortion = np.array(matrix), np.array(distortion)
        self.colour = None if colour is None else ColourCamera(**colour)

    def points(self, depth: AnyArray) -> NDArray[np.float32]:
        """Return points (H, W, 3) of a depth image (H, W), in its unit; zero where it is zero."""
        import cv2

        rows, columns = depth.shape
        pixels = np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), axis=-1)
        flat = pixels.reshape(-1, 1, 2).astype(np.float64)
        # Without a new camera matrix these are x / z and y / z
        rays = cv2.undistortPoints(flat, self.matrix, self.distortion).reshape(rows, columns, 2)
        xyz = np.dstack([rays, np.ones(depth.shape)]) * depth[..., None]
        return np.asarray(xyz, dtype=np.float32)

    def coloured(self, xyz: AnyArray, colour: AnyArray) -> Image | None:
        """Return the colour image as seen from the depth camera.

        Args:
            xyz: (H, W, 3) points [mm]; pixels without a point or outside the colour image are
                black.
            colour: (h, w, 4) colour image, BGRA.
        """
        import cv2

        if self.colour is None:
            return None
        camera = self.colour
        # Millimetres to metres, the unit of the camera's translation
        points = xyz.reshape(-1, 1, 3).astype(np.float64) / 1e3
        turn, _ = cv2.Rodrigues(np.array(camera.rotation))
        seen, _ = cv2.projectPoints(
            points, turn, np.array(camera.translation), np.array(camera.matrix),
            np.array(camera.distortion),
        )  # fmt: skip
        at = np.nan_to_num(seen.reshape(*xyz.shape[:2], 2)).astype(np.float32)
        # Outside the image, where remap writes black
        at[~xyz.any(axis=-1)] = -1
        mapped = cv2.remap(colour, at, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)  # type: ignore[call-overload]
        # BGRA to RGB
        rgb = np.ascontiguousarray(mapped[..., 2::-1])
        return Image(rgb, self.matrix, self.distortion)


class SerialParams(Params):
    """Selection of a camera by its serial number."""

    serial: str | None = None
    """Serial number of the camera, if there are several."""


def chosen(
    name: str,
    found: Iterable[str],
    wanted: str | None,
    look: str = "is it on, and in this computer's network?",
    kind: str = "camera",
    give: str = "serial",
) -> str:
    """Return the name of the wanted device, or of the only one.

    Args:
        name: The driver's name.
        found: Names of the devices that are there.
        wanted: The device that the recipe names; None if it names none.
        look: What to look at if there is none.
        kind: What these devices are.
        give: The driver's parameter that names one.

    Raises:
        DeviceError: There is none, there are several, or none has the name.
    """
    known = sorted(found)
    if not known:
        raise DeviceError(f"{name}: no {kind} found; {look}")
    if wanted is None and len(known) > 1:
        raise DeviceError(f"{name}: several {kind}s, give {give}: {', '.join(known)}")
    if wanted not in (None, *known):
        raise DeviceError(f"{name}: no {kind} {wanted}; there are: {', '.join(known)}")
    return wanted or known[0]


def cloud_of(xyz: NDArray[Any], per_metre: float) -> PointCloud:
    """Return a cloud from coordinates (H, W, 3) or (N, 3).

    Args:
        xyz: The device's coordinates; a point at the origin is a missing one.
        per_metre: Number of the device's units per metre.
    """
    metres = xyz.astype(np.float32)
    metres /= np.float32(per_metre)  # exact to the last bit, which times 0.001 is not
    metres[~metres.any(axis=-1)] = np.nan
    return PointCloud(CAMERA, metres)


def require_in_range(name: str, cloud: PointCloud, model: ScannerModel | None) -> None:
    """Raise DeviceError if a cloud is so far out of range that its unit is probably wrong."""
    if model is None:
        return
    distance = median_distance(cloud)
    if times_outside(distance, model) > STATED_LIMIT:
        cure = "check the recipe's scanner model, and the unit in which the driver gives points"
        if times_outside(distance / 1e3, model) <= DETECTED_LIMIT:
            cure = "these look like millimetres: let its driver give metres"
        raise DeviceError(
            f"{name}: median distance {distance:.4g} m, but {model.model} sees {model.near:.3f} "
            f"to {model.far:.3f} m; {cure}"
        )


class OpenScanner(Device):
    """Base class of scanners; drivers implement ``expose``, and ``close`` if there is a device."""

    def __init__(
        self, name: str, facts: Mapping[str, str], model: ScannerModel | None = None
    ) -> None:
        """Store name and facts (see :class:`flangeye.devices.Scanner`), and the model if known."""
        self.name = name
        self.facts = dict(facts)
        self._model = model

    def close(self) -> None:
        """Disconnect; safe to call twice."""

    def _scan(
        self,
        xyz: NDArray[Any],
        per_metre: float,
        times: tuple[int, int],
        image: Image | None = None,
    ) -> Scan:
        """Return the scan of an exposure; for the coordinates see :func:`cloud_of`.

        Raises:
            DeviceError: The scan is far out of the model's range.
        """
        cloud = cloud_of(xyz, per_metre)
        require_in_range(self.name, cloud, self._model)
        return Scan(cloud, *times, image)
