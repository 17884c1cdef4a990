"""The cell in 3D: arm, box, scanner and what it saw, drawn from the recipe and the log."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
from nicegui import ui

from flangeye.maths.geometry import basis_of_plane
from flangeye.maths.kinematics import Arm
from flangeye.models.robots import RobotModel
from flangeye.models.scanners import ScannerModel
from flangeye.types import CircleFeature, Feature, Floats

BALLS = 5
"""A capsule is drawn as so many balls."""
ROUND = 90
"""Points that a circle is drawn with."""

DARK = "body.body--dark .scene canvas {filter: invert(0.88) hue-rotate(180deg)}"
"""At night what is light is dark and colours keep their hue: a scene has one background only."""


def new_scene(width: int, height: int, fps: int = 20) -> ui.scene:
    """Return an empty scene as wide as its column, which follows the page into the dark."""
    ui.add_css(DARK)
    scene = ui.scene(width=width, height=height, fps=fps, background_color="#eef1f5")
    return scene.classes("w-full scene")


def draw_arm(scene: ui.scene, robot: RobotModel, joints: Floats) -> None:
    """Draw the arm's capsules; where the model has none, its links as lines."""
    frames, robot = Arm(robot).frames(joints), robot.filled()
    with scene:
        for volume in robot.volumes:
            frame = frames[volume.link]
            along = np.linspace(np.array(volume.start), np.array(volume.end), BALLS)
            places = frame[:3, :3] @ along.T + frame[:3, 3:]
            for place in places.T.tolist():
                scene.sphere(volume.radius).move(*place).material("#9aa4b4")
        if not robot.volumes:
            draw_lines(scene, frames[:, :3, 3], "#9aa4b4")


def draw_box(scene: ui.scene, centre: Floats, size: Floats, colour: str) -> None:
    """Draw the edges of a box."""
    width, depth, height = np.asarray(size).tolist()
    with scene:
        box = scene.box(width, depth, height, wireframe=True)
        box.move(*np.asarray(centre).tolist()).material(colour)


def draw_frustum(scene: ui.scene, scanner: ScannerModel, base_T_camera: Floats) -> None:
    """Draw what the scanner can see."""
    half = np.tan(np.array(scanner.field_of_view) / 2)
    signs = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1], [-1, -1]])
    rims = [
        np.column_stack([signs * half * depth, np.full(5, depth)])
        for depth in (scanner.near, scanner.far)
    ]
    placed = [rim @ base_T_camera[:3, :3].T + base_T_camera[:3, 3] for rim in rims]
    for rim in placed:
        draw_lines(scene, rim, "#3a7ebf")
    for near, far in zip(*placed, strict=True):
        draw_lines(scene, np.stack([near, far]), "#3a7ebf")


def draw_lines(scene: ui.scene, points: Floats, colour: str) -> None:
    """Draw lines from point to point."""
    with scene:
        for start, end in pairwise(np.asarray(points).tolist()):
            scene.line(start, end).material(colour)


def outline_of(feature: Feature) -> Floats:
    """Return (N, 3) points of a fitted circle in the camera; of what is no circle, its centre."""
    if not isinstance(feature, CircleFeature) or feature.normal is None or not feature.radii:
        return np.asarray(feature.centre)[None]
    angles = np.linspace(0, 2 * np.pi, ROUND)
    ring = np.column_stack([np.cos(angles), np.sin(angles)])
    radius = max(feature.radii.values())
    return np.asarray(feature.centre + radius * ring @ basis_of_plane(feature.normal)[:2])


def draw_cloud(
    scene: ui.scene, points: Floats, colour: tuple[float, float, float], size: float = 0.002
) -> Any:
    """Draw a cloud in one colour, its points of a size [m], and return it."""
    with scene:
        colours = np.tile(colour, (len(points), 1))
        return scene.point_cloud(points.tolist(), colours.tolist(), point_size=size)
