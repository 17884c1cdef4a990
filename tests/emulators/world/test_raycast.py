"""The shortcuts of ray casting change nothing."""

import numpy as np
import pytest

from flangeye.models.loading import load_model
from flangeye_emulators.world.cell import SimulatedCell
from flangeye_emulators.world.raycast import Pixels, RaycastScene, _rays, pixels_of
from tests.emulators.world.bench import SCANNER, facing, flange, flange_scene, plate, zoomed


def axes_of(pixels: Pixels) -> list[np.ndarray]:
    return list(np.moveaxis(pixels.directions, -1, 0))


def test_pixels_fill_the_field_of_view() -> None:
    pixels = pixels_of(SCANNER)
    assert pixels.directions.shape == (1544, 2064, 3)
    middle_row = pixels.directions[772]
    half = np.tan(SCANNER.field_of_view[0] / 2)
    assert middle_row[0, 0] - pixels.size / 2 == pytest.approx(-half, rel=1e-6)
    assert middle_row[-1, 0] + pixels.size / 2 == pytest.approx(half, rel=1e-6)


def test_resolution_scales_the_image_and_keeps_the_field() -> None:
    pixels = pixels_of(SCANNER, 0.25)
    assert pixels.directions.shape == (386, 516, 3)
    assert pixels.size == pytest.approx(4 * pixels_of(SCANNER).size, rel=1e-6)


@pytest.mark.parametrize("size", [(400, 300), (399, 301)])
@pytest.mark.parametrize("tilt", [0.0, 0.4])
def test_looking_at_every_second_pixel_finds_what_every_pixel_sees(
    tilt: float, size: tuple[int, int]
) -> None:
    pixels = pixels_of(zoomed(SCANNER, *size))
    scene = flange_scene(facing(tilt))
    quick, full = scene.look(pixels), scene._cast(_rays(np.zeros(3), *axes_of(pixels)))
    assert (quick.body == full.body).mean() > 0.9999
    same = quick.body == full.body
    assert np.abs(quick.depth - full.depth)[same].max() < 2e-6
    towards = np.stack([quick.facing(axis) for axis in np.eye(3)])
    assert np.abs((towards * full.normals).sum(axis=0))[same].min() > 0.999
    slant = (np.stack(axes_of(pixels)) * towards).sum(axis=0)
    assert np.abs(quick.slant - slant).max() < 1e-6


def test_shadows_at_every_second_pixel_are_those_at_every_pixel() -> None:
    pixels = pixels_of(zoomed())
    scene = flange_scene(facing(0.3))
    light = np.array([0.35, 0.0, 0.07])
    depth = scene.look(pixels).depth
    points = pixels.directions * depth[..., None]
    hidden = scene.hidden(light, pixels, depth, np.ones(depth.shape, bool))
    assert 0 < hidden.mean() < 1
    exactly = scene._blocked(_rays(light, *np.moveaxis(points - light, -1, 0)))
    assert (hidden != exactly).mean() < 1e-3
    part = np.zeros(depth.shape, bool)
    part[101:220, 33:280] = True
    np.testing.assert_array_equal(scene.hidden(light, pixels, depth, part)[part], hidden[part])


def test_a_gap_shows_nothing() -> None:
    pixels = pixels_of(SCANNER, 0.05)
    seen = RaycastScene([plate(0.8, half=0.1)]).look(pixels)
    assert not np.isfinite(seen.depth[0, 0])
    assert seen.depth[38, 51] == pytest.approx(0.8, abs=1e-6)


def test_a_plane_is_flat_to_single_precision() -> None:
    pixels = pixels_of(zoomed())
    camera_T_flange = facing(0.3)
    seen = flange_scene(camera_T_flange).look(pixels)
    points = (pixels.directions * seen.depth[..., None]).reshape(-1, 3).astype(np.float64)
    local = (points - camera_T_flange[:3, 3]) @ camera_T_flange[:3, :3]
    radius = np.hypot(local[:, 0], local[:, 1])
    shape = flange()
    assert shape.bore is not None
    face = (radius > shape.bore + 1e-5) & (radius < shape.rim - 1e-5) & (local[:, 2] > -5e-5)
    assert face.sum() > 15000
    # All but the pixels that just touch a countersink.
    assert np.quantile(np.abs(local[face, 2]), 0.99) < 5e-7


def test_the_cell_has_a_second_disc_of_a_similar_size() -> None:
    robot_flange = flange()
    cell = SimulatedCell(
        load_model("robots", "ur5"),
        robot_flange,
        np.array([0.6, 0, 0.3]),
        np.array([0.3, 0.3, 0.2]),
    )
    table, wall, ring, post = cell.around()
    assert table.mesh.vertices[:, 2].max() == 0
    assert wall.mesh.vertices[:, 0].min() > 0.6 + 0.15
    size = np.ptp(ring.mesh.vertices, axis=0).max()
    assert 1.1 < size / (2 * robot_flange.outer) < 1.2
    assert np.abs(ring.mesh.vertices[:, 1]).min() > 0.15
    assert post.material.albedo < 0.05


def test_an_arm_without_volumes_is_a_flange_in_the_air() -> None:
    robot = load_model("robots", "ur5").model_copy(update={"volumes": ()})
    cell = SimulatedCell(robot, flange(), np.array([0.6, 0, 0.3]), np.array([0.3, 0.3, 0.2]))
    assert len(cell.arm(np.tile(np.eye(4), (7, 1, 1)), np.eye(4))) == 2
