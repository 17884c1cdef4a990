"""Client of the control channel: injects faults and reads the emulator's true state."""

import ipaddress
import json
import socket
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from flangeye.devices import Device
from flangeye.errors import StageError
from flangeye.motion.arm import run_number
from flangeye.types import Floats
from flangeye_emulators.controllers.arm import SpringSurface

CONTROL_PORT = 29998
"""Port of the control channel. It is defined here because a client imports no server code."""


OWN = ipaddress.IPv4Network("127.64.0.0/10")
"""Loopback network of the emulators: as many addresses as Linux has process numbers."""


def address_of(host: str) -> str:
    """Return a host's address; for ``auto`` a free loopback address."""
    return str(OWN[run_number() % OWN.num_addresses]) if host == "auto" else host


class EmulatorTruth(NamedTuple):
    """True state of the emulated arm.

    Attributes:
        base_T_flange: (4, 4) true flange pose.
        joints: (n,) true joint angles [rad]: reported ones plus the errors of the joint zeros.
        speed: Speed of the fastest joint [rad/s]; zero at rest.
        time: Time of the controller [s], the same as RTDE's timestamp.
    """

    base_T_flange: Floats
    joints: Floats
    speed: float
    time: float


class EmulatorControl(Device):
    """A connection to the control channel of a controller on loopback.

    ``with EmulatorControl("127.0.0.5") as control: control.fault("freeze=3 s")``
    """

    def __init__(self, host: str, port: int = CONTROL_PORT, patience: float = 5.0) -> None:
        """Connect.

        Args:
            host: Address of the controller.
            port: Port of its control channel.
            patience: Longest wait for an answer [s].

        Raises:
            StageError: No controller answers at this address.
        """
        try:
            self._socket = socket.create_connection((host, port), timeout=patience)
        except OSError as error:
            raise StageError(
                f"no controller on loopback at {host}:{port} ({error.strerror or error}); "
                f"start one: flangeye emulator ur5e --host {host}"
            ) from None
        self._lines = self._socket.makefile("rw", encoding="utf-8", newline="\n")

    def ask(self, action: str, **arguments: Any) -> dict[str, Any]:
        """Return the answer to one request.

        Raises:
            StageError: The request was refused, or the connection ended.
        """
        try:
            self._lines.write(json.dumps({"do": action, **arguments}) + "\n")
            self._lines.flush()
            line = self._lines.readline()
        except OSError as error:
            raise StageError(f"the controller on loopback does not answer: {error}") from None
        if not line:
            raise StageError("the controller on loopback has ended")
        answer: dict[str, Any] = json.loads(line)
        if not answer.pop("ok"):
            raise StageError(f"loopback: {answer['error']}")
        return answer

    def truth(self) -> EmulatorTruth:
        """Return the arm's true state at present."""
        said = self.ask("truth")
        return EmulatorTruth(
            np.array(said["base_T_flange"]), np.array(said["joints"]), said["speed"], said["time"]
        )

    def state(self) -> dict[str, Any]:
        """Return the controller's modes, by name."""
        return self.ask("state")

    def log(self) -> list[str]:
        """Return the event log: commands, programs, and stops with their reasons."""
        return [f"{time:.3f} {what}" for time, what in self.ask("log")["lines"]]

    def figures(self) -> dict[str, float]:
        """Return statistics of the control cycle's timing, and the process's CPU time [s]."""
        return self.ask("figures")

    def fault(self, text: str) -> None:
        """Inject a fault: ``NAME[=DURATION][@WHEN]``, for example ``freeze=3 s@moving``."""
        self.ask("fault", fault=text)

    def clear(self) -> None:
        """Clear all faults of network and control mode, and faults still to come."""
        self.ask("clear")

    def reset(self) -> None:
        """Reset the controller to its state after power-on; open connections stay open."""
        self.ask("reset")

    def set_surfaces(self, *surfaces: SpringSurface) -> None:
        """Replace all contact surfaces by these."""
        self.ask(
            "surfaces",
            surfaces=[
                {
                    "point": surface.point.tolist(),
                    "normal": surface.normal.tolist(),
                    "stiffness": surface.stiffness,
                    "damping": surface.damping,
                }
                for surface in surfaces
            ],
        )

    def put(self, joints: Sequence[float] | Floats) -> None:
        """Set the arm's joint angles [rad] without a motion."""
        self.ask("put", joints=[float(angle) for angle in joints])

    def unlock_after(self, seconds: float) -> None:
        """Set the time after which a protective stop can be unlocked [s]."""
        self.ask("unlock-after", seconds=seconds)

    def close(self) -> None:
        """End the connection."""
        self._lines.close()
        self._socket.close()
