"""Positions in robot programs and in what controllers print, each in its maker's way of writing."""

from __future__ import annotations

import re
from bisect import bisect
from collections.abc import Mapping
from pathlib import Path

from flangeye.files.tables.table import Row, Table

_NUMBER = r"([-+]?(?:\d+(?:\.\d*)?|\.\d+)(?:[eE][-+]?\d+)?)"


def _list_of(count: int) -> str:
    return r"\s*" + r"\s*,\s*".join([_NUMBER] * count) + r"\s*"


def _named(names: str, number: str) -> str:
    """Return a pattern of numbers behind their names: ``X 1.5, Y 2``."""
    return r"\s*,\s*".join(name + number for name in names)


POSITIONS: Mapping[str, re.Pattern[str]] = {
    # Universal Robots: p[0.4, -0.1, 0.3, 2.2, 0.1, 0]
    "x_m y_m z_m vx_rad vy_rad vz_rad": re.compile(rf"\bp\[{_list_of(6)}\]"),
    # KUKA: {X 400, Y -100, Z 300, A 10, B 0, C 180}
    "x_mm y_mm z_mm a_deg b_deg c_deg": re.compile(_named("XYZABC", rf"\s+{_NUMBER}")),
    # Fanuc: X = 400.000 mm, …, W = 180.000 deg, …
    "x_mm y_mm z_mm w_deg p_deg r_deg": re.compile(
        _named("XYZ", rf"\s*=\s*{_NUMBER}\s*mm")
        + r"\s*,\s*"
        + _named("WPR", rf"\s*=\s*{_NUMBER}\s*deg")
    ),
    # ABB: [[400, -100, 300], [1, 0, 0, 0], …]
    "x_mm y_mm z_mm q1 q2 q3 q4": re.compile(rf"\[\s*\[{_list_of(3)}\]\s*,\s*\[{_list_of(4)}\]"),
}
"""How positions are written, by their columns."""


def position_rows(file: Path, text: str) -> tuple[tuple[str, ...], list[Row]]:
    """Return the columns and rows of the positions in a text; both empty if it holds none."""
    for heading, pattern in POSITIONS.items():
        found = list(pattern.finditer(text))
        if found:
            ends = [end.start() for end in re.finditer("\n", text)]
            rows = [
                (f"{file}:{bisect(ends, match.start()) + 1}", match.groups()) for match in found
            ]
            return tuple(heading.split()), rows
    return (), []


def holds_positions(table: Table) -> bool:
    """Return whether a table is from a robot program."""
    return " ".join(table.heading) in POSITIONS
