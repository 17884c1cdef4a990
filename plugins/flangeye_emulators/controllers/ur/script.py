"""The registers of ur_rtde's control script, and the state its threads share."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from flangeye.types import Floats
from flangeye_emulators.controllers.arm import ForceMode
from flangeye_emulators.controllers.ur.controller import URController
from flangeye_emulators.controllers.ur.program import Program, Thread

CONTROL_SCRIPT = "rtde_control"
"""Name of the program that ur_rtde uploads to take its commands."""

_NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"

_MOVE = re.compile(
    rf"\b(move[jlp])\((p?)\[([^\]]+)\]((?:,\s*[avr]={_NUMBER})*)\)",
)


class ControlScript(Program):
    """The control script as its commands see it: arguments, answers, progress, threads.

    Attributes:
        box: The controller it runs on.
        path: Moves that were written into the script.
        orders: What the threads of the script are to do.
        internal: A command the script gives itself while the client gives none.
    """

    def __init__(self, box: URController, offset: int, path: Sequence[Move]) -> None:
        """Run on ``box``; ``offset`` is 24 for a client that uses the upper registers."""
        super().__init__(box.arm)
        self.box, self.path, self.offset = box, path, offset
        self.orders = Orders()
        self.internal = 0
        self._writes = self._operation = 0

    def integer(self, index: int) -> int:
        """Return an integer argument; 0 is the command itself."""
        return self.box.registers.input_int[self.offset + index]

    def number(self, index: int) -> float:
        """Return a float argument."""
        return self.box.registers.input_double[self.offset + index]

    def numbers(self, index: int, count: int = 6) -> Floats:
        """Return float arguments (count,), from ``index`` on."""
        first = self.offset + index
        return np.array(self.box.registers.input_double[first : first + count])

    def give_integer(self, value: int) -> None:
        """Answer with an integer."""
        # The third register of the script's own reports progress.
        self.box.registers.output_int[self.offset + 1] = int(value)

    def give_numbers(self, values: Floats) -> None:
        """Answer with floats (count,)."""
        for i, value in enumerate(values.tolist()):
            self.box.registers.output_double[self.offset + i] = value

    def show_progress(self, value: int | None) -> None:
        """Set the progress register of a background operation; None if none runs.

        Bits 0-14 the progress, 15 whether one runs, 16-22 a count of writes, 24-30 of operations.
        """
        self._writes = (self._writes + 1) % 128
        if value == 0:
            self._operation = (self._operation + 1) % 128
        word = self._writes << 16 | self._operation << 24
        if value is not None:
            word |= 1 << 15 | min(value, 0x7FFF)
        self.box.registers.output_int[self.offset + 2] = word

    def in_background(self, operation: Thread) -> Thread:
        """Wrap a thread so that its progress shows."""
        self.show_progress(0)
        yield from operation
        self.show_progress(None)

    def abandon_move(self) -> None:
        """Kill the move in the background, if there is one."""
        if self.kill("move"):
            self.show_progress(None)


@dataclass
class SpeedOrder:
    """A velocity to keep: a twist (6,) in base, or joint speeds (6,)."""

    in_space: bool
    target: Floats
    acceleration: float


@dataclass
class ServoOrder:
    """Joint angles (6,) to follow."""

    target: Floats
    lookahead: float
    gain: float


@dataclass
class Orders:
    """Latest commands for the threads of the script.

    Attributes:
        speed: For the speed thread.
        servo: For the servo thread.
        force: For the force thread.
        force_gain: Scales the force mode's speed; the script starts with a half.
        stops_in_space: Which stop a plain stop command makes. The script looks at what the last
            stop in the background was, not at the command: joints until there was one.
        contact_steps: Cycles since the contact that the contact thread found; 0 for none.
    """

    speed: SpeedOrder | None = None
    servo: ServoOrder | None = None
    force: ForceMode | None = None
    force_gain: float = 0.5
    stops_in_space: bool = False
    contact_steps: int = 0
    jog_axes: Floats = field(default_factory=lambda: np.eye(3))


@dataclass(frozen=True, eq=False)
class Move:
    """One ``movej``, ``movel`` or ``movep``.

    Attributes:
        kind: ``movej``, ``movel`` or ``movep``.
        is_pose: Whether the target is a pose (6,), or joint angles (6,).
        target: (6,)
        acceleration: [m/s^2], or [rad/s^2].
        speed: [m/s], or [rad/s].
        blend: Radius [m], or [rad].
    """

    kind: str
    is_pose: bool
    target: Floats
    acceleration: float
    speed: float
    blend: float


class ScriptSource(NamedTuple):
    """A whole program: its name, and its lines from ``def`` to ``end``."""

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


def register_offset(program: str) -> int:
    """Return the first register the control script uses: 0, or 24."""
    found = re.search(r"reg_offset_int = # int register offset\s*(\d+)", program)
    return int(found[1]) if found else 0


def injected_path(program: str) -> list[Move]:
    """Return the moves that ur_rtde wrote into its control script; empty without any."""
    _, begins, rest = program.partition("# inject move path\n")
    if not begins:
        return []
    body = re.split(r"^\s*end\b", rest, maxsplit=1, flags=re.M)[0]
    return [parse_move(found) for found in _MOVE.finditer(body)]


def find_move(line: str) -> Move | None:
    """Return the move a line makes, if it is one."""
    found = _MOVE.fullmatch(line.strip())
    return parse_move(found) if found else None


def parse_move(found: re.Match[str]) -> Move:
    """Return a parsed move, with URScript's defaults for what it omits."""
    kind, is_pose, target, options = found.groups()
    joint = kind == "movej"
    given = {
        name: float(value) for name, value in re.compile(rf"([avr])=({_NUMBER})").findall(options)
    }
    return Move(
        kind=kind,
        is_pose=bool(is_pose),
        target=np.array([float(number) for number in target.split(",")]),
        acceleration=given.get("a", 1.4 if joint else 1.2),
        speed=given.get("v", 1.05 if joint else 0.25),
        blend=given.get("r", 0.0),
    )
