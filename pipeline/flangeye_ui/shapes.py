"""Shapes of arms and scanners: a picture for the lists, and the recipe's arm as a mesh for 3D."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
from nicegui import app
from starlette.responses import PlainTextResponse, Response

from flangeye.maths.geometry import basis_of_plane, rigid
from flangeye.maths.kinematics import Arm
from flangeye.models.loading import load_model, model_names
from flangeye.models.robots import RobotModel
from flangeye.models.scanners import ScannerModel
from flangeye.report.still import Scene, rods, still
from flangeye.types import Floats
from flangeye_ui.project import Project

ROUND = 24
"""Faces round a capsule."""
KEPT = {"cache-control": "private, max-age=3600"}


def add(project: Project) -> None:
    """Serve the shapes."""

    @lru_cache(maxsize=8)
    def arm(text: str, q: str) -> bytes | None:
        recipe, _ = project.check()
        robot: RobotModel | None = recipe.context.get(RobotModel) if recipe else None
        try:
            return _mesh(robot, np.array([float(x) for x in q.split(",")])) if robot else None
        except (ValueError, IndexError):
            return None

    @app.get("/shapes/{kind}/{name}.svg")
    def picture(kind: str, name: str) -> Response:
        if kind not in ("robots", "scanners") or name not in model_names(kind):
            return PlainTextResponse("no such shape\n", 404)
        return Response(_picture(kind, name), media_type="image/svg+xml", headers=KEPT)

    @app.get("/shapes/arm.stl")
    def mesh(q: str) -> Response:
        found = arm(project.text, q)
        if found is None:
            return PlainTextResponse("no such shape\n", 404)
        return Response(found, media_type="model/stl")


def address_of_arm(joints: Floats) -> str:
    """Return where the mesh of the recipe's arm with these joint values is served."""
    return "shapes/arm.stl?q=" + ",".join(f"{x:.5f}" for x in joints)


@lru_cache(maxsize=256)
def _picture(kind: str, name: str) -> str:
    model = load_model(kind, name)  # type: ignore[arg-type]
    if kind == "robots":
        return still(Scene(robot=model), name)
    return still(Scene(scanner=model if isinstance(model, ScannerModel) else None), name)


def _mesh(robot: RobotModel, joints: Floats) -> bytes:
    """Return the arm as STL, in the base: by its URDF's meshes, or else by its capsules."""
    import trimesh

    frames = Arm(robot).frames(joints)
    parts = [body.apply_transform(frames[index]) for index, body in robot.meshes()]
    parts = parts or [_capsule(radius, ends) for radius, ends in rods(robot, joints)]
    whole: Any = trimesh.util.concatenate(parts)
    return bytes(trimesh.exchange.stl.export_stl(whole))


def _capsule(radius: float, ends: Floats) -> Any:
    import trimesh

    along = ends[-1] - ends[0]
    height = float(np.linalg.norm(along))
    axis = along / height if height else np.array([0.0, 0.0, 1.0])
    place = rigid(basis_of_plane(axis).T, ends.mean(axis=0))
    body = trimesh.creation.capsule(height=height, radius=radius, count=[ROUND, ROUND])
    return body.apply_transform(place)
