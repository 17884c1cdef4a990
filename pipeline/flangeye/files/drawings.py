"""Lines of a DXF drawing: LINE, ARC, CIRCLE, LWPOLYLINE and POLYLINE of the ASCII format.

A DXF file consists of pairs of lines: a group code and its value (AutoCAD's DXF reference). Other
entities are skipped.
"""

import math
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import numpy as np

from flangeye.errors import StageError
from flangeye.files.regular import read_text
from flangeye.types import Floats

DxfGroup = tuple[int, str]
Entity = tuple[str, list[DxfGroup]]

MOST_PIECES = 200_000
"""Most line segments of one drawing."""


def read_dxf(path: Path) -> tuple[Floats, str | None]:
    """Return the line segments (E, 2, 3) of a DXF drawing, and its unit if it states one.

    Raises:
        StageError: It is not an ASCII DXF, is too large, or holds invalid numbers.
    """
    groups = _groups(path)
    pieces: list[Floats] = []
    for name, entity in _entities(groups):
        try:
            line = _upright(path, name, entity, _line(name, entity))
        except (ValueError, OverflowError):
            raise StageError(f"{path}: a {name} has a coordinate that is not a number") from None
        pieces += [np.stack([line[:-1], line[1:]], axis=1)] if len(line) > 1 else []
        if sum(map(len, pieces)) > MOST_PIECES:
            raise StageError(
                f"{path}: holds more than {MOST_PIECES} line segments; keep the seam only"
            )
    out = np.concatenate([np.zeros((0, 2, 3)), *pieces])
    if not np.isfinite(out).all():
        raise StageError(f"{path}: holds coordinates that are not finite")
    long = np.linalg.norm(out[:, 1] - out[:, 0], axis=1) > 0
    return out[long], _unit(groups)


def _groups(path: Path) -> list[DxfGroup]:
    rows = read_text(path).splitlines()
    try:
        return [(int(rows[k]), rows[k + 1].strip()) for k in range(0, len(rows) - 1, 2)]
    except ValueError:
        raise StageError(f"{path}: is not an ASCII DXF; save it as one (R12 to 2018)") from None


def _unit(groups: list[DxfGroup]) -> str | None:
    for (_, name), (_, value) in pairwise(groups):
        if name == "$INSUNITS":
            # As far as lengths here have such a unit
            return {"1": "in", "4": "mm", "6": "m"}.get(value)
    return None


def _entities(groups: list[DxfGroup]) -> Iterator[Entity]:
    """Yield the entities; a POLYLINE comes with its vertices."""
    inside, name, found = False, "", list[DxfGroup]()
    for code, value in [*groups, (0, "EOF")]:
        if code == 2 and name == "SECTION":
            inside = value == "ENTITIES"
        if code != 0:
            found.append((code, value))
        elif name == "POLYLINE" and value == "VERTEX":
            found.append((0, value))
        else:
            if inside and name:
                yield name, found
            name, found = value, []


def _line(name: str, groups: list[DxfGroup]) -> Floats:
    """Return an entity as a polyline (N, 3); N is 0 for an entity without lines."""
    of = {code: value for code, value in reversed(groups) if code != 0}
    if name == "LINE":
        return np.array([[float(of.get(c + k, "0")) for c in (10, 20, 30)] for k in (0, 1)])
    if name in ("ARC", "CIRCLE"):
        start, stop = (math.radians(float(of.get(code, "0"))) for code in (50, 51))
        sweep = 2 * math.pi if name == "CIRCLE" else (stop - start) % (2 * math.pi)
        centre = np.array([float(of.get(code, "0")) for code in (10, 20, 30)])
        return centre + _arc(float(of[40]) if 40 in of else 0.0, start, sweep)
    if name in ("LWPOLYLINE", "POLYLINE"):
        return _polyline(name, groups, int(of.get(70, "0")) & 1 == 1)
    return np.zeros((0, 3))


def _upright(path: Path, name: str, groups: list[DxfGroup], line: Floats) -> Floats:
    """Return a flat entity's line in the drawing's axes; entities drawn from below are mirrored."""
    up = float(next((v for c, v in groups if c == 230), "1"))
    if name == "LINE" or not len(line) or abs(up - 1) < 1e-6:
        return line
    if abs(up + 1) > 1e-6:
        raise StageError(f"{path}: a {name} lies in an inclined plane; export it as lines")
    # DXF's arbitrary axis algorithm: an extrusion along -z reverses x and z
    return line * [-1.0, 1.0, -1.0]


def _arc(radius: float, start: float, sweep: float) -> Floats:
    angles = start + np.linspace(0.0, sweep, max(2, math.ceil(abs(sweep) / math.radians(3)) + 1))
    return radius * np.stack([np.cos(angles), np.sin(angles), 0 * angles], axis=1)


def _polyline(name: str, groups: list[DxfGroup], closed: bool) -> Floats:
    """Return the line through vertices and arcs; an arc's bulge is tan(angle / 4)."""
    height = next((float(v) for c, v in groups if c == 38), 0.0)
    first = (10,) if name == "LWPOLYLINE" else (0,)
    vertices: list[list[float]] = []
    for code, value in groups:
        if code in first:
            vertices.append([0.0, 0.0, height, 0.0])
        if vertices and code in (10, 20, 30, 42):
            vertices[-1][(10, 20, 30, 42).index(code)] = float(value)
    line: list[Floats] = []
    ahead = vertices[1:] + (vertices[:1] if closed else [])
    for here, there in zip(vertices, ahead, strict=False):
        line.append(np.array([here[:3]]))
        chord = np.subtract(there[:3], here[:3])
        if here[3] and chord.any():
            sweep = 4 * math.atan(here[3])
            radius = float(np.hypot(*chord[:2])) / 2 / math.sin(sweep / 2)
            start = math.atan2(chord[1], chord[0]) - sweep / 2 - math.pi / 2
            arc = _arc(radius, start, sweep)
            line.append((here[:3] + arc - arc[0])[1:-1])
    return np.concatenate(
        [*line, np.array([v[:3] for v in (ahead or vertices)[-1:]]).reshape(-1, 3)]
    )
