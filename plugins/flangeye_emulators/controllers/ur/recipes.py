"""RTDE recipes: which variables a package holds, and how it is packed."""

from __future__ import annotations

import struct
from collections.abc import Sequence

from flangeye_emulators.controllers.ur.controller import URController
from flangeye_emulators.controllers.ur.variables import (
    FORMATS,
    INPUTS,
    NOT_FOUND,
    OUTPUTS,
    write_inputs,
)


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
