"""A simulated finger: its tip in the groove of a workpiece, its camera rendering real images."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from flangeye.devices import DeviceError, SensorFrame, StateSource, TactileSensor
from flangeye.errors import StageError
from flangeye.geometry import rigid, rotation_from_rpy
from flangeye.stage import Params, part
from flangeye.types import Image, Seed
from flangeye.units import Angle, Duration, Length, param
from flangeye.workpiece import CadSeam, WorkpiecePath, load_workpiece
from flangeye_plugins.welding.finger import Finger
from flangeye_plugins.welding.frame import Tool, WorkPlane
from flangeye_plugins.welding.motion import turned
from flangeye_plugins.welding.path import Path
from flangeye_plugins.welding.simulated.groove import Contact, Gap, Groove, Section, Tip
from flangeye_plugins.welding.simulated.render import FingerCamera, Optics, typical_compliance

Floats = NDArray[np.float64]


class GapParams(Params):
    """A piece of a wall that is missing."""

    start: Length = param(ge=0, description="Where it begins, along the seam.")
    length: Length = param("20 mm", gt=0)
    side: int = Field(1, ge=-1, le=1, description="1 the left wall, -1 the right one.")


class SimulatedFingerParams(Params):
    """Parameters of ``sensor.simulated_finger``."""

    workpiece: WorkpiecePath = param(
        "v-straight", description="One of data/workpieces, or a .yaml file of one's own."
    )
    seam: str = Field("groove", description="Name of the seam in that file.")
    position: tuple[Length, Length, Length] = param(
        ("600 mm", "0 mm", "250 mm"), description="Of the origin of its CAD, in base."
    )
    rpy: tuple[Angle, Angle, Angle] = param(
        ("0 deg", "0 deg", "20 deg"), description="Roll, pitch, yaw of its CAD, in base."
    )
    gaps: tuple[GapParams, ...] = Field((), description="Pieces of a wall that are missing.")
    rate: float = Field(30.0, gt=0, le=200, description="Images per second.")
    latency: Duration = param("30 ms", ge=0, description="From the exposure to the image.")
    jitter: Duration = param("5 ms", ge=0, description="Standard deviation of the latency.")
    dropped: float = Field(0.02, ge=0, lt=1, description="Share of images that never arrive.")
    noise: float = Field(3.0, ge=0, description="Of the image, standard deviation [grey levels].")
    blur: float = Field(0.7, gt=0, description="Of the image, standard deviation [px].")
    glare: float = Field(60.0, ge=0, description="Of a wandering reflection [grey levels].")
    held: bool = Field(
        False, description="The tip is held where it is first, as in a punch mark: to calibrate."
    )
    hidden: tuple[Duration, Duration] | None = param(
        None, description="The tag is out of sight from the first time to the second."
    )
    fails: Duration | None = param(None, description="When the camera is lost.")


@dataclass(frozen=True, eq=False)
class Exposure:
    """An image that is under way.

    Attributes:
        time_ns: When it was taken.
        arrives_ns: When it can be had.
        displacement: (3,) of the tip then, in the tool's axes [m].
    """

    time_ns: int
    arrives_ns: int
    displacement: Floats


class SimulatedFinger:
    """A finger on an arm, over a workpiece.

    Attributes:
        name: For people.
        camera_matrix: (3, 3) [px].
        distortion: (k,) OpenCV's coefficients.
        contact: The tip in the groove. For tests; a stage must not look.
        tool: Where the tool is in the plane of the groove. For tests.
    """

    def __init__(
        self, finger: Finger, robot: StateSource, seed: Seed, params: SimulatedFingerParams
    ) -> None:
        """Lay the workpiece down and mount the finger."""
        self.name = f"simulated finger {finger.model}"
        self.camera_matrix, self.distortion = finger.camera.matrix, np.array([])
        plane, groove = _true_groove(params)
        self.contact = Contact(groove, Tip(radius=finger.radius))
        self.tool = Tool(finger, plane)
        self._robot, self._params = robot, params
        self._rng = np.random.default_rng([seed, 11])
        optics = Optics(params.blur, params.noise, params.glare)
        self._camera = FingerCamera(finger, optics, self._rng)
        self._compliance = typical_compliance()
        self._under_way: deque[Exposure] = deque()
        self._started: int | None = None
        self._exposures = 0
        self._mark: Floats | None = None

    def frame(self) -> SensorFrame | None:
        """Let the tip settle where the arm now is, and return an image that has arrived, if any.

        Raises:
            DeviceError: The camera is lost.
        """
        state = self._robot.state()
        now = state.time_ns
        self._started = now if self._started is None else self._started
        age = (now - self._started) * 1e-9
        if self._params.fails is not None and age >= self._params.fails:
            raise DeviceError(f"{self.name}: the camera is lost")
        pose = self.tool.pose(state.base_T_flange, now * 1e-9)
        tip = self._tip(pose.position)
        if age * self._params.rate >= self._exposures:
            self._exposures += 1
            self._expose(now, age, turned(tip - pose.position, -pose.angle))
        if not self._under_way or self._under_way[0].arrives_ns > now:
            return None
        exposure = self._under_way.popleft()
        return SensorFrame(self._image(exposure), exposure.time_ns)

    def close(self) -> None:
        """Nothing to let go of."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _tip(self, rest: Floats) -> Floats:
        """Return where the tip is (3,), when undeformed it would be at ``rest`` (3,)."""
        if not self._params.held:
            return self.contact.settle(rest)
        self._mark = rest if self._mark is None else self._mark
        return self._mark

    def _expose(self, now: int, age: float, displacement: Floats) -> None:
        params = self._params
        late = max(0.0, params.latency + params.jitter * float(self._rng.standard_normal()))
        if self._rng.uniform() < params.dropped:
            return
        hidden = params.hidden is not None and params.hidden[0] <= age < params.hidden[1]
        # A tag that something covers: it is as if it were far out of the image.
        displacement = displacement + (np.array([1.0, 0.0, 0.0]) if hidden else 0.0)
        self._under_way.append(Exposure(now, now + round(late * 1e9), displacement))

    def _image(self, exposure: Exposure) -> Image:
        return self._camera.image(*self._compliance.tag(exposure.displacement))


def _true_groove(params: SimulatedFingerParams) -> tuple[WorkPlane, Groove]:
    workpiece = load_workpiece(params.workpiece)
    if params.seam not in workpiece.seams:
        known = ", ".join(workpiece.seams)
        raise StageError(f"{params.workpiece}: has no seam '{params.seam}'; it has: {known}")
    seam = workpiece.seams[params.seam]
    pose = rigid(rotation_from_rpy(*params.rpy), np.asarray(params.position))
    points = seam.points @ pose[:3, :3].T + pose[:3, 3]
    openings = np.tile(pose[:3, :3] @ seam.opening, (len(points), 1))
    plane = WorkPlane(points, openings)
    gaps = tuple(Gap(gap.start, gap.start + gap.length, gap.side) for gap in params.gaps)
    return plane, Groove(Path(plane.points(points)), _section(seam, params), gaps)


def _section(seam: CadSeam, params: SimulatedFingerParams) -> Section:
    if seam.half_angle is None or seam.half_width is None:
        raise StageError(
            f"{params.workpiece}: seam '{params.seam}' needs half_angle and half_width to be felt"
        )
    return Section(seam.half_angle, seam.half_width / float(np.tan(seam.half_angle)))


@part("sensor.simulated_finger")
def sensor_simulated_finger(
    finger: Finger, robot: StateSource, seed: Seed, params: SimulatedFingerParams
) -> TactileSensor:
    """A compliant finger in a groove, simulated, on whatever arm the recipe drives."""
    return SimulatedFinger(finger, robot, seed, params)
