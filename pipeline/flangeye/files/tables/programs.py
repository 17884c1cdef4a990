"""Positions in robot programs and in what controllers print, each in its maker's way of writing."""

from __future__ import annotations

import re
from bisect import bisect
from pathlib import Path

from flangeye.files.tables.table import Rows
from flangeye.maths.pose_formats import CONVENTIONS


def program_rows(file: Path, text: str) -> Rows | None:
    """Return the positions in a text, a row each, with the convention they are in; None if none."""
    for name, convention in CONVENTIONS.items():
        found = list(re.finditer(convention.program, text)) if convention.program else []
        if found:
            ends = [end.start() for end in re.finditer("\n", text)]
            rows = [
                (f"{file}:{bisect(ends, match.start()) + 1}", match.groups()) for match in found
            ]
            own = convention.in_units(convention.program_length, convention.angle)
            labels = zip(own.labels, own.units, strict=True)
            heading = tuple("_".join(filter(None, pair)).lower() for pair in labels)
            return Rows(heading, rows, convention=name)
    return None
