"""A seam that climbs, bends and twists, flattened; and a weld along one, in three dimensions."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
import yaml
from numpy.typing import NDArray

from flangeye.files.paths import bundled
from flangeye.maths.seam_geometry import distances_to_line
from flangeye.models.finger import Finger
from flangeye.models.model import read_model
from flangeye.motion.seam_following import Command
from flangeye.types import BASE, FLANGE, Seam, Transform
from flangeye.types.geometry import rigid, rotation_exp, rotation_from_rpy
from flangeye_emulators.finger.sensor import SimulatedFinger
from flangeye_emulators.weld_world.truth import ToolFile
from flangeye_emulators.world import bench
from flangeye_plugins.weld.frame import Tool, WorkSurface, body_from
from tests.plugins.weld import cell
from tools.weld_bench import FINGER

Floats = NDArray[np.float64]
TOLD = Finger.model_validate(
    {**FINGER, "direction": "30 deg", "tip": ["60 mm", "-20 mm", "150 mm"]}
)


def around(end: float) -> Floats:
    return np.linspace(0.0, np.radians(end), 400)


def pipe_on_plate(end: float = 200.0) -> tuple[Floats, Floats]:
    """A fillet about a pipe of 120 mm: its opening leans outwards by 45 deg."""
    angle = around(end)
    out = np.column_stack([np.cos(angle), np.sin(angle), 0 * angle])
    return 0.06 * out, (out + [0, 0, 1]) / np.sqrt(2)


def pipe_on_pipe(end: float = 200.0) -> tuple[Floats, Floats]:
    """A branch of 120 mm on a pipe of 200 mm: it climbs by up to 33 deg, and its opening turns."""
    angle, radius, run = around(end), 0.06, 0.1
    x, y = radius * np.cos(angle), radius * np.sin(angle)
    z = np.sqrt(run**2 - x**2)
    out = np.column_stack([np.cos(angle), np.sin(angle), 0 * angle])
    openings = np.column_stack([x, 0 * x, z]) / run + out
    points = np.column_stack([x, y, z - run])
    along = np.gradient(points, axis=0)
    along /= np.linalg.norm(along, axis=1)[:, None]
    openings -= np.sum(openings * along, axis=1)[:, None] * along
    return points, openings / np.linalg.norm(openings, axis=1)[:, None]


def over_a_hill(end: float = 0.15) -> tuple[Floats, Floats]:
    x = np.linspace(0.0, end, 400)
    points = np.column_stack(
        [x, 0.01 * np.sin(2 * np.pi * x / 0.15), 0.02 * np.sin(np.pi * x / 0.15)]
    )
    return points, np.tile([0.0, 0.0, 1.0], (len(x), 1))


SEAMS = (pipe_on_plate, pipe_on_pipe, over_a_hill)


@pytest.mark.parametrize("seam", SEAMS)
def test_what_is_flattened_is_as_long_and_comes_back_to_where_it_was(seam: Any) -> None:
    points, openings = seam()
    surface = WorkSurface(points, openings)
    lengths = np.linalg.norm(np.diff(points, axis=0), axis=1)
    assert np.linalg.norm(np.diff(surface.points, axis=0), axis=1) == pytest.approx(lengths)
    assert surface.path.length == pytest.approx(lengths.sum())
    along = np.concatenate([[0.0], np.cumsum(lengths)])
    assert surface.to_base(surface.points, along) == pytest.approx(points, abs=0.02e-3)
    beside = surface.points[::20] + [0.0, 0.0, 1.5e-3]
    for place, point in zip(beside, surface.to_base(beside, along[::20]), strict=True):
        assert surface.to_plane(point, surface.foot(point)) == pytest.approx(place, abs=1e-6)


def test_a_circle_turns_in_the_surface_by_its_part_of_the_curvature() -> None:
    """About a pipe of radius R, on a cone of 45 deg, the seam's radius is R / cos 45 deg."""
    surface = WorkSurface(*pipe_on_plate())
    bends = [surface.path.bend(s) for s in np.linspace(0.02, surface.path.length - 0.02, 9)]
    assert bends == pytest.approx([np.cos(np.pi / 4) / 0.06] * 9, rel=5e-3)


@pytest.mark.parametrize("seam", SEAMS)
def test_the_tool_stands_on_the_surface_with_tip_and_torch_on_the_seam(seam: Any) -> None:
    points, openings = seam()
    surface, body = WorkSurface(points, openings), body_from(TOLD.torch_from_tip, 0.0, 0.0)
    tool, path = Tool(TOLD, surface, body), WorkSurface(points, openings).path
    for s in np.linspace(0.06, path.length - 0.01, 7).tolist():
        place = path.at(s)
        angle = float(np.arctan2(*place.tangent[::-1]))
        # Turned until the torch is over the seam
        for _ in range(5):
            flange = tool.base_T_flange(np.array([*place.point, 0.0]), angle, s)
            torch = flange.apply(np.array(TOLD.tip) + TOLD.flange_R_tool @ TOLD.torch_from_tip)
            off = surface.to_plane(torch, surface.foot(torch))
            behind = path.at(surface.foot(torch))
            angle += float((off[:2] - behind.point) @ behind.normal) / body.distance
        assert np.linalg.norm(points - torch, axis=1).min() < 0.5e-3
        found = tool.pose(flange, 0.0)
        assert found.position == pytest.approx([*place.point, 0.0], abs=1e-6)
        missed = found.position[:2] - body.distance * found.direction - off[:2]
        assert missed @ behind.normal == pytest.approx(0.0, abs=0.1e-3)
        assert missed @ behind.tangent == pytest.approx(0.0, abs=1e-3)
        up = surface.at(s).axes[:, 2]
        assert up @ tool.up(flange.rotation) > np.cos(np.radians(30.0))


@pytest.mark.parametrize("seam", SEAMS)
def test_the_tip_goes_as_it_is_told_and_the_tool_stays_as_it_is_to_stand(seam: Any) -> None:
    surface = WorkSurface(*seam())
    tool, path = Tool(TOLD, surface), surface.path
    s, step = 0.5 * path.length, 1e-3
    place = path.at(s)
    angle = np.arctan2(*place.tangent[::-1])
    flange = tool.base_T_flange(np.array([*place.point, -1e-3]), angle, s)
    before = tool.pose(flange, 0.0)
    velocity = np.array([*(5e-3 * place.tangent + 1e-3 * place.normal), 0.5e-3])
    for _ in range(1000):
        place = path.at(surface.foot(flange.apply(np.array(TOLD.tip)), s))
        velocity = np.array([*(5e-3 * place.tangent + 1e-3 * place.normal), 0.5e-3])
        twist = tool.twist(Command(velocity, 0.0), flange)
        rotation = rotation_exp(twist[3:] * step) @ flange.rotation
        flange = Transform(BASE, FLANGE, rigid(rotation, flange.translation + twist[:3] * step))
    after = tool.pose(flange, 1.0)
    there = path.at(s + 5e-3)
    assert after.position[2] - before.position[2] == pytest.approx(0.5e-3, abs=0.05e-3)
    off = after.position[:2] - there.point
    assert off @ there.normal == pytest.approx(1e-3, abs=0.05e-3)
    assert off @ there.tangent == pytest.approx(0.0, abs=0.2e-3)
    stands = tool.base_T_flange(after.position, after.angle, s)
    away = tool.up(flange.rotation) @ tool.up(stands.rotation)
    assert away > np.cos(np.radians(0.5))


@pytest.mark.parametrize(
    ("seam", "end"),
    [(pipe_on_plate, 360.0), pytest.param(pipe_on_pipe, 110.0, marks=pytest.mark.slow)],
)
def test_the_torch_keeps_to_a_seam_that_bends_out_of_every_plane(
    seam: Any, end: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Judged from the flange's poses alone: the torch's distance to the left of the true seam.

    Once around, the torch goes 20 mm over the seam's start.
    """
    points, openings = seam(end)
    trimesh.creation.box(bounds=[points.min(axis=0) - 0.02, points.max(axis=0) + 0.02]).export(
        tmp_path / "part.stl"
    )
    file = {
        "title": "pipe", "cad": "part.stl", "unit": "m",
        "seams": [{"name": "groove", "points": points.tolist(), "opening": openings.tolist(),
                   "half_angle": "40 deg", "half_width": "8 mm"}],
    }  # fmt: skip
    (tmp_path / "part.yaml").write_text(yaml.safe_dump(file))
    line = points @ cell.HERE[:3, :3].T + cell.HERE[:3, 3]
    up = openings @ cell.HERE[:3, :3].T
    turn, middle = rotation_from_rpy(0.005, -0.005, 0.01), line.mean(axis=0)
    plan = (line - middle) @ turn.T + middle + [1.5e-3, -1e-3, 0.5e-3]
    planned = Seam(plan, up, np.tile(np.eye(3) * 1e-6, (len(plan), 1, 1)), np.radians(40.0))
    tool = read_model(bundled("data") / "tools" / "srm.yaml", ToolFile)
    torch = np.array(tool.tip) + tool.flange_R_tool @ tool.torch_from_tip
    where: list[Floats] = []
    frame = SimulatedFinger.frame

    def watched(self: SimulatedFinger) -> Any:
        where.append(bench.true_flange(self._robot.state()).apply(torch))
        return frame(self)

    monkeypatch.setattr(SimulatedFinger, "frame", watched)
    report, _ = cell.run(
        planned, str(tmp_path / "part.yaml"), speed="15 mm/s", ends="3 mm", overlap="20 mm",
        limits={"joint_speed": "90 deg/s"},
    )  # fmt: skip
    assert report.completed, report.reason
    seen = np.array(where)
    near = np.linalg.norm(seen[:, None] - line, axis=2).argmin(axis=1)
    begins = int(np.argmax((near > 3) & (near < 12)))
    seen, near = seen[begins:], near[begins:]
    along = np.linalg.norm(np.diff(line, axis=0, prepend=line[:1]), axis=1).cumsum()
    assert along[near[-1]] == pytest.approx(20e-3 if end == 360 else along[-1], abs=4e-3)
    # On the seam, between its ends
    on = (near > 3) & (near < len(line) - 4)
    on &= np.linalg.norm(seen - line[near], axis=1) < 8e-3
    left = np.cross(up, np.gradient(line, axis=0))
    left /= np.linalg.norm(left, axis=1)[:, None]
    off = np.sum((seen - line[near]) * left[near], axis=1)[on]
    welded = np.unique(near[on])
    assert len(welded) > 0.98 * (len(line) - 8)
    assert np.sqrt(np.mean(off**2)) < 0.25e-3 and np.abs(off).max() < 0.5e-3
    height = np.sum((seen - line[near]) * up[near], axis=1)[on]
    assert np.abs(height).max() < 2.5e-3
    # The world's own record agrees, also where the plane that it is flattened to lies on itself.
    arc_from = report.along >= report.figures["arc_from"]
    assert distances_to_line(report.true_torch[arc_from], line).max() < 8e-3
