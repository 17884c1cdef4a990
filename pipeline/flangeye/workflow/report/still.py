"""A still SVG picture of a cell: arm, field of view, workspace box and poses."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from html import escape
from itertools import pairwise

import numpy as np

from flangeye.maths.kinematics import Arm
from flangeye.models.robots import RobotModel
from flangeye.models.scanners import ScannerModel
from flangeye.types import Floats
from flangeye.types.geometry import rigid, rotation_from_rpy
from flangeye.workflow.report.facts import Facts
from flangeye.workflow.report.look import SERIES

AZIMUTH, ELEVATION = np.radians(-62.0), np.radians(20.0)
"""Where the picture is taken from, about the base: it shows an arm that reaches along x."""
LINE_IN_PIXELS = 'vector-effect="non-scaling-stroke"'
"""Attribute that keeps a line's width in pixels at any scale of the picture."""


@dataclass(frozen=True, eq=False)
class StillScene:
    """The content of a still picture, in the base.

    Attributes:
        robot: The arm, drawn from its capsules.
        joints: Joint values of the arm [rad or m]; None draws it in a typical pose.
        scanner: The scanner.
        base_T_camera: (4, 4) pose of the camera; None where unknown.
        box: Centre and size of the arm's allowed box [m].
        poses: Positions of the flange [m], each with whether it was taken.
    """

    robot: RobotModel | None = None
    joints: Floats | None = None
    scanner: ScannerModel | None = None
    base_T_camera: Floats | None = None
    box: tuple[Floats, Floats] | None = None
    poses: Sequence[tuple[Floats, bool]] = ()


def ready(robot: RobotModel) -> Floats:
    """Return typical joint values for a drawing, with the flange out and up."""
    return np.array(_ready(robot.model_dump_json()))


@lru_cache(maxsize=64)
def _ready(model: str) -> tuple[float, ...]:
    robot = RobotModel.model_validate_json(model)
    arm, reach = Arm(robot), robot.length
    for far, high in ((0.45, 0.30), (0.35, 0.35), (0.30, 0.20)):
        flange = np.array([far * reach, 0.0, high * reach])
        # Of the flange from level, in the arm that is ready to be scanned [rad]
        found = arm.inverse(rigid(rotation_from_rpy(0.0, 0.25, 0.0), flange))
        if len(found):
            # Elbow up: the solution whose links are highest, and none of them below the floor
            heights = [arm.frames(q)[:, 2, 3].min() + arm.frames(q)[:, 2, 3].mean() for q in found]
            return tuple(found[int(np.argmax(heights))])
    return (0.0,) * arm.n


def scene_of(facts: Facts) -> StillScene | None:
    """Return the calibrated cell, with its arm at the first used pose.

    None if the scanner is not fixed to the base, or a model is not available.
    """
    arm, camera = facts.model("robots"), facts.model("scanners")
    if facts.base_T_camera is None or arm is None or camera is None:
        return None
    used = [o for o in facts.measured if o.used]
    joints = next((facts.log.poses[o.id]["joints"] for o in used if o.id in facts.log.poses), None)
    return StillScene(
        robot=arm,
        joints=None if joints is None else np.array(joints),
        scanner=camera if isinstance(camera, ScannerModel) else None,
        base_T_camera=facts.base_T_camera,
        poses=[(np.array(o.tcp_in_base), o.used) for o in facts.measured if o.tcp_in_base],
    )


def still(scene: StillScene, label: str) -> str:
    """Return the picture as SVG, with the colours of the page that contains it."""
    shapes = [*_arm(scene), *_seen(scene), *_kept(scene), *_poses(scene)]
    corners = np.vstack([shape.points for shape in shapes] or [np.zeros((1, 3))])
    floor = _floor(corners)
    flat = np.vstack([_flat(shape.points) for shape in [*floor, *shapes]])
    margin = 0.08  # [m]
    low, high = flat.min(axis=0) - margin, flat.max(axis=0) + margin
    size = high - low
    drawn = "".join(shape.drawn() for shape in [*floor, *shapes])
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" role="img" '
        f'viewBox="{low[0]:.3f} {low[1]:.3f} {size[0]:.3f} {size[1]:.3f}" '
        f'style="width:100%;height:100%" fill="none" stroke-linecap="round" '
        f'stroke-linejoin="round"><title>{escape(label)}</title>{drawn}</svg>'
    )


@dataclass(frozen=True, eq=False)
class _Polyline:
    """A line through (N, 3) points [m]."""

    points: Floats
    colour: str
    width: float
    more: str = ""

    def drawn(self) -> str:
        at = " ".join(f"{x:.3f},{y:.3f}" for x, y in _flat(self.points))
        style = f'style="stroke:{self.colour}" stroke-width="{self.width:.4f}"'
        return f'<polyline points="{at}" {style} {self.more}/>'


def _flat(points: Floats) -> Floats:
    """Return the positions (N, 2) of points in the picture, with y down."""
    ahead = np.array([np.cos(AZIMUTH), np.sin(AZIMUTH), 0.0])
    right = np.array([-ahead[1], ahead[0], 0.0])
    up = np.cos(ELEVATION) * np.array([0.0, 0.0, 1.0]) - np.sin(ELEVATION) * ahead
    return np.asarray(np.atleast_2d(points) @ np.stack([right, -up], axis=1))


def _floor(corners: Floats) -> Iterable[_Polyline]:
    """Return the squares of the floor below everything, and the axes of the base."""
    # Edge of a square of the floor [m].
    square = 0.25
    low = np.floor(np.minimum(corners.min(axis=0), -square) / square)[:2].astype(int)
    high = np.ceil(np.maximum(corners.max(axis=0), square) / square)[:2].astype(int)
    lines = []
    for axis in (0, 1):
        for n in range(low[axis], high[axis] + 1):
            ends = np.zeros((2, 3))
            ends[:, axis], ends[:, 1 - axis] = n, (low[1 - axis], high[1 - axis])
            lines.append(_Polyline(square * ends, "var(--grid, #9aa4b4)", 1.0, LINE_IN_PIXELS))
    for axis, colour in enumerate((SERIES["x"], SERIES["y"], SERIES["z"])):
        tip = np.zeros((2, 3))
        tip[1, axis] = square
        lines.append(_Polyline(tip, colour, 0.012))
    return lines


def rods(robot: RobotModel, joints: Floats) -> list[tuple[float, Floats]]:
    """Return the arm's capsules, the flange's included: radius and ends (2, 3) in base [m]."""
    arm = Arm(robot)
    frames, flange = arm.frames(joints), arm.flange(joints)
    found = [
        (v.radius, np.array([v.start, v.end]) @ at[:3, :3].T + at[:3, 3])
        for v, at in ((v, frames[v.link]) for v in robot.filled().volumes)
    ]
    origins = frames[:, :3, 3]
    # Radius of the links of an arm whose capsules are not in its file [m]
    found = found or [(0.045, np.stack(pair)) for pair in pairwise(origins)]
    # Radius of the smallest flange plate of ISO 9409-1 that arms of this size carry [m]
    plate = 0.032
    return [*found, (plate, flange[:3, 3] - np.outer([0.03, plate], flange[:3, 2]))]


def _arm(scene: StillScene) -> list[_Polyline]:
    """Return the arm's capsules, the far ones first, each with an edge."""
    if scene.robot is None:
        return []
    joints = ready(scene.robot) if scene.joints is None else scene.joints
    # Painter's algorithm: the nearest capsule is drawn last
    towards = np.array([np.cos(AZIMUTH), np.sin(AZIMUTH), np.tan(ELEVATION)])
    placed = sorted(rods(scene.robot, joints), key=lambda rod: float((rod[1] @ towards).mean()))
    edge, fill = "var(--axis, #5b6474)", "var(--arm, #b9c1cd)"
    lines = []
    for radius, ends in placed:
        lines.append(_Polyline(ends, edge, 2 * radius))
        # Width of the dark edge round the arm [m]
        lines.append(_Polyline(ends, fill, 2 * radius - 0.012))
    flange = Arm(scene.robot).flange(joints)
    return [
        *lines,
        _Polyline(flange[:3, 3] + np.outer([0.0, 0.1], flange[:3, 2]), SERIES["circle"], 0.01),
    ]


def _seen(scene: StillScene) -> list[_Polyline]:
    """Return lines of the scanner and of its field of view."""
    if scene.scanner is None:
        return []
    at = np.eye(4) if scene.base_T_camera is None else scene.base_T_camera
    near, far = frustum(scene.scanner, at)
    rays = [np.stack([at[:3, 3], corner]) for corner in far[:4]]
    edges = [_Polyline(line, SERIES["used"], 1.5, LINE_IN_PIXELS) for line in (near, far, *rays)]
    return [*edges, _Polyline(np.stack([at[:3, 3]] * 2), SERIES["used"], 9.0, LINE_IN_PIXELS)]


def frustum(scanner: ScannerModel, base_T_camera: Floats) -> tuple[Floats, Floats]:
    """Return (5, 3) closed outlines of the nearest and the farthest that a scanner sees [m]."""
    half = np.tan(np.array(scanner.field_of_view) / 2)
    signs = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1], [-1, -1]])
    near, far = (
        np.column_stack([signs * half * depth, np.full(5, depth)]) @ base_T_camera[:3, :3].T
        + base_T_camera[:3, 3]
        for depth in (scanner.near, scanner.far)
    )
    return near, far


def _kept(scene: StillScene) -> list[_Polyline]:
    """Return the edges of the box that the arm keeps to."""
    if scene.box is None:
        return []
    centre, size = scene.box
    signs = [[-1, -1], [1, -1], [1, 1], [-1, 1], [-1, -1]]
    rims = [np.column_stack([np.array(signs), np.full(5, z)]) * size / 2 + centre for z in (-1, 1)]
    posts = [np.stack(pair) for pair in zip(*(rim[:4] for rim in rims), strict=True)]
    dashed = f'{LINE_IN_PIXELS} stroke-dasharray="4 4"'
    return [_Polyline(line, "var(--unverified, #d98a00)", 1.0, dashed) for line in [*rims, *posts]]


def _poses(scene: StillScene) -> list[_Polyline]:
    good, bad = "var(--verified, #1a7f45)", "var(--refused, #c02626)"
    return [_Polyline(np.stack([at, at]), good if used else bad, 0.03) for at, used in scene.poses]
