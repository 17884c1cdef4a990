"""What the time-of-flight camera measures and gets wrong."""

import numpy as np
import pytest

from flangeye.models.loading import load_model
from flangeye_emulators.world.mesh import MATERIALS, box
from flangeye_emulators.world.raycast import RaycastScene, SolidBody, pixels_of
from flangeye_emulators.world.scanner import TimeOfFlight
from tests.emulators.world.bench import plate

KINECT = load_model("scanners", "azure-kinect")


def scan(bodies, resolution=0.25, noise=1.0, seed=0, **changes):
    scanner = KINECT.model_copy(update={"calibration_error": 0.0, "noise_grain": 0.0, **changes})
    camera = TimeOfFlight(scanner, resolution, noise, np.random.default_rng(7))
    return camera.scan(RaycastScene(bodies), np.random.default_rng(seed))


def middle(points):
    rows, columns = points.shape[:2]
    return points[rows // 4 : -rows // 4, columns // 4 : -columns // 4]


def test_without_noise_depths_are_exact() -> None:
    points = middle(scan([plate(0.8, half=1.0)], noise=0.0))
    assert points[..., 2] == pytest.approx(np.full(points.shape[:2], 0.8), abs=1e-6)


def test_depths_are_whole_millimetres() -> None:
    depth = middle(scan([plate(0.8, half=1.0)]))[..., 2] * 1e3
    assert np.abs(depth - np.rint(depth)).max() < 1e-3


@pytest.mark.parametrize("depth", [0.8, 2.0])
def test_noise_has_a_floor_and_grows_with_the_square_of_the_distance(depth: float) -> None:
    points = middle(scan([plate(depth, half=2.0)]))[30:40, 30:50]
    half_range = (KINECT.near + KINECT.far) / 2
    wanted = KINECT.temporal_noise * (0.3 + 0.7 * (depth / half_range) ** 2)
    wanted /= np.sqrt(MATERIALS["matt"].albedo)
    digits = 1e-3 / np.sqrt(12)
    assert np.nanstd(points[..., 2]) == pytest.approx(np.hypot(wanted, digits), rel=0.15)


def test_metal_is_much_noisier() -> None:
    wall, metal = (
        np.nanstd(middle(scan([plate(0.8, material, half=1.0)]))[20:, 20:][..., 2])
        for material in (MATERIALS["matt"], MATERIALS["anodised"])
    )
    assert metal > 3 * wall


def test_steps_in_metal_are_measured_too_far() -> None:
    block = SolidBody(box([-0.1, -0.1, 0.75], [0.1, 0.1, 0.8]), MATERIALS["metal"])
    points = scan([block, plate(1.0, half=1.0)], resolution=1.0, temporal_noise=0.0)
    rows, columns = points.shape[:2]
    across = points[rows // 2, :, 2] - 0.75
    on_block = np.flatnonzero(np.abs(across) < 0.02)
    middle_of_block, beside_edge = np.median(across[on_block]), across[on_block[3]]
    assert abs(middle_of_block) < 1e-3
    assert 1e-3 < beside_edge < 6e-3


def test_pixels_at_an_edge_see_both_sides() -> None:
    block = SolidBody(box([-0.1, -0.1, 0.75], [0.1, 0.1, 0.8]), MATERIALS["matt"])
    points = scan([block, plate(1.0, half=1.0)], resolution=1.0)
    depth = points[..., 2]
    between = (depth > 0.77) & (depth < 0.98)
    assert 50 < between.sum() < 0.02 * depth.size


def test_the_systematic_error_repeats_and_the_noise_does_not() -> None:
    body, error = [plate(0.8, half=1.0)], KINECT.calibration_error
    first, second = (
        middle(scan(body, seed=seed, calibration_error=error))[..., 2] - 0.8 for seed in (1, 2)
    )  # fmt: skip
    assert not np.array_equal(first, second, equal_nan=True)
    blocks = [
        np.nanmean(e[:70].reshape(7, 10, 8, 10), axis=(1, 3)).ravel() for e in (first, second)
    ]
    assert np.corrcoef(*blocks)[0, 1] > 0.7
    assert 0.3e-3 < np.sqrt(np.nanmean(first**2)) < 12e-3


def test_out_of_range_is_missing() -> None:
    assert np.isnan(scan([plate(0.45, half=1.0)])).all()
    assert np.isnan(scan([plate(3.9, half=5.0)])).all()


def test_scans_are_the_same_for_the_same_seed() -> None:
    first, again = (scan([plate(0.8, half=1.0)], seed=5).tobytes() for _ in range(2))
    assert first == again


def test_the_image_is_the_cameras() -> None:
    assert pixels_of(KINECT).directions.shape == (576, 640, 3)
