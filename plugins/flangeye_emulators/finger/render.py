"""What the camera in a simulated finger sees: the tag, in perspective, and its imperfections."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flangeye.maths.geometry import rotation_exp, rotation_log
from flangeye.models.finger import FingerGeometry
from flangeye.types import Floats, Image
from flangeye_plugins.weld.touch.tag_observation import dictionary_of

MODULES = 8
"""Of the printed tag with its white margin: six of a 4x4 tag, and one on each side."""

TEXELS = 40
"""To a module of the texture."""


BACKGROUND = 90.0
"""What is behind the tag [grey levels]."""


@dataclass(frozen=True)
class Optics:
    """What is wrong with the images.

    Attributes:
        blur: Standard deviation [px].
        noise: Standard deviation [grey levels].
        glare: Brightness of the reflection that wanders over the image [grey levels].
    """

    blur: float = 0.7
    noise: float = 3.0
    glare: float = 60.0


@dataclass(frozen=True, eq=False)
class Compliance:
    """How the tag moves with the tip; nobody but the simulation knows.

    Attributes:
        share: (3,) displacement of the tag per displacement of the tip, in the tool's axes.
        tilt: Tilt of the tag per lateral displacement of the tip [rad/m].
        stiffening: Relative loss of ``share`` at a displacement of 2 mm.
        camera_R_tool: (3, 3) how the camera is mounted.
        rest: (3,) of the undeformed tag in the camera [m].
        rotation: (3,) rotation vector of the undeformed tag in the camera [rad].
    """

    share: Floats
    tilt: float
    stiffening: float
    camera_R_tool: Floats
    rest: Floats
    rotation: Floats

    def tag(self, displacement: Floats) -> tuple[Floats, Floats]:
        """Return the tag's rotation (3, 3) and translation (3,) for one of the tip (3,) [m]."""
        size = float(np.linalg.norm(displacement)) / 2e-3
        moved = self.share * displacement * (1.0 - self.stiffening * size**2)
        lean = self.tilt * np.array([-displacement[1], displacement[0], 0.0])
        rotation = rotation_exp(self.camera_R_tool @ lean) @ rotation_exp(self.rotation)
        return rotation, self.rest + self.camera_R_tool @ moved


def typical_compliance() -> Compliance:
    """Return a soft finger: the tag sits above the tip and follows it in part, leaning."""
    # The camera looks down along the tool's -z, turned a little about it.
    turn = rotation_exp(np.array([0.0, 0.0, np.deg2rad(25.0)]))
    return Compliance(
        share=np.array([0.75, 0.75, 0.9]),
        tilt=20.0,
        stiffening=0.004,
        camera_R_tool=turn @ np.diag([1.0, -1.0, -1.0]),
        rest=np.array([0.8e-3, -0.5e-3, 45e-3]),
        # It faces the camera, leaning by 5 degrees.
        rotation=rotation_log(rotation_exp(np.array([0.07, 0.05, 0.2])) @ np.diag([1.0, -1, -1])),
    )


class FingerCamera:
    """Renders the tag of one finger."""

    def __init__(self, finger: FingerGeometry, optics: Optics, rng: np.random.Generator) -> None:
        """Print the tag; every image draws its noise from ``rng``."""
        import cv2

        self._lens, self._optics, self._rng = finger.camera, optics, rng
        marker = cv2.aruco.generateImageMarker(dictionary_of(finger), finger.tag.id, 6 * TEXELS)
        paper = np.full((MODULES * TEXELS, MODULES * TEXELS), 230, dtype=np.uint8)
        paper[TEXELS:-TEXELS, TEXELS:-TEXELS] = np.where(marker > 0, 230, 25)
        self._paper = paper
        self._texel = finger.tag.side / (6 * TEXELS)
        self._grain = rng.standard_normal(
            (2 * finger.camera.height, 2 * finger.camera.width), np.float32
        )
        self._clock = 0.0

    def image(self, rotation: Floats, translation: Floats) -> Image:
        """Return what is seen of a tag at a pose in the camera: (3, 3), and (3,) [m]."""
        lens = self._lens
        onto = lens.matrix @ np.column_stack([rotation[:, 0], rotation[:, 1], translation])
        seen = np.full((lens.height, lens.width), BACKGROUND, dtype=np.uint8)
        sheet = onto @ self._sheet()
        x, y = self._extent(sheet, MODULES * TEXELS)
        if x.stop > x.start and y.stop > y.start:
            seen[y, x] = self._warped(sheet, x, y)
        return Image(self._spoilt(seen), lens.matrix, np.array(lens.distortion))

    def _extent(self, sheet: Floats, size: int) -> tuple[slice, slice]:
        """Return the columns and rows in which the paper may be seen."""
        rim = np.array([[0, 0, 1], [size, 0, 1], [size, size, 1], [0, size, 1]]) - [0.5, 0.5, 0.0]
        ends = rim @ sheet.T
        if (ends[:, 2] <= 0).any():  # partly behind the camera: no telling from its corners
            return slice(0, self._lens.width), slice(0, self._lens.height)
        across = ends[:, :2] / ends[:, 2:]
        low = np.clip(np.floor(across.min(axis=0)) - 1, 0, None).astype(int)
        high = np.ceil(across.max(axis=0)).astype(int) + 2
        width, height = self._lens.width, self._lens.height
        return slice(int(low[0]), min(int(high[0]), width)), slice(
            int(low[1]), min(int(high[1]), height)
        )

    def _warped(self, sheet: Floats, x: slice, y: slice) -> NDArray[np.uint8]:
        """Return the paper as seen in some columns and rows, each pixel the mean of four."""
        import cv2

        k = 2
        moved = np.array([[1.0, 0.0, -x.start], [0.0, 1.0, -y.start], [0.0, 0.0, 1.0]])
        fine = np.diag([k, k, 1.0]) @ _half_pixel(k) @ moved @ sheet
        width, height = x.stop - x.start, y.stop - y.start
        seen = cv2.warpPerspective(
            self._paper, fine, (width * k, height * k), flags=cv2.INTER_LINEAR,
            borderValue=BACKGROUND,
        )  # fmt: skip
        small = cv2.resize(seen, (width, height), interpolation=cv2.INTER_AREA)
        return np.asarray(small, dtype=np.uint8)

    def _sheet(self) -> Floats:
        """Return (3, 3): from the texture's pixels to the tag's plane; its y points up."""
        middle = MODULES * TEXELS / 2 - 0.5
        u = self._texel
        return np.array([[u, 0.0, -u * middle], [0.0, -u, u * middle], [0.0, 0.0, 1.0]])

    def _spoilt(self, seen: NDArray[np.uint8]) -> NDArray[np.uint8]:
        import cv2

        optics = self._optics
        grey = cv2.GaussianBlur(seen, (0, 0), optics.blur).astype(np.float32)
        grey += self._reflection(seen.shape) + optics.noise * self._noise(seen.shape)
        return np.asarray(np.clip(np.rint(grey), 0, 255).astype(np.uint8))

    def _noise(self, shape: tuple[int, ...]) -> NDArray[np.float32]:
        """Return unit noise: a random piece of a larger field, which is quicker than drawing it."""
        row, column = (int(self._rng.integers(0, size)) for size in shape)
        return np.asarray(self._grain[row : row + shape[0], column : column + shape[1]])

    def _reflection(self, shape: tuple[int, ...]) -> NDArray[np.float32]:
        """Return a soft bright spot that wanders over the image."""
        self._clock += 1.0
        height, width = shape
        x = width * (0.5 + 0.45 * np.sin(0.031 * self._clock))
        y = height * (0.5 + 0.45 * np.sin(0.047 * self._clock + 1.0))
        across = np.exp(-(((np.arange(width) - x) / (0.12 * width)) ** 2))
        down = np.exp(-(((np.arange(height) - y) / (0.12 * height)) ** 2))
        return np.asarray(self._optics.glare * np.outer(down, across), dtype=np.float32)


def _half_pixel(factor: int) -> Floats:
    """Return (3, 3): pixel centres of an image onto those of one ``factor`` times as fine."""
    shift = (factor - 1) / (2 * factor)
    return np.array([[1.0, 0.0, shift], [0.0, 1.0, shift], [0.0, 0.0, 1.0]])
