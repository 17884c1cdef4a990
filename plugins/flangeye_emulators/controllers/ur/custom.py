"""Small programs a client sends itself: one statement a line, no control flow."""

from __future__ import annotations

import re
from collections.abc import Callable

from flangeye_emulators.controllers.poses import pose_matrix
from flangeye_emulators.controllers.ur.commands.moves import travel
from flangeye_emulators.controllers.ur.controller import URController
from flangeye_emulators.controllers.ur.program import Program, ProgramError, Thread
from flangeye_emulators.controllers.ur.state import Registers
from flangeye_emulators.controllers.ur.urscript import find_move

_CALL = re.compile(r"(\w+)\((.*)\)")
_NUMBER = re.compile(r"[-+]?\d+\.?\d*(?:[eE][-+]?\d+)?")


class CustomProgram(Program):
    """A program of plain calls: moves, registers, ``sleep``, ``stopj``, ``stopl``, ``set_tcp``."""

    def __init__(self, box: URController, source: str) -> None:
        """Run ``source``, from ``def`` to ``end``, on ``box``."""
        super().__init__(box.arm)
        self._box = box
        lines = [line.split("#")[0].strip() for line in source.splitlines()[1:-1]]
        self._lines = [line for line in lines if line]

    def main(self) -> Thread:
        """Run line after line."""
        for line in self._lines:
            move = find_move(line)
            if move is not None:
                yield from self.complete(lambda move=move: travel(self.arm, [move]))  # type: ignore[misc]
                continue
            call = _CALL.fullmatch(line)
            if call is None or call[1] not in CALLS:
                raise ProgramError(f"'{line}' is not simulated")
            numbers = [float(number) for number in _NUMBER.findall(call[2])]
            thread = CALLS[call[1]](self, numbers)
            if thread is not None:
                yield from thread
        yield

    def write_integer(self, numbers: list[float]) -> None:
        """``write_output_integer_register(0 +24, 1)``: the last number is the value."""
        self._box.registers.output_int[self._register(numbers)] = int(numbers[-1])

    def write_float(self, numbers: list[float]) -> None:
        """``write_output_float_register(12, 0.5)``."""
        self._box.registers.output_double[self._register(numbers)] = numbers[-1]

    def _register(self, numbers: list[float]) -> int:
        register = int(sum(numbers[:-1]))
        if len(numbers) < 2 or not 0 <= register < Registers.COUNT:
            raise ProgramError(f"there is no register {register}")
        return register

    def sleep(self, numbers: list[float]) -> Thread:
        """``sleep(0.5)``."""
        until = self._box.time + sum(numbers)
        while self._box.time < until:
            yield

    def stop_joints_at(self, numbers: list[float]) -> Thread:
        """``stopj(2)``."""
        return self.stop_joints(numbers[0] if numbers else 2.0)

    def stop_in_space_at(self, numbers: list[float]) -> Thread:
        """``stopl(2)``."""
        return self.stop_in_space(numbers[0] if numbers else 2.0)

    def set_tool(self, numbers: list[float]) -> None:
        """``set_tcp(p[0, 0, 0.1, 0, 0, 0])``."""
        if len(numbers) != 6:
            raise ProgramError("set_tcp takes a pose of six numbers")
        self.arm.set_tool(pose_matrix(numbers))

    def say(self, numbers: list[float]) -> None:
        """``textmsg(...)``: nobody reads it."""
        del numbers


CALLS: dict[str, Callable[[CustomProgram, list[float]], Thread | None]] = {
    "write_output_integer_register": CustomProgram.write_integer,
    "write_output_float_register": CustomProgram.write_float,
    "sleep": CustomProgram.sleep,
    "stopj": CustomProgram.stop_joints_at,
    "stopl": CustomProgram.stop_in_space_at,
    "set_tcp": CustomProgram.set_tool,
    "textmsg": CustomProgram.say,
    "sync": CustomProgram.say,
}
