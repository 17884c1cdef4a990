"""Reading the finger beside the control loop: images in, feelings out."""

from __future__ import annotations

import queue
import threading
from typing import Any, NamedTuple, Protocol, Self

from flangeye.devices import DeviceError, RobotState, SensorFrame, TactileSensor
from flangeye.errors import FlangeyeError
from flangeye.models.finger import Finger
from flangeye_plugins.weld.touch.region_of_interest import Piece, RegionOfInterest
from flangeye_plugins.weld.touch.tag_observation import TagDetector, TagReading
from flangeye_plugins.weld.touch.tip_displacement import Interpreter, TipDisplacement

CONFIDENT = 0.3
"""Readings below this confidence are not used."""

POLLING = 2e-3
"""Between two looks for a new image, in real time [s]."""


class TagObservation(NamedTuple):
    """One image, and what was felt in it.

    Attributes:
        time_ns: Middle of its exposure.
        piece: The part of it that was read.
        feeling: None where there is no tag in it, or none to be trusted.
    """

    time_ns: int
    piece: Piece
    feeling: TipDisplacement | None


class Reader:
    """From an image to a feeling."""

    def __init__(self, finger: Finger) -> None:
        """Prepare for a calibrated finger; see :class:`Interpreter`."""
        import cv2

        # The images are small: OpenCV's threads cost more than they bring, and disturb the loop.
        cv2.setNumThreads(1)
        self._detector, self._interpreter = TagDetector(finger), Interpreter(finger)
        self._region = RegionOfInterest()

    def read(self, frame: SensorFrame) -> TagObservation:
        """Return what is felt in an image."""
        for piece in self._region.pieces(frame.image):
            reading = self._detector.find(piece.image)
            if reading is not None:
                break
        self._region.follow(piece, None if reading is None else reading.corners)
        return self._observation(piece, frame.time_ns, reading)

    def reread(self, piece: Piece, time_ns: int) -> TagObservation:
        """Return what is felt in a piece that was read before, from a log."""
        return self._observation(piece, time_ns, self._detector.find(piece.image))

    def _observation(
        self, piece: Piece, time_ns: int, reading: TagReading | None
    ) -> TagObservation:
        if reading is None or reading.confidence < CONFIDENT:
            return TagObservation(time_ns, piece, None)
        return TagObservation(time_ns, piece, self._interpreter.feel(reading, time_ns))


class LatestState:
    """The newest sample of the arm, for a sensor that asks for it from another thread."""

    def __init__(self, state: RobotState) -> None:
        self._state = state

    def state(self) -> RobotState:
        """Return the newest sample that the loop has taken."""
        return self._state

    def tell(self, state: RobotState) -> None:
        """Take a sample."""
        self._state = state


class FingerCameraReader(Protocol):
    """Gives what was seen since the last cycle, oldest first."""

    def seen(self) -> list[TagObservation]:
        """Return new sights; never waits.

        Raises:
            DeviceError: The camera is lost.
        """
        ...

    def __enter__(self) -> Self: ...

    def __exit__(self, *_: object) -> None: ...


class SteppedReader:
    """Reads in the loop itself: in simulated time nothing is late by being computed."""

    def __init__(self, sensor: TactileSensor, reader: Reader) -> None:
        self._sensor, self._reader = sensor, reader

    def seen(self) -> list[TagObservation]:
        """Return what has arrived; raise DeviceError where the camera is lost."""
        frame = self._sensor.frame()
        return [] if frame is None else [self._reader.read(frame)]

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        """Nothing to end."""


class ThreadedReader:
    """Reads in a thread: the loop never waits for an image or its detection."""

    def __init__(self, sensor: TactileSensor, reader: Reader) -> None:
        self._sensor, self._reader = sensor, reader
        self._sights: queue.SimpleQueue[TagObservation] = queue.SimpleQueue()
        self._ending = threading.Event()
        self._error: FlangeyeError | None = None
        self._thread = threading.Thread(target=self._watch, name="finger", daemon=True)

    def seen(self) -> list[TagObservation]:
        """Return what has arrived; raise DeviceError where the camera is lost."""
        if self._error is not None:
            raise self._error
        sights: list[TagObservation] = []
        while not self._sights.empty():
            sights.append(self._sights.get())
        return sights

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: Any) -> None:
        self._ending.set()
        self._thread.join(timeout=2.0)

    def _watch(self) -> None:
        while not self._ending.is_set():
            try:
                frame = self._sensor.frame()
                if frame is not None:
                    self._sights.put(self._reader.read(frame))
                    continue
            except FlangeyeError as error:
                self._error = error
                return
            except Exception as error:  # a camera's client may fail in any way
                self._error = DeviceError(
                    f"{self._sensor.name}: failed with {type(error).__name__}: {error}"
                )
                return
            self._ending.wait(POLLING)
