"""The flange's shape as points: areas, heights and normals are those of its dimensions."""

from pathlib import Path

import numpy as np
import pytest

from flangeye import StageError
from flangeye.models.loading import load_model
from flangeye.models.targets import wrist_circle_of
from flangeye_plugins.verify.registration import _normals, _ring, read_surface, surface_of
from tests.plugins.verify.test_icp import FLANGE_50, MM

SPACING = 0.4 * MM
SURFACE = surface_of(FLANGE_50, SPACING)
RADIUS = np.linalg.norm(SURFACE.points[:, :2], axis=1)
HEIGHT = SURFACE.points[:, 2]


def area(chosen: np.ndarray) -> float:
    """Return the area that points stand for [m^2]."""
    return float(chosen.sum()) * SPACING**2


@pytest.mark.parametrize(
    ("chosen", "expected", "normal"),
    [
        # The face without four holes and the pin's; the bore's floor; the wrist around the plate.
        ((HEIGHT == 0), np.pi * (30.5**2 - 16.4**2 - 5 * 3**2), 1.0),
        ((RADIUS < 15.7 * MM) & (HEIGHT < -6.1 * MM), np.pi * 15.75**2, 1.0),
        ((RADIUS > 31.6 * MM), np.pi * (37.5**2 - 31.5**2), 1.0),
        # The bore's wall below its chamfer, and the plate's below its own.
        ((np.abs(RADIUS - 15.75 * MM) < 1e-6), 2 * np.pi * 15.75 * (6.2 - 0.65), 0.0),
        ((np.abs(RADIUS - 31.5 * MM) < 1e-6), 2 * np.pi * 31.5 * (6.5 - 1.0), 0.0),
    ],
)
def test_a_part_of_the_shape_has_its_area_and_faces_its_way(
    chosen: np.ndarray, expected: float, normal: float
) -> None:
    assert area(chosen) == pytest.approx(expected * MM**2, rel=0.03)
    assert SURFACE.normals[chosen, 2] == pytest.approx(np.full(chosen.sum(), normal), abs=1e-9)


def test_walls_and_chamfers_face_outwards_at_the_rim_and_inwards_at_the_bore() -> None:
    outwards = np.einsum("ni,ni->n", SURFACE.normals[:, :2], SURFACE.points[:, :2]) / RADIUS
    chamfer = (HEIGHT < 0) & (HEIGHT > -0.65 * MM)
    for wall, rim, sign in (
        (np.abs(RADIUS - 31.5 * MM) < 1e-6, RADIUS > 30.5 * MM, 1),
        (np.abs(RADIUS - 15.75 * MM) < 1e-6, RADIUS < 16.4 * MM, -1),
    ):
        assert outwards[wall] == pytest.approx(np.full(wall.sum(), sign))
        slanted = chamfer & rim & ~wall
        assert slanted.sum() > 100
        assert outwards[slanted] == pytest.approx(np.full(slanted.sum(), sign * np.sqrt(0.5)))
        assert SURFACE.normals[slanted, 2] == pytest.approx(np.full(slanted.sum(), np.sqrt(0.5)))


def test_neighbours_are_as_far_apart_as_was_asked() -> None:
    near, _ = SURFACE.tree.query(SURFACE.points, k=2)
    assert np.median(near[:, 1]) == pytest.approx(SPACING, rel=0.1)


def test_of_a_wrist_circle_nothing_but_its_disc_is_known() -> None:
    model = wrist_circle_of(load_model("robots", "ur10e").flange, 0.09)
    disc = surface_of(model, 1 * MM)
    assert (disc.points[:, 2] == 0).all()
    assert len(disc.points) * MM**2 == pytest.approx(np.pi * 0.045**2, rel=0.03)


def test_a_line_of_no_length_sweeps_nothing() -> None:
    points, normals = _ring((0.01, 0.0), (0.01, 0.0), SPACING)
    assert points.shape == normals.shape == (0, 3)


def test_normals_are_where_a_neighbourhood_is_thinnest() -> None:
    rng = np.random.default_rng(0)
    flat = np.column_stack([rng.uniform(0, 1, (400, 2)), 1e-4 * rng.standard_normal(400)])
    assert np.abs(_normals(flat)[:, 2]) == pytest.approx(np.ones(400), abs=0.01)


def test_a_cloud_needs_a_hundred_points(tmp_path: Path) -> None:
    path = tmp_path / "few.xyz"
    points = np.random.default_rng(0).uniform(-30, 30, (100, 3))
    np.savetxt(path, points)
    found = read_surface(path, "mm", np.eye(3), np.array([0.0, 0.0, 1.0]))
    assert found.points == pytest.approx(points * MM + [0, 0, 1], abs=1e-6)
    np.savetxt(path, points[:99])
    with pytest.raises(StageError, match="few.xyz: 99 points; a flange needs 100 or more"):
        read_surface(path, "mm", np.eye(3), np.zeros(3))
