"""What the structured-light scanner measures, misses and gets wrong."""

from typing import Any

import numpy as np
import pytest

from flangeye.types.geometry import rigid, rotation_from_rpy
from flangeye_emulators.world import scanner
from flangeye_emulators.world.mesh import MATERIALS, box
from flangeye_emulators.world.raycast import RaycastScene, SolidBody, pixels_of
from flangeye_emulators.world.scanner import (
    Distortion,
    StructuredLight,
    correlated_normal,
    normal_quantile,
)
from tests.emulators.world.bench import (
    SCANNER,
    facing,
    flange,
    flange_scene,
    in_flange,
    plate,
    quiet,
    zoomed,
)  # fmt: skip


def rng(seed=0):
    return np.random.default_rng(seed)


def scan(scanner, scene, resolution=1.0, noise=1.0, seed=0):
    return StructuredLight(scanner, resolution, noise, rng(7)).scan(scene, rng(seed))


def tilted_plate(tilt, material=MATERIALS["matt"]):
    """A large plate through (0, 0, 0.788 m), turned about the image's y."""
    turn = rigid(rotation_from_rpy(0, tilt, 0), np.array([0, 0, (SCANNER.near + SCANNER.far) / 2]))
    return RaycastScene([SolidBody(box([-0.6, -0.6, 0], [0.6, 0.6, 0.01]), material).moved(turn)])


def test_without_noise_the_face_is_a_plane_and_the_rim_a_circle() -> None:
    pose = facing(0.2)
    points = in_flange(scan(zoomed(quiet()), flange_scene(pose), noise=0.0), pose)
    radius, shape = np.hypot(points[:, 0], points[:, 1]), flange()
    assert shape.bore is not None
    face = (radius < shape.rim) & (radius > shape.bore) & (points[:, 2] > -2e-5)
    assert np.quantile(np.abs(points[face, 2]), 0.99) < 5e-7
    angle = np.arctan2(points[face, 1], points[face, 0])
    sector = ((angle + np.pi) / (2 * np.pi) * 90).astype(int) % 90
    outermost = np.array([radius[face][sector == k].max() for k in range(90)])
    innermost = np.array([radius[face][sector == k].min() for k in range(90)])
    # The outermost of a few pixels of 0.31 mm is a little inside the edge, on average.
    assert shape.rim - 0.15e-3 < outermost.mean() <= shape.rim
    assert shape.bore <= innermost.mean() < shape.bore + 0.15e-3


def test_a_scan_is_organised_and_missing_points_are_nan() -> None:
    points = scan(SCANNER, flange_scene(facing()), resolution=0.1)
    assert points.shape == (154, 206, 3)
    assert points.dtype == np.float32
    missing = np.isnan(points)
    assert (missing.any(axis=-1) == missing.all(axis=-1)).all()
    assert 0.1 < missing[..., 2].mean() < 0.9
    depth = points[~missing[..., 2]][:, 2]
    assert depth.min() > SCANNER.near - 2e-3 and depth.max() < SCANNER.far + 2e-3


def test_the_projector_throws_shadows_away_from_itself() -> None:
    block = SolidBody(box([-0.05, -0.05, 0.7], [0.05, 0.05, 0.72]), MATERIALS["matt"])
    points = scan(quiet(projection=None), RaycastScene([block, plate(0.9)]), 0.2, noise=0.0)
    pixels = pixels_of(SCANNER, 0.2)
    row = points[points.shape[0] // 2, :, 2]
    x_behind = pixels.directions[points.shape[0] // 2, :, 0] * 0.9
    missing = np.isnan(row)
    # Camera at 0, projector at x = 0.343, z = 0.071: light that passes the block's left edge meets
    # the plate at x = -0.176, and to the right of the block nothing is hidden but by the block.
    baseline = SCANNER.baseline * np.array(
        [np.cos(SCANNER.convergence), np.sin(SCANNER.convergence)]
    )
    edge = baseline[0] + (-0.05 - baseline[0]) * (0.9 - baseline[1]) / (0.7 - baseline[1])
    shadow = (x_behind > edge + 1e-3) & (x_behind < -0.05 * 0.9 / 0.7 - 1e-3)
    assert shadow.sum() > 30
    assert missing[shadow].all()
    assert not missing[(x_behind < edge - 1e-3) & (x_behind > -0.3)].any()
    assert not missing[(x_behind > 0.05 * 0.9 / 0.7 + 1e-3) & (x_behind < 0.3)].any()


def test_the_projector_lights_only_its_own_field() -> None:
    points = scan(quiet(), RaycastScene([plate(1.1, half=1.0)]), 0.1, noise=0.0)
    missing = np.isnan(points[..., 2]).mean(axis=0) > 0.5
    assert missing[-1] and not missing[0], "far off, its field lies towards its far side"


@pytest.mark.parametrize("tilt", [0.0, 0.6])
def test_noise_is_as_the_data_sheet_says_and_grows_with_incidence(tilt: float) -> None:
    scanner = zoomed(quiet(calibration_error=0.0))
    points = scan(scanner, tilted_plate(tilt))
    exact = scan(scanner, tilted_plate(tilt), noise=0.0)
    middle = (slice(120, 180), slice(160, 240))
    error = (points - exact)[middle][..., 2]
    error = error[np.isfinite(error)]
    assert error.size > 4700
    assert error.std() == pytest.approx(scanner.temporal_noise / np.cos(tilt), rel=0.04)
    assert abs(error.mean()) < 4 * error.std() / np.sqrt(error.size)


def test_noise_grows_with_the_square_of_the_depth() -> None:
    scanner = zoomed(quiet(calibration_error=0.0))
    deviation = [
        np.nanstd(scan(scanner, RaycastScene([plate(depth)]))[100:200, 100:300, 2])
        for depth in (0.5, 1.0)
    ]
    assert deviation[1] / deviation[0] == pytest.approx(4.0, rel=0.04)


@pytest.mark.parametrize(
    ("material", "grain"), [(MATERIALS["metal"], 1.2), (MATERIALS["anodised"], 1.5)]
)
def test_metal_is_noisier(material: Any, grain: float) -> None:
    scanner = zoomed(quiet(calibration_error=0.0))
    points = scan(scanner, RaycastScene([plate(0.788, material)]))[120:180, 160:240, 2]
    assert np.nanstd(points) == pytest.approx(grain * scanner.temporal_noise, rel=0.05)


def test_neighbours_share_their_noise() -> None:
    image = correlated_normal((400, 500), 1.7, rng())
    assert image.std() == pytest.approx(1.0, rel=0.03)
    for apart in (1, 3):
        measured = np.corrcoef(image[:, apart:].ravel(), image[:, :-apart].ravel())[0, 1]
        assert measured == pytest.approx(np.exp(-(apart**2) / (4 * 1.7**2)), abs=0.03)


def test_the_quantile_is_that_of_the_normal_distribution() -> None:
    assert normal_quantile(np.array([0.5, 0.8413, 0.1587])) == pytest.approx([0, 1, -1], abs=0.03)


def test_distortion_has_its_rms_and_is_smooth() -> None:
    pixels = pixels_of(SCANNER, 0.05)
    fields = [Distortion(SCANNER, pixels, 1e-4, rng(seed)) for seed in range(3)]
    depths = np.linspace(SCANNER.near, SCANNER.far, 21)
    for field in fields:
        errors = [field.depth_error(np.full((77, 103), d, dtype=np.float32)) for d in depths]
        assert np.sqrt(np.mean(np.square(errors))) == pytest.approx(1e-4, rel=0.1)
        assert np.abs(np.diff(errors[10], axis=1)).max() < 3e-5
    middle = np.full((77, 103), 0.788, dtype=np.float32)
    assert not np.array_equal(fields[0].depth_error(middle), fields[1].depth_error(middle))
    aside = fields[0].points(middle) - pixels.directions * middle[..., None]
    assert 0 < np.abs(aside[..., :2]).max() < 2e-4
    assert not aside[..., 2].any()


def test_scans_are_the_same_for_the_same_seed_and_no_other() -> None:
    scene = flange_scene(facing(0.2))
    first, again, other = (
        scan(SCANNER, scene, resolution=0.2, seed=seed) for seed in (3, 3, 4)
    )  # fmt: skip
    assert first.tobytes() == again.tobytes()
    assert not np.array_equal(first, other, equal_nan=True)


def test_metal_is_lost_where_it_mirrors_the_projector() -> None:
    # The bisector of the directions to camera and projector leans half of 24 degrees to x.
    bisecting = np.arctan2(SCANNER.baseline, 0.788 - 0.071) / 2
    lost = {}
    for name, material in {"metal": MATERIALS["metal"], "wall": MATERIALS["matt"]}.items():
        for turn in (-bisecting, bisecting):
            points = scan(zoomed(), tilted_plate(turn, material))
            lost[name, turn] = np.isnan(points[100:200, 150:250, 2]).mean()
    assert lost["metal", -bisecting] > 0.4
    assert lost["metal", bisecting] < 0.01
    assert lost["wall", -bisecting] < 0.01


def test_dark_surfaces_are_lost_when_seen_at_an_angle() -> None:
    lost = {
        (material.albedo, tilt): np.isnan(scan(zoomed(), tilted_plate(tilt, material))).mean()
        for material in (MATERIALS["anodised"], MATERIALS["painted"])
        for tilt in (0.1, 1.0)
    }
    assert lost[MATERIALS["anodised"].albedo, 0.1] < 0.02
    assert lost[MATERIALS["anodised"].albedo, 1.0] > 0.9
    assert lost[MATERIALS["painted"].albedo, 1.0] < 0.02


def test_edges_lose_points_and_few_fly() -> None:
    pose = facing(0.1)
    points = in_flange(scan(zoomed(), flange_scene(pose)), pose)
    clean = in_flange(scan(zoomed(quiet()), flange_scene(pose)), pose)
    radius, sharp = np.hypot(points[:, 0], points[:, 1]), np.hypot(clean[:, 0], clean[:, 1])
    outer = flange().outer
    rim = (radius > outer - 4e-4) & (radius < outer) & (points[:, 2] > -2e-3)
    sharp_rim = (sharp > outer - 4e-4) & (sharp < outer) & (clean[:, 2] > -2e-3)
    assert rim.sum() < 0.7 * sharp_rim.sum()
    flying = (points[:, 2] < -0.05) & (points[:, 2] > -0.25)
    assert 1 <= flying.sum() < 0.005 * len(points)


def test_distances_near_steps_are_those_of_the_whole_image() -> None:
    marked = np.random.default_rng(3).random((150, 2000)) < 1e-4
    marked[-1, -1] = marked[0, 0] = True
    whole, near = scanner.distance_to(marked), scanner.distance_within(9, marked)
    # All that noise looks at is exact; farther off, sums of steps are rounded by their order.
    assert np.array_equal(near[whole < 3], whole[whole < 3])
    assert np.abs(near - whole)[whole < 8].max() < 1e-6
    assert near[whole >= 8].min() > 7.999
