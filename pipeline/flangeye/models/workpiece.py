"""A workpiece to weld: its CAD as triangles, and its seams as polylines, from one YAML file.

::

    title: Plate with a straight V-groove
    cad: plate.stl            # STL, PLY, OBJ, … beside this file
    unit: mm                  # of the CAD and of the points below; neither says it itself
    seams:
      - name: groove
        points: [[-100, -10, 14], [100, -10, 14]]   # along the root, from start to end
        opening: [0, 0, 1]                          # out of the groove, towards the torch
        half_angle: 40 deg
        half_width: 8.4 mm
    source: where the CAD comes from
"""

import io
import json
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated, Any
from urllib.parse import unquote

import numpy as np
from numpy.typing import NDArray
from pydantic import BeforeValidator, Field

from flangeye.errors import StageError
from flangeye.files.clouds import PER_METRE, FileUnit
from flangeye.files.paths import WHOLE, bundled_file
from flangeye.files.regular import read_regular
from flangeye.models.model import Model, read_model, readable
from flangeye.types import Floats
from flangeye.units import Angle, Length

Vector = tuple[float, float, float]

MESHES = (".stl", ".ply", ".obj", ".glb", ".gltf", ".3mf", ".step", ".stp")
STEP_SUFFIXES = (".step", ".stp")
"""Surfaces, which ``cascadio`` of the extra ``cad`` cuts into triangles, in metres."""


class SeamLine(Model):
    """One seam as the file has it."""

    name: str
    points: tuple[Vector, ...] = Field(min_length=2)
    """Points along the root, in order."""
    opening: Vector | tuple[Vector, ...]
    """Direction out of the groove, towards the torch: one for all, or one a point."""
    half_angle: Angle | None = None
    """Angle between a wall and the opening."""
    half_width: Length | None = None
    """Lateral distance from the root to a shoulder."""


class WorkpieceFile(Model):
    """Content of a workpiece's YAML file."""

    title: str
    cad: str
    """File with triangles, beside this one: STL, PLY, …"""
    unit: FileUnit
    """Unit of the CAD's coordinates and of the seams' points."""
    seams: tuple[SeamLine, ...] = Field(min_length=1)
    source: str = ""


@dataclass(frozen=True, eq=False)
class CadSeam:
    """One seam in the CAD's frame.

    Attributes:
        points: (N, 3) along the root [m].
        openings: (N, 3) unit vectors towards the torch.
        half_angle: Between a wall and the opening [rad], if known.
        half_width: Distance from the root to a shoulder [m], if known.
    """

    points: Floats
    openings: Floats
    half_angle: float | None
    half_width: float | None

    @property
    def closed(self) -> bool:
        """Whether it ends where it begins."""
        return bool(np.allclose(self.points[0], self.points[-1], rtol=0.0, atol=1e-6))


@dataclass(frozen=True, eq=False)
class Workpiece:
    """A workpiece in its CAD's own frame.

    Attributes:
        title: Shown in messages and reports.
        path: Path of the workpiece's file.
        unit: Unit of the CAD, as configured.
        vertices: (V, 3) vertices of the CAD [m].
        triangles: (T, 3) indices of vertices.
        seams: Seams by name.
    """

    title: str
    path: Path
    unit: FileUnit
    vertices: Floats
    triangles: NDArray[np.int32]
    seams: Mapping[str, CadSeam]

    @property
    def diagonal(self) -> float:
        """Diagonal of the bounding box [m]."""
        return float(np.linalg.norm(np.ptp(self.vertices, axis=0)))


WorkpiecePath = Annotated[
    Path,
    BeforeValidator(bundled_file("workpiece", "workpieces")),
    readable(WorkpieceFile),
    WHOLE,
]
"""A parameter that names a workpiece: a bundled one, or a file beside the recipe."""


def load_workpiece(path: Path) -> Workpiece:
    """Read a workpiece and its CAD.

    Raises:
        RecipeError: The YAML file is wrong; every mistake with its line.
        StageError: The CAD cannot be read, or a seam is not on it.
    """
    file: WorkpieceFile = read_model(path, WorkpieceFile)
    scale = 1.0 / PER_METRE[file.unit]
    vertices, triangles = read_mesh(path.parent / file.cad)
    vertices = vertices * scale
    seams = {line.name: _seam(path, line, scale) for line in file.seams}
    # Names became keys: equal ones have overwritten each other.
    if len(seams) < len(file.seams):
        raise StageError(f"{path}: two seams have one name")
    for name, seam in seams.items():
        _check_on_part(path, name, seam, vertices)
    return Workpiece(file.title, path, file.unit, vertices, triangles, seams)


def read_mesh(path: Path) -> tuple[Floats, NDArray[np.int32]]:
    """Return vertices (V, 3), in the file's unit, and triangles (T, 3) of a mesh.

    Raises:
        StageError: It is missing, damaged, or holds no triangles.
    """
    if path.suffix.lower() not in MESHES:
        raise StageError(f"{path}: '{path.suffix}' is not CAD; known: {', '.join(MESHES)}")
    if path.suffix.lower() in (*STEP_SUFFIXES, ".3mf") and find_spec("cascadio") is None:
        raise StageError(f"{path}: STEP and 3MF need: pip install 'flangeye[cad]'")
    vertices, triangles = _decoded(path, _content(path))
    if triangles.ndim != 2 or not len(triangles):
        raise StageError(f"{path}: holds no triangles; is it a mesh, and is the file complete?")
    if not np.isfinite(vertices).all():
        raise StageError(f"{path}: holds vertices that are not finite")
    if triangles.min() < 0 or triangles.max() >= len(vertices):
        raise StageError(
            f"{path}: has a triangle with a corner that is not among its vertices; is the file "
            f"complete?"
        )
    return vertices, triangles.astype(np.int32)


def _content(path: Path) -> bytes:
    # Largest CAD file [bytes]: five million triangles
    return read_regular(path, 256_000_000)


def _decoded(path: Path, raw: bytes) -> tuple[Floats, NDArray[np.int64]]:
    """Decode without native code: Open3D's reader ends the process at a damaged file."""
    import trimesh

    try:
        gltf = path.suffix.lower() == ".gltf"
        more: dict[str, Any] = {"resolver": _buffers(path, raw)} if gltf else {}
        mesh: Any = trimesh.load(
            io.BytesIO(raw), file_type=path.suffix[1:].lower(), process=False, force="mesh", **more
        )
        return np.array(mesh.vertices, np.float64), np.array(mesh.faces, np.int64)
    except StageError:  # of a buffer, which it names
        raise
    except Exception as error:  # damaged bytes can break the decoder in any way
        reason = " ".join(str(error).split())[:80] or type(error).__name__
        raise StageError(f"{path}: is not a mesh, or is damaged: {reason}") from None


def _buffers(path: Path, raw: bytes) -> dict[str, bytes]:
    """Return by URI the buffers that a glTF file has in files of their own, in its folder."""
    uris = [str(each.get("uri", "data:")) for each in json.loads(raw).get("buffers", [])]
    outside = [uri for uri in uris if not uri.startswith("data:")]
    # A recipe from another hand must not read files elsewhere
    if away := [uri for uri in outside if Path(unquote(uri)).name != unquote(uri)]:
        raise StageError(f"{path}: its buffer {away[0]} is not a file in its own folder")
    return {uri: _content(path.parent / unquote(uri)) for uri in outside}


def _seam(path: Path, line: SeamLine, scale: float) -> CadSeam:
    points = np.array(line.points) * scale
    openings = np.array(line.opening, dtype=np.float64)
    if not (np.linalg.norm(np.diff(points, axis=0), axis=1) > 0).all():
        raise StageError(f"{path}: seam '{line.name}' has the same point twice in a row")
    if openings.ndim == 2 and len(openings) != len(points):
        raise StageError(
            f"{path}: seam '{line.name}' has {len(points)} points and {len(openings)} openings; "
            "write one for all, or one for each"
        )
    lengths = np.linalg.norm(openings, axis=-1, keepdims=True)
    if not (lengths > 0).all():
        raise StageError(f"{path}: seam '{line.name}' has an opening without a direction")
    openings = np.broadcast_to(openings / lengths, points.shape)
    return CadSeam(points, openings, line.half_angle, line.half_width)


def _check_on_part(path: Path, name: str, seam: CadSeam, vertices: Floats) -> None:
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    outside = np.maximum(np.maximum(low - seam.points, seam.points - high), 0.0)
    # Catches millimetres read as metres and seams of another revision; a root may lie a little
    # outside.
    off = float(np.linalg.norm(outside, axis=1).max())
    # A seam may be this far outside the CAD's box, as a share of its diagonal
    if off > 0.1 * np.linalg.norm(high - low):
        raise StageError(
            f"{path}: seam '{name}' is {off * 1e3:.4g} mm outside its CAD; both must be in one "
            "frame and one unit"
        )
