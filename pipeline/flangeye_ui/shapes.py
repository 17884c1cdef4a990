"""Shapes of arms and scanners: a picture for the lists, and the recipe's arm as a mesh for 3D."""

from __future__ import annotations

from functools import cache, lru_cache
from importlib.metadata import PackageNotFoundError, files
from pathlib import Path
from typing import Any

import numpy as np
from nicegui import app
from starlette.responses import PlainTextResponse, Response

from flangeye.maths.geometry import basis_of_plane, rigid
from flangeye.maths.kinematics import Arm
from flangeye.models.loading import load_model, model_names
from flangeye.models.robots import RobotModel
from flangeye.models.scanners import ScannerModel
from flangeye.models.urdf import robot_from_urdf
from flangeye.report.still import StillScene, rods, still
from flangeye.types import Floats
from flangeye_ui.project import Project

ROUND = 24
"""Faces round a capsule."""
PUBLISHED = {
    "ur3": "ur_description/urdf/ur3_robot.urdf", "ur5": "ur_description/urdf/ur5_robot.urdf",
    "ur10": "ur_description/urdf/ur10_robot.urdf",
    "franka-panda": "panda_description/urdf/panda.urdf",
}  # fmt: skip
"""URDFs of the package ``example-robot-data`` that have the meshes of an arm, by model."""


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
        return Response(
            _picture(kind, name),
            media_type="image/svg+xml",
            headers={"cache-control": "private, max-age=3600"},
        )

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
        return still(StillScene(robot=model), name)
    return still(StillScene(scanner=model if isinstance(model, ScannerModel) else None), name)


def _mesh(robot: RobotModel, joints: Floats) -> bytes:
    """Return the arm as STL, in the base: by meshes, its own or published, or else by capsules."""
    import trimesh

    drawn = next((arm for arm in (robot, _published(robot, joints)) if arm and arm.meshes()), None)
    if drawn is None:
        parts = [_capsule(radius, ends) for radius, ends in rods(robot, joints)]
    else:
        frames = Arm(drawn).frames(joints)
        parts = [body.apply_transform(frames[index]) for index, body in drawn.meshes()]
    whole: Any = trimesh.util.concatenate(parts)
    return bytes(trimesh.exchange.stl.export_stl(whole))


def _published(robot: RobotModel, joints: Floats) -> RobotModel | None:
    """Return the arm of ``example-robot-data`` that stands as this one does, if there is one."""
    found = _published_arm(robot.model)
    if found is None or len(found.joints) != len(robot.joints):
        return None
    apart = Arm(found).flange(joints) - Arm(robot).flange(joints)
    # An arm whose flange stands farther than this from the published one's is not drawn by its
    # meshes: ten times what a correction of an arm's lengths changes [m]
    published_within = 5e-3
    return found if np.linalg.norm(apart[:3, 3]) < published_within else None


@cache
def _published_arm(model: str) -> RobotModel | None:
    try:
        names = (files("example-robot-data") or ()) if model in PUBLISHED else ()
    except PackageNotFoundError:
        return None
    urdf = next((name for name in names if f"{name}".endswith(f"/{PUBLISHED[model]}")), None)
    return robot_from_urdf(Path(str(urdf.locate()))) if urdf else None


def _capsule(radius: float, ends: Floats) -> Any:
    import trimesh

    along = ends[-1] - ends[0]
    height = float(np.linalg.norm(along))
    axis = along / height if height else np.array([0.0, 0.0, 1.0])
    place = rigid(basis_of_plane(axis).T, ends.mean(axis=0))
    body = trimesh.creation.capsule(height=height, radius=radius, count=[ROUND, ROUND])
    return body.apply_transform(place)
