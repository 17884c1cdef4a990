"""What the control script of ur_rtde does, natively: the register protocol.

A client writes a command's number into input_int_register_0 and its arguments into the registers
after it. output_int_register_0 answers READY, and DONE until the client clears the command.
Commands for streams are taken up again in every cycle and the answer stays READY.
"""

from __future__ import annotations

from flangeye_emulators.controllers.ur.commands import COMMANDS, STREAMED
from flangeye_emulators.controllers.ur.program import Thread
from flangeye_emulators.controllers.ur.script import ControlScript

READY, DONE = 1, 2


class CommandLoop(ControlScript):
    """Takes commands from the input registers, cycle by cycle."""

    def main(self) -> Thread:
        """Take commands until one ends the script."""
        self.show_progress(None)
        self._signal(READY)
        executed = False
        while True:
            code = self.integer(0) or self._take_internal()
            if code == 255:  # stop script
                return
            if code == 0:
                executed = False
                self._signal(READY)
            elif code in STREAMED:
                yield from self._process(code)
                self._signal(READY)
            elif not executed:
                self.box.note(f"command {code}")
                yield from self._process(code)
                self._signal(DONE)
                executed = True
            yield

    def _process(self, code: int) -> Thread:
        handler = COMMANDS.get(code)
        if handler is None:
            self.box.note(f"command {code} is not simulated")
            return
        thread = handler(self)
        if thread is not None:
            yield from thread

    def _take_internal(self) -> int:
        code, self.internal = self.internal, 0
        return code

    def _signal(self, state: int) -> None:
        self.box.registers.output_int[self.offset] = state
