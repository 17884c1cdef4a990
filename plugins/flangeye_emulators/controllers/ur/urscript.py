"""The little URScript that ur_rtde writes itself: moves in a path, and small custom functions."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from flangeye.types import Floats

CONTROL_SCRIPT = "rtde_control"
"""Name of the program that ur_rtde uploads to take its commands."""

_BEGINS = re.compile(r"^def (\w+)\(\):", re.M)
_ENDS = re.compile(r"\nend[ \t]*(?=\n|$)")
_NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
_MOVE = re.compile(
    rf"\b(move[jlp])\((p?)\[([^\]]+)\]((?:,\s*[avr]={_NUMBER})*)\)",
)
_OPTION = re.compile(rf"([avr])=({_NUMBER})")
_OFFSET = re.compile(r"reg_offset_int = # int register offset\s*(\d+)")


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
    """Return the first whole program in ``text``, if there is one, and what comes after it."""
    begins = _BEGINS.search(text)
    ends = _ENDS.search(text, begins.end()) if begins else None
    if begins is None or ends is None:
        return None, text
    return ScriptSource(begins[1], text[begins.start() : ends.end()]), text[ends.end() :]


def register_offset(program: str) -> int:
    """Return the first register the control script uses: 0, or 24."""
    found = _OFFSET.search(program)
    return int(found[1]) if found else 0


def injected_path(program: str) -> list[Move]:
    """Return the moves ur_rtde wrote into its control script; empty when there are none."""
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
    """Return the move that was found; URScript's defaults where it does not say."""
    kind, is_pose, target, options = found.groups()
    joint = kind == "movej"
    given = {name: float(value) for name, value in _OPTION.findall(options)}
    return Move(
        kind=kind,
        is_pose=bool(is_pose),
        target=np.array([float(number) for number in target.split(",")]),
        acceleration=given.get("a", 1.4 if joint else 1.2),
        speed=given.get("v", 1.05 if joint else 0.25),
        blend=given.get("r", 0.0),
    )
