"""The cell in 3D: floor, axes, arm, box, scanner, poses and what was seen of the flange."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from nicegui import events, ui

from flangeye.maths.geometry import basis_of_plane
from flangeye.models.robots import RobotModel
from flangeye.models.scanners import ScannerModel
from flangeye.report.look import LIGHT, SERIES
from flangeye.report.still import frustum, ready
from flangeye.types import CircleFeature, Feature, Floats
from flangeye_ui.shapes import address_of_arm

ROUND = 90
"""Points that a circle is drawn with."""
FLOOR, SQUARES = 4, 16
"""Edge of the floor [m], and squares along it."""
AXES = 0.25
"""Length of the base's axes [m]."""
Point = tuple[float, float, float]
View = tuple[Point, Point, Point]
"""Where the camera stands, where it looks [m], and the direction that is up."""
CELL: dict[str, View] = {
    name: (eye, (0.35, 0.0, 0.4), (0.0, 0.0, 1.0))
    for name, eye in {
        "Overview": (1.2, -1.1, 0.95), "Front": (1.9, 0.0, 0.5), "Side": (0.35, -1.6, 0.5),
        "Top": (0.35, -0.01, 1.9),
    }.items()
}  # fmt: skip
"""Views of a cell in its base."""
SCANNED: dict[str, View] = {
    "From the scanner": ((0.0, -0.02, 0.2), (0.0, 0.0, 0.8), (0.0, -1.0, 0.0)),
    "From the side": ((0.7, -0.1, 0.8), (0.0, 0.0, 0.8), (0.0, -1.0, 0.0)),
}
"""Views of a scan in its camera, whose y points down."""
SCAN, FLANGE, RIM, EARLIER = "#1f242e", "#0533bf", "#d91a1a", "#809980"
"""Colours of clouds; the rims of earlier scans are pale."""
TAKEN, LEFT_OUT = "#2e9e5b", "#d64545"
"""Colours of poses and of what is left at them."""
SHAFT, TIP = 0.002, 0.006
"""Radii of an arrow [m]."""
SHOWN = 2_500
"""Points of a cloud that are sent: 20,000 held a browser up for a second on two busy cores."""
DARK = "body.body--dark .scene canvas {filter: invert(0.88) hue-rotate(180deg)}"
"""At night what is light is dark and colours keep their hue: a scene has one background only."""


class Scene3D(ui.scene):
    """A scene with axes and views to choose from; of a cell also with a floor in squares."""

    def __init__(
        self,
        height: int,
        views: Mapping[str, View] = CELL,
        hovered: Callable[[str], None] | None = None,
    ) -> None:
        """Make one as wide as its column; ``hovered`` hears which named thing is pointed at."""
        ui.add_css(DARK)
        self._hovered, self._last, self._of = hovered, "", views
        self._floor = views is not SCANNED
        super().__init__(
            width=640, height=height, fps=20 if self._floor else 10, on_click=self._pointed,
            grid=(FLOOR, SQUARES) if self._floor else False, background_color=LIGHT["panel"],
            click_events=["click", "mousemove"] if hovered else ["click"],
        )  # fmt: skip
        self.classes("w-full scene").style(f"height: {height}px")
        self.props('role="img" aria-label="The cell in 3D"')
        with self:
            for axis, name in enumerate("xyz"):
                tip = np.eye(3)[axis] * AXES
                self.line([0, 0, 0], tip.tolist()).material(SERIES[name])
                self.text(name, f"color: {SERIES[name]}").move(*(1.12 * tip).tolist())
        self._stays = set(self.objects)
        self._views()
        self.look(next(iter(views)))

    def _views(self) -> None:
        scale = f"floor: squares of {1e3 * FLOOR / SQUARES:.0f} mm; " if self._floor else ""
        with ui.row().classes("items-center gap-1 w-full"):
            for name in self._of:
                button = ui.button(name, on_click=lambda name=name: self.look(name))
                button.props("flat dense no-caps")
            ui.label(f"{scale}axes: {1e3 * AXES:.0f} mm; drag to turn").classes("note")

    def wipe(self) -> None:
        """Take everything away but the axes."""
        self.delete_objects(lambda each: each.id not in self._stays)

    def fit(self) -> None:
        """Take the size of the column, after it was hidden."""
        self.run_method("resize")

    def look(self, view: str) -> None:
        """Look from one of the views."""
        eye, middle, up = self._of[view]
        self.move_camera(*eye, *middle, *up, 0.0)

    def _pointed(self, event: events.SceneClickEventArguments) -> None:
        name = next((hit.object_name for hit in event.hits if hit.object_name), "")
        if self._hovered and name != self._last:
            self._last = name
            self._hovered(name)

    def arm(self, robot: RobotModel, joints: Floats | None = None) -> None:
        """Draw the arm, with these joint values or ready to be scanned."""
        with self:
            body = self.stl(address_of_arm(ready(robot) if joints is None else joints))
            body.material("#aab4c3")

    def box_of(self, centre: Floats, size: Floats) -> None:
        """Draw the edges of the box that the arm keeps to [m]."""
        width, depth, height = np.asarray(size).tolist()
        with self:
            box = self.box(width, depth, height, wireframe=True)
            box.move(*np.asarray(centre).tolist()).material(SERIES["unused"])

    def sees(self, scanner: ScannerModel, base_T_camera: Floats) -> Any:
        """Draw what the scanner can see, and return the ball that stands for it."""
        near, far = frustum(scanner, base_T_camera)
        rays = [np.stack([base_T_camera[:3, 3], corner]) for corner in far[:4]]
        for line in (near, far, *rays):
            self.lines(line, SERIES["used"])
        with self:
            ball = self.sphere(0.05).move(*base_T_camera[:3, 3].tolist())
        return ball.material(SERIES["used"])

    def lines(self, points: Floats, colour: str) -> None:
        """Draw lines from point to point."""
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
            shaft = self.cylinder(SHAFT, SHAFT, length).move(*(place + along / 2).tolist())
            cone = self.cylinder(0.0, TIP, 3 * TIP).move(*(place + along).tolist())
        for part in (shaft, cone):
            part.rotate_R(turn).material(colour)

    def pose(self, place: Sequence[float], taken: bool, name: str) -> None:
        """Draw a pose of the flange, green where it is taken and red where it is left out."""
        with self:
            ball = self.sphere(0.014).move(*place).with_name(name)
            ball.material(TAKEN if taken else LEFT_OUT)

    def say(self, text: str, place: Sequence[float]) -> None:
        """Write in the picture, in place of what was written last."""
        self.delete_objects(lambda each: each.name == "said")
        if text:
            with self:
                shown = self.text(text, f"background: #fff; color: {LIGHT['refused']}")
                x, y, z = place
                shown.with_name("said").move(x, y, z + 0.05)

    def cloud(self, points: Floats, colour: str, size: float = 0.002) -> None:
        """Draw a cloud, thinned and to 0.1 mm, in one colour, its points of a size [m]."""
        few = np.round(points[:: 1 + len(points) // SHOWN], 4)
        with self:
            self.point_cloud(few.tolist(), point_size=size).material(colour)


def views_of(places: Floats) -> dict[str, View]:
    """Return views of a cell, at first from near the places (N, 3) that matter [m]."""
    middle = (places.min(axis=0) + places.max(axis=0)) / 2
    away = 1.4 * max(float(np.ptp(places, axis=0).max()), AXES)
    eye = middle + away * np.array([0.75, -0.75, 0.45])
    (x, y, z), (to_x, to_y, to_z) = eye.tolist(), middle.tolist()
    return {"Near": ((x, y, z), (to_x, to_y, to_z), (0.0, 0.0, 1.0)), **CELL}


def outline_of(feature: Feature) -> Floats:
    """Return (N, 3) points of a fitted circle in the camera; of what is no circle, its centre."""
    if not isinstance(feature, CircleFeature) or feature.normal is None or not feature.radii:
        return np.asarray(feature.centre)[None]
    angles = np.linspace(0, 2 * np.pi, ROUND)
    ring = np.column_stack([np.cos(angles), np.sin(angles)])
    radius = max(feature.radii.values())
    return np.asarray(feature.centre + radius * ring @ basis_of_plane(feature.normal)[:2])
