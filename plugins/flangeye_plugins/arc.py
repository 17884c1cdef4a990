"""Kind ``arc``: welding power sources, for weld.tactile."""

import select
import socket
import struct
import sys
import time

from pydantic import Field

from flangeye.devices import PATIENCE, Arc, Device, DeviceError
from flangeye.models.arc import ArcTimes
from flangeye.plugin.stage import Params, part


class ManualArcParams(ArcTimes, Params):
    """Parameters of ``arc.manual``; within ``ignition`` the person has to strike the arc."""


class ManualArc(Device):
    """Asks a person to switch, on standard error and by the terminal's bell.

    Attributes:
        name: Shown in messages and reports.
    """

    def __init__(self) -> None:
        self.name = "power source switched by hand"
        self._burns = self._flows = False

    def gas(self, on: bool) -> None:
        """Ask the person to open or close the gas."""
        if on != self._flows:
            self._flows = on
            self._ask_person("GAS ON" if on else "GAS OFF")

    def burn(self, on: bool) -> None:
        """Ask the person to strike or end the arc."""
        if on != self._burns:
            self._burns = on
            self._ask_person("STRIKE THE ARC NOW" if on else "END THE ARC NOW")

    def burning(self) -> bool | None:
        """Return None: there is no arc signal."""
        return None

    def close(self) -> None:
        """Ask the person to end the arc."""
        self.burn(False)
        self.gas(False)

    def _ask_person(self, what: str) -> None:
        bell = "\a"
        sys.stderr.write(f"{bell}>>> {what} <<<\n")
        sys.stderr.flush()


@part("arc.manual")
def arc_manual(params: ManualArcParams) -> Arc:
    """A person strikes and ends the arc when asked; nothing measures whether it burns."""
    return ManualArc()


HEADER = struct.Struct(">HB")


class UrDigitalParams(ArcTimes, Params):
    """Parameters of ``arc.ur_digital``."""

    host: str = Field(min_length=1)
    """Address of the controller: 192.168.1.10."""
    output: int = Field(ge=0, le=7)
    """Standard digital output that starts the arc."""
    gas: int | None = Field(None, ge=0, le=7)
    """Output of the gas valve, where the power source has none."""
    established: int | None = Field(None, ge=0, le=7)
    """Standard digital input that is high while the arc burns."""


class UrDigitalArc(Device):
    """A power source behind a controller's outputs.

    Attributes:
        name: Shown in messages and reports.
    """

    def __init__(self, params: UrDigitalParams) -> None:
        """Connect and switch all off.

        Raises:
            DeviceError: The controller cannot be reached, or another client has its outputs.
        """
        self.name = f"arc on output {params.output} of {params.host}"
        self._params, self._arrived, self._inputs, self._closed = params, b"", 0, False
        self._until = time.monotonic() + PATIENCE
        try:
            # RTDE's port
            self._line = socket.create_connection((params.host, 30004), PATIENCE)
        except OSError as error:
            raise DeviceError(f"{self.name}: {error}") from None
        try:
            self._negotiate()
            self._off()
        except DeviceError:
            self._line.close()
            raise

    def gas(self, on: bool) -> None:
        """Switch the gas valve, if it has an output of its own."""
        if self._params.gas is not None:
            self._set(self._params.gas, on)

    def burn(self, on: bool) -> None:
        """Switch the arc on or off."""
        self._set(self._params.output, on)

    def burning(self) -> bool | None:
        """Return whether the arc's input is high in the newest package; None without an input."""
        if self._params.established is None:
            return None
        self._read()
        return bool(self._inputs >> self._params.established & 1)

    def close(self) -> None:
        """Switch everything off, and disconnect."""
        if self._closed:
            return
        try:
            self._off()
        except DeviceError:
            pass  # it is gone; its outputs go low with the arm's program
        finally:
            self._closed = True
            self._line.close()

    def _off(self) -> None:
        self.burn(False)
        self.gas(False)

    def _negotiate(self) -> None:
        """Set up RTDE: receive the bits of the digital inputs, send those of the outputs."""
        # RTDE's requests: V protocol version 2, O values to receive, I values to send, S start
        self._asked("V", struct.pack(">H", 2))
        # Packages in a second [Hz]: what every generation of controller can send
        self._asked("O", struct.pack(">d", 125.0) + b"actual_digital_input_bits")
        names = b"standard_digital_output_mask,standard_digital_output"
        self._recipe = self._asked("I", names)[:1]
        self._asked("S", b"")

    def _asked(self, kind: str, body: bytes) -> bytes:
        """Return the answer to a request; other packages that arrive meanwhile are skipped."""
        self._say(kind, body)
        while time.monotonic() < self._until:
            self._receive(0.05)
            for answered, answer in self._packages():
                if answered == kind and answer[:1] in (b"", b"\0"):
                    raise DeviceError(
                        f"{self.name}: the controller refuses RTDE's {kind}; another client, or a "
                        "fieldbus, may have its outputs"
                    )
                if answered == kind:
                    return answer
        raise DeviceError(f"{self.name}: the controller does not answer RTDE's {kind}")

    def _set(self, output: int, on: bool) -> None:
        if self._closed:
            raise DeviceError(f"{self.name}: is closed")
        self._read()  # what is never read would fill the controller's buffer
        self._say("U", self._recipe + bytes([1 << output, on << output]))

    def _say(self, kind: str, body: bytes) -> None:
        try:
            self._line.sendall(HEADER.pack(HEADER.size + len(body), ord(kind)) + body)
        except OSError as error:
            raise DeviceError(f"{self.name}: {error}") from None

    def _read(self) -> None:
        """Read the packages that have arrived, without waiting; store the newest inputs."""
        self._receive(0.0)
        for kind, body in self._packages():
            if kind == "U":
                self._inputs = int.from_bytes(body[1:9], "big")

    def _receive(self, patience: float) -> None:
        while select.select([self._line], [], [], patience)[0]:
            try:
                arrived = self._line.recv(65536)
            except OSError as error:
                raise DeviceError(f"{self.name}: {error}") from None
            if not arrived:
                raise DeviceError(f"{self.name}: the controller has closed the connection")
            self._arrived, patience = self._arrived + arrived, 0.0

    def _packages(self) -> list[tuple[str, bytes]]:
        """Return the whole packages that have arrived: letter and body of each."""
        found = []
        while len(self._arrived) >= HEADER.size:
            size, kind = HEADER.unpack_from(self._arrived)
            if len(self._arrived) < max(size, HEADER.size):
                break
            found.append((chr(kind), self._arrived[HEADER.size : size]))
            self._arrived = self._arrived[max(size, HEADER.size) :]
        return found


@part("arc.ur_digital")
def arc_ur_digital(params: UrDigitalParams) -> Arc:
    """A power source that digital outputs of a Universal Robots controller switch."""
    return UrDigitalArc(params)
