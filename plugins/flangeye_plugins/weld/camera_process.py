"""Runs the finger's camera in its own process, beside the control loop.

There its images are taken and read, and drawn where it is simulated: none of that keeps a cycle
waiting, and a camera's client that crashes takes no weld with it. The process answers one question
after the other, so that nothing ever queues up; a thread of the program asks them.
"""

from __future__ import annotations

import multiprocessing
import queue
import signal
import threading
from contextlib import ExitStack, suppress
from multiprocessing.connection import Connection
from typing import Any, NamedTuple, Self

from flangeye.devices import PATIENCE, DeviceError, Profiler, RobotState, TactileSensor, WeldProfile
from flangeye.errors import FlangeyeError
from flangeye.files.processes import busy, keep_current_folder_out
from flangeye.types import Floats
from flangeye_plugins.weld.finger_camera import (
    CameraJob,
    FingerReader,
    LatestState,
    TagObservation,
    torch_of,
)


class Seeing(NamedTuple):
    """The open camera and profiler of the process.

    Attributes:
        latest: Where the arm is.
        reader: Reads the camera's images.
        sensor: The camera.
        look: Behind the torch, if there is one.
    """

    latest: LatestState
    reader: FingerReader
    sensor: TactileSensor
    look: Profiler | None


class CameraProcess:
    """Runs a finger's camera in another process, so that the loop never waits for an image.

    A look behind the torch is read there too.

    Attributes:
        behind: How far behind the torch that is [m], once it is open; None where there is none.
    """

    def __init__(self, job: CameraJob) -> None:
        """Prepare for a camera; it is opened when the context begins."""
        self._wire, self._theirs = multiprocessing.Pipe()
        self._process = multiprocessing.get_context("spawn").Process(
            target=camera_process, args=(self._theirs, job), name="finger", daemon=True
        )
        self._state = job.state
        self._sights: queue.SimpleQueue[TagObservation] = queue.SimpleQueue()
        self._looks: queue.SimpleQueue[WeldProfile] = queue.SimpleQueue()
        self.behind: float | None = None
        self._ending = threading.Event()
        self._error: DeviceError | None = None
        self._thread = threading.Thread(target=self._watch, name="finger", daemon=True)

    def seen(self) -> list[TagObservation]:
        """Return new readings; raise DeviceError if the camera is lost."""
        if self._error is not None:
            raise self._error
        sights: list[TagObservation] = []
        while not self._sights.empty():
            sights.append(self._sights.get())
        return sights

    def looks(self) -> list[WeldProfile]:
        """Return new profiles from behind the torch."""
        looks: list[WeldProfile] = []
        while not self._looks.empty():
            looks.append(self._looks.get())
        return looks

    def tell(self, state: RobotState) -> None:
        """Take the arm's newest sample; the thread passes it on."""
        self._state = state

    def true_torch(self) -> tuple[Floats, Floats] | None:
        """Stop reading images; return where a simulated torch really was, None for a real one."""
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
            DeviceError: It cannot be opened, or not in time.
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
                    self._looks.put(answer)
                else:
                    self._sights.put(answer)
        except (EOFError, OSError):
            self._error = DeviceError("the finger's camera is lost: its process has ended")

    def _end_watch(self) -> None:
        self._ending.set()
        self._thread.join(PATIENCE)

    def _end(self) -> None:
        """Close the camera process; one that hangs is killed."""
        self._wire.close()
        self._process.join(PATIENCE)
        if self._process.is_alive():
            self._process.kill()
            self._process.join()


def camera_process(wire: Connection, job: CameraJob) -> None:
    """Open the camera and answer requests; main function of the camera process."""
    for told in (signal.SIGINT, signal.SIGTSTP):
        signal.signal(told, signal.SIG_IGN)  # the program gets it too, and ends this process
    latest = LatestState(job.state)
    with (
        suppress(EOFError, BrokenPipeError, ConnectionResetError),  # the program is gone
        ExitStack() as opened,
    ):
        name = "the finger's camera"
        try:
            reader = FingerReader(job.finger)
            sensor = opened.enter_context(job.camera(latest))
            name = "the look behind the torch"
            look = job.profiler(latest, sensor)
            if look is not None:
                opened.enter_context(look)
        except Exception as error:
            wire.send(_told(name, error))
            return
        wire.send(None if look is None else look.behind)
        seeing = Seeing(latest, reader, sensor, look)
        while True:
            wire.send(_answer(wire.recv(), seeing))


def _answer(question: Any, seeing: Seeing) -> Any:
    """Return the torch's pose; or, given the arm's pose, the sighting or why there is none."""
    if question == "torch":
        return torch_of(seeing.sensor)
    seeing.latest.tell(question)
    name = seeing.sensor.name
    try:
        frame = seeing.sensor.frame()
        if frame is not None:
            return seeing.reader.read(frame)
        if seeing.look is None:
            return None
        name = seeing.look.name
        return seeing.look.profile()
    except Exception as error:
        return _told(name, error)


def _told(name: str, error: Exception) -> DeviceError:
    """Return what a camera's client did wrong; it may fail in any way."""
    if isinstance(error, FlangeyeError):
        return DeviceError(str(error))
    return DeviceError(f"{name}: failed with {type(error).__name__}: {error}")
