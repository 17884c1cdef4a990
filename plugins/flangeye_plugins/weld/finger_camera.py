"""Turns the finger's images into measurements of the tip, beside the control loop."""

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
    """One image and its measurement.

    Attributes:
        time_ns: Middle of its exposure.
        piece: The part of it that was read.
        feeling: None where there is no tag in it, or none to be trusted.
    """

    time_ns: int
    piece: ImageRegion
    feeling: TipDisplacement | None


class FingerReader:
    """From an image to a feeling."""

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
        """Return the measurement in a logged crop of an image."""
        return self._observation(piece, time_ns, self._detector.find(piece.image))

    def _observation(
        self, piece: ImageRegion, time_ns: int, reading: TagReading | None
    ) -> TagObservation:
        # Corners that are off by more than 0.7 px are those of no square.
        if reading is None or reading.confidence < 0.3:
            return TagObservation(time_ns, piece, None)
        return TagObservation(time_ns, piece, self._interpreter.feel(reading, time_ns))


class LatestState:
    """The newest sample of the arm, for a sensor that asks for it."""

    def __init__(self, state: RobotState) -> None:
        self._state = state

    def state(self) -> RobotState:
        """Return the newest sample that the loop has taken."""
        return self._state

    def tell(self, state: RobotState) -> None:
        """Take a sample."""
        self._state = state


class CameraJob(NamedTuple):
    """Opens a finger's camera, in this process or another.

    Attributes:
        sensor: Opens it, given finger, arm and seed.
        finger: The finger, calibrated.
        state: Current state of the arm.
        seed: For what is simulated.
        look: Opens a profile sensor behind the torch, if there is one.
    """

    sensor: BoundPart
    finger: Finger
    state: RobotState
    seed: Seed
    look: BoundPart | None = None

    def camera(self, robot: StateSource) -> TactileSensor:
        """Open the camera, which may ask ``robot`` where it is."""
        sensor: TactileSensor = self.sensor(self.finger, robot, self.seed)
        return sensor

    def profiler(self, robot: StateSource, camera: TactileSensor) -> Profiler | None:
        """Open the profiler behind the torch, if there is one, beside the open camera."""
        return None if self.look is None else self.look(robot, camera, self.seed)


class FingerCameraReader(Protocol):
    """Gives all measurements since the last cycle, oldest first."""

    @property
    def behind(self) -> float | None:
        """Distance of the profile behind the torch [m]; None without a profiler."""

    def looks(self) -> list[WeldProfile]:
        """Return new profiles of the bead; never waits.

        Raises:
            DeviceError: The profile sensor is lost.
        """

    def seen(self) -> list[TagObservation]:
        """Return new sights; never waits.

        Raises:
            DeviceError: The camera is lost.
        """

    def tell(self, state: RobotState) -> None:
        """Take the arm's newest sample, for a sensor that asks for it; never waits."""

    def true_torch(self) -> tuple[Floats, Floats] | None:
        """Return the true path of a simulated torch after the weld; else None."""

    def __enter__(self) -> Self: ...

    def __exit__(self, *_: object) -> None: ...


class SteppedReader:
    """Reads in the loop itself: in simulated time nothing is late by being computed."""

    def __init__(self, job: CameraJob) -> None:
        """Open the camera.

        Raises:
            StageError: It cannot be opened.
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
        """Take the arm's newest sample."""
        self._latest.tell(state)

    def true_torch(self) -> tuple[Floats, Floats] | None:
        """Return where a simulated torch really was, or None."""
        return torch_of(self._sensor)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if self._look is not None:
            self._look.close()
        self._sensor.close()


def torch_of(sensor: TactileSensor) -> tuple[Floats, Floats] | None:
    """Return where the torch of a simulated sensor really was; of any other, None."""
    return sensor.true_torch() if isinstance(sensor, KnowsTorch) else None
