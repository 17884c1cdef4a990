"""solve.svd: exact recovery, equivariance, calibrated covariance, refusals, published result."""

import re
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
from flangeye.types.geometry import covariance_at, kabsch, kabsch_covariance, rotation_exp
from flangeye_plugins.solve.observations import noise_of, require_poses
from flangeye_plugins.solve.svd import (
    SvdParams,
    _fit_rms,
    _median_distance,
    require_right_handed,
    require_rotation,
    require_same_units,
    require_several_places,
    solve_svd,
)

TRUTH = rotation_exp(np.array([2.9, 0.4, -0.3])), np.array([0.4, -0.7, 0.9])
MM = 1e-3
RNG = np.random.default_rng(0)


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


def test_centres_that_fit_in_a_mirror_only_are_refused() -> None:
    rng = np.random.default_rng(0)
    tcps = rng.uniform(-0.2, 0.2, (8, 3))
    centres = (tcps - [0.6, 0.0, 1.0]) @ rotation_exp(np.array([2.0, 0.3, -0.4]))
    noise = 1e-4 * rng.standard_normal((8, 3))
    require_right_handed(centres + noise, tcps)
    require_right_handed(centres + 100 * noise, tcps)  # noise alone is not a mirror
    for axis in range(3):
        mirrored = (centres + noise) * np.where(np.arange(3) == axis, -1.0, 1.0)
        with pytest.raises(CalibrationRefused, match=r"only when mirrored \(0.1 mm rms instead of"):
            require_right_handed(mirrored, tcps)


@pytest.mark.parametrize(
    ("rises", "noise", "refused"),
    [(0.1, 0.018, True), (0.1, 0.0184, False), (5.2e-4, 1e-5, True), (4.8e-4, 1e-5, False)],
)
def test_a_mirror_is_named_that_leaves_a_tenth_of_more_than_a_millimetre(
    rises: float, noise: float, refused: bool
) -> None:
    """A saddle: no turn takes it to its mirror, so it is off by twice its height, less noise."""
    low = np.array([[0.3, 0.3, 0], [-0.3, 0.3, 0], [-0.3, -0.3, 0], [0.3, -0.3, 0]])
    heights = np.array([1.0, -1.0, 1.0, -1.0])
    saddle = low + np.outer(heights, [0.0, 0.0, rises])
    bend = np.outer(heights, [0.0, 0.0, noise])
    centres = saddle * [1.0, 1.0, -1.0] + bend
    if not refused:
        require_right_handed(centres, saddle)
        return
    with pytest.raises(
        CalibrationRefused, match=f"mirrored \\({noise * 1e3:.1f} mm rms instead of "
    ):
        require_right_handed(centres, saddle)


def test_the_noise_that_residuals_show_is_the_noise_of_one_coordinate() -> None:
    rng, sigma, count = np.random.default_rng(1), 1e-3, 6
    found = []
    for _ in range(600):
        centres = rng.uniform(-0.2, 0.2, (count, 3))
        tcps = centres + sigma * rng.standard_normal((count, 3))
        rotation, shift = kabsch(centres, tcps)
        found.append(noise_of(tcps - centres @ rotation.T - shift))
    assert np.mean(found) == pytest.approx(sigma, rel=0.06)


def test_three_poses_are_needed_and_more_than_one_place() -> None:
    require_poses(3)
    with pytest.raises(StageError, match="4 poses needed, 3 given: "):
        require_poses(3, needed=4)
    with pytest.raises(StageError, match="3 poses needed, 2 given: "):
        require_poses(2)
    around = np.array([[1.0, 0, 0], [-1.0, 0, 0], [0, 1.0, 0], [0, -1.0, 0]])
    require_several_places(1.01e-3 * around + [0.4, -0.2, 0.3])
    said = r"all 4 poses are at one place, \(0.400, -0.200, 0.300\) m within 0.9 mm: move the arm"
    with pytest.raises(StageError, match=said):
        require_several_places(0.9e-3 * around + [0.4, -0.2, 0.3])


@pytest.mark.parametrize(
    ("ratio", "taken"), [(0.51, True), (1.99, True), (0.49, False), (2.01, False)]
)
def test_centres_are_about_as_far_apart_as_the_poses(ratio: float, taken: bool) -> None:
    tcps = RNG.uniform(-0.2, 0.2, (9, 3))
    if taken:
        require_same_units(ratio * tcps + 5.0, tcps)
        return
    with pytest.raises(
        CalibrationRefused, match=f"the circle centres are {ratio:.4g} times as far apart"
    ):
        require_same_units(ratio * tcps + 5.0, tcps)


def test_of_distances_the_middle_one_counts() -> None:
    line = np.outer([0.0, 1.0, 3.0, 30.0], [0.0, 0.6, 0.8])
    assert _median_distance(line) == pytest.approx(np.median([1, 2, 3, 27, 29, 30]))


def test_centres_inform_of_shifts_by_their_number_and_of_turns_by_their_levers() -> None:
    points = RNG.uniform(-0.3, 0.3, (7, 3)) + 2.0
    found = np.linalg.inv(kabsch_covariance(points, 1e-3))
    levers = points - points.mean(axis=0)
    inertia = (levers**2).sum() * np.eye(3) - levers.T @ levers
    expected = 1e6 * np.block([[inertia, np.zeros((3, 3))], [np.zeros((3, 3)), 7 * np.eye(3)]])
    assert found == pytest.approx(expected, abs=1e-6)


def test_a_rotation_that_stays_unknown_is_named_with_what_would_show_it() -> None:
    line = np.outer(np.linspace(-0.2, 0.2, 7), [0.0, 0.6, 0.8])
    aside = np.outer([1, -1, 1, 0, 1, -1, 1], [1e-3, 0.0, 0.0])
    with pytest.raises(CalibrationRefused) as on_a_line:
        require_rotation(line + aside, 1e-3, np.radians(1))
    assert str(on_a_line.value) == (
        "the 7 flange centres lie on a line along base (0.00, 0.60, 0.80) within 1.3 mm: rotation "
        "about that line is not observable; move the arm across it"
    )
    require_rotation(line + 100 * aside, 1e-3, np.radians(1))
    # 0.2 m of lever about z alone, and noise that it does not outweigh.
    flat = 0.1 * np.array([[1.0, 0, 0], [-1.0, 0, 0], [0, 1.0, 0], [0, -1.0, 0]])
    sigma = 4e-3 / np.sqrt(2 * 0.1**2)  # about x and about y; about z by root 2 better
    require_rotation(flat, 4e-3, 1.01 * sigma)
    for noise, cure in ((4e-3, "spread the poses further, and check"), (6e-3, "no scanner or arm")):
        with pytest.raises(CalibrationRefused) as weak:
            require_rotation(flat, noise, 0.5 * sigma)
        told = f"{np.degrees(sigma * noise / 4e-3):.1f} deg only"
        assert told in str(weak.value) and f"{noise * 1e3:.1f} mm of noise per axis; {cure}" in str(
            weak.value
        )


def test_what_a_shift_would_explain_tells_nothing_of_a_rotation() -> None:
    """Turns about a point far away shift the centres as well: neither is known by it better."""
    flat = 0.1 * np.array([[1.0, 0, 0], [-1.0, 0, 0], [0, 1.0, 0], [0, -1.0, 0]])
    limit = 4e-3 / np.sqrt(2 * 0.1**2)
    away = flat + [3.0, -2.0, 1.0]
    require_rotation(away, 4e-3, 1.01 * limit)
    with pytest.raises(CalibrationRefused, match="is known to"):
        require_rotation(away, 4e-3, 0.99 * limit)


def test_of_two_rotations_that_are_weak_the_weaker_is_named() -> None:
    """Levers of 100 mm about y and of 50 mm about x, of both about z."""
    flat = np.array([[0.1, 0, 0], [-0.1, 0, 0], [0, 0.05, 0], [0, -0.05, 0]])
    with pytest.raises(CalibrationRefused) as weak:
        require_rotation(flat, 4e-3, 1e-3)
    named = re.match(r"rotation about base \((.*?)\) is known to ([\d.]+) deg", str(weak.value))
    assert named is not None
    axis = [float(x) for x in named[1].split(",")]
    assert np.abs(axis).tolist() == [1.0, 0.0, 0.0]
    assert float(named[2]) == pytest.approx(np.degrees(4e-3 / np.sqrt(2 * 0.05**2)), abs=0.05)


def test_a_fit_leaves_the_root_of_the_mean_square_distance() -> None:
    corners = np.array([[1.0, 1, 0], [1, -1, 0], [-1, 1, 0], [-1, -1, 0]])
    bent = corners + np.outer([0.3, -0.3, -0.3, 0.3], [0.0, 0.0, 1.0])
    assert _fit_rms(corners + 3.0, bent) == pytest.approx(0.3)
