"""solve.svd: exact recovery, equivariance, calibrated covariance, refusals, published result."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from flangeye import CalibrationRefused, StageError
from flangeye.maths.statistics import chi2_quantile
from flangeye.types import (
    BASE,
    FLANGE,
    CircleFeature,
    HandEye,
    Observation,
    Observations,
    Source,
    Transform,
    by_frame,
)
from flangeye.types.geometry import covariance_at, rotation_exp
from flangeye_plugins.solve.named import SvdParams, solve_svd

TRUTH = rotation_exp(np.array([2.9, 0.4, -0.3])), np.array([0.4, -0.7, 0.9])
MM = 1e-3


def observe(centres: np.ndarray, tcps: np.ndarray) -> Observations:
    """Observations of (N, 3) centres in camera and (N, 3) TCPs in base."""
    pose = np.eye(4)
    items = []
    for i, (centre, tcp) in enumerate(zip(centres, tcps, strict=True)):
        pose[:3, 3] = tcp
        circle = CircleFeature(
            centre, np.array([0, 0, -1]), {}, np.eye(3) * 1e-10, np.diag([1e-8, 1e-8, 0]), 1.0
        )
        items.append(
            Observation(f"{i:02d}", circle, by_frame(Transform(BASE, FLANGE, pose.copy())))
        )
    return Observations(items, Source("test"))


def to_camera(tcps: np.ndarray) -> np.ndarray:
    """Exact centres in camera of (N, 3) TCPs, for the TRUTH."""
    return (tcps - TRUTH[1]) @ TRUTH[0]


def solve(centres: np.ndarray, tcps: np.ndarray) -> HandEye:
    return solve_svd(observe(centres, tcps), SvdParams())


def cloud(seed: int, n: int = 12) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.array([0.4, -0.5, 0.2]) + rng.uniform(-1, 1, (n, 3)) * [0.15, 0.15, 0.1]


@given(seed=st.integers(0, 10**6), n=st.integers(3, 30))
@settings(max_examples=40)
def test_exact_centres_give_the_exact_pose(seed: int, n: int) -> None:
    tcps = cloud(seed, n)
    try:
        found = solve(to_camera(tcps), tcps).base_T_camera.transform
    except CalibrationRefused:  # three random points may happen to be nearly in line
        assert n == 3
        return
    np.testing.assert_allclose(found.rotation, TRUTH[0], atol=1e-9)
    np.testing.assert_allclose(found.translation, TRUTH[1], atol=1e-9)


@given(seed=st.integers(0, 10**6))
@settings(max_examples=25)
def test_moving_the_base_moves_the_answer_and_nothing_else(seed: int) -> None:
    rng = np.random.default_rng(seed)
    tcps = cloud(seed)
    centres = to_camera(tcps) + 0.3 * MM * rng.standard_normal((12, 3))
    turn, shift = rotation_exp(rng.standard_normal(3)), rng.standard_normal(3)
    here, there = solve(centres, tcps), solve(centres, tcps @ turn.T + shift)
    before, after = here.base_T_camera.transform, there.base_T_camera.transform
    np.testing.assert_allclose(after.rotation, turn @ before.rotation, atol=1e-9)
    np.testing.assert_allclose(after.translation, turn @ before.translation + shift, atol=1e-9)
    block = np.kron(np.eye(2), turn)
    np.testing.assert_allclose(
        there.base_T_camera.covariance,
        block @ here.base_T_camera.covariance @ block.T,
        rtol=1e-6,
        atol=1e-16,
    )


@given(seed=st.integers(0, 10**6), thickness=st.sampled_from([0.0, 1e-9, 1e-5]))
@settings(max_examples=25)
def test_planar_centres_never_give_a_reflection(seed: int, thickness: float) -> None:
    rng = np.random.default_rng(seed)
    tcps = cloud(seed) * [1, 1, 0] + rng.standard_normal((12, 3)) * thickness
    centres = to_camera(tcps) + 0.1 * MM * rng.standard_normal((12, 3))
    found = solve(centres, tcps).base_T_camera.transform
    assert np.linalg.det(found.rotation) == pytest.approx(1.0)
    np.testing.assert_allclose(found.rotation, TRUTH[0], atol=0.02)


def test_residual_is_mapped_centre_minus_tcp_in_input_order() -> None:
    tcps = cloud(5)
    centres = to_camera(tcps)
    tcps[3, 0] -= 1.2 * MM
    calibration = solve(centres, tcps)
    assert [p.observation.id for p in calibration.pairs] == [f"{i:02d}" for i in range(12)]
    assert all(p.used for p in calibration.pairs)
    found = calibration.base_T_camera.transform
    np.testing.assert_allclose(
        [p.residual for p in calibration.pairs], found.apply(centres) - tcps, atol=1e-12
    )
    assert calibration.pairs[3].residual[0] > 0.9 * MM
    assert calibration.method == "solve.svd"


def test_one_place_is_refused() -> None:
    tcps = np.tile([0.3, -0.1, 0.25], (5, 1))
    with pytest.raises(StageError) as refused:
        solve(to_camera(tcps), tcps)
    assert str(refused.value) == (
        "all 5 poses are at one place, (0.300, -0.100, 0.250) m within 0.0 mm: "
        "move the arm between captures"
    )
    assert refused.value.exit_code == 2


def test_two_poses_are_refused() -> None:
    tcps = cloud(0, 2)
    with pytest.raises(StageError) as refused:
        solve(to_camera(tcps), tcps)
    assert str(refused.value) == (
        "3 poses needed, 2 given: add poses, or see why captures were set aside"
    )


def test_centres_in_line_are_refused_with_the_motion_that_is_missing() -> None:
    rng = np.random.default_rng(1)
    axis = np.array([0.02, 0.99, 0.14]) / np.linalg.norm([0.02, 0.99, 0.14])
    tcps = np.linspace(-0.15, 0.15, 12)[:, None] * axis + [0.4, -0.5, 0.2]
    tcps += rng.uniform(-0.1, 0.1, (12, 3)) * MM
    with pytest.raises(CalibrationRefused) as refused:
        solve(to_camera(tcps) + 0.1 * MM * rng.standard_normal((12, 3)), tcps)
    assert str(refused.value) == (
        "the 12 flange centres lie on a line along base (0.02, 0.99, 0.14) within 0.1 mm: "
        "rotation about that line is not observable; move the arm across it"
    )
    assert refused.value.exit_code == 1


def test_millimetres_beside_metres_are_refused() -> None:
    tcps = cloud(2)
    with pytest.raises(CalibrationRefused) as refused:
        solve(1000 * to_camera(tcps), tcps)
    assert str(refused.value) == (
        "the circle centres are 1000 times as far apart as the robot's poses; check that both are "
        "in metres, and that each scan belongs to its robot pose"
    )


def test_a_mirrored_scanner_frame_is_refused() -> None:
    tcps = cloud(3)
    with pytest.raises(CalibrationRefused) as refused:
        solve(to_camera(tcps) * [-1, 1, 1], tcps)
    assert str(refused.value).startswith("the centres fit the poses only when mirrored (0.0 mm rms")


@pytest.mark.parametrize("n", [4, 20])
def test_the_stated_region_holds_the_truth(n: int) -> None:
    inside = coverage(n, runs=250)
    assert 0.95 - 0.042 <= inside <= 0.95 + 0.042  # three standard deviations of 250 runs


@pytest.mark.slow
@pytest.mark.parametrize("n", [4, 8, 20])
def test_the_stated_region_holds_the_truth_in_93_to_97_percent(n: int) -> None:
    assert 0.93 <= coverage(n, runs=1000) <= 0.97


def coverage(n: int, runs: int) -> float:
    """Share of simulated runs whose stated 95 % region of the pose holds the truth."""
    inside = 0
    for seed in range(runs):
        rng = np.random.default_rng([n, seed])
        tcps = cloud(seed, n)
        estimate = solve(to_camera(tcps) + 0.3 * MM * rng.standard_normal((n, 3)), tcps)
        inside += holds(estimate.base_T_camera)
    return inside / runs


def holds(estimate) -> bool:
    """Whether the estimate's 95 % region holds the TRUTH."""
    found = estimate.transform
    skew = TRUTH[0] @ found.rotation.T
    phi = np.array([skew[2, 1] - skew[1, 2], skew[0, 2] - skew[2, 0], skew[1, 0] - skew[0, 1]]) / 2
    about_in_camera = found.inverse().apply(estimate.about)
    tau = TRUTH[0] @ about_in_camera + TRUTH[1] - estimate.about
    error = np.concatenate([phi, tau])
    distance = error @ np.linalg.solve(estimate.covariance, error)
    return bool(distance <= chi2_quantile(0.95, 6))


def test_the_stated_error_at_a_point_matches_the_scatter() -> None:
    tcps, corner = cloud(0, 20), np.array([0.6, -0.3, 0.3])
    at = (corner - TRUTH[1]) @ TRUTH[0]
    mapped, stated = [], []
    for seed in range(300):
        noise = 0.3 * MM * np.random.default_rng(seed).standard_normal((20, 3))
        estimate = solve(to_camera(tcps) + noise, tcps).base_T_camera
        mapped.append(estimate.transform.apply(at))
        stated.append(covariance_at(estimate.covariance, estimate.about, corner[None])[0])
    scatter, predicted = np.cov(np.array(mapped).T), np.mean(stated, axis=0)
    assert np.trace(scatter) == pytest.approx(np.trace(predicted), rel=0.2)


def test_published_centres_give_the_published_matrix(ancorasir: Path) -> None:
    folder = ancorasir / "data" / "aubo"
    centres = np.load(folder / "p_camera_mat.npy").T.astype(float)
    tcps = np.load(folder / "p_robot_mat.npy").T
    found = solve(centres, tcps).base_T_camera.transform
    np.testing.assert_allclose(found.matrix, np.load(folder / "H.npy"), atol=1e-6)
