"""The sample workpieces: V-grooves, straight, curved and round, a T-joint, a pipe on a plate.

``python -m tools.workpieces data/workpieces`` makes the files again.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
import yaml
from numpy.typing import NDArray

from flangeye.types import Floats
from flangeye_emulators.world.mesh import Mesh, box

LENGTH, WIDTH, HEIGHT = 0.2, 0.13, 0.024
"""Of the plates [m]: x along the groove, y across, z up; the origin is amid the lower face."""
DEPTH, HALF_ANGLE = 0.010, float(np.radians(40.0))
"""Of the grooves: how deep the root lies [m], and what a wall leans from the vertical."""
RIB = (0.030, 0.050)
"""Where a rib stands on the plate, in y [m]: it tells one end and one side from the other."""
RIB_HEIGHT, RIB_SPAN = 0.012, (-0.07, 0.0)
"""Its height, and where its sloping ends begin and end, in x [m]."""
STEP = 0.002
"""Between stations along a curved groove [m]."""


@dataclass(frozen=True)
class Plate:
    """One sample workpiece.

    Attributes:
        name: Name of its files.
        title: For people.
        root: y of the groove's root at x, (N,) to (N,) [m]; its slope at both ends is zero.
        straight: Whether two stations are enough.
        ribbed: Whether it has the rib; without, it can be slid or turned and look the same.
        length: Along x [m].
        step: Between stations along a curved groove [m].
    """

    name: str
    title: str
    root: Callable[[Floats], Floats]
    straight: bool = False
    ribbed: bool = True
    length: float = LENGTH
    step: float = STEP

    def stations(self) -> Floats:
        """Return (S,) x of the cross-sections [m]."""
        half = self.length / 2
        ends = [-half, *(_rib_corners() if self.ribbed else ()), half]
        if not self.straight:
            ends += np.arange(-half, half, self.step).tolist()
        return np.unique(np.round(ends, 9))

    def seam(self) -> Floats:
        """Return (S, 3) points along the root [m]."""
        x = np.array([-0.5, 0.5]) * self.length if self.straight else self.stations()
        return np.column_stack([x, self.root(x), np.full(len(x), HEIGHT - DEPTH)])

    def mesh(self) -> Mesh:
        """Return the closed surface: a sheet of cross-sections over a flat underside."""
        top = self._sheet()
        bottom = top * [1.0, 1.0, 0.0]
        return _solid(top, bottom)

    def _sheet(self) -> Floats:
        """Return (S, 9, 3): corners of each cross-section's upper side, in the order of y."""
        x = self.stations()
        root = self.root(x)
        slope = np.gradient(root, x) if not self.straight else np.zeros(len(x))
        aside = np.stack([-slope, np.ones(len(x))], axis=1) / np.hypot(slope, 1.0)[:, None]
        half = DEPTH * np.tan(HALF_ANGLE)
        foot = HEIGHT + 0.0 * x
        top = HEIGHT + (_rib_height(x) if self.ribbed else 0.0 * x)
        middle = np.stack([x, root], axis=1)
        lines = [
            np.column_stack([x, 0 * x - WIDTH / 2, foot]),
            np.column_stack([middle - half * aside, foot]),
            np.column_stack([middle, foot - DEPTH]),
            np.column_stack([middle + half * aside, foot]),
            *(np.column_stack([x, 0 * x + y, foot]) for y in (RIB[0] - 0.004,)),
            *(np.column_stack([x, 0 * x + y, top]) for y in RIB),
            *(np.column_stack([x, 0 * x + y, foot]) for y in (RIB[1] + 0.004, WIDTH / 2)),
        ]
        return np.stack(lines, axis=1)


def _rib_corners() -> tuple[float, ...]:
    start, end = RIB_SPAN
    return start, start + RIB_HEIGHT, end - RIB_HEIGHT, end


def _rib_height(x: Floats) -> Floats:
    return np.interp(x, _rib_corners(), (0.0, RIB_HEIGHT, RIB_HEIGHT, 0.0))


def _solid(top: Floats, bottom: Floats) -> Mesh:
    """Close the space between two (S, K, 3) sheets, the one above the other."""
    stations, corners = top.shape[:2]
    index = np.arange(stations * corners).reshape(stations, corners)
    under = index + stations * corners
    edges = [index[:, 0], index[-1, :], index[::-1, -1], index[0, ::-1]]
    loop = np.concatenate([edge[:-1] for edge in edges])
    skirt = np.stack([loop, loop + stations * corners])
    triangles = [_quads(index), _quads(under)[:, ::-1], _quads(np.c_[skirt, skirt[:, :1]])]
    vertices = np.concatenate([top.reshape(-1, 3), bottom.reshape(-1, 3)])
    return Mesh(vertices, np.concatenate(triangles).astype(np.int32))


def _quads(grid: NDArray[np.intp]) -> NDArray[np.intp]:
    """Return (T, 3) triangles of a grid of indices, anticlockwise seen along row x column."""
    a, b, c, d = grid[:-1, :-1], grid[1:, :-1], grid[1:, 1:], grid[:-1, 1:]
    return np.stack([a, b, c, a, c, d], axis=-1).reshape(-1, 3)


STRAIGHT = Plate(
    "v-straight",
    "Plate with a straight V-groove",
    lambda x: np.full(len(x), -0.015),
    straight=True,
)
CURVED = Plate(
    "v-curved",
    "Plate with a curved V-groove",
    lambda x: -0.02 + 0.0075 * (1 + np.cos(2 * np.pi * x / LENGTH)),
)
LONG = Plate(
    "v-long",
    "Plate of two metres with a V-groove that swerves by 30 mm",
    lambda x: -0.03 + 0.015 * (1 + np.cos(np.pi * x)),
    ribbed=False,
    length=2.0,
    step=0.02,
)
PLATES = (STRAIGHT, CURVED, LONG)


T_JOINT = ([-0.1, -0.055, 0.0], [0.1, 0.055, 0.01]), ([-0.08, 0.0, 0.01], [0.08, 0.01, 0.06])
"""Corners of two plates [m], the shorter one upright on the other; their fillet is along x."""


def write_files(folder: Path) -> None:
    """Write every sample as a binary STL and the YAML file of its seam, in millimetres."""
    for name, (mesh, description) in samples().items():
        write_stl(folder / f"{name}.stl", mesh)
        (folder / f"{name}.yaml").write_text(description, encoding="utf-8")


def samples() -> Mapping[str, tuple[Mesh, str]]:
    """Return each sample's surface and YAML file, by name."""
    plates = {plate.name: (plate.mesh(), _description(plate)) for plate in PLATES}
    return {
        **plates,
        "fillet": (t_joint(), _fillet()),
        "v-ring": (round_cover(), _ring()),
        "pipe-on-plate": (pipe_on_plate(), _pipe()),
    }


def t_joint() -> Mesh:
    """Return the two plates of a T-joint."""
    return _together(*(box(*corners) for corners in T_JOINT))


def _together(first: Mesh, second: Mesh) -> Mesh:
    vertices = np.concatenate([first.vertices, second.vertices])
    triangles = np.concatenate([first.triangles, second.triangles + len(first.vertices)])
    return Mesh(vertices, triangles.astype(np.int32))


def _fillet() -> str:
    (start, _, root), (end, _, _) = T_JOINT[1]
    points = np.array([[start, 0.0, root], [end, 0.0, root]])
    seam = _seam("fillet", points, [0, -1, 1], np.pi / 4, T_JOINT[1][1][2] - root)
    return _yaml("T-joint of two plates of 10 mm", "fillet", seam)


RING, COVER = 0.06, 0.11
"""Radius of a round V-groove, and of the cover that it is in, about the origin [m]."""
AROUND = 120
"""Points about it: chords miss the circle by 0.02 mm."""


def round_cover() -> Mesh:
    """Return a round cover that is to be welded into its ring."""
    half = DEPTH * np.tan(HALF_ANGLE)
    profile = [
        [0.0, 0.0], [COVER, 0.0], [COVER, HEIGHT], [RING + half, HEIGHT],
        [RING, HEIGHT - DEPTH], [RING - half, HEIGHT], [0.0, HEIGHT],
    ]  # fmt: skip
    cover = trimesh.creation.revolve(profile, sections=AROUND)
    return Mesh(np.asarray(cover.vertices), np.asarray(cover.faces, dtype=np.int32))


def _ring() -> str:
    return _yaml("Cover with a round V-groove", "v-ring", _groove(_circle(HEIGHT - DEPTH)))


def _circle(height: float) -> Floats:
    angle = np.linspace(0.0, 2 * np.pi, AROUND + 1)
    flat = np.full(len(angle), height)
    return np.column_stack([RING * np.cos(angle), RING * np.sin(angle), flat])


PIPE = (0.005, 0.03)
"""Wall and height of a pipe of radius ``RING`` [m]."""
FOOT = ((-0.1, -0.09, 0.0), (0.1, 0.09, 0.01))
"""Corners of the plate that it stands on [m]."""


def pipe_on_plate() -> Mesh:
    """Return a pipe that stands on a plate."""
    wall, height = PIPE
    pipe = trimesh.creation.annulus(RING - wall, RING, height, sections=AROUND)
    pipe.apply_translation([0.0, 0.0, FOOT[1][2] + height / 2])
    return _together(
        box(*FOOT), Mesh(np.asarray(pipe.vertices), np.asarray(pipe.faces, dtype=np.int32))
    )


def _pipe() -> str:
    points = _circle(FOOT[1][2])
    outwards = points / RING + [0.0, 0.0, 1.0 - FOOT[1][2] / RING]
    opening = [[round(float(v), 6) for v in way] for way in outwards]
    seam = _seam("fillet", points, opening, np.pi / 4, PIPE[1])
    return _yaml("Pipe of 120 mm on a plate of 10 mm", "pipe-on-plate", seam)


def write_stl(path: Path, mesh: Mesh) -> None:
    """Write triangles as binary STL, in millimetres."""
    corners = mesh.vertices[mesh.triangles] * 1000.0
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    kind = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
    facets = np.zeros(len(corners), dtype=kind)
    facets["normal"], facets["corners"] = normals, corners
    header = b"made by flangeye, unit mm".ljust(80)
    path.write_bytes(header + np.uint32(len(facets)).tobytes() + facets.tobytes())


def _description(plate: Plate) -> str:
    return _yaml(plate.title, plate.name, _groove(plate.seam()))


def _groove(points: Floats) -> dict[str, Any]:
    return _seam("groove", points, [0, 0, 1], HALF_ANGLE, DEPTH / np.cos(HALF_ANGLE))


def _seam(
    name: str, points: Floats, opening: list[Any], half_angle: float, wall: float
) -> dict[str, Any]:
    """Return a seam between two walls of a length [m], each at an angle to the opening [rad]."""
    return {
        "name": name,
        "points": [[round(float(1e3 * v), 6) for v in point] for point in points],
        "opening": opening,
        "half_angle": f"{np.degrees(half_angle):.6g} deg",
        "half_width": f"{1e3 * wall * np.sin(half_angle):.6g} mm",
    }


def _yaml(title: str, name: str, seam: Mapping[str, Any]) -> str:
    described = {
        "title": title,
        "cad": f"{name}.stl",
        "unit": "mm",
        "seams": [dict(seam)],
        "source": "made by python -m tools.workpieces",
    }
    return yaml.safe_dump(described, sort_keys=False, default_flow_style=None, width=100)


if __name__ == "__main__":
    write_files(Path(sys.argv[1]))
