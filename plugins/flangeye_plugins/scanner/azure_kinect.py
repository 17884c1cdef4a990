"""``scanner.azure_kinect``: an Azure Kinect, or its MKV recording, through pyk4a.

The camera runs in a separate process, because libk4a may abort its process when a device is
unplugged, which must not end the run.
"""

import contextlib
import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np
from pydantic import Field

from flangeye.devices import (
    PATIENCE,
    DeviceError,
    FrameDropped,
    MachineName,
    Scan,
    Scanner,
    find_named,
    require_named,
)
from flangeye.devices import settings_file as machine_settings
from flangeye.files.paths import RecipeFile
from flangeye.files.processes import Pipe, PipeEndedError, python_command
from flangeye.models.scanners import ScannerModel
from flangeye.plugin.stage import Params, part
from flangeye_plugins.scanner.opened import DepthView, OpenScanner

NAME = "scanner.azure_kinect"
HOST = Path(__file__).with_name("kinect_host.py")


class AzureKinectParams(Params):
    """Parameters of ``scanner.azure_kinect``."""

    recording: RecipeFile | None = None
    """An MKV recording to play instead, one capture an exposure."""
    device: int = Field(0, ge=0)
    """Serial number or index of the camera, if there are several."""
    depth_mode: Literal["NFOV_UNBINNED", "NFOV_2X2BINNED", "WFOV_UNBINNED", "WFOV_2X2BINNED"] = (
        "NFOV_UNBINNED"
    )
    """Depth mode of the camera; a recording has its own."""
    # Longest wait for a frame [s]
    timeout: ClassVar[float] = 2.0
    python: MachineName = "kinect"
    """The Python that has pyk4a, where this one cannot have it: a name under [programs] of this
    machine's settings; this Python where they have no 'kinect'."""


@part("scanner.azure_kinect")
def scanner_azure_kinect(model: ScannerModel | None, params: AzureKinectParams) -> Scanner:
    """Scan with an Azure Kinect, or its recording: depth, and colour mapped to it.

    A scan far out of the model's range is refused.

    Raises:
        DeviceError: The SDK, the camera or the recording was not found.
    """
    if params.recording is not None and not params.recording.is_file():
        raise DeviceError(f"{NAME}: no recording at {params.recording}")
    pipe = _host(params)
    try:
        # Longest time in which the camera starts: a cold one loads its depth engine [s]
        facts = _answer(pipe, 20.0)["facts"]
    except DeviceError:
        pipe.close()
        raise
    return AzureKinect(pipe, facts, model, params)


def _host(params: AzureKinectParams) -> Pipe:
    asked = {
        "recording": None if params.recording is None else str(params.recording),
        "device": params.device,
        "depth_mode": params.depth_mode,
        "timeout_ms": round(params.timeout * 1e3),
    }
    command = _python(params.python)
    try:
        return Pipe([*command, str(HOST), json.dumps(asked)])
    except OSError as error:
        raise DeviceError(f"{NAME}: {command[0]} cannot be run ({error.strerror})") from None


def _python(name: str) -> list[str]:
    """Return the command of the Python in the machine's settings; by default the present one."""
    if name == "kinect" and find_named("programs", name) is None:
        return python_command()
    # An older Python knows no -P; isolated, it imports nothing from the current folder either.
    return [str(require_named("programs", name, NAME)), "-I"]


def _answer(pipe: Pipe, patience: float) -> dict[str, Any]:
    """Return the host process's answer; raise its error message as DeviceError."""
    try:
        answer: dict[str, Any] = json.loads(pipe.line(patience))
    except PipeEndedError as error:
        raise DeviceError(f"{NAME}: the SDK has ended its process ({error})") from None
    except TimeoutError:
        raise DeviceError(f"{NAME}: no frame in time; is the camera still connected?") from None
    if answer.get("dropped"):
        raise FrameDropped(f"{NAME}: {answer['error']}")
    if "error" in answer:
        said = answer["error"].partition("\n")[0].strip()
        install = (
            "pyk4a-bundle needs NumPy 1: make it a Python of its own (python -m venv kinect; "
            "kinect/bin/pip install pyk4a-bundle 'numpy<2') and name it on this machine: kinect = "
            '"/whole/path/to/kinect/bin/python" under [programs] in '
        )
        cure = f"; {install}{machine_settings()}" if "Import" in said or "Module" in said else ""
        raise DeviceError(f"{NAME}: {said}{cure}")
    return answer


class AzureKinect(OpenScanner):
    """An open camera or recording."""

    def __init__(
        self,
        pipe: Pipe,
        facts: dict[str, str],
        model: ScannerModel | None,
        params: AzureKinectParams,
    ) -> None:
        """Use a running host process with an open camera."""
        what = params.recording.name if params.recording else facts["serial"]
        super().__init__(f"Azure Kinect {what}", {"unit": "mm", **facts}, model)
        self._pipe, self._params = pipe, params

    def expose(self) -> Callable[[], Scan]:
        """Take the next capture; the arm must wait until it has arrived."""
        started = time.monotonic_ns()
        with contextlib.suppress(OSError):  # the answer says what became of the process
            self._pipe.write(b"next\n")
        # The host waits for the camera first: its message says more than a timeout here
        answer = _answer(self._pipe, self._params.timeout + 0.5)
        depth = self._array(answer["depth"], np.uint16)
        colour = self._array(answer["colour"], np.uint8) if "colour" in answer else None
        times = started, time.monotonic_ns()

        def decode() -> Scan:
            view = DepthView(**answer["calibration"])
            xyz = view.points(depth)
            image = None if colour is None else view.coloured(xyz, colour)
            # The SDK's format DEPTH16, whose unit is the millimetre
            return self._scan(xyz, 1000.0, times, image)

        return decode

    def close(self) -> None:
        """Disconnect from the camera."""
        self._pipe.close()

    def _array(self, shape: list[int], kind: Any) -> Any:
        size = int(np.prod(shape)) * np.dtype(kind).itemsize
        try:
            data = self._pipe.read(size, PATIENCE)
        except (PipeEndedError, TimeoutError) as error:
            raise DeviceError(f"{self.name}: lost in the middle of a frame ({error})") from None
        return np.frombuffer(data, dtype=kind).reshape(shape)
