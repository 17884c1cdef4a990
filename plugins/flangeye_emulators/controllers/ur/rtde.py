"""RTDE, version 2: packages of a length, a letter and a body, all big-endian.

One client negotiates, says which variables it wants (one output recipe) and which it will send
(input recipes, numbered from 1), starts the stream, and then data packages go both ways.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence

from flangeye_emulators.controllers.network import Connection, Network
from flangeye_emulators.controllers.ur.controller import URController
from flangeye_emulators.controllers.ur.variables import (
    FORMATS,
    INPUTS,
    NOT_FOUND,
    OUTPUTS,
    write_inputs,
)

PORT = 30004
VERSION = 2
IN_USE = "IN_USE"

_HEADER = struct.Struct(">HB")
_FREQUENCY = struct.Struct(">d")


class RtdePort:
    """The RTDE port of a controller: its sessions, and who may write which input."""

    def __init__(self, network: Network, box: URController) -> None:
        self._network = network
        self.box = box
        self.sessions: set[RtdeSession] = set()
        network.offer(PORT, lambda: RtdeSession(network, self))

    def publish(self, cycle: int) -> None:
        """Send every session the package of this control cycle."""
        for session in self.sessions:
            session.publish(cycle)

    def claim(self, names: list[str], session: RtdeSession) -> list[str]:
        """Return those inputs that another session writes; if there are none, claim them all."""
        taken = [
            name
            for name in names
            if any(name in other.inputs for other in self.sessions if other is not session)
        ]
        if not taken:
            session.inputs.update(names)
        return taken


class RtdeSession(Connection):
    """One client.

    Attributes:
        inputs: Names of the variables it writes.
    """

    def __init__(self, network: Network, port: RtdePort) -> None:
        super().__init__(network)
        self._port = port
        self.inputs: set[str] = set()
        self._buffer = b""
        self._recipes: dict[int, InputRecipe] = {}
        self._output: OutputRecipe | None = None
        self._every = 1
        self._started = False

    def opened(self) -> None:
        """Join the port."""
        self._port.sessions.add(self)

    def closed(self) -> None:
        """Give the inputs free."""
        self._started = False
        self._port.sessions.discard(self)

    def received(self, data: bytes) -> None:
        """Act on each whole package."""
        self._buffer += data
        while len(self._buffer) >= _HEADER.size:
            size, kind = _HEADER.unpack_from(self._buffer)
            if size < _HEADER.size:
                self.abort()
                return
            if len(self._buffer) < size:
                return
            body, self._buffer = self._buffer[_HEADER.size : size], self._buffer[size:]
            act = ACTIONS.get(chr(kind))
            if act is not None:
                act(self, body)

    def publish(self, cycle: int) -> None:
        """Send a data package, when the stream runs and it is time."""
        if self._started and self._output is not None and cycle % self._every == 0:
            self.stream(_package("U", self._output.pack(self._port.box)))

    def _answer(self, kind: str, body: bytes) -> None:
        self.send(_package(kind, body))

    def _negotiate(self, body: bytes) -> None:
        (version,) = struct.unpack(">H", body[:2].rjust(2, b"\0"))
        self._answer("V", bytes([version == VERSION]))

    def _tell_version(self, body: bytes) -> None:
        del body
        self._answer("v", struct.pack(">4I", *self._port.box.box.version))

    def _set_outputs(self, body: bytes) -> None:
        (frequency,) = _FREQUENCY.unpack_from(body.ljust(_FREQUENCY.size, b"\0"))
        recipe = OutputRecipe(_names(body[_FREQUENCY.size :]))
        rate = self._port.box.box.rate
        self._every = max(1, round(rate / frequency)) if 0 < frequency <= rate else 1
        self._output = recipe if recipe.valid else None
        self._answer("O", bytes([recipe.valid]) + ",".join(recipe.types).encode())

    def _set_inputs(self, body: bytes) -> None:
        recipe = InputRecipe(_names(body))
        taken = self._port.claim(recipe.names, self) if recipe.valid else []
        types = [
            IN_USE if name in taken else type_
            for name, type_ in zip(recipe.names, recipe.types, strict=True)
        ]
        number = 0
        if recipe.valid and not taken:
            number = len(self._recipes) + 1
            self._recipes[number] = recipe
        self._answer("I", bytes([number]) + ",".join(types).encode())

    def _start(self, body: bytes) -> None:
        del body
        self._started = self._output is not None
        self._answer("S", bytes([self._started]))

    def _pause(self, body: bytes) -> None:
        del body
        self._started = False
        self._answer("P", b"\1")

    def _take_data(self, body: bytes) -> None:
        recipe = self._recipes.get(body[0]) if body else None
        if recipe is not None:
            recipe.apply(body[1:], self._port.box)


ACTIONS: dict[str, Callable[[RtdeSession, bytes], None]] = {
    "V": RtdeSession._negotiate,
    "v": RtdeSession._tell_version,
    "O": RtdeSession._set_outputs,
    "I": RtdeSession._set_inputs,
    "S": RtdeSession._start,
    "P": RtdeSession._pause,
    "U": RtdeSession._take_data,
}


def _package(kind: str, body: bytes) -> bytes:
    return _HEADER.pack(_HEADER.size + len(body), ord(kind)) + body


def _names(body: bytes) -> list[str]:
    return [name.strip() for name in body.decode("ascii", "replace").split(",") if name.strip()]


class OutputRecipe:
    """Variables that are sent to a client again and again.

    Attributes:
        types: Type of each variable; ``NOT_FOUND`` where there is none of that name.
        valid: Whether all were found.
    """

    def __init__(self, names: Sequence[str]) -> None:
        """Look the names up."""
        self.types = [OUTPUTS[name].type if name in OUTPUTS else NOT_FOUND for name in names]
        self.valid = NOT_FOUND not in self.types
        if self.valid:
            self._values = [OUTPUTS[name].values for name in names]
            self._packing = struct.Struct(">B" + "".join(FORMATS[t] for t in self.types))

    def pack(self, box: URController) -> bytes:
        """Return the body of one data package."""
        values: list[float] = [1]  # the one recipe's id
        for values_of in self._values:
            values.extend(values_of(box))
        return self._packing.pack(*values)


class InputRecipe:
    """Variables that a client sends together.

    Attributes:
        names: Names of the variables.
        types: Type of each; ``NOT_FOUND`` where there is none of that name.
        valid: Whether all were found.
    """

    def __init__(self, names: Sequence[str]) -> None:
        """Look the names up."""
        self.names = list(names)
        self.types = [INPUTS.get(name, NOT_FOUND) for name in names]
        self.valid = NOT_FOUND not in self.types
        if self.valid:
            self._packing = struct.Struct(">" + "".join(FORMATS[t] for t in self.types))
            # A vector has no effect on this controller: its first number stands for it.
            self._places = []
            place = 0
            for type_ in self.types:
                self._places.append(place)
                place += len(struct.unpack(f">{FORMATS[type_]}", bytes(_size(type_))))

    def apply(self, body: bytes, box: URController) -> None:
        """Do what a package says; one that is too short is dropped.

        ur_rtde sends packages that are longer than their recipe; what is beyond is not read.
        """
        if len(body) >= self._packing.size:
            values = self._packing.unpack_from(body)
            write_inputs(box, dict(zip(self.names, (values[i] for i in self._places), strict=True)))


def _size(type_: str) -> int:
    return struct.calcsize(f">{FORMATS[type_]}")
