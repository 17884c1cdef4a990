"""Sensor data: clouds, images, and captures."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from flangeye.types.arrays import Array, Note, Pixels, freeze
from flangeye.types.frames import CAMERA, TARGET, Motion, PointCloud, PosedMeasurement, Poses

Role = Literal["calibration", "verification"]


@dataclass(frozen=True, eq=False)
class Image:
    """An image of a calibrated camera.

    Attributes:
        pixels: (H, W) grey or (H, W, 3) RGB, uint8.
        camera_matrix: (3, 3) pinhole matrix [px].
        distortion: (k,) OpenCV's distortion coefficients; empty for an undistorted image.
        camera_covariance: (8, 8) of fx, fy, cx, cy [px], k1, k2, p1, p2, the same for all images
            of a session; (0, 0) where the camera counts as known.
    """

    pixels: Pixels
    camera_matrix: Array
    distortion: Array = field(default_factory=lambda: np.zeros(0))
    camera_covariance: Array = field(default_factory=lambda: np.zeros((0, 0)))

    def __post_init__(self) -> None:
        pixels = np.asarray(self.pixels)
        grey_or_rgb = pixels.ndim == 2 or pixels.shape[2:] == (3,)
        if pixels.dtype != np.uint8 or not grey_or_rgb:
            got = f"{pixels.shape} {pixels.dtype}"
            raise ValueError(f"an image is (H, W) or (H, W, 3) uint8, not {got}")
        view = pixels.view()
        view.setflags(write=False)
        object.__setattr__(self, "pixels", view)
        known = np.size(self.camera_covariance) == 0  # JSON writes (0, 0) as (0,)
        object.__setattr__(self, "camera_covariance", np.reshape(
            self.camera_covariance, (0, 0) if known else (8, 8)))  # fmt: skip
        freeze(self, camera_matrix=(3, 3), distortion=np.shape(self.distortion),
               camera_covariance=np.shape(self.camera_covariance))  # fmt: skip


@dataclass(frozen=True, eq=False)
class Capture(PosedMeasurement):
    """One scan of the target, with the robot's pose at that time.

    Attributes:
        id: Unique within a run.
        cloud: The scan, in ``camera``; without points where only an image was taken.
        poses: Poses reported by the controllers, by frame.
        joints: (n,) joint angles [rad], when known.
        time_ns: When the exposure ended.
        role: ``verification`` captures are kept from every solver.
        image: Image of a camera in the scanner, in the same frame, if there is one.
        camera: Frame of the scanner that took it; a cell has several.
        target: Frame of the seen target.
        motion: The flange's motion about the capture, if it was recorded in motion.
        arm_joints: (n,) joint angles of each arm of a cell whose joints are known [rad], by its
            frame.
    """

    id: str
    cloud: PointCloud
    poses: Poses
    joints: Array | None = None
    time_ns: int = 0
    role: Role = "calibration"
    image: Image | None = None
    camera: str = CAMERA
    target: str = TARGET
    motion: Motion | None = None
    arm_joints: Mapping[str, Array] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class FlangeCloud:
    """The part of one scan that is the flange's face and rim.

    Attributes:
        cloud: (N, 3) points in ``camera``, all finite.
        centre: (3,) rough centre of the disc in ``camera`` [m]; a start for fitting.
        normal: (3,) rough unit normal in ``camera``, towards the scanner.
        camera_T_target: (4, 4) rough pose of a body; None of a circle or a sphere.
        others: (K, 4, 4) other poses that explain the scan as well.
        ratio: Logarithm of how much likelier its edge is the flange's rim than another disc's;
            None where that was not asked.
    """

    cloud: PointCloud
    centre: Array
    normal: Array
    camera_T_target: Array | None = None
    ratio: float | None = None
    others: Array = field(default_factory=lambda: np.zeros((0, 4, 4)))

    def __post_init__(self) -> None:
        others = np.reshape(self.others, (-1, 4, 4))  # JSON writes (0, 4, 4) as (0,)
        object.__setattr__(self, "others", others)
        freeze(self, centre=(3,), normal=(3,), others=others.shape)
        if self.camera_T_target is not None:
            freeze(self, camera_T_target=(4, 4))

    @property
    def alone(self) -> list[FlangeCloud]:
        """The same fit with one pose only, for each pose that explains the scan."""
        poses = (self.camera_T_target, *self.others)
        return [replace(self, camera_T_target=each, others=self.others[:0]) for each in poses]


@dataclass(frozen=True, eq=False)
class ScanPlace:
    """The arm's pose while the scanner on its flange took a cloud.

    Attributes:
        points: Number of points taken there.
        base_T_flange: (4, 4) as the controller reported it.
        joints: (n,) as reported [rad].
    """

    points: int
    base_T_flange: Array
    joints: Array

    def __post_init__(self) -> None:
        freeze(self, base_T_flange=(4, 4), joints=np.shape(self.joints))


@dataclass(frozen=True, eq=False)
class WorkpieceScan:
    """A scan of the workpiece.

    Attributes:
        cloud: Points in ``camera``. Clouds from several places are concatenated, each in the
            ``camera`` of its own place.
        source: Description of the source.
        notes: Warnings and records.
        truth: Simulation only: the true seams by name, (N, 3) in ``base`` [m]. The runner keeps it
            from the stages that plan and weld.
        places: Where the arm stood for each cloud; empty where the scanner stands beside the arm.
    """

    cloud: PointCloud
    source: str
    notes: tuple[Note, ...] = ()
    truth: Mapping[str, Array] = field(default_factory=dict)
    places: tuple[ScanPlace, ...] = ()
