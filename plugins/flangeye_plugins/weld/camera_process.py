"""Runs the finger's camera in its own process, beside the control loop.

The process takes and reads the images (a simulated camera also renders them there), so no control
cycle waits for an image, and a crash of the camera's driver does not end the weld's process. It
answers one request at a time, sent by a thread of the main process, so requests never queue up.
"""

from __future__ import annotations

import multiprocessing
import queue
import signal
import threading
from contextlib import ExitStack, suppress
from multiprocessing.connection import Connection
from typing import Any, Self, TypeVar

from flangeye.devices import PATIENCE, DeviceError, Profiler, RobotState, TactileSensor, WeldProfile
from flangeye.errors import FlangeyeError
from flangeye.files.processes import busy, keep_current_folder_out
from flangeye.types import Floats
from flangeye_plugins.weld.finger_camera import CameraJob, SteppedReader, TagObservation

Item = TypeVar("Item")


class CameraProcess:
    """Runs a finger's camera in another process, so that the control loop never waits for an image.

    The profile sensor behind the torch, if there is one, is read there too.

    Attributes:
        behind: Distance of the profile behind the torch [m], known once the sensor is open; None
            without a sensor.
    """

    def __init__(self, job: CameraJob) -> None:
        """Prepare for a camera; entering the context opens it."""
        self._wire, self._theirs = multiprocessing.Pipe()
        self._process = multiprocessing.get_context("spawn").Process(
            target=camera_process, args=(self._theirs, job), name="finger", daemon=True
        )
        self._state = job.state
        self._sights: queue.SimpleQueue[TagObservation] = queue.SimpleQueue()
        self._profiles: queue.SimpleQueue[WeldProfile] = queue.SimpleQueue()
        self.behind: float | None = None
        self._ending = threading.Event()
        self._error: DeviceError | None = None
        self._thread = threading.Thread(target=self._watch, name="finger", daemon=True)

    def seen(self) -> list[TagObservation]:
        """Return the measurements since the last call; raise DeviceError if the camera is lost."""
        if self._error is not None:
            raise self._error
        return _emptied(self._sights)

    def profiles(self) -> list[WeldProfile]:
        """Return the bead profiles since the last call."""
        return _emptied(self._profiles)

    def tell(self, state: RobotState) -> None:
        """Store the arm's newest state, which the thread passes to the camera process."""
        self._state = state

    def true_torch(self) -> tuple[Floats, Floats] | None:
        """Stop reading images; return the true path of a simulated torch, None for a real one."""
        self._end_watch()
        with suppress(OSError, EOFError):
            self._wire.send("torch")
            if self._wire.poll(PATIENCE):
                truth: tuple[Floats, Floats] | None = self._wire.recv()
                return truth
        return None

    def __enter__(self) -> Self:
        """Open the camera.

        Raises:
            DeviceError: The camera cannot be opened, or not in time.
        """
        keep_current_folder_out()
        self._process.start()
        self._theirs.close()
        try:
            self._check_opened()
        except DeviceError:
            self._end()
            raise
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._end_watch()
        self._end()

    def _check_opened(self) -> None:
        try:
            if not self._wire.poll(30.0):
                raise DeviceError(f"the finger's camera does not open (30 s){busy()}")
            answer = self._wire.recv()
        except (EOFError, OSError):
            raise DeviceError(
                "the finger's camera cannot be opened: its process has ended"
            ) from None
        if isinstance(answer, DeviceError):
            raise answer
        self.behind = answer

    def _watch(self) -> None:
        try:
            while not self._ending.is_set():
                self._wire.send(self._state)
                answer = self._wire.recv()
                if isinstance(answer, DeviceError):
                    self._error = answer
                    return
                if answer is None:
                    # Every 2 ms, a fraction of the time between two images.
                    self._ending.wait(2e-3)
                elif isinstance(answer, WeldProfile):
                    self._profiles.put(answer)
                else:
                    self._sights.put(answer)
        except (EOFError, OSError):
            self._error = DeviceError("the finger's camera is lost: its process has ended")

    def _end_watch(self) -> None:
        self._ending.set()
        self._thread.join(PATIENCE)

    def _end(self) -> None:
        """Close the camera process; kill it if it hangs."""
        self._wire.close()
        self._process.join(PATIENCE)
        if self._process.is_alive():
            self._process.kill()
            self._process.join()


def _emptied(items: queue.SimpleQueue[Item]) -> list[Item]:
    return [items.get() for _ in range(items.qsize())]


def camera_process(wire: Connection, job: CameraJob) -> None:
    """Open the camera and answer requests; main function of the camera process."""
    for number in (signal.SIGINT, signal.SIGTSTP):
        signal.signal(number, signal.SIG_IGN)  # the program gets it too, and ends this process
    with (
        suppress(EOFError, BrokenPipeError, ConnectionResetError),  # the program is gone
        ExitStack() as opened,
    ):
        try:
            reader = opened.enter_context(SteppedReader(job))
        except Exception as error:
            wire.send(_device_error("the finger's camera or profiler", error))
            return
        wire.send(reader.behind)
        while True:
            wire.send(_answer(wire.recv(), reader))


def _answer(question: Any, reader: SteppedReader) -> Any:
    """Return the answer to one request of the main process.

    The answer to the arm's state is the next measurement or bead profile, None if there is neither
    yet, or the error. The answer to "torch" is the true path of a simulated torch.
    """
    if question == "torch":
        return reader.true_torch()
    reader.tell(question)
    device: TactileSensor | Profiler = reader.sensor
    try:
        if seen := reader.seen():
            return seen[0]
        device = reader.profiler or device
        return next(iter(reader.profiles()), None)
    except Exception as error:
        return _device_error(device.name, error)


def _device_error(name: str, error: Exception) -> DeviceError:
    """Return any exception of a camera's driver as a DeviceError."""
    if isinstance(error, FlangeyeError):
        return DeviceError(str(error))
    return DeviceError(f"{name}: failed with {type(error).__name__}: {error}")


FingerCameraReader = SteppedReader | CameraProcess
"""Gives all measurements and profiles since the last cycle, oldest first, and never waits."""
