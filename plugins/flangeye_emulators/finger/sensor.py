"""A simulated finger: its tip in a workpiece's groove, and a camera that renders images."""

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from flangeye.devices import Device, DeviceError, SensorFrame, StateSource, TactileSensor
from flangeye.errors import StageError
from flangeye.models.finger import Finger, FingerGeometry
from flangeye.models.model import read_model
from flangeye.models.workpiece import CadSeam, load_workpiece
from flangeye.motion.seam_following import ToolPose
from flangeye.plugin.stage import part
from flangeye.types import Floats, Image, Seed, Transform
from flangeye.types.geometry import rotation_exp, rotation_from_rpy, rotation_log
from flangeye.units import Duration, Length, param
from flangeye_emulators.weld_world.groove import GrooveSection, Tip
from flangeye_emulators.weld_world.truth import ToolFile, ToolPath, WeldTruth, WorldPath
from flangeye_emulators.weld_world.world import ImageQueue, Nominal, WeldWorld
from flangeye_emulators.world import bench
from flangeye_emulators.world.bench import LaidParams
from flangeye_plugins.weld.corners import corners_of
from flangeye_plugins.weld.frame import Tool, WorkSurface, flattened
from flangeye_plugins.weld.touch.tag_observation import dictionary_of


class SimulatedFingerParams(LaidParams):
    """Parameters of ``sensor.simulated_finger``: the true world of the finger."""

    tool: ToolPath = param("srm")
    """The true finger and torch: one of data/tools, or a .yaml file."""
    seam: str = "groove"
    """Name of the seam in that file."""
    leg: int | None = Field(None, ge=1)
    """Leg of a seam with sharp corners."""
    plate: Length | None = param(None, gt=0)
    """Thickness of the upper plate of a lap joint or fillet, in place of a groove."""
    world: WorldPath = param("as_filed")
    """What is true and differs from the controller's files: arm, tool, finger, clock, workpiece,
    heat. One of data/worlds, or a .yaml file."""
    hidden: tuple[Duration, Duration] | None = param(None)
    """Start and end of the time in which the tag is hidden."""
    held: bool = False
    """To calibrate: the tip stays where it first touches, as in a punch mark."""
    fails: Duration | None = param(None)
    """Time at which the camera is lost."""


class SimulatedFinger(Device):
    """A finger on an arm, over a workpiece, in a simulated true world.

    Attributes:
        name: Name in messages and reports.
        camera_matrix: (3, 3) camera matrix [px].
        distortion: (k,) OpenCV's distortion coefficients.
        world: The true world; not to be used by stages.
        tool: Conversion to the true pose of the tool in the groove's plane; not to be used by
            stages.
    """

    def __init__(
        self, robot: StateSource, seed: Seed, params: SimulatedFingerParams, truth: WeldTruth
    ) -> None:
        """Create the true world with the workpiece and the true finger."""
        finger = read_model(params.tool, ToolFile)
        self.name = f"simulated finger {finger.model}"
        self.camera_matrix, self.distortion = finger.camera.matrix, np.array([])
        self._surface, nominal = _as_planned(finger, params)
        self._planned = self._surface.path
        self.world = WeldWorld(nominal, truth, [seed, 12], self._flattened)
        self.tool = Tool(finger, self._surface)
        self._robot, self._params = robot, params
        self._rng = np.random.default_rng([seed, 11])
        self._camera = FingerCamera(finger, self._rng)
        self._compliance = typical_compliance()
        self._shutter: ImageQueue[Floats] = ImageQueue(
            replace(truth.clock, hidden=params.hidden), self._rng
        )
        self._started: int | None = None
        self._mark: Floats | None = None
        self._torch: list[tuple[float, Floats, float]] = []

    def frame(self) -> SensorFrame | None:
        """Simulate the tip at the arm's present pose; return the next arrived image, if any.

        Raises:
            DeviceError: The camera is lost.
        """
        state = self._robot.state()
        now = state.time_ns * 1e-9
        self._started = state.time_ns if self._started is None else self._started
        age = (state.time_ns - self._started) * 1e-9
        if self._params.fails is not None and age >= self._params.fails:
            raise DeviceError(f"{self.name}: the camera is lost")
        flange = bench.true_flange(state)
        shown = self._shown(self.tool.pose(flange, now), flange)
        self._torch.append((now, *self._beside_plan()))
        if self._shutter.due(age):
            # A tag that something covers: it is as if it were far out of the image.
            hidden = self._shutter.hidden(age)
            self._shutter.expose(now, shown + (np.array([1.0, 0, 0]) if hidden else 0.0))
        seen = self._shutter.arrived(now)
        return (
            None if seen is None else SensorFrame(self._image(seen.item), round(seen.stamp * 1e9))
        )

    def true_torch(self) -> tuple[Floats, Floats]:
        """Return times (K,) [s] and the true positions of the torch (K, 3) in base [m].

        The true seam differs from the planned one, and heat moves it. The positions are shifted so
        that they lie relative to the planned seam as they really did to the true one, because the
        score compares them with the planned seam.
        """
        known = list(self._torch)  # in one go: a thread that reads images may add to it
        times, near = (np.array([each[i] for each in known]) for i in (0, 2))
        torch = np.array([place for _, place, _ in known]).reshape(-1, 3)
        return times, self._surface.to_base(torch, near)

    def _beside_plan(self) -> tuple[Floats, float]:
        """Return the torch (3,) relative to the planned seam [m], and its arc length there [m].

        The true seam's offset from the planned one is subtracted.
        """
        world = self.world
        true = world.groove.root.at(world.torch_s)
        across = float((world.torch[:2] - true.point) @ true.normal)
        seam = true.point + (across - world.off) * true.normal  # heat has moved it there
        s = self._planned.foot(seam, world.torch_s)
        planned = self._planned.at(s)
        off = np.array([*(seam - planned.point), true.height - planned.height])
        return np.asarray(world.torch - off), s

    def close(self) -> None:
        """Do nothing; there is no device."""

    def _shown(self, pose: ToolPose, base_T_flange: Transform) -> Floats:
        """Return the tip's displacement (3,) as the tag shows it, in the tool's axes [m]."""
        if not self._params.held:
            return self.world.settle(pose, self._stands(pose, base_T_flange))
        axes, tip = self.world.held(pose, self._stands(pose, base_T_flange))
        self._mark = tip if self._mark is None else self._mark
        return np.asarray(axes.T @ (self._mark - tip))

    def _stands(self, pose: ToolPose, base_T_flange: Transform) -> Floats:
        """Return the tool's tilt (3, 3): its axes with the heading removed."""
        axes = self.tool.in_plane(base_T_flange)
        return np.asarray(rotation_from_rpy(0.0, 0.0, -pose.angle) @ axes)

    def _flattened(self, tip: Floats, torch: Floats) -> Floats:
        """Return the torch (3,) in the flattened plane, from the tangent plane at the tip."""
        surface = self._surface
        before = self.world.contact.s
        in_base = surface.to_base(tip[None], np.array([before]))[0]
        s = surface.foot(in_base, before)
        beside = surface.at(s)
        near = s + float((torch - tip)[:2] @ beside.place.tangent)
        in_base = in_base + beside.to_base(torch - tip)
        return surface.to_plane(in_base, surface.foot(in_base, near))

    def _image(self, displacement: Floats) -> Image:
        return self._camera.image(*self._compliance.tag(displacement))


def _as_planned(finger: ToolFile, params: SimulatedFingerParams) -> tuple[WorkSurface, Nominal]:
    """Return the work surface, and the nominal values with the CAD's seam in the plane."""
    workpiece = load_workpiece(params.workpiece)
    if params.seam not in workpiece.seams:
        known = ", ".join(workpiece.seams)
        raise StageError(f"{params.workpiece}: has no seam '{params.seam}'; it has: {known}")
    seam = workpiece.seams[params.seam]
    pose = params.base_T_part
    points = seam.points @ pose[:3, :3].T + pose[:3, 3]
    openings = seam.openings @ pose[:3, :3].T
    if params.leg is not None:
        corners = [corner.point for corner in corners_of(flattened(points, openings))]
        bounds = [0, *corners, len(points) - 1]
        kept = slice(bounds[params.leg - 1], bounds[params.leg] + 1)
        points, openings = points[kept], openings[kept]
    surface = WorkSurface(points, openings)
    tip = Tip(finger.radius, finger.lateral, finger.axial)
    section = _section(seam, params)
    return surface, Nominal(surface.path, section, tip, finger.torch_from_tip, np.eye(3))


def _section(seam: CadSeam, params: SimulatedFingerParams) -> GrooveSection:
    if params.plate is not None:
        return GrooveSection(np.pi / 4, params.plate, -np.pi / 4)
    if seam.half_angle is None or seam.half_width is None:
        raise StageError(
            f"{params.workpiece}: seam '{params.seam}' needs half_angle and half_width to be felt"
        )
    return GrooveSection(seam.half_angle, seam.half_width / float(np.tan(seam.half_angle)))


@part("sensor.simulated_finger")
def sensor_simulated_finger(
    finger: Finger, robot: StateSource, seed: Seed, params: SimulatedFingerParams
) -> TactileSensor:
    """A simulated compliant finger in a groove, on the recipe's arm.

    Args:
        finger: The finger as configured for the controller; the simulation does not use it.
        robot: The arm that carries the finger.
        seed: Seed of the noise and of the world's random values.
        params: Parameters of the true world.
    """
    del finger
    return SimulatedFinger(robot, seed, params, read_model(params.world, WeldTruth))


@dataclass(frozen=True, eq=False)
class Compliance:
    """True relation between the motions of tip and tag; known to the simulation only.

    Attributes:
        share: (3,) displacement of the tag per displacement of the tip, in the tool's axes.
        tilt: Tilt of the tag per lateral displacement of the tip [rad/m].
        stiffening: Relative loss of ``share`` at a displacement of 2 mm.
        camera_R_tool: (3, 3) rotation from tool axes to the camera.
        rest: (3,) position of the undeformed tag in the camera [m].
        rotation: (3,) rotation vector of the undeformed tag in the camera [rad].
    """

    share: Floats
    tilt: float
    stiffening: float
    camera_R_tool: Floats
    rest: Floats
    rotation: Floats

    def tag(self, displacement: Floats) -> tuple[Floats, Floats]:
        """Return the tag's rotation (3, 3) and translation (3,) for a tip displacement (3,) [m]."""
        size = float(np.linalg.norm(displacement)) / 2e-3
        moved = self.share * displacement * (1.0 - self.stiffening * size**2)
        lean = self.tilt * np.array([-displacement[1], displacement[0], 0.0])
        rotation = rotation_exp(self.camera_R_tool @ lean) @ rotation_exp(self.rotation)
        return rotation, self.rest + self.camera_R_tool @ moved


def typical_compliance() -> Compliance:
    """Return a soft finger's compliance: the tag above the tip follows in part and tilts."""
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

    # What is behind the tag [grey levels].
    background: ClassVar[float] = 90.0

    # To a module of the texture.
    texels: ClassVar[int] = 40

    # Of the printed tag with its white margin: six of a 4x4 tag, and one on each side.
    modules: ClassVar[int] = 8

    # Standard deviations of the blur [px] and of the noise, and brightness of a reflection that
    # moves over the image [grey levels].
    blur: ClassVar[float] = 0.7
    noise: ClassVar[float] = 3.0
    glare: ClassVar[float] = 60.0

    def __init__(self, finger: FingerGeometry, rng: np.random.Generator) -> None:
        """Prepare the tag's print; every image takes its noise from ``rng``."""
        import cv2

        self._lens, self._rng = finger.camera, rng
        marker = cv2.aruco.generateImageMarker(
            dictionary_of(finger), finger.tag.id, 6 * self.texels
        )
        paper = np.full(
            (self.modules * self.texels, self.modules * self.texels), 230, dtype=np.uint8
        )
        paper[self.texels : -self.texels, self.texels : -self.texels] = np.where(
            marker > 0, 230, 25
        )
        self._paper = paper
        self._texel = finger.tag.side / (6 * self.texels)
        self._grain = rng.standard_normal(
            (2 * finger.camera.height, 2 * finger.camera.width), np.float32
        )
        self._grain *= self.noise
        # Made once: to come by the memory takes longer than to fill it.
        shape = finger.camera.height, finger.camera.width
        self._grey, self._light = np.empty(shape, np.float32), np.empty(shape, np.float32)
        self._glare = np.empty(shape)
        self._clock = 0.0

    def image(self, rotation: Floats, translation: Floats) -> Image:
        """Return the image of the tag at a rotation (3, 3) and translation (3,) [m]."""
        lens = self._lens
        onto = lens.matrix @ np.column_stack([rotation[:, 0], rotation[:, 1], translation])
        seen = np.full((lens.height, lens.width), self.background, dtype=np.uint8)
        sheet = onto @ self._sheet()
        x, y = self._extent(sheet, self.modules * self.texels)
        if x.stop > x.start and y.stop > y.start:
            seen[y, x] = self._warped(sheet, x, y)
        return Image(self._spoilt(seen), lens.matrix, np.array(lens.distortion))

    def _extent(self, sheet: Floats, size: int) -> tuple[slice, slice]:
        """Return the columns and rows of the image that can show the paper."""
        rim = np.array([[0, 0, 1], [size, 0, 1], [size, size, 1], [0, size, 1]]) - [0.5, 0.5, 0.0]
        ends = rim @ sheet.T
        if (ends[:, 2] <= 0).any():  # partly behind the camera: its corners cannot be projected
            return slice(0, self._lens.width), slice(0, self._lens.height)
        across = ends[:, :2] / ends[:, 2:]
        low = np.clip(np.floor(across.min(axis=0)) - 1, 0, None).astype(int)
        high = np.ceil(across.max(axis=0)).astype(int) + 2
        width, height = self._lens.width, self._lens.height
        return slice(int(low[0]), min(int(high[0]), width)), slice(
            int(low[1]), min(int(high[1]), height)
        )

    def _warped(self, sheet: Floats, x: slice, y: slice) -> NDArray[np.uint8]:
        """Return the printed sheet in a window of the image, with four samples per pixel."""
        import cv2

        k = 2
        moved = np.array([[1.0, 0.0, -x.start], [0.0, 1.0, -y.start], [0.0, 0.0, 1.0]])
        fine = np.diag([k, k, 1.0]) @ _half_pixel(k) @ moved @ sheet
        width, height = x.stop - x.start, y.stop - y.start
        seen = cv2.warpPerspective(
            self._paper, fine, (width * k, height * k), flags=cv2.INTER_LINEAR,
            borderValue=self.background,
        )  # fmt: skip
        small = cv2.resize(seen, (width, height), interpolation=cv2.INTER_AREA)
        return np.asarray(small, dtype=np.uint8)

    def _sheet(self) -> Floats:
        """Return the homography (3, 3) from texture pixels to the tag's plane (y upwards)."""
        middle = self.modules * self.texels / 2 - 0.5
        u = self._texel
        return np.array([[u, 0.0, -u * middle], [0.0, -u, u * middle], [0.0, 0.0, 1.0]])

    def _spoilt(self, seen: NDArray[np.uint8]) -> NDArray[np.uint8]:
        import cv2

        grey, light = self._grey, self._light
        np.copyto(grey, cv2.GaussianBlur(seen, (0, 0), self.blur))
        np.copyto(light, self._reflection(seen.shape), casting="same_kind")
        light += self._noise(seen.shape)
        grey += light
        np.rint(grey, out=grey)
        np.clip(grey, 0, 255, out=grey)
        return grey.astype(np.uint8)

    def _noise(self, shape: tuple[int, ...]) -> NDArray[np.float32]:
        """Return noise: a random crop of a larger field, which is faster than new noise."""
        row, column = (int(self._rng.integers(0, size)) for size in shape)
        return np.asarray(self._grain[row : row + shape[0], column : column + shape[1]])

    def _reflection(self, shape: tuple[int, ...]) -> Floats:
        """Return a soft bright spot that moves over the image."""
        self._clock += 1.0
        height, width = shape
        x = width * (0.5 + 0.45 * np.sin(0.031 * self._clock))
        y = height * (0.5 + 0.45 * np.sin(0.047 * self._clock + 1.0))
        across = np.exp(-(((np.arange(width) - x) / (0.12 * width)) ** 2))
        down = np.exp(-(((np.arange(height) - y) / (0.12 * height)) ** 2))
        np.outer(down, across, out=self._glare)
        self._glare *= self.glare
        return self._glare


def _half_pixel(factor: int) -> Floats:
    """Return the (3, 3) map of pixel centres to those of an image ``factor`` times as fine."""
    shift = (factor - 1) / (2 * factor)
    return np.array([[1.0, 0.0, shift], [0.0, 1.0, shift], [0.0, 0.0, 1.0]])
