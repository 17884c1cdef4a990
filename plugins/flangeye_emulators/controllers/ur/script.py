"""Native implementation of ur_rtde's control script, which reads commands from input registers.

Command numbers are those of ur_rtde 1.6. Only the commands used by the project's driver are
implemented. Any other is logged and answered as done, without effect.
"""

import math
import re
from functools import partial
from typing import ClassVar, NamedTuple

import numpy as np

from flangeye.types import Floats
from flangeye_emulators.controllers.motion import Travel, joint_move, linear_move
from flangeye_emulators.controllers.mover import Mover
from flangeye_emulators.controllers.poses import pose_matrix, pose_vector
from flangeye_emulators.controllers.ur.controller import RefusedError, URController


class ControlScript:
    """The control script, run cycle by cycle."""

    # Values of the first register, which the client reads
    ready: ClassVar[int] = 1
    done: ClassVar[int] = 2

    def __init__(self, box: URController, offset: int) -> None:
        """Run on ``box``; ``offset`` is 24 for a client that uses the upper registers."""
        self._box, self._mover, self._offset = box, Mover(box.arm), offset
        self._begun = self._waits = self._in_background = False
        self._writes = self._operation = 0
        self._show_progress(None)
        self._signal(self.ready)

    def cycle(self) -> bool:
        """Execute the client's command; return whether the script continues."""
        code = self._integer(0)
        if code == 255:  # stop script
            return False
        if code == 0:
            self._begun = False
            self._signal(self.ready)
        elif code == 10:  # speedL, given anew in every cycle: the twist is kept until it is stopped
            self._mover.go_on(self._numbers(0), self._number(6), math.inf)
            self._signal(self.ready)
        elif not self._begun:
            self._box.note(f"command {code}")
            self._begun, self._waits = True, self._act(code)
        if self._in_background and not self._mover.busy:
            self._in_background = False
            self._show_progress(None)
        if self._begun and not (self._waits and self._mover.busy):
            self._signal(self.done)
        self._mover.drive()
        return True

    def _act(self, code: int) -> bool:
        """Execute one command; return whether it completes only when the arm is at rest."""
        arm = self._box.arm
        if code in (1, 3):  # moveJ, moveL
            self._mover.halt()
            given = self._numbers(0), self._number(6), self._number(7)
            self._mover.append(partial(self._move, code, *given))
            return self._client_waits()
        if code in (33, 34):  # stopL, stopJ: the script stops in joint angles for both
            self._mover.halt(self._number(0), in_space=False)
            return self._client_waits()
        if code == 15:  # speedStop
            self._mover.halt(self._number(0))
            return True
        if code == 29:  # setTcp
            arm.set_tool(pose_matrix(self._numbers(0)))
        elif code == 35:  # setWatchdog [Hz]
            self._box.set_watchdog(self._offset, self._number(0))
        elif code == 40:  # getTCPOffset
            tool = pose_vector(arm.chain.flange_T_tcp).tolist()
            self._box.registers.output_double[self._offset : self._offset + 6] = tool
        else:
            self._box.note(f"command {code} is not simulated")
        return False

    def _move(self, code: int, target: Floats, speed: float, acceleration: float) -> Travel:
        """Return a move from the present position, to joint angles or linearly to a pose."""
        stance = self._box.arm.stance
        if code == 3:
            return linear_move(stance.base_T_tcp, pose_matrix(target), speed, acceleration)
        # No joint turns faster than it can
        way = np.abs(target - stance.joints)
        fastest = np.min(self._box.arm.speed_limits * way.max() / np.maximum(way, 1e-300))
        return joint_move(stance.joints, target, min(speed, float(fastest)), acceleration)

    def _client_waits(self) -> bool:
        """Return whether the client waits for the end; otherwise progress is reported."""
        self._in_background = self._integer(1) == 1
        self._show_progress(0 if self._in_background else None)
        return not self._in_background

    def _integer(self, index: int) -> int:
        """Return an integer argument; index 0 is the command itself."""
        return self._box.registers.input_int[self._offset + index]

    def _number(self, index: int) -> float:
        return self._box.registers.input_double[self._offset + index]

    def _numbers(self, index: int) -> Floats:
        """Return six float arguments, from ``index`` on."""
        first = self._offset + index
        return np.array(self._box.registers.input_double[first : first + 6])

    def _signal(self, state: int) -> None:
        self._box.registers.output_int[self._offset] = state

    def _show_progress(self, value: int | None) -> None:
        """Write the progress of a background operation to its register; None if there is none.

        Bits 0-14 are the progress, bit 15 is set while one runs, bits 16-22 count writes, bits
        24-30 count operations.
        """
        self._writes = (self._writes + 1) % 128
        if value == 0:
            self._operation = (self._operation + 1) % 128
        word = self._writes << 16 | self._operation << 24
        if value is not None:
            word |= 1 << 15 | value
        self._box.registers.output_int[self._offset + 2] = word


class ScriptSource(NamedTuple):
    """A complete program: its name, and its text from ``def`` to ``end``."""

    name: str
    text: str


def take_program(text: str) -> tuple[ScriptSource | None, str]:
    """Return the first complete program in ``text``, if any, and the rest of the text."""
    begins = re.search(r"^def (\w+)\(\):", text, flags=re.M)
    end = re.compile(r"\nend[ \t]*(?=\n|$)")
    ends = end.search(text, begins.end()) if begins else None
    if begins is None or ends is None:
        return None, text
    return ScriptSource(begins[1], text[begins.start() : ends.end()]), text[ends.end() :]


def run_program(box: URController, source: ScriptSource) -> None:
    """Start the control script; a controller that is not ready ignores it, like the robot."""
    if source.name != "rtde_control":
        box.note(f"program {source.name} is not simulated")
        return
    # The first register it uses: 0, or 24
    offset = re.search(r"reg_offset_int = # int register offset\s*(\d+)", source.text)
    try:
        box.load(ControlScript(box, int(offset[1]) if offset else 0).cycle, source.name)
    except RefusedError as error:
        box.note(f"program {source.name} ignored: {error}")
