"""seam.groove: a V-groove without CAD, against the truth, and its refusals."""

import numpy as np
import pytest

from flangeye import CalibrationRefused, StageError
from flangeye.maths.geometry import rigid, rotation_from_rpy
from flangeye.maths.seam_geometry import errors_from, tube_radii
from flangeye.models.loading import load_model
from flangeye.types import CAMERA, Box, PointCloud, Seed, WorkpieceScan
from flangeye_plugins.seam.groove import GrooveParams, seam_groove
from tests.plugins.seam.scenes import BASE_T_CAMERA, hand_eye, scanned

MM = 1e-3
PHOXI = load_model("scanners", "phoxi-m")


def planned(scan, workspace=None, hand=None, **given):
    params = GrooveParams.model_validate(given)
    return seam_groove(hand or hand_eye(), scan, Seed(0), params, workspace, PHOXI)


def grooved(roots, half_angle=40, depth=10 * MM, spacing=0.7 * MM, noise=0.05 * MM, seed=0):
    """Return a scan of a plate of 200 x 160 mm with straight grooves at y, in closed form."""
    rng = np.random.default_rng(seed)
    ticks = np.arange(-0.1, 0.1, spacing), np.arange(-0.08, 0.08, spacing)
    x, y = (grid.ravel() for grid in np.meshgrid(*ticks))
    away = (
        np.abs(y[:, None] - np.asarray(roots)).min(axis=1) if len(roots) else np.full(len(y), 1.0)
    )
    z = -np.maximum(depth - away / np.tan(np.radians(half_angle)), 0.0)
    part = np.column_stack([x, y, z + rng.normal(0, noise, len(z))])
    in_base = part @ rotation_from_rpy(0, 0, 0.3).T + [0.6, 0.0, 0.27]
    xyz = BASE_T_CAMERA.inverse().apply(in_base).astype(np.float32)
    ends = [[[-0.1, r, -depth], [0.1, r, -depth]] for r in roots]
    truth = np.array(ends).reshape(-1, 2, 3) @ rotation_from_rpy(0, 0, 0.3).T + [0.6, 0.0, 0.27]
    return WorkpieceScan(PointCloud(CAMERA, xyz), "plate"), truth


@pytest.mark.parametrize("workpiece", ["v-straight", "v-curved"])
def test_the_root_is_where_it_is(workpiece: str) -> None:
    scan, truth = scanned(workpiece, seed=1)
    seam = planned(scan)
    errors = errors_from(seam, truth)
    assert np.sqrt(np.mean(errors**2)) < 0.2 * MM
    assert (errors <= tube_radii(seam)).mean() > 0.9
    assert tube_radii(seam).max() < 1.0 * MM
    assert seam.arc_length[-1] == pytest.approx(0.2, abs=0.015)
    assert np.degrees(seam.half_angle) == pytest.approx(40, abs=1.5)
    assert seam.half_width == pytest.approx(8.4 * MM, abs=0.5 * MM)


@pytest.mark.parametrize("half_angle", [25, 40, 60])
def test_the_angle_and_the_root_of_a_plain_groove(half_angle: int) -> None:
    scan, truth = grooved([0.01], half_angle, depth=6 * MM)
    seam = planned(scan, max_width="40 mm")
    assert np.degrees(seam.half_angle) == pytest.approx(half_angle, abs=1)
    assert errors_from(seam, truth[0]).max() < 0.1 * MM
    assert (errors_from(seam, truth[0]) <= tube_radii(seam)).all()
    assert (seam.openings_in_base[:, 2] > 0.99).all()


@pytest.mark.slow
def test_the_tube_holds_the_share_it_says() -> None:
    """Points of 12 grooves against their standard deviations across the seam, scanner's aside."""
    squares = []
    for seed in range(12):
        scan, truth = grooved([0.01], seed=seed)
        seam = seam_groove(hand_eye(), scan, Seed(0), GrooveParams(), None, None)
        squares.append((errors_from(seam, truth[0]) / tube_radii(seam))[::20] ** 2)
    inside = float(np.mean(np.concatenate(squares) <= 1))
    assert inside > 0.93  # the tube is a circle around an ellipse: never too thin


def test_the_seam_moves_with_the_scene() -> None:
    scan, _ = grooved([0.01])
    motion = rigid(rotation_from_rpy(0.02, -0.03, 0.04), np.array([0.01, 0.02, -0.03]))
    seam, moved = planned(scan), planned(scan, hand=hand_eye(error=motion))
    expected = seam.points_in_base @ motion[:3, :3].T + motion[:3, 3]
    assert np.allclose(moved.points_in_base, expected, atol=1e-9)


def test_backwards_starts_at_the_other_end() -> None:
    scan, _ = grooved([0.01])
    seam, back = planned(scan), planned(scan, backwards=True)
    assert np.allclose(seam.points_in_base[::-1], back.points_in_base)
    near, far = np.linalg.norm(seam.points_in_base[[0, -1]], axis=1)
    assert near < far


def test_a_plate_without_a_groove_is_refused() -> None:
    with pytest.raises(CalibrationRefused) as error:
        planned(grooved([])[0])
    assert str(error.value) == (
        "seam.groove: no V-groove: no hollow up to 30 mm wide and 25 mm deep, with two walls and a "
        "flat face on both sides, is 40 mm long (max_width, max_depth, min_length)"
    )


def test_of_two_grooves_the_recipe_must_say_which() -> None:
    scan, truth = grooved([-0.04, 0.03])
    with pytest.raises(CalibrationRefused) as error:
        planned(scan)
    told = str(error.value)
    assert told.startswith("seam.groove: ambiguous: 2 V-grooves are as good: ")
    assert told.endswith(" mm in base; say which with near:")
    for line in truth:
        near = tuple(f"{1e3 * x:.0f} mm" for x in line.mean(axis=0))
        assert errors_from(planned(scan, near=near), line).max() < 0.1 * MM


def test_a_rough_groove_is_refused() -> None:
    with pytest.raises(CalibrationRefused, match=r"mm rms from a smooth line, limit 0.001 mm"):
        planned(grooved([0.01])[0], max_residual="0.001 mm")


def test_a_seam_outside_the_workspace_is_refused() -> None:
    with pytest.raises(CalibrationRefused, match="seam.groove: the seam leaves the workspace by"):
        planned(grooved([0.01])[0], Box(np.array([0.6, 0.0, 0.3]), np.array([0.1, 0.3, 0.2])))


def test_too_small_a_scan_is_refused() -> None:
    scan = WorkpieceScan(PointCloud(CAMERA, np.ones((5, 3), np.float32)), "few")
    with pytest.raises(StageError, match="seam.groove: the scan has 5 points; 1000 are needed"):
        planned(scan)
