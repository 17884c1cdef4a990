"""verify.icp and error.icp: equation (11), on a flange whose shape and place are known."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from flangeye import StageError
from flangeye.files.clouds import read_cloud
from flangeye.models.loading import load_model
from flangeye.models.robots import FlangeDetails
from flangeye.models.targets import Flange, load_standard
from flangeye.models.targets import flange_of as from_catalogue
from flangeye.types import (
    BASE,
    CAMERA,
    FLANGE,
    FlangeCloud,
    HandEye,
    PointCloud,
    PoseError,
    Transform,
    TransformEstimate,
    VerificationView,
    Views,
)
from flangeye.types.geometry import (
    rigid,
    rotation_exp,
    rotation_from_quaternion,
    rotation_from_rpy,
    rotation_log,
)
from flangeye_plugins.error import error_holdout, error_icp
from flangeye_plugins.verify.icp import (
    CadCloud,
    IcpParams,
    IcpSettings,
    ViewComparison,
    _figures,
    verify_icp,
)
from flangeye_plugins.verify.registration import (
    Registration,
    SampledSurface,
    read_surface,
    surface_of,
)

MM = 1e-3
TRUTH = Transform(
    BASE, CAMERA, rigid(rotation_exp(np.array([2.9, 0.4, -0.3])), np.array([0.4, -0.7, 0.9]))
)
POSE = Transform(
    BASE, FLANGE, rigid(rotation_from_rpy(0.25, -0.2, 0.4), np.array([0.4, -0.5, 0.2]))
)


def flange_50() -> Flange:
    """A plate with the dimensions of ISO 9409-1-50-4-M6."""
    details = FlangeDetails.model_validate(
        {
            "standard": "ISO 9409-1-50-4-M6",
            "rim_chamfer": "1 mm",
            "bore_chamfer": "0.65 mm",
            "bore_depth": "6.2 mm",
            "thickness": "6.5 mm",
            "wrist": "75 mm",
            "source": "test",
        }
    )
    angles = tuple(np.radians([45.0, 135.0, 225.0, 315.0]).tolist())
    return Flange(
        name="50-4-M6", rim=30.5 * MM, outer=31.5 * MM, bore=16.4 * MM, pitch=25 * MM, holes=angles,
        hole=3 * MM, pin=np.pi / 2, pin_hole=3 * MM, details=details,
    )  # fmt: skip


FLANGE_50 = flange_50()


def view(noise: float = 0.05 * MM, identity: str = "v") -> VerificationView:
    """The flange at POSE as a scanner at TRUTH sees it: only what faces it, with noise."""
    camera_T_flange = TRUTH.inverse() @ POSE
    surface = surface_of(FLANGE_50, 0.8 * MM)
    points = camera_T_flange.apply(surface.points)
    normals = surface.normals @ camera_T_flange.rotation.T
    facing = np.einsum("ni,ni->n", normals, -points) > 0.3 * np.linalg.norm(points, axis=1)
    seen = points[facing] + noise * np.random.default_rng(0).standard_normal((facing.sum(), 3))
    centre, normal = camera_T_flange.translation, camera_T_flange.rotation[:, 2]
    flange = FlangeCloud(PointCloud(CAMERA, seen.astype(np.float32)), centre, normal)
    return VerificationView(identity, flange, POSE)


def calibration(error: Transform) -> HandEye:
    """A calibration off by ``error``: what it maps into the camera is moved by it."""
    wrong = Transform(BASE, CAMERA, TRUTH.matrix @ error.inverse().matrix)
    return HandEye(TransformEstimate(wrong, np.eye(6) * 1e-12, wrong.translation), (), "test")


def off_by(phi: np.ndarray, tau: np.ndarray) -> Transform:
    """A motion in camera that turns by ``phi`` about the flange and shifts it by ``tau``."""
    centre, rotation = (TRUTH.inverse() @ POSE).translation, rotation_exp(phi)
    return Transform(CAMERA, CAMERA, rigid(rotation, centre + tau - rotation @ centre))


@given(seed=st.integers(0, 10**6))
@settings(max_examples=8)
def test_the_error_of_a_calibration_is_found(seed: int) -> None:
    rng = np.random.default_rng(seed)
    axis = (TRUTH.inverse() @ POSE).rotation[:, 2]
    phi, tau = rng.uniform(-0.02, 0.02, 3), rng.uniform(-3, 3, 3) * MM
    phi -= axis * (axis @ phi)  # the plate says nothing about turns about its axis
    result = verify_icp(calibration(off_by(phi, tau)), Views([view()]), FLANGE_50, IcpParams())
    figures = result.figures
    # In the plane only chamfers and walls tell, hence the tolerance.
    np.testing.assert_allclose([figures[k] for k in "xyz"], tau, atol=0.15 * MM)
    assert figures["tilt"] == pytest.approx(np.linalg.norm(phi), abs=5e-4)
    assert "clocking" not in figures
    assert result.errors == {"v": figures["translation"]}


def test_the_camera_origin_shows_the_rotation_times_the_distance() -> None:
    error = off_by(np.array([0.01, 0.0, 0.0]), np.zeros(3))
    figures = verify_icp(calibration(error), Views([view()]), FLANGE_50, IcpParams()).figures
    assert figures["translation"] < 0.1 * MM
    assert figures["camera_translation"] > 5 * MM
    np.testing.assert_allclose(
        [figures[f"camera_{k}"] for k in "xyz"], error.translation, atol=0.4 * MM
    )


def test_a_turn_about_the_flanges_own_axis_is_clocking_and_no_tilt() -> None:
    phi = np.array([3e-3, -4e-3, 7e-3])
    fit = Registration(rigid(rotation_exp(phi), np.zeros(3)), 1e-5, 0.9, True)
    error = PoseError(np.eye(4), np.zeros(3), np.eye(3))
    figures = _figures(ViewComparison(error, fit))
    assert figures["tilt"] == pytest.approx(5e-3)
    assert figures["clocking"] == pytest.approx(7e-3)
    assert (figures["rms"], figures["overlap"]) == (1e-5, 0.9)
    assert "clocking" not in _figures(ViewComparison(error, replace(fit, roll_seen=False)))


def test_translations_are_the_lengths_of_their_coordinates() -> None:
    off = off_by(np.array([0.002, -0.001, 0.003]), np.array([0.5, -0.3, 0.4]) * MM)
    figures = verify_icp(calibration(off), Views([view()]), FLANGE_50, IcpParams()).figures
    for whole in ("translation", "camera_translation"):
        prefix = whole.removesuffix("translation")
        parts = [figures[f"{prefix}{name}"] for name in "xyz"]
        assert figures[whole] == pytest.approx(np.linalg.norm(parts))


def test_a_right_calibration_passes_and_a_wrong_one_does_not() -> None:
    views = Views([view()])
    right = verify_icp(calibration(off_by(np.zeros(3), np.zeros(3))), views, FLANGE_50, IcpParams())
    wrong = verify_icp(
        calibration(off_by(np.zeros(3), np.array([0, 2 * MM, 0]))), views, FLANGE_50, IcpParams()
    )
    assert right.passed
    assert not wrong.passed
    assert wrong.reason == (
        f"the flange is {wrong.figures['translation'] * 1e3:.3f} mm and "
        f"{np.degrees(wrong.figures['tilt']):.3f} deg from where it should be, "
        "beyond the limits of 1 mm and 1 deg"
    )


def test_the_worst_view_counts() -> None:
    good, bad = view(identity="good"), view(identity="bad")
    moved = rigid(np.eye(3), np.array([0, 0, 2 * MM])) @ POSE.matrix
    bad = VerificationView("bad", bad.flange, Transform(BASE, FLANGE, moved))
    result = verify_icp(
        calibration(off_by(np.zeros(3), np.zeros(3))), Views([good, bad]), FLANGE_50, IcpParams()
    )
    assert not result.passed
    assert result.figures["views"] == 2
    assert result.figures["translation"] == result.errors["bad"] > result.errors["good"]


def test_icp_that_fails_is_an_infinite_error() -> None:
    far = calibration(off_by(np.zeros(3), np.array([0.2, 0, 0])))
    result = verify_icp(far, Views([view()]), FLANGE_50, IcpParams())
    assert not result.passed
    assert result.reason == (
        "ICP failed, the error is infinite: view v: no points came within 20 mm of the flange's shape"
    )
    assert (
        error_icp(far.base_T_camera.transform, [], Views([view()]), FLANGE_50, IcpSettings())
        is None
    )


def test_a_plain_disc_cannot_tell_a_shift_along_its_face() -> None:
    disc = FLANGE_50.model_copy(update={"bore": None, "holes": (), "pin": None})
    result = verify_icp(
        calibration(off_by(np.zeros(3), np.zeros(3))), Views([view()]), disc, IcpParams()
    )
    assert result.reason == (
        "ICP failed, the error is infinite: view v: "
        "the matched points are too flat to show a shift along the face"
    )


def test_without_a_verification_view_it_says_how_to_get_one() -> None:
    with pytest.raises(StageError) as refused:
        verify_icp(calibration(off_by(np.zeros(3), np.zeros(3))), Views(), FLANGE_50, IcpParams())
    assert str(refused.value) == (
        "no verification view: let the acquire step mark one or more captures as "
        "verification captures, or use verify.holdout, which needs none"
    )


def test_the_result_is_bit_identical() -> None:
    candidate = calibration(off_by(np.array([0.01, 0.02, 0]), np.array([1, 2, 3]) * MM))
    first = verify_icp(candidate, Views([view()]), FLANGE_50, IcpParams())
    second = verify_icp(candidate, Views([view()]), FLANGE_50, IcpParams())
    assert first.figures == second.figures


def test_the_sampled_shape_has_the_plates_dimensions() -> None:
    surface = surface_of(FLANGE_50)
    radius = np.linalg.norm(surface.points[:, :2], axis=1)
    face = (surface.points[:, 2] == 0) & (surface.normals[:, 2] == 1)
    assert radius[face].max() == pytest.approx(30.5 * MM, abs=0.5 * MM)
    assert radius[face].min() == pytest.approx(16.4 * MM, abs=0.5 * MM)
    assert surface.points[:, 2].min() == pytest.approx(-6.5 * MM)
    assert radius.max() == pytest.approx(37.5 * MM, abs=0.5 * MM)
    np.testing.assert_allclose(np.linalg.norm(surface.normals, axis=1), 1.0)
    at_hole = np.linalg.norm(surface.points - [17.7 * MM, 17.7 * MM, 0], axis=1)
    assert at_hole.min() > 2.9 * MM


def test_a_cad_cloud_takes_the_place_of_the_dimensions(tmp_path: Path) -> None:
    surface = surface_of(FLANGE_50)
    turned = (surface.points - [0, 0, -6 * MM]) @ rotation_from_rpy(0, np.pi, 0) * 1000
    path = tmp_path / "flange.xyz"
    np.savetxt(path, turned)
    cad = CadCloud.model_validate(
        {"file": str(path), "unit": "mm", "offset": ["0 mm", "0 mm", "-6 mm"],
         "rpy": ["0 deg", "180 deg", "0 deg"]}
    )  # fmt: skip
    tau = np.array([1.0, -0.5, 0.7]) * MM
    result = verify_icp(
        calibration(off_by(np.zeros(3), tau)), Views([view()]), FLANGE_50, IcpParams(cad=cad)
    )
    np.testing.assert_allclose([result.figures[k] for k in "xyz"], tau, atol=0.1 * MM)


def test_a_missing_cad_cloud_is_said(tmp_path: Path) -> None:
    cad = CadCloud(file=tmp_path / "no.pcd", unit="mm")
    with pytest.raises(StageError) as refused:
        verify_icp(
            calibration(off_by(np.zeros(3), np.zeros(3))),
            Views([view()]),
            FLANGE_50,
            IcpParams(cad=cad),
        )
    assert str(refused.value).startswith(f"{tmp_path}/no.pcd: ")


def test_error_icp_needs_a_flange() -> None:
    with pytest.raises(StageError, match="add the recipe's 'robot' section"):
        error_icp(TRUTH, [], Views([view()]), None, IcpSettings())


def test_error_holdout_needs_three_poses() -> None:
    with pytest.raises(StageError) as refused:
        error_holdout(TRUTH, [], Views(), None)
    assert str(refused.value) == (
        "error.holdout needs 3 poses or more that stay out of the pool, not 0: set reserve: 5"
    )


def test_the_published_flange_roll_is_found(ancorasir: Path) -> None:
    """Published H, verification cloud and CAD: 0.5-0.6 mm at the flange, roll 0.84 deg.

    The paper prints (-0.26, +-0.27, -0.35) mm at the camera's origin, where an ICP stopped early.
    """
    folder = ancorasir / "data" / "aubo"
    seen = read_cloud(folder / "tool0_5.pcd").points()
    quaternion = np.array([-0.085809201, -0.389310586, 0.914859337, 0.064081527])
    position = np.array([0.27704067625331485, -0.573055166920657, 0.26205388882758757])
    pose = Transform(BASE, FLANGE, rigid(rotation_from_quaternion(quaternion), position))
    flange_cloud = FlangeCloud(PointCloud(CAMERA, seen), seen.mean(0), np.array([0, 0, -1]))
    published = Transform(BASE, CAMERA, np.load(folder / "H.npy"))
    cad = CadCloud.model_validate(
        {"file": str(ancorasir / "flange_ground_truth" / "flange_aubo_cropped.pcd"), "unit": "m",
         "offset": ["0 mm", "0 mm", "-6 mm"], "rpy": ["0 deg", "180 deg", "0 deg"]}
    )  # fmt: skip
    flange = from_catalogue(load_model("robots", "aubo-i5").flange, load_standard("50-4-M6"))
    result = verify_icp(
        HandEye(TransformEstimate(published, np.eye(6), np.zeros(3)), (), "published"),
        Views([VerificationView("5", flange_cloud, pose)]),
        flange,
        IcpParams(cad=cad),
    )
    figures = result.figures
    assert figures["translation"] == pytest.approx(0.70 * MM, abs=0.05 * MM)
    assert figures["camera_translation"] == pytest.approx(3.2 * MM, abs=0.3 * MM)
    assert np.degrees(abs(figures["clocking"])) == pytest.approx(1.0, abs=0.15)


def test_surfaces_read_from_files_have_unit_normals(tmp_path: Path) -> None:
    plane = np.random.default_rng(0).uniform(-1, 1, (500, 3)) * [0.03, 0.03, 0]
    path = tmp_path / "plane.xyz"
    np.savetxt(path, plane)
    surface: SampledSurface = read_surface(path, "m", np.eye(3), np.zeros(3))
    np.testing.assert_allclose(np.abs(surface.normals[:, 2]), 1.0)


def test_the_log_of_a_small_motion_is_its_rotation() -> None:
    phi = np.array([0.01, -0.02, 0.005])
    np.testing.assert_allclose(rotation_log(off_by(phi, np.zeros(3)).rotation), phi, atol=1e-12)
