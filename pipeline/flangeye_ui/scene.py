"""The cell in 3D: floor, axes, the arm by its shape, box, scanner, poses and the flange as seen."""

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from functools import cache, lru_cache
from importlib.metadata import PackageNotFoundError, files
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from nicegui import app, events, ui
from starlette.responses import PlainTextResponse, Response

from flangeye import types as t
from flangeye.errors import FlangeyeError
from flangeye.maths.kinematics import Arm
from flangeye.models.loading import load_model, model_names
from flangeye.models.robots import RobotModel
from flangeye.models.scanners import ScannerModel
from flangeye.models.urdf import robot_from_urdf
from flangeye.types import CircleFeature, Feature, Floats
from flangeye.types.geometry import basis_of_plane, rigid
from flangeye.workflow.log.read import RunLog
from flangeye.workflow.recipe.load import Recipe
from flangeye.workflow.report.look import LIGHT, SERIES
from flangeye.workflow.report.still import StillScene, frustum, ready, rods, still
from flangeye.workflow.report.units import millimetres
from flangeye_ui.project import Project

PUBLISHED = {
    "ur3": "ur_description/urdf/ur3_robot.urdf", "ur5": "ur_description/urdf/ur5_robot.urdf",
    "ur10": "ur_description/urdf/ur10_robot.urdf",
    "franka-panda": "panda_description/urdf/panda.urdf",
}  # fmt: skip
"""URDFs of the package ``example-robot-data`` that have the meshes of an arm, by model."""


def add(project: Project) -> None:
    """Serve the meshes of the scene."""

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
    """Return the URL of the mesh of the recipe's arm at these joint values."""
    return "shapes/arm.stl?q=" + ",".join(f"{x:.5f}" for x in joints)


@lru_cache(maxsize=256)
def _picture(kind: str, name: str) -> str:
    model = load_model(kind, name)  # type: ignore[arg-type]
    if kind == "robots":
        return still(StillScene(robot=model), name)
    return still(StillScene(scanner=model if isinstance(model, ScannerModel) else None), name)


def _mesh(robot: RobotModel, joints: Floats) -> bytes:
    """Return the arm as STL in the base: from its own or published meshes, or from capsules."""
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
    """Return the arm of ``example-robot-data`` with the same kinematics; None without one."""
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
    body = trimesh.creation.capsule(height=height, radius=radius, count=[24, 24])
    return body.apply_transform(place)


BASE_AXES = 0.25
"""Length of the base's axes [m]."""
Coordinates = tuple[float, float, float]
View = tuple[Coordinates, Coordinates, Coordinates]
"""Where the camera stands, where it looks [m], and the direction that is up."""
SCANNED: dict[str, View] = {
    "From the scanner": ((0.0, -0.02, 0.2), (0.0, 0.0, 0.8), (0.0, -1.0, 0.0)),
    "From the side": ((0.7, -0.1, 0.8), (0.0, 0.0, 0.8), (0.0, -1.0, 0.0)),
}
"""Views of a scan in its camera, whose y points down."""


class Scene3D(ui.scene):
    """A scene with axes and selectable views; a cell's scene also shows a floor grid."""

    def __init__(
        self,
        height: int,
        views: Mapping[str, View] | None = None,
        hovered: Callable[[str], None] | None = None,
    ) -> None:
        """Create a scene as wide as its column.

        Args:
            height: Height [px].
            views: Viewpoints by name; None for those of a cell.
            hovered: Called with the name of the object under the pointer.
        """
        # At night what is light is dark and colours keep their hue: a scene has one background
        # only.
        ui.add_css("body.body--dark .scene canvas {filter: invert(0.88) hue-rotate(180deg)}")
        self._hovered, self._last = hovered, ""
        # Until it is framed, a cell is as large as an arm's reach [m]
        self._of = views or views_of(np.array([[-0.5, -0.5, 0.0], [0.5, 0.5, 1.0]]))
        self._floor = views is None
        super().__init__(
            width=640, height=height, fps=20 if self._floor else 10, on_click=self._pointed,
            grid=(4, 16) if self._floor else False, background_color=LIGHT["panel"],
            click_events=["click", "mousemove"] if hovered else ["click"],
        )  # fmt: skip
        self.classes("w-full scene").style(f"height: {height}px")
        self.props('role="img" aria-label="The cell in 3D"')
        with self:
            for axis, name in enumerate("xyz"):
                tip = np.eye(3)[axis] * BASE_AXES
                self.line([0, 0, 0], tip.tolist()).material(SERIES[name])
                self.text(name, f"color: {SERIES[name]}").move(*(1.12 * tip).tolist())
        self._stays = set(self.objects)
        self._views()
        self.look(next(iter(self._of)))

    def _views(self) -> None:
        scale = "floor: squares of 250 mm; " if self._floor else ""  # 16 along 4 m
        with ui.row().classes("items-center gap-1 w-full"):
            for name in self._of:
                button = ui.button(name, on_click=lambda name=name: self.look(name))
                button.props("flat dense no-caps")
            ui.label(f"{scale}axes: {1e3 * BASE_AXES:.0f} mm; drag to rotate").classes("note")

    def wipe(self) -> None:
        """Remove everything except the axes."""
        self.delete_objects(lambda each: each.id not in self._stays)

    def fit(self) -> None:
        """Resize the scene to its column, which has no size while hidden."""
        self.run_method("resize")

    def frame(self, places: Floats) -> None:
        """Move the viewpoint such that all positions (N, 3) [m] fill the picture."""
        self._of = views_of(places)
        self.look(next(iter(self._of)))

    def look(self, view: str) -> None:
        """Switch to one of the views."""
        eye, middle, up = self._of[view]
        self.move_camera(*eye, *middle, *up, 0.0)

    def _pointed(self, event: events.SceneClickEventArguments) -> None:
        name = next((hit.object_name for hit in event.hits if hit.object_name), "")
        if self._hovered and name != self._last:
            self._last = name
            self._hovered(name)

    def arm(self, robot: RobotModel, joints: Floats | None = None) -> None:
        """Draw the arm, with these joint values or in a typical pose."""
        with self:
            body = self.stl(address_of_arm(ready(robot) if joints is None else joints))
            body.material("#aab4c3")

    def box_of(self, centre: Floats, size: Floats) -> None:
        """Draw the edges of the arm's allowed box [m]."""
        width, depth, height = np.asarray(size).tolist()
        with self:
            box = self.box(width, depth, height, wireframe=True)
            box.move(*np.asarray(centre).tolist()).material(SERIES["unused"])

    def sees(self, scanner: ScannerModel, base_T_camera: Floats) -> Any:
        """Draw the scanner's field of view; return the ball that represents the scanner."""
        near, far = frustum(scanner, base_T_camera)
        rays = [np.stack([base_T_camera[:3, 3], corner]) for corner in far[:4]]
        for line in (near, far, *rays):
            self.lines(line, SERIES["used"])
        with self:
            ball = self.sphere(0.05).move(*base_T_camera[:3, 3].tolist())
        return ball.material(SERIES["used"])

    def lines(self, points: Floats, colour: str) -> None:
        """Draw a polyline through points."""
        with self:
            for start, end in pairwise(np.asarray(points).tolist()):
                self.line(start, end).material(colour)

    def arrow(self, place: Floats, along: Floats, colour: str) -> None:
        """Draw an arrow from a place [m]."""
        across, other, tip = basis_of_plane(along)
        if not np.isfinite(tip).all():
            return
        turn, length = np.column_stack([across, tip, -other]).tolist(), float(np.linalg.norm(along))
        with self:
            shaft = self.cylinder(0.003, 0.003, length).move(*(place + along / 2).tolist())
            cone = self.cylinder(0.0, 0.009, 0.027).move(*(place + along).tolist())
        for part in (shaft, cone):
            part.rotate_R(turn).material(colour)

    def pose(self, place: Sequence[float], taken: bool, name: str) -> None:
        """Draw a pose of the flange: green if used, red if left out."""
        with self:
            ball = self.sphere(0.014).move(*place).with_name(name)
            ball.material(LIGHT["verified"] if taken else LIGHT["refused"])

    def say(self, text: str, place: Sequence[float]) -> None:
        """Write a text into the picture, in place of the last one."""
        self.delete_objects(lambda each: each.name == "said")
        if text:
            with self:
                shown = self.text(text, f"background: #fff; color: {LIGHT['refused']}")
                x, y, z = place
                shown.with_name("said").move(x, y, z + 0.05)

    def cloud(self, points: Floats, colour: str = "", size: float = 0.002) -> None:
        """Draw a cloud, thinned and rounded to 0.1 mm, with a point size [m].

        Without a colour the points of a scan are coloured by their distance from the camera.
        """
        # Points of a cloud that are sent: 20,000 held a browser up for a second on two busy cores
        most_sent = 2_500
        few = np.round(points[:: 1 + len(points) // most_sent], 4)
        with self:
            if colour:
                self.point_cloud(few.tolist(), point_size=size).material(colour)
            elif len(few):
                self.point_cloud(few.tolist(), by_distance(few[:, 2]).tolist(), size)


def by_distance(distances: Floats) -> Floats:
    """Return (N, 3) colours of N points, red first, 0 to 1: near ones yellow, far ones violet."""
    import cv2

    low, high = np.quantile(distances, [0.02, 0.98])
    near = np.interp(distances, [low, max(high, low + 1e-3)], [255, 0]).astype(np.uint8)
    colours = cv2.applyColorMap(near, cv2.COLORMAP_VIRIDIS).reshape(-1, 3)[:, ::-1]
    return np.round(colours / 255.0, 2)


def views_of(places: Floats) -> dict[str, View]:
    """Return views of a cell, each from where all of the places (N, 3) are in sight [m]."""
    low, high = places.min(axis=0), places.max(axis=0)
    middle = (low + high) / 2
    away = max(float(np.linalg.norm(high - low)), BASE_AXES)
    return {
        name: (_point(middle + away * np.array(towards)), _point(middle), (0.0, 0.0, 1.0))
        for name, towards in {
            "Overview": (0.65, -0.65, 0.4), "Front": (1.0, 0.0, 0.1), "Side": (0.0, -1.0, 0.1),
            "Top": (0.0, -0.01, 1.0),
        }.items()
    }  # fmt: skip


def _point(place: Floats) -> Coordinates:
    x, y, z = place.tolist()
    return x, y, z


def outline_of(feature: Feature) -> Floats:
    """Return (N, 3) points of a fitted circle in the camera; of other features, the centre."""
    if not isinstance(feature, CircleFeature) or feature.normal is None or not feature.radii:
        return np.asarray(feature.centre)[None]
    # Points that a circle is drawn with
    angles = np.linspace(0, 2 * np.pi, 90)
    ring = np.column_stack([np.cos(angles), np.sin(angles)])
    radius = max(feature.radii.values())
    return np.asarray(feature.centre + radius * ring @ basis_of_plane(feature.normal)[:2])


def drawing_of(project: Project) -> str:
    """Return the cell as SVG; empty while the recipe is wrong or has no arm."""
    recipe, _ = project.check()
    robot: RobotModel | None = recipe.context.get(RobotModel) if recipe else None
    if recipe is None or robot is None:
        return ""
    scanner = recipe.context.get(ScannerModel)
    at = None
    with suppress(FlangeyeError):
        at = base_T_camera_of(recipe)
    rows = project.plan if project.planned == project.text else []
    scene = StillScene(
        robot=robot,
        scanner=scanner if at is not None else None,
        base_T_camera=at,
        box=box_of(recipe),
        poses=[(np.array(row["place"]), not row["why_not"]) for row in rows],
    )
    return still(scene, f"The cell: {robot.model}{f' and {scanner.model}' if scanner else ''}")


def base_T_camera_of(recipe: Recipe) -> Floats | None:
    """Return the scanner's guessed or simulated pose; None without one.

    Raises:
        StageError: The poses that were shown are not poses of this arm.
    """
    params: Any = recipe.steps[0].params
    robot, scanner = (recipe.context.get(m) for m in (RobotModel, ScannerModel))
    view, camera = getattr(params, "view", None), getattr(params, "camera", None)
    if view is not None and robot is not None and scanner is not None:
        return np.asarray(view(Arm(robot), scanner))
    at = getattr(camera, "base_T_camera", None)
    return None if at is None else np.asarray(at)


def box_of(recipe: Recipe) -> tuple[Floats, Floats] | None:
    """Return centre and size of the box that the arm keeps to [m], if there is one."""
    limits = recipe.header.robot and recipe.header.robot.limits
    return (np.array(limits.box.centre), np.array(limits.box.size)) if limits else None


class ScanView:
    """A 3D scene, with a line on the outcome of its scan.

    Attributes:
        log: Log of the scans; None until it was read.
    """

    def __init__(self, log: RunLog | None = None) -> None:
        self.log = log
        self._output = ui.label().props('role="status"')
        self._scene = Scene3D(340, SCANNED)

    def say(self, text: str) -> None:
        """Show a text in place of a scan's verdict."""
        self._output.text = text

    def show(self, capture: str) -> None:
        """Show a scan: its flange, the fitted rim, and its outcome."""
        if self.log is None:
            return
        self.say(f"capture {capture}: {outcome_text(self.log, capture)}")
        self._scene.wipe()
        for entry in self.log.of_kind("segment"):
            if entry.capture == capture and isinstance(entry.value, t.FlangeCloud):
                self._cloud(entry.value)
        for entry in self.log.of_kind("fit"):
            if entry.capture == capture:
                self._scene.cloud(outline_of(entry.value), SERIES["circle"], 0.001)

    def _cloud(self, flange: t.FlangeCloud) -> None:
        self._scene.cloud(flange.cloud.points().astype(np.float64), SERIES["used"])
        at = np.asarray(flange.centre)
        (x, y, z), (to_x, to_y, to_z) = (at - 0.15 * at / np.linalg.norm(at)).tolist(), at.tolist()
        self._scene.move_camera(x, y, z, to_x, to_y, to_z, 0.0, -1.0, 0.0, 0.0)


def outcome_text(log: RunLog, capture: str) -> str:
    """Return the outcome of a capture in words."""
    for rejection in log.rejections:
        if rejection.id == capture:
            return f"set aside by {rejection.stage}: {rejection.reason}"
    calibration = log.calibration()
    for pair in calibration.pairs if calibration else ():
        if pair.observation.id == capture:
            residual = f"residual {millimetres(float(np.linalg.norm(pair.residual)))} mm"
            return f"{'used' if pair.used else 'not used'}, {pair.reason or residual}"
    if log.poses.get(capture, {}).get("role") == "verification":
        return "kept for verification"
    return "not solved"
