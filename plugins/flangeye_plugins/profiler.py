"""``profiler.*``: sensors that measure the bead behind the torch. Add one: a new module.

Such sensors evaluate each profile themselves and send the result as lines of text.

In the maker's program the sensor is set up to find bead and joint, and to send the bead's offset
from the joint over TCP, one line for each profile. The recipe states the column of the offset, its
unit and its sign. A line without a number in that column is skipped.
"""

import math
import socket
import threading
import time
from typing import Literal

from pydantic import Field

from flangeye.devices import (
    PATIENCE,
    Device,
    DeviceError,
    Profiler,
    StateSource,
    TactileSensor,
    WeldProfile,
)
from flangeye.plugin.stage import Params, part
from flangeye.types import Seed
from flangeye.units import Duration, Length, param


class TcpParams(Params):
    """Parameters of ``profiler.tcp``."""

    host: str = Field(min_length=1)
    """Name or address of the sensor."""
    port: int = Field(ge=1, le=65535)
    """TCP port on which the sensor sends its measurements."""
    behind: Length = param(gt=0, le=0.2)
    """Distance of the measured profile behind the torch."""
    sigma: Length = param("0.05 mm", gt=0)
    """Standard deviation of the offset in one profile."""
    column: int = Field(1, ge=1)
    """Which column of a line is the bead's offset."""
    separator: str = Field(",", min_length=1, max_length=1)
    """Separator between two columns."""
    unit: Literal["m", "mm", "um"] = "mm"
    """Unit of that column."""
    positive: Literal["left", "right"] = "left"
    """To which side of the joint, along the weld, it is positive."""
    latency: Duration = param("10 ms", ge=0)
    """Time from the exposure to the arrival of its line."""


class TcpProfiler(Device):
    """Reads lines in a thread, and keeps the newest profile.

    Attributes:
        name: Shown in messages and reports.
        behind: Distance of the profile behind the torch [m].
    """

    def __init__(self, params: TcpParams) -> None:
        """Connect.

        Raises:
            DeviceError: Nothing answers there.
        """
        self.name, self.behind = f"profile sensor at {params.host}:{params.port}", params.behind
        self._params = params
        side = 1.0 if params.positive == "left" else -1.0
        self._scale = side * {"m": 1.0, "mm": 1e-3, "um": 1e-6}[params.unit]
        self._newest: WeldProfile | None = None
        self._lost = ""
        self._closing = False
        self._lock = threading.Lock()
        try:
            self._socket = socket.create_connection((params.host, params.port), PATIENCE)
        except OSError as error:
            raise DeviceError(
                f"{self.name}: cannot be reached ({error}); is it on, and does it send there?"
            ) from None
        # Longest wait for data, before it is looked whether to go on [s]
        self._socket.settimeout(0.2)
        self._thread = threading.Thread(target=self._read, name=self.name, daemon=True)
        self._thread.start()

    def profile(self) -> WeldProfile | None:
        """Return the newest profile not yet returned, or None.

        Raises:
            DeviceError: The sensor has ended the connection, or sends no lines.
        """
        with self._lock:
            profile, self._newest = self._newest, None
            lost = self._lost
        if profile is None and lost:
            raise DeviceError(f"{self.name}: {lost}")
        return profile

    def close(self) -> None:
        """Disconnect."""
        self._closing = True
        self._thread.join(PATIENCE)
        self._socket.close()

    def _read(self) -> None:
        begun = b""
        # A line is no longer [bytes].
        longest = 4096
        while not self._closing:
            try:
                data = self._socket.recv(longest)
            except TimeoutError:
                continue
            except OSError as error:
                self._lose(f"the connection is lost ({error})")
                return
            if not data:
                self._lose("has ended the connection")
                return
            *lines, begun = (begun + data).split(b"\n")
            for line in lines:
                self._take(line)
            if len(begun) > longest:
                self._lose(f"sends no lines: {longest} bytes without an end of line")
                return

    def _lose(self, why: str) -> None:
        with self._lock:
            self._lost = why

    def _take(self, line: bytes) -> None:
        taken = time.monotonic_ns() - round(self._params.latency * 1e9)
        value = self._value(line)
        if value is not None:
            with self._lock:
                self._newest = WeldProfile(self._scale * value, self._params.sigma, taken)

    def _value(self, line: bytes) -> float | None:
        """Return the value of the line's measurement column; None if it holds no number."""
        columns = line.decode("ascii", "replace").split(self._params.separator)
        try:
            value = float(columns[self._params.column - 1])
        except (IndexError, ValueError):
            return None
        return value if math.isfinite(value) else None


@part("profiler.tcp")
def profiler_tcp(
    robot: StateSource, sensor: TactileSensor, seed: Seed, params: TcpParams
) -> Profiler:
    """A profile sensor that sends the bead's offset as lines of text over TCP."""
    return TcpProfiler(params)
