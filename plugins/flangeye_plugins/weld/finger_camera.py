"""Converts the finger's images into measurements of the tip, in the control loop or beside it."""

from __future__ import annotations

from typing import NamedTuple, Protocol, Self

from flangeye.devices import (
    KnowsTorch,
    Profiler,
    RobotState,
    SensorFrame,
    StateSource,
    TactileSensor,
    WeldProfile,
)
from flangeye.models.finger import Finger
from flangeye.plugin.stage import BoundPart
from flangeye.types import Floats, Seed
from flangeye_plugins.weld.touch.tag_observation import (
    ImageRegion,
    RegionOfInterest,
    TagDetector,
    TagReading,
)
from flangeye_plugins.weld.touch.tip_displacement import Interpreter, TipDisplacement


class TagObservation(NamedTuple):
    """One image of the finger and the tip displacement measured in it.

    Attributes:
        time_ns: Middle of its exposure.
        piece: The crop of the image that was read.
        feeling: The displacement; None if no tag was found or the detection is unreliable.
    """

    time_ns: int
    piece: ImageRegion
    feeling: TipDisplacement | None


class FingerReader:
    """Measures the tip's displacement in images."""

    def __init__(self, finger: Finger) -> None:
        """Prepare for a calibrated finger; see :class:`Interpreter`."""
        import cv2

        # The images are small: OpenCV's threads cost more than they bring, and disturb the loop.
        cv2.setNumThreads(1)
        self._detector, self._interpreter = TagDetector(finger), Interpreter(finger)
        self._region = RegionOfInterest()

    def read(self, frame: SensorFrame) -> TagObservation:
        """Return the measurement in an image."""
        for piece in self._region.pieces(frame.image):
            reading = self._detector.find(piece.image)
            if reading is not None:
                break
        self._region.follow(piece, None if reading is None else reading.corners)
        return self._observation(piece, frame.time_ns, reading)

    def reread(self, piece: ImageRegion, time_ns: int) -> TagObservation:
        """Return the measurement from a logged crop of an image."""
        return self._observation(piece, time_ns, self._detector.find(piece.image))

    def _observation(
        self, piece: ImageRegion, time_ns: int, reading: TagReading | None
    ) -> TagObservation:
        # Corners that are off by more than 0.7 px are those of no square.
        if reading is None or reading.confidence < 0.3:
            return TagObservation(time_ns, piece, None)
        return TagObservation(time_ns, piece, self._interpreter.feel(reading, time_ns))


class LatestState:
    """Holds the arm's newest state, for a simulated sensor that needs it."""

    def __init__(self, state: RobotState) -> None:
        self._state = state

    def state(self) -> RobotState:
        """Return the newest state that was stored."""
        return self._state

    def tell(self, state: RobotState) -> None:
        """Store a new state."""
        self._state = state


class CameraJob(NamedTuple):
    """All that is needed to open a finger's camera, in this process or another.

    Attributes:
        sensor: Opens the camera, given finger, arm and seed.
        finger: The finger, calibrated.
        state: Current state of the arm.
        seed: Seed of a simulated sensor.
        look: Opens a profile sensor behind the torch, if there is one.
    """

    sensor: BoundPart
    finger: Finger
    state: RobotState
    seed: Seed
    look: BoundPart | None = None

    def camera(self, robot: StateSource) -> TactileSensor:
        """Open the camera; a simulated one reads the arm's pose from ``robot``."""
        sensor: TactileSensor = self.sensor(self.finger, robot, self.seed)
        return sensor

    def profiler(self, robot: StateSource, camera: TactileSensor) -> Profiler | None:
        """Open the profile sensor behind the torch; return None if there is none."""
        return None if self.look is None else self.look(robot, camera, self.seed)


class FingerCameraReader(Protocol):
    """Interface: gives all measurements since the last cycle, oldest first."""

    @property
    def behind(self) -> float | None:
        """Distance of the profile behind the torch [m]; None without a profiler."""

    def looks(self) -> list[WeldProfile]:
        """Return new profiles of the bead; never waits.

        Raises:
            DeviceError: The profile sensor is lost.
        """

    def seen(self) -> list[TagObservation]:
        """Return new measurements; never waits.

        Raises:
            DeviceError: The camera is lost.
        """

    def tell(self, state: RobotState) -> None:
        """Store the arm's newest state, for a simulated sensor; never waits."""

    def true_torch(self) -> tuple[Floats, Floats] | None:
        """Return the true path of a simulated torch after the weld; else None."""

    def __enter__(self) -> Self: ...

    def __exit__(self, *_: object) -> None: ...


class SteppedReader:
    """Reads the camera within the control loop: in simulated time computing causes no delay."""

    def __init__(self, job: CameraJob) -> None:
        """Open the camera.

        Raises:
            StageError: The camera cannot be opened.
        """
        self._latest = LatestState(job.state)
        self._reader, self._sensor = FingerReader(job.finger), job.camera(self._latest)
        try:
            self._look = job.profiler(self._latest, self._sensor)
        except BaseException:
            self._sensor.close()
            raise

    @property
    def behind(self) -> float | None:
        """Distance of the profile behind the torch [m]; None without a profiler."""
        return None if self._look is None else self._look.behind

    def looks(self) -> list[WeldProfile]:
        """Return new profiles; raise DeviceError if the sensor is lost."""
        profile = None if self._look is None else self._look.profile()
        return [] if profile is None else [profile]

    def seen(self) -> list[TagObservation]:
        """Return new measurements; raise DeviceError if the camera is lost."""
        frame = self._sensor.frame()
        return [] if frame is None else [self._reader.read(frame)]

    def tell(self, state: RobotState) -> None:
        """Store the arm's newest state."""
        self._latest.tell(state)

    def true_torch(self) -> tuple[Floats, Floats] | None:
        """Return the true path of a simulated torch; None for a real one."""
        return torch_of(self._sensor)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if self._look is not None:
            self._look.close()
        self._sensor.close()


def torch_of(sensor: TactileSensor) -> tuple[Floats, Floats] | None:
    """Return the true path of a simulated sensor's torch: times [s] and positions; else None."""
    return sensor.true_torch() if isinstance(sensor, KnowsTorch) else None
