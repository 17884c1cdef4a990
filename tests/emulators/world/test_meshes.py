"""Shapes are where they should be, to a micrometre."""

from typing import Any

import numpy as np
import pytest

from flangeye import StageError
from flangeye.models.loading import load_model
from flangeye.models.targets import flange_of, load_standard
from flangeye_emulators.world.mesh import (
    SEGMENTS,
    box,
    capsule,
    circle,
    disc,
    flange_mesh,
    merged,
    recess_outline,
    region,
    wrist_mesh,
)
from tests.emulators.world.bench import flange


def area(mesh, keep=slice(None)):
    a, b, c = np.moveaxis(mesh.vertices[mesh.triangles[keep]], 1, 0)
    return 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1).sum()


def polygon(radius, segments):
    """Area of a regular polygon on a circle."""
    return 0.5 * segments * radius**2 * np.sin(2 * np.pi / segments)


def test_a_measured_circle_is_round_to_a_micrometre() -> None:
    inside = circle(50e-3, SEGMENTS)
    middles = (inside + np.roll(inside, 1, axis=0)) / 2
    assert 50e-3 - np.hypot(*middles.T).min() < 1e-6


def test_a_region_has_the_area_of_its_outline_less_its_holes() -> None:
    holes = [circle(0.01, 90, (0.02, 0)), circle(0.005, 60, (-0.02, 0.01))]
    mesh = region(circle(0.05, 180), holes, 0.3)
    wanted = polygon(0.05, 180) - polygon(0.01, 90) - polygon(0.005, 60)
    assert area(mesh) == pytest.approx(wanted, rel=1e-9)
    assert (mesh.vertices[:, 2] == 0.3).all()


@pytest.mark.parametrize("robot", ["ur5", "franka-panda", "aubo-i5"])
def test_the_face_is_the_rim_less_bore_holes_and_recesses(robot: str) -> None:
    shape = flange(robot)
    mesh = flange_mesh(shape)
    face = (mesh.vertices[mesh.triangles][:, :, 2] == 0).all(axis=1)
    holes = len(shape.holes) * polygon(shape.hole, 120) + polygon(shape.pin_hole, 120)
    slots = [s.width**2 / 4 * np.pi + 2 * s.half_span * s.radius * s.width
             for s in shape.details.recesses]  # fmt: skip
    wanted = polygon(shape.rim, SEGMENTS) - polygon(shape.bore, SEGMENTS) - holes - sum(slots)
    assert area(mesh, face) == pytest.approx(wanted, rel=3e-4)


def test_the_chamfers_fall_at_45_degrees() -> None:
    shape = flange()
    vertices = flange_mesh(shape).vertices
    radius = np.hypot(vertices[:, 0], vertices[:, 1])
    bottom = vertices[np.isclose(radius, shape.outer, atol=1e-9), 2]
    assert bottom.max() == pytest.approx(shape.rim - shape.outer)
    assert shape.bore is not None
    inner = np.isclose(radius, shape.bore - shape.details.bore_chamfer, atol=1e-9)
    assert vertices[inner, 2].max() == pytest.approx(-shape.details.bore_chamfer)


def test_the_flange_lies_behind_its_face_and_before_the_wrist() -> None:
    shape = flange()
    z = flange_mesh(shape).vertices[:, 2]
    assert z.max() == 0
    assert wrist_mesh(shape).vertices[:, 2].max() == -shape.details.thickness


def test_a_recess_follows_its_circle() -> None:
    recess = flange("franka-panda").details.recesses[0]
    outline = recess_outline(recess)
    radius = np.hypot(*outline.T)
    assert radius.min() == pytest.approx(recess.radius - recess.width / 2, rel=1e-6)
    assert radius.max() == pytest.approx(recess.radius + recess.width / 2, rel=1e-6)
    middle = outline.mean(axis=0)
    assert np.arctan2(middle[1], middle[0]) == pytest.approx(recess.angle, abs=1e-6)


@pytest.mark.parametrize("end", [(0, 0, 0.3), (0.1, -0.2, 0.05), (0, 0, 0)])
def test_every_point_of_a_capsule_is_a_radius_from_its_axis(end: tuple[Any, ...]) -> None:
    start, stop = np.array([0.1, 0.2, 0.3]), np.array([0.1, 0.2, 0.3]) + end
    vertices = capsule(start, stop, 0.05, 24).vertices
    along = stop - start
    share = np.clip((vertices - start) @ along / max(along @ along, 1e-30), 0, 1)
    distance = np.linalg.norm(vertices - start - share[:, None] * along, axis=1)
    assert distance == pytest.approx(np.full(len(vertices), 0.05), abs=1e-12)


def test_box_disc_and_merging() -> None:
    both = merged([box([0, 0, 0], [1, 2, 3]), disc(1.0, 5.0)])
    assert area(both) == pytest.approx(2 * (2 + 3 + 6) + polygon(1.0, SEGMENTS))
    assert both.triangles.max() == len(both.vertices) - 1


def test_a_plate_of_another_standard_has_none_of_the_robots_recesses() -> None:
    robot = load_model("robots", "franka-panda")
    small = flange_mesh(flange_of(robot.flange, load_standard("40-4-M6")))
    assert not np.isclose(small.vertices[:, 2], -robot.flange.recesses[0].depth, atol=1e-9).any()


def test_holes_that_do_not_fit_are_refused() -> None:
    crowded = flange().model_copy(update={"pitch": 0.019})
    with pytest.raises(StageError) as error:
        flange_mesh(crowded)
    assert str(error.value) == (
        "flange ISO 9409-1-50-4-M6: holes of 6.90 mm on a pitch circle of 38.00 mm do not fit "
        "between its bore and its rim"
    )
