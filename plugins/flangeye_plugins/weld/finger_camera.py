"""Converts the finger's images into measurements of the tip, in the control loop or beside it."""

from __future__ import annotations

from typing import NamedTuple, Self

from flangeye.devices import (
    KnowsTorch,
    Profiler,
    RobotState,
    SensorFrame,
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
        profiler: Opens a profile sensor behind the torch, if there is one.
    """

    sensor: BoundPart
    finger: Finger
    state: RobotState
    seed: Seed
    profiler: BoundPart | None = None


class SteppedReader:
    """Reads camera and profile sensor where it is called: in simulated time that causes no delay.

    Attributes:
        sensor: The camera.
        profiler: The profile sensor behind the torch; None without one.
    """

    def __init__(self, job: CameraJob) -> None:
        """Open the camera, then the profile sensor.

        Raises:
            StageError: One of them cannot be opened.
        """
        self._latest = LatestState(job.state)
        self._reader = FingerReader(job.finger)
        self.sensor: TactileSensor = job.sensor(job.finger, self._latest, job.seed)
        self.profiler: Profiler | None = None
        try:
            if job.profiler is not None:
                self.profiler = job.profiler(self._latest, self.sensor, job.seed)
        except BaseException:
            self.sensor.close()
            raise

    @property
    def behind(self) -> float | None:
        """Distance of the profile behind the torch [m]; None without a profile sensor."""
        return None if self.profiler is None else self.profiler.behind

    def profiles(self) -> list[WeldProfile]:
        """Return new profiles; raise DeviceError if the sensor is lost."""
        profile = None if self.profiler is None else self.profiler.profile()
        return [] if profile is None else [profile]

    def seen(self) -> list[TagObservation]:
        """Return new measurements; raise DeviceError if the camera is lost."""
        frame = self.sensor.frame()
        return [] if frame is None else [self._reader.read(frame)]

    def tell(self, state: RobotState) -> None:
        """Store the arm's newest state, for a simulated sensor."""
        self._latest.tell(state)

    def true_torch(self) -> tuple[Floats, Floats] | None:
        """Return a simulated torch's true path: times [s] and positions; None for a real one."""
        return self.sensor.true_torch() if isinstance(self.sensor, KnowsTorch) else None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        try:
            if self.profiler is not None:
                self.profiler.close()
        finally:
            self.sensor.close()
