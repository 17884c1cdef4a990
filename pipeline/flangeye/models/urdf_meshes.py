"""Bounding capsules of a URDF's links, from their meshes or simple bodies."""

from __future__ import annotations

import io
import itertools
import math
import xml.etree.ElementTree as ET
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from flangeye.errors import RecipeError
from flangeye.files.regular import read_regular
from flangeye.files.words import reason_of
from flangeye.types import Floats
from flangeye.types.geometry import basis_of_plane


class MissingMesh(RecipeError):
    """A mesh file that the URDF names does not exist."""


def capsule_of(body: ET.Element, urdf: Path, packages: Mapping[str, Path]) -> Capsule:
    """Return the capsule that encloses a collision geometry, in the geometry's frame.

    Args:
        body: The element within ``<geometry>``.
        urdf: The file it is of.
        packages: Where packages are, by name.

    Raises:
        MissingMesh: The mesh is not there; the message says where it was looked for.
        RecipeError: It cannot be read.
    """
    if body.tag == "sphere":
        return Capsule(np.zeros(3), np.zeros(3), _number(body, "radius", urdf))
    points = _points(body, urdf, packages)
    require_metres(urdf, f"a <{body.tag}>", points)
    capsule = fit_capsule(points)
    outside = float(capsule.distance(points).max())
    if outside > 1e-6:
        raise RecipeError(f"{urdf}: a mesh sticks {outside * 1e3:.3f} mm out of its capsule")
    return capsule


def require_metres(urdf: Path, what: str, xyz: Any) -> None:
    """Refuse coordinates so large that products of them overflow, and LAPACK never ends.

    Raises:
        RecipeError: No part of an arm is so large.
    """
    reach = float(np.abs(xyz).max())
    if not reach < 1e3:
        raise RecipeError(f"{urdf}: {what} reaches {reach:.3g} m; a URDF's lengths are in m")


def mesh_of(body: ET.Element, urdf: Path, packages: Mapping[str, Path]) -> Any:
    """Return a geometry's surface in its own frame [m] as a trimesh, for drawing.

    Raises:
        RecipeError: The mesh file is missing, or cannot be read.
    """
    import trimesh

    if body.tag == "mesh":
        scale = np.array(numbers_of(urdf, body, "scale", "1 1 1"))
        return _loaded(_find(body.get("filename", ""), urdf, packages)).apply_scale(scale)
    if body.tag == "sphere":
        return trimesh.creation.icosphere(radius=_number(body, "radius", urdf))
    return trimesh.convex.convex_hull(_points(body, urdf, packages))


def _points(body: ET.Element, urdf: Path, packages: Mapping[str, Path]) -> Floats:
    if body.tag == "box":
        half = np.array(numbers_of(urdf, body, "size", "")) / 2
        # A capsule around the corners holds the whole box, which is convex.
        return np.asarray(half * np.array(list(itertools.product((-1, 1), repeat=3))))
    if body.tag == "cylinder":
        return _cylinder(_number(body, "radius", urdf), _number(body, "length", urdf))
    if body.tag == "mesh":
        scale = np.array(numbers_of(urdf, body, "scale", "1 1 1"))
        return np.asarray(vertices(_find(body.get("filename", ""), urdf, packages)) * scale)
    raise RecipeError(f"{urdf}: <{body.tag}> is not a geometry of URDF")


def _number(body: ET.Element, name: str, urdf: Path) -> float:
    return numbers_of(urdf, body, name, "0", 1)[0]


def _cylinder(radius: float, length: float) -> Floats:
    angles = np.linspace(0, 2 * np.pi, 64, endpoint=False)
    around = radius / np.cos(np.pi / 64)  # the polygon that lies about the circle
    ring = around * np.stack([np.cos(angles), np.sin(angles), 0 * angles], axis=1)
    half = np.array([0, 0, length / 2])
    return np.concatenate([ring - half, ring + half])


def _find(name: str, urdf: Path, packages: Mapping[str, Path]) -> Path:
    """Return the file of ``package://NAME/…``, ``file://…`` or a path beside the URDF."""
    if not name.startswith("package://"):
        path = urdf.parent / name.removeprefix("file://")
        if _is_file(path):
            return path
        raise MissingMesh(f"{urdf}: mesh '{_short(name)}' is not at {_short(str(path))}")
    package, _, below = name.removeprefix("package://").partition("/")
    # Without ROS nobody resolves package names: URDFs are then usually in a folder of their
    # package, or beside it.
    folders = [packages[package]] if package in packages else _nearby(urdf, package)
    for folder in folders:
        if _is_file(folder / below):
            return folder / below
    first, slash, _ = below.partition("/")
    named, holds = _short(package), f"{_short(first)}{slash}"
    looked = ", ".join(map(str, folders)) or f"any folder '{named}' above {urdf.parent}"
    raise MissingMesh(
        f"{urdf}: mesh '{_short(name)}' was not found in {looked}; write "
        f"robot: {{packages: {{{named}: FOLDER}}}}, where FOLDER holds {holds}"
    )


def _is_file(path: Path) -> bool:
    try:
        return path.is_file()
    except OSError:  # a name longer than any file may have
        return False


def _short(name: str) -> str:
    shown = 300  # characters of a name that a message shows
    return name if len(name) <= shown else f"{name[:shown]}…"


def _nearby(urdf: Path, package: str) -> list[Path]:
    above = urdf.absolute().parents
    named = [folder for folder in above if folder.name == package]
    return named + [folder / package for folder in above if (folder / package).is_dir()]


def vertices(path: Path) -> Floats:
    """Return the vertices (V, 3) of a mesh, decoded from its bytes: it opens no other file.

    Raises:
        RecipeError: It is not a regular file of a known kind, is too large, or is damaged.
    """
    return np.asarray(_loaded(path).vertices, dtype=np.float64).reshape(-1, 3)


def _loaded(path: Path) -> Any:
    import trimesh

    kind = path.suffix.lower()
    meshes = (".stl", ".obj", ".dae", ".ply")
    if kind not in meshes:
        raise RecipeError(f"{path}: '{kind}' is not a mesh format; known: {', '.join(meshes)}")
    # Decoded from memory: OBJ and DAE may name further files, which a recipe from elsewhere must
    # not open.
    raw = read_regular(path, 200_000_000, RecipeError)
    if kind == ".dae" and (b"<!DOCTYPE" in raw or b"<!ENTITY" in raw):
        raise RecipeError(f"{path}: declares a document type or entities, which are not read")
    try:
        mesh: Any = trimesh.load(io.BytesIO(raw), file_type=kind[1:], force="mesh")
        points = np.asarray(mesh.vertices, dtype=np.float64).reshape(-1, 3)
    except Exception as error:  # trimesh raises whatever its readers do
        raise RecipeError(f"{path}: is not a readable mesh: {reason_of(error)}") from None
    if not len(points) or not np.isfinite(points).all():
        raise RecipeError(f"{path}: has no vertices, or some that are not finite")
    return mesh


def numbers_of(
    urdf: Path, element: ET.Element | None, name: str, default: str, count: int = 3
) -> list[float]:
    """Return the numbers of an attribute.

    Args:
        urdf: The file, for the message.
        element: Element with the attribute; None counts as one without it.
        name: Name of the attribute.
        default: Text to use without the attribute.
        count: Number of numbers that the attribute must have.

    Raises:
        RecipeError: The attribute has another count of numbers, or some are not finite.
    """
    text = default if element is None else element.get(name, default)
    try:
        numbers = [float(word) for word in text.split()]
    except ValueError:
        numbers = []
    if len(numbers) != count or not all(map(math.isfinite, numbers)):
        words = {1: "one finite number", 3: "three finite numbers"}
        raise RecipeError(f'{urdf}: {name}="{text[:80]}" is not {words[count]}')
    return numbers


class Capsule(NamedTuple):
    """All points within ``radius`` of a segment.

    Attributes:
        start: (3,) one end of the segment [m].
        end: (3,) the other.
        radius: Radius about the segment [m].
    """

    start: Floats
    end: Floats
    radius: float

    def distance(self, points: Floats) -> Floats:
        """Return how far (N, 3) points lie outside, (N,); negative inside [m]."""
        along = self.end - self.start
        # The tiny number keeps a capsule of no length, a sphere, from dividing by zero.
        share = (points - self.start) @ along / max(float(along @ along), 1e-300)
        nearest = self.start + np.clip(share, 0, 1)[:, None] * along
        return np.asarray(np.linalg.norm(points - nearest, axis=1) - self.radius)

    @property
    def volume(self) -> float:
        """Volume of the capsule [m^3]."""
        length = float(np.linalg.norm(self.end - self.start))
        return float(np.pi * self.radius**2 * (length + 4 / 3 * self.radius))


def fit_capsule(points: Floats) -> Capsule:
    """Return a small capsule around (N, 3) points: the smallest along any of six directions.

    The directions are the coordinate axes, as links are drawn, and the points' principal axes.
    """
    # Makers draw links along their frame's axes, where a bracket would turn the principal ones
    principal = np.linalg.svd(points - points.mean(axis=0), full_matrices=False)[2]
    candidates = [_along(points, axis) for axis in (*np.eye(3), *principal)]
    return min(candidates, key=lambda capsule: capsule.volume)


def _along(points: Floats, direction: Floats) -> Capsule:
    axes = basis_of_plane(direction)
    local = points @ axes.T
    centre = _middle(local[:, :2])
    off = np.linalg.norm(local[:, :2] - centre, axis=1)
    radius = float(off.max())
    # A round end reaches beyond the segment's by this much at each point's distance.
    beyond = np.sqrt(np.maximum(radius**2 - off**2, 0.0))
    low, high = (local[:, 2] + beyond).min(), (local[:, 2] - beyond).max()
    # A body wider than long needs no segment: a sphere about its middle
    if low > high:
        low = high = (local[:, 2].min() + local[:, 2].max()) / 2
        radius = float(np.hypot(off, local[:, 2] - low).max())
    ends = np.array([[*centre, low], [*centre, high]]) @ axes
    return Capsule(ends[0], ends[1], radius)


def _middle(flat: Floats) -> Floats:
    """Return nearly the centre of the smallest circle about (N, 2) points (Badoiu, Clarkson)."""
    # A row for each coordinate: along pairs of numbers NumPy takes twice as long
    x, y = np.ascontiguousarray(_outermost(flat).T)
    at_x, at_y = (x.min() + x.max()) / 2, (y.min() + y.max()) / 2
    # Steps towards the smallest circle; its radius is then too large by a thousandth at most
    for step in range(1, 2000):
        farthest = ((x - at_x) ** 2 + (y - at_y) ** 2).argmax()
        at_x += (x[farthest] - at_x) / (step + 1)
        at_y += (y[farthest] - at_y) / (step + 1)
    return np.array([at_x, at_y])


def _outermost(flat: Floats) -> Floats:
    """Return those of (N, 2) points on or next to their convex hull; no other is ever farthest."""
    from scipy.spatial import ConvexHull, QhullError

    try:
        sides = ConvexHull(flat).equations
    except (QhullError, ValueError):  # on a line, or not finite
        return flat
    least = -1e-9 * np.ptp(flat, axis=0).max()
    near = np.zeros(len(flat), bool)
    for x, y, offset in sides:
        near |= flat @ [x, y] + offset > least
    return np.asarray(flat[near])
