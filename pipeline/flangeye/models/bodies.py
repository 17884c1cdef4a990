"""A body of known shape to find in a scan: a gripper, a torch, a plate, by its CAD."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from flangeye.errors import RecipeError, StageError
from flangeye.files.clouds import PER_METRE, FileUnit
from flangeye.files.paths import bundled
from flangeye.files.words import nearest
from flangeye.maths.kinematics import Arm
from flangeye.models.robots import RobotModel
from flangeye.models.urdf_meshes import Capsule, fit_capsule
from flangeye.models.workpiece import MESHES, STEP_SUFFIXES, read_mesh
from flangeye.types import Floats, Indices
from flangeye.types.geometry import each_applied, invert

SMALLEST, LARGEST = 0.02, 3.0
"""Diagonal of a body that an arm carries and a scanner sees [m]; of the robot's base at most."""


@dataclass(frozen=True, eq=False)
class TargetBody:
    """A body's surface, in the frame of its file.

    Attributes:
        name: Shown in messages and reports.
        vertices: (V, 3) vertices [m].
        triangles: (T, 3) indices of vertices.
        note: Note on how the unit was inferred; empty if it was stated.
    """

    name: str
    vertices: Floats
    triangles: NDArray[np.int32]
    note: str = ""

    @property
    def size(self) -> float:
        """Diagonal of the box around it [m]."""
        return float(np.linalg.norm(np.ptp(self.vertices, axis=0)))

    @cached_property
    def capsule(self) -> Capsule:
        """A small capsule around it."""
        return fit_capsule(self.vertices)

    @cached_property
    def digest(self) -> str:
        """SHA-256 of its surface: equal bodies, equal digests."""
        return hashlib.sha256(self.vertices.tobytes() + self.triangles.tobytes()).hexdigest()

    def at(self, joints: Floats | None) -> TargetBody:
        """Return the body at an arm's joint angles (n,) [rad]; a rigid one is always the same."""
        return self

    def edges(self, most: int) -> Floats:
        """Return the longest sharp edges (E, 2, 3) [m], for a line drawing."""
        import trimesh

        mesh = trimesh.Trimesh(self.vertices, self.triangles)
        # Facets of a turned part meet at less, and would cover a drawing with lines.
        sharp = mesh.face_adjacency_angles > np.radians(30)
        ends = np.asarray(mesh.vertices[mesh.face_adjacency_edges[sharp]])
        length = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)
        return np.asarray(ends[np.argsort(-length, kind="stable")[:most]])

    def as_ply(self) -> str:
        """Return the body as an ASCII PLY file in metres, to 0.1 um."""
        head = (
            f"ply\nformat ascii 1.0\nelement vertex {len(self.vertices)}\n"
            "property float x\nproperty float y\nproperty float z\n"
            f"element face {len(self.triangles)}\nproperty list uchar int vertex_indices\n"
            "end_header\n"
        )
        points = "".join(f"{x:.7f} {y:.7f} {z:.7f}\n" for x, y, z in self.vertices)
        return head + points + "".join(f"3 {a} {b} {c}\n" for a, b, c in self.triangles)


ARM = "robot"
"""The name of a body that is not a file: the arm itself."""


@dataclass(frozen=True, eq=False)
class ArmBody(TargetBody):
    """The links of an arm, each in its own frame.

    Attributes:
        links: (V,) number of the frame that each vertex moves with, the base's 0.
        arm: The arm's kinematics.
    """

    links: Indices = field(default_factory=lambda: np.zeros(0, np.intp), kw_only=True)
    arm: Arm = field(kw_only=True)

    def at(self, joints: Floats | None) -> TargetBody:
        """Return the arm at joint angles (n,) [rad], drawn in its flange's frame.

        Raises:
            StageError: The joint angles are unknown.
        """
        if joints is None or len(joints) != self.arm.n:
            raise StageError(
                f"{self.name}: the arm's posture follows from its joint angles, but a capture has "
                "none: record them"
            )
        return _posed(self, tuple(map(float, joints)))

    @property
    def by_link(self) -> dict[int, TargetBody]:
        """The mesh of each link that has one, in its own frame."""
        out = {}
        for k in np.unique(self.links).tolist():
            own = np.flatnonzero(self.links == k)
            # `own` ascends, so its index is a vertex's number within the link.
            number = np.searchsorted(own, self.triangles[self.links[self.triangles[:, 0]] == k])
            out[k] = TargetBody(f"link{k}", self.vertices[own], number.astype(np.int32))
        return out


@lru_cache(maxsize=4)
def _posed(body: ArmBody, joints: tuple[float, ...]) -> TargetBody:
    # In the flange's frame, as for a body that the flange carries
    angles = np.array(joints)
    frames = invert(body.arm.flange(angles)) @ body.arm.frames(angles)
    return TargetBody(
        body.name, each_applied(frames[body.links], body.vertices), body.triangles, body.note
    )


def arm_body(robot: RobotModel | None, links: Mapping[int, str], near: Path) -> ArmBody:
    """Return the surface of an arm: its URDF's meshes, or those of a recipe.

    Args:
        robot: The arm.
        links: Meshes in metres by the number of the joint's frame that they are drawn in.
        near: Folder of the recipe.

    Raises:
        RecipeError: The recipe has no arm, or the arm's surface is unknown.
    """
    if robot is None:
        raise RecipeError(
            f"body: {ARM} is the arm itself; name its URDF, robot: {{urdf: arm.urdf}}"
        )
    if unknown := [number for number in links if not 0 <= number <= len(robot.joints)]:
        raise RecipeError(f"links: {robot.model} has links 0 to {len(robot.joints)}, not {unknown}")
    parts = [(k, *_read(near / name)) for k, name in links.items()] or [
        (k, np.asarray(mesh.vertices), np.asarray(mesh.faces, np.int32))
        for k, mesh in robot.meshes()
    ]
    if not parts:
        raise RecipeError(
            f"body: {ARM} needs the meshes of {robot.model}'s links; name its URDF, "
            "robot: {urdf: arm.urdf}, with its meshes beside it"
        )
    # Vertices of all links stand in one array: each link's triangles shift by those before.
    before = np.cumsum([0, *(len(vertices) for _, vertices, _ in parts)])
    return ArmBody(
        robot.model,
        np.concatenate([vertices for _, vertices, _ in parts]).astype(np.float64),
        np.concatenate([t + n for (_, _, t), n in zip(parts, before, strict=False)]),
        links=np.repeat([k for k, _, _ in parts], np.diff(before)),
        arm=Arm(robot),
    )


def carrying(robot: RobotModel, body: TargetBody | None) -> RobotModel:
    """Return an arm with the space of the body on its flange among the space that it fills.

    Raises:
        StageError: The space of the arm itself is not known.
    """
    if body is None or isinstance(body, ArmBody):
        # The arm's own links are in its volumes already.
        return robot
    return robot.carrying(*body.capsule)


def _read(path: Path) -> tuple[Floats, NDArray[np.int32]]:
    try:
        return read_mesh(path)
    except StageError as error:
        raise RecipeError(str(error)) from None


def body_names() -> list[str]:
    """Return the names of the bundled bodies, sorted."""
    return sorted(path.stem for path in (bundled("data") / "bodies").glob("*.stl"))


def load_body(name: str, unit: FileUnit | None, near: Path) -> TargetBody:
    """Return the body ``name``: a bundled one, or a mesh file beside the recipe.

    Args:
        name: A bundled body's name, or a path with the suffix of a mesh.
        unit: Unit of the mesh's coordinates; judged by its size if not given.
        near: Folder of the recipe.

    Raises:
        RecipeError: There is no such body, its file is damaged, or its size is not a tool's.
    """
    path = near / name
    if path.suffix.lower() not in MESHES:
        path = bundled("data") / "bodies" / f"{name}.stl"
        if not path.is_file():
            close = nearest(name, body_names(), n=2) or body_names()
            raise RecipeError(
                f"no body '{name}'; known: {', '.join(close)}, or a file ({', '.join(MESHES)})"
            )
    vertices, triangles = _read(path)
    used, note = _unit_of(path, vertices, unit)
    return TargetBody(path.stem, vertices / PER_METRE[used], triangles, note)


def _unit_of(path: Path, vertices: Floats, unit: FileUnit | None) -> tuple[FileUnit, str]:
    """Return the unit of a mesh, and how it was inferred; empty if it was stated."""
    across = float(np.linalg.norm(np.ptp(vertices, axis=0)))
    sizes = {each: across / PER_METRE[each] for each in PER_METRE}
    fitting = [each for each, size in sizes.items() if SMALLEST <= size <= LARGEST]
    in_each = " or ".join(f"{1e3 * sizes[each]:.0f} mm with unit: {each}" for each in fitting)
    limits = f"a body to look for is {SMALLEST * 1e3:g} mm to {LARGEST:g} m across"
    # glTF by definition (2.0, section 3.4), STEP as it is read
    stated: FileUnit | None = unit or (
        "m" if path.suffix.lower() in (".glb", ".gltf", *STEP_SUFFIXES) else None
    )
    if stated in fitting:
        return stated, ""
    if stated or not fitting:
        has = (
            f"{sizes[stated]:.4g} m across with unit: {stated}"
            if stated
            else f"{across:.4g} across"
        )
        other = f"it would be {in_each}" if fitting else "no known unit gives such a size"
        raise RecipeError(f"{path.name}: it is {has}, and {limits}; {other}")
    # Inches are assumed only if neither metres nor millimetres fit, centimetres last.
    used = min(fitting, key=("m", "mm", "in", "cm").index)
    return used, (
        f"{path.name}: unit: {used} is assumed, by its size of {sizes[used] * 1e3:.0f} mm; state "
        "the unit where that is wrong"
    )
