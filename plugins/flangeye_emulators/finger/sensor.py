"""A simulated finger: its tip in the groove of a workpiece, its camera rendering real images."""

from __future__ import annotations

import numpy as np
from pydantic import Field

from flangeye.devices import Device, DeviceError, SensorFrame, StateSource, TactileSensor
from flangeye.errors import StageError
from flangeye.maths.geometry import rigid, rotation_from_rpy
from flangeye.models.finger import Finger
from flangeye.models.model import read_model
from flangeye.models.workpiece import CadSeam, WorkpiecePath, load_workpiece
from flangeye.motion.seam_following import ToolPose
from flangeye.plugin.stage import Params, part
from flangeye.types import Floats, Image, Seed, Transform
from flangeye.units import Angle, Duration, Length, param
from flangeye_emulators.finger.render import FingerCamera, Optics, typical_compliance
from flangeye_emulators.weld_world.clock import Shutter
from flangeye_emulators.weld_world.groove import Section, Tip
from flangeye_emulators.weld_world.settings import GapParams, ToolFile, ToolPath, WorldParams
from flangeye_emulators.weld_world.world import Nominal, WeldWorld
from flangeye_emulators.world import room
from flangeye_plugins.weld.corners import corners_of
from flangeye_plugins.weld.frame import Tool, WorkPlane
from flangeye_plugins.weld.path import Path


class SectionParams(Params):
    """A joint's cross-section, as it really is."""

    left: Angle = param(ge=0, le=np.pi / 2, description="The left wall, from the opening.")
    right: Angle = param(ge=0, le=np.pi / 2, description="The right wall, from the opening.")
    depth: Length = param(gt=0, description="From the walls' upper edge to the root.")


class SimulatedFingerParams(Params):
    """Parameters of ``sensor.simulated_finger``: the world, whatever the controller's files say."""

    tool: ToolPath = param(
        "srm", description="The true finger and torch: one of data/worlds, or a .yaml file."
    )
    workpiece: WorkpiecePath = param(
        "v-straight", description="One of data/workpieces, or a .yaml file of one's own."
    )
    seam: str = Field("groove", description="Name of the seam in that file.")
    position: tuple[Length, Length, Length] = param(
        ("600 mm", "0 mm", "250 mm"),
        description="Position of the workpiece's CAD origin in the base.",
    )
    rpy: tuple[Angle, Angle, Angle] = param(
        ("0 deg", "0 deg", "20 deg"), description="Roll, pitch, yaw of its CAD, in base."
    )
    leg: int | None = Field(None, ge=1, description="Leg of a seam with sharp corners.")
    section: SectionParams | None = Field(
        None, description="The joint's true cross-section, where it is not the file's groove."
    )
    gaps: tuple[GapParams, ...] = Field((), description="Pieces of a wall that are missing.")
    rate: float = Field(30.0, gt=0, le=200, description="Images per second.")
    latency: Duration = param("30 ms", ge=0, description="Time from the exposure to the image.")
    jitter: Duration = param("5 ms", ge=0, description="Standard deviation of the latency.")
    dropped: float = Field(0.02, ge=0, lt=1, description="Share of images that never arrive.")
    noise: float = Field(
        3.0, ge=0, description="Noise of the image, standard deviation [grey levels]."
    )
    blur: float = Field(0.7, gt=0, description="Blur of the image, standard deviation [px].")
    glare: float = Field(
        60.0, ge=0, description="Brightness of a wandering reflection [grey levels]."
    )
    world: WorldParams = Field(
        default_factory=WorldParams,
        description="What is true and differs from the files: arm, tool, finger, clock, workpiece, "
        "heat.",
    )
    held: bool = Field(
        False, description="The tip is held where it is first, as in a punch mark: to calibrate."
    )
    hidden: tuple[Duration, Duration] | None = param(
        None, description="The tag is out of sight from the first time to the second."
    )
    fails: Duration | None = param(None, description="When the camera is lost.")


class SimulatedFinger(Device):
    """A finger on an arm, over a workpiece, in a world of its own.

    Attributes:
        name: For people.
        camera_matrix: (3, 3) [px].
        distortion: (k,) OpenCV's coefficients.
        world: What is true. A stage must not look.
        tool: Where the tool truly is in the plane of the groove. A stage must not look.
    """

    def __init__(self, robot: StateSource, seed: Seed, params: SimulatedFingerParams) -> None:
        """Lay the workpiece down and mount the true finger."""
        finger = read_model(params.tool, ToolFile)
        self.name = f"simulated finger {finger.model}"
        self.camera_matrix, self.distortion = finger.camera.matrix, np.array([])
        self._plane, nominal = _as_planned(finger, params)
        truth = _truth(params)
        self.world, self._planned = WeldWorld(nominal, truth, [seed, 12]), Path(nominal.seam)
        self.tool = Tool(finger, self._plane)
        self._robot, self._params = robot, params
        self._rng = np.random.default_rng([seed, 11])
        optics = Optics(params.blur, params.noise, params.glare)
        self._camera = FingerCamera(finger, optics, self._rng)
        self._compliance = typical_compliance()
        self._shutter: Shutter[Floats] = Shutter(truth.clock, self._rng)
        self._started: int | None = None
        self._mark: Floats | None = None
        self._torch: list[tuple[float, Floats]] = []

    def frame(self) -> SensorFrame | None:
        """Let the tip settle where the arm now is, and return an image that has arrived, if any.

        Raises:
            DeviceError: The camera is lost.
        """
        state = self._robot.state()
        now = state.time_ns * 1e-9
        self._started = state.time_ns if self._started is None else self._started
        age = (state.time_ns - self._started) * 1e-9
        if self._params.fails is not None and age >= self._params.fails:
            raise DeviceError(f"{self.name}: the camera is lost")
        pose = self.tool.pose(room.true_flange(state), now)
        shown = self._shown(pose, room.true_flange(state))
        self._torch.append((now, self._beside_plan()))
        if self._shutter.due(age):
            # A tag that something covers: it is as if it were far out of the image.
            hidden = self._shutter.hidden(age)
            self._shutter.expose(now, age, shown + (np.array([1.0, 0, 0]) if hidden else 0.0))
        seen = self._shutter.arrived(now)
        return (
            None if seen is None else SensorFrame(self._image(seen.item), round(seen.stamp * 1e9))
        )

    def true_torch(self) -> tuple[Floats, Floats]:
        """Return times (K,) [s] and where the torch really was then (K, 3), in base [m].

        It lies beside the planned seam as it lay beside the true one, which wanders and which heat
        moves: what scores it knows the planned one.
        """
        known = list(self._torch)  # in one go: a thread that reads images may add to it
        times = np.array([time for time, _ in known])
        torch = np.array([place for _, place in known]).reshape(-1, 3)
        return times, self._plane.base_T_plane.apply(torch)

    def _beside_plan(self) -> Floats:
        """Return the torch (3,) less what the true seam is off the planned one beside it [m]."""
        world = self.world
        true = world.groove.root.at(world.torch_s)
        across = float((world.torch[:2] - true.point) @ true.normal)
        seam = true.point + (across - world.off) * true.normal  # heat has moved it there
        planned = self._planned.at(self._planned.foot(seam, world.torch_s))
        off = np.array([*(seam - planned.point), true.height - planned.height])
        return np.asarray(world.torch - off)

    def close(self) -> None:
        """Nothing to let go of."""

    def _shown(self, pose: ToolPose, base_T_flange: Transform) -> Floats:
        """Return what the tag shows of the tip's displacement (3,), along the tool's axes."""
        if not self._params.held:
            return self.world.settle(pose, self._stands(pose, base_T_flange))
        axes, tip = self.world.held(pose, self._stands(pose, base_T_flange))
        self._mark = tip if self._mark is None else self._mark
        return np.asarray(axes.T @ (self._mark - tip))

    def _stands(self, pose: ToolPose, base_T_flange: Transform) -> Floats:
        """Return how the tool stands (3, 3): its axes, turned back by its heading."""
        axes = self._plane.base_T_plane.rotation.T @ self.tool.base_R_tool(base_T_flange)
        return np.asarray(rotation_from_rpy(0.0, 0.0, -pose.angle) @ axes)

    def _image(self, displacement: Floats) -> Image:
        return self._camera.image(*self._compliance.tag(displacement))


def _truth(params: SimulatedFingerParams) -> WorldParams:
    """Return the world with the clock and workpiece of the sensor's parameters."""
    own = {
        name: getattr(params, name) for name in ("rate", "latency", "jitter", "dropped", "hidden")
    }
    world = params.world
    gaps = (*params.gaps, *world.workpiece.gaps)
    return world.model_copy(
        update={
            "clock": world.clock.model_copy(update=own),
            "workpiece": world.workpiece.model_copy(update={"gaps": gaps}),
        }
    )


def _as_planned(finger: ToolFile, params: SimulatedFingerParams) -> tuple[WorkPlane, Nominal]:
    """Return the plane of the work, and the seam as its CAD has it."""
    workpiece = load_workpiece(params.workpiece)
    if params.seam not in workpiece.seams:
        known = ", ".join(workpiece.seams)
        raise StageError(f"{params.workpiece}: has no seam '{params.seam}'; it has: {known}")
    seam = workpiece.seams[params.seam]
    pose = rigid(rotation_from_rpy(*params.rpy), np.asarray(params.position))
    points = seam.points @ pose[:3, :3].T + pose[:3, 3]
    openings = np.tile(pose[:3, :3] @ seam.opening, (len(points), 1))
    plane = WorkPlane(points, openings)
    if params.leg is not None:
        corners = [corner.point for corner in corners_of(plane.points(points))]
        bounds = [0, *corners, len(points) - 1]
        kept = slice(bounds[params.leg - 1], bounds[params.leg] + 1)
        points = points[kept]
        plane = WorkPlane(points, openings[kept])
    tip = Tip(finger.radius, finger.lateral, finger.axial)
    return plane, Nominal(
        plane.points(points), _section(seam, params), tip, finger.torch_from_tip, np.eye(3)
    )


def _section(seam: CadSeam, params: SimulatedFingerParams) -> Section:
    if (told := params.section) is not None:
        return Section((told.left + told.right) / 2, told.depth, (told.left - told.right) / 2)
    if seam.half_angle is None or seam.half_width is None:
        raise StageError(
            f"{params.workpiece}: seam '{params.seam}' needs half_angle and half_width to be felt"
        )
    return Section(seam.half_angle, seam.half_width / float(np.tan(seam.half_angle)))


@part("sensor.simulated_finger")
def sensor_simulated_finger(
    finger: Finger, robot: StateSource, seed: Seed, params: SimulatedFingerParams
) -> TactileSensor:
    """A compliant finger in a groove, simulated, on whatever arm the recipe drives.

    Args:
        finger: What the controller knows of it: nothing here depends on it.
        robot: Carries it.
        seed: Of noise and of the world's own chance.
        params: The world.
    """
    del finger
    return SimulatedFinger(robot, seed, params)
