"""solve.robust: efficiency, outliers, normals, calibrated covariance, what it refuses."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from flangeye import CalibrationRefused, StageError
from flangeye.maths.statistics import chi2_quantile
from flangeye.models.cell import cell_of
from flangeye.models.configuration import DEFAULT
from flangeye.types import (
    BASE,
    CAMERA,
    FLANGE,
    Box,
    CircleFeature,
    HandEye,
    Observation,
    Observations,
    Source,
    Transform,
    by_frame,
)
from flangeye.types.geometry import (
    basis_of_plane,
    covariance_at,
    kabsch_covariance,
    rigid,
    rotation_exp,
)
from flangeye_plugins.solve.robust import RobustParams, solve_cell, solve_robust
from flangeye_plugins.solve.svd import SvdParams, solve_svd
from flangeye_plugins.verify.holdout import HoldoutParams, verify_holdout

MM, DEG = 1e-3, np.pi / 180
TRUTH = Transform(
    BASE, CAMERA, rigid(rotation_exp(np.array([2.9, 0.4, -0.3])), np.array([0.4, -0.7, 0.9]))
)
WORK = Box(np.array([0.4, -0.5, 0.2]), np.array([0.3, 0.3, 0.2]))
BIAS = 0.05 * DEG


class Cell:
    """A simulated cell that makes observations with known noise."""

    def __init__(self, seed: int, sigma: float = 0.3 * MM) -> None:
        self.rng = np.random.default_rng(seed)
        self.sigma = sigma
        self.bias = np.append(BIAS * self.rng.standard_normal(2), 1.0)

    def pose(self, tilt: float = 0.3) -> np.ndarray:
        place = WORK.centre + self.rng.uniform(-0.5, 0.5, 3) * WORK.size
        return rigid(rotation_exp(self.rng.uniform(-tilt, tilt, 3)), place)

    def observe(
        self,
        name: str,
        pose: np.ndarray,
        *,
        depth: float = 1.0,
        normal: float | None = None,
        off: float = 0.0,
    ) -> Observation:
        """One observation; ``depth`` scales the noise along the axis, ``off`` makes an outlier."""
        axes = basis_of_plane(TRUTH.rotation.T @ pose[:3, 2])
        covariance = axes.T @ np.diag([1.0, 1.0, depth**2]) @ axes * self.sigma**2
        noise = np.linalg.cholesky(covariance) @ self.rng.standard_normal(3)
        centre = TRUTH.inverse().apply(pose[:3, 3]) + noise + off * self.direction()
        circle = CircleFeature(centre, None, {}, covariance, None, 1.0)
        if normal is not None:
            seen = (
                TRUTH.rotation.T
                @ rotation_exp(normal * self.rng.standard_normal(3))
                @ (pose[:3, :3] @ (self.bias / np.linalg.norm(self.bias)))
            )
            across = normal**2 * (np.eye(3) - np.outer(seen, seen))
            circle = CircleFeature(centre, seen, {}, covariance, across, 1.0)
        return Observation(name, circle, by_frame(Transform(BASE, FLANGE, pose)))

    def direction(self) -> np.ndarray:
        vector = self.rng.standard_normal(3)
        return vector / np.linalg.norm(vector)


def simulate(n: int, seed: int, wrong: int = 0, **kind: float) -> list[Observation]:
    """n poses, the last ``wrong`` of which are gross outliers of 5 to 80 mm."""
    cell = Cell(seed)
    return [
        cell.observe(
            f"{i:02d}", cell.pose(), off=cell.rng.uniform(5, 80) * MM * (i >= n - wrong), **kind
        )
        for i in range(n)
    ]


def solve(observations: Sequence[Observation], **params: object) -> HandEye:
    return solve_cell(observations, cell_of(DEFAULT, None), RobustParams.model_validate(params))


def svd(observations: Sequence[Observation]) -> HandEye:
    return solve_svd(Observations(observations, Source("test")), SvdParams())


@pytest.mark.parametrize("wrong", [0, 4])
def test_poses_held_out_in_closed_form_are_off_like_those_solved_without(wrong) -> None:
    observations = simulate(24, 3, wrong=wrong)
    found = solve(observations)

    def by_solving_again(some: Sequence[Observation]) -> HandEye:
        return replace(solve(some), without=None)

    params = HoldoutParams(max_rms="100 mm")
    closed = verify_holdout(found, solve, params).figures
    again = verify_holdout(replace(found, without=None), by_solving_again, params).figures
    assert closed["rms"] == pytest.approx(again["rms"], rel=0.05)
    # What a log gives back knows nothing of its solver, and is told the same
    read = verify_holdout(replace(found, without=None), solve, params).figures
    assert read == closed


def test_poses_that_leave_too_few_are_not_held_out() -> None:
    assert not verify_holdout(solve(simulate(5, 0)), solve, HoldoutParams(folds=2)).passed


def rms_at_work(calibration: HandEye) -> float:
    grid = WORK.grid(4)
    mapped = calibration.base_T_camera.transform.apply(TRUTH.inverse().apply(grid))
    return float(np.sqrt(((mapped - grid) ** 2).sum(axis=1).mean()))


def rms(values: Sequence[float]) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def holds(calibration: HandEye) -> bool:
    """Whether the stated 95 % region of the pose holds the truth."""
    estimate = calibration.base_T_camera
    found = estimate.transform
    skew = TRUTH.rotation @ found.rotation.T
    phi = np.array([skew[2, 1] - skew[1, 2], skew[0, 2] - skew[2, 0], skew[1, 0] - skew[0, 1]]) / 2
    tau = TRUTH.apply(found.inverse().apply(estimate.about)) - estimate.about
    error = np.concatenate([phi, tau])
    distance = error @ np.linalg.solve(estimate.covariance, error)
    return bool(distance <= chi2_quantile(0.95, 6))


@given(seed=st.integers(0, 10**6), n=st.integers(4, 25))
@settings(max_examples=15)
def test_exact_centres_give_the_exact_pose(seed: int, n: int) -> None:
    cell = Cell(seed, sigma=1e-9)
    found = solve([cell.observe(f"{i}", cell.pose()) for i in range(n)]).base_T_camera.transform
    np.testing.assert_allclose(found.matrix, TRUTH.matrix, atol=1e-6)


@pytest.mark.parametrize("turned", [True, False])
@given(seed=st.integers(0, 10**6))
@settings(max_examples=4)
def test_moving_the_base_moves_the_answer_and_nothing_else(turned: bool, seed: int) -> None:
    observations = simulate(15, seed, wrong=2, normal=1e-3)
    rng = np.random.default_rng(seed)
    turn = rotation_exp(turned * rng.standard_normal(3))
    motion = Transform("there", BASE, rigid(turn, rng.standard_normal(3)))
    moved = [
        Observation(
            o.id, o.circle, by_frame(Transform(BASE, FLANGE, (motion @ o.base_T_flange).matrix))
        )
        for o in observations
    ]
    here, there = solve(observations), solve(moved)
    # As reported, the answer is for a box of the work, whose sides keep to the axes of the base
    pairs = [(here.true[0].transform, there.true[0].transform)]
    if not turned:
        pairs.append((here.base_T_camera.transform, there.base_T_camera.transform))
    for found, again in pairs:
        np.testing.assert_allclose(again.matrix, (motion @ found).matrix, atol=1e-7)
    assert [p.used for p in here.pairs] == [p.used for p in there.pairs]


def test_without_outliers_it_reaches_the_bound() -> None:
    """Issue 3: within 1.05 x the Cramer-Rao bound, over the workspace."""
    errors, bounds = [], []
    for seed in range(12):
        cell = Cell(seed)
        observations = [cell.observe(f"{i}", cell.pose()) for i in range(75)]
        errors.append(rms_at_work(solve(observations)))
        tcps = np.array([o.tcp_in_base for o in observations])
        covariance = kabsch_covariance(tcps, cell.sigma)
        at_work = covariance_at(covariance, tcps.mean(axis=0), WORK.grid(4))
        bounds.append(np.sqrt(np.trace(at_work, axis1=1, axis2=2).mean()))
    # 12 runs leave the ratio an error of 8 %; the slow test has 400.
    assert rms(errors) <= (1.05 + 0.16) * rms(bounds)


def test_gross_outliers_cost_nothing() -> None:
    """Issue 3: with 15 % outliers within 1.10 x of what the inliers alone give."""
    found, inliers_alone = [], []
    for seed in range(15):
        observations = simulate(20, seed, wrong=3)
        found.append(rms_at_work(solve(observations)))
        inliers_alone.append(rms_at_work(svd(observations[:17])))
    assert rms(found) <= 1.10 * rms(inliers_alone)


def test_rejected_pairs_say_how_far_off_they_are() -> None:
    cell = Cell(3)
    observations = [cell.observe(f"{i:02d}", cell.pose(), off=0.03 * (i == 4)) for i in range(20)]
    calibration = solve(observations)
    rejected = [p for p in calibration.pairs if not p.used]
    assert [p.observation.id for p in rejected] == ["04"]
    off = np.linalg.norm(rejected[0].residual) / MM
    assert rejected[0].reason is not None
    assert rejected[0].reason.startswith(f"residual {off:.1f} mm, ")
    assert rejected[0].reason.endswith(" sigma")
    assert 40 < float(rejected[0].reason.split()[3]) < 160


def test_each_centre_counts_with_its_own_covariance() -> None:
    """Centres ten times better in depth, seen from many sides: far better than equal weights."""
    observations = [simulate(20, seed, depth=0.1) for seed in range(10)]
    ours = rms([rms_at_work(solve(o)) for o in observations])
    assert ours < 0.7 * rms([rms_at_work(svd(o)) for o in observations])


def test_normals_help() -> None:
    observations = [simulate(10, seed, normal=5e-4) for seed in range(10)]
    with_normals = rms([rms_at_work(solve(o)) for o in observations])
    assert with_normals < 0.9 * rms([rms_at_work(solve(o, normals="off")) for o in observations])


def test_normals_of_another_frame_are_left_out_and_said() -> None:
    observations = []
    for o in simulate(15, 0, normal=1e-3):
        turned = o.base_T_flange.matrix @ rigid(rotation_exp(np.array([np.pi, 0, 0])), np.zeros(3))
        observations.append(Observation(o.id, o.circle, by_frame(Transform(BASE, FLANGE, turned))))
    calibration = solve(observations)
    assert rms_at_work(calibration) < 1 * MM
    assert calibration.notes[0] == (
        "the measured normals stand 180 deg from the robot's flange axis, so they are left out: "
        "check the orientation of the poses, and the tool frame they are in"
    )


def test_orientations_that_cannot_be_right_are_refused() -> None:
    """Quaternions in the wrong order: the centres fit, and the normals tell."""
    observations = []
    for o in simulate(15, 0, normal=1e-3):
        turn = rotation_exp(np.array([np.radians(76), 0, 0]))
        turned = o.base_T_flange.matrix @ rigid(turn, np.zeros(3))
        observations.append(Observation(o.id, o.circle, by_frame(Transform(BASE, FLANGE, turned))))
    with pytest.raises(CalibrationRefused) as error:
        solve(observations)
    assert str(error.value) == (
        "the measured normals stand 76 deg from the robot's flange axis: the orientations of the "
        "poses are wrong, or belong to another tool frame; 'flangeye doctor' tries the orders of "
        "quaternions and angles"
    )


def test_a_wrong_normal_does_not_cost_its_centre() -> None:
    observations = simulate(15, 0, normal=1e-3)
    circle = observations[2].circle
    assert circle.normal is not None
    bent = rotation_exp(np.array([0.05, 0.02, 0])) @ circle.normal
    wrong = CircleFeature(circle.centre, bent, {}, circle.covariance, circle.normal_covariance, 1.0)
    observations[2] = Observation("02", wrong, by_frame(observations[2].base_T_flange))
    calibration = solve(observations)
    assert all(p.used for p in calibration.pairs)
    assert "normals left out because they disagree with the others: 1" in calibration.notes


def in_line(n: int, normal: float | None, tilt: float) -> list[Observation]:
    cell = Cell(0)
    axis = np.array([0.02, 0.99, 0.14]) / np.linalg.norm([0.02, 0.99, 0.14])
    observations = []
    for i, along in enumerate(np.linspace(-0.15, 0.15, n)):
        pose = rigid(rotation_exp(cell.rng.uniform(-tilt, tilt, 3)), WORK.centre + along * axis)
        observations.append(cell.observe(f"{i:02d}", pose, normal=normal))
    return observations


def test_centres_in_line_are_enough_with_normals() -> None:
    calibration = solve(in_line(12, 1e-3, 0.3))
    assert rms_at_work(calibration) < 1 * MM
    assert holds(calibration)


def test_two_poses_are_refused() -> None:
    with pytest.raises(StageError, match="3 poses needed .* 2 given"):
        solve(simulate(2, 0))


@pytest.mark.parametrize("n", [3, 4, 5])
def test_few_poses_are_solved_without_rejecting_any(n: int) -> None:
    for seed in range(2):
        calibration = solve(simulate(n, seed))
        assert sum(p.used for p in calibration.pairs) >= n - 1
        assert np.isfinite(calibration.base_T_camera.covariance).all()


def test_it_stops_pulling_when_the_workspace_is_known_well_enough() -> None:
    pulled = []

    def arm() -> Iterator[Observation]:
        for observation in simulate(60, 0):
            pulled.append(observation.id)
            yield observation

    params = RobustParams.model_validate({"required": "2.5 mm"})
    calibration = solve_robust(Observations(arm(), Source("test")), params, WORK)
    assert 6 <= len(pulled) < 60
    assert len(calibration.pairs) == len(pulled)


@pytest.mark.parametrize("kind", [
    {"normal": 1e-3}, *(pytest.param(kind, marks=pytest.mark.slow) for kind in ({}, {"depth": 0.1})),
])  # fmt: skip
def test_the_stated_region_holds_the_truth(kind: dict[str, Any]) -> None:
    inside = np.mean([holds(solve(simulate(15, seed, wrong=2, **kind))) for seed in range(30)])
    assert inside >= 0.95 - 0.12  # three standard deviations of 30 runs


TOO_WIDE = pytest.mark.xfail(strict=True, reason="99.6 %: no arm is taken for so good a one")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "n"),
    [
        ({}, 8), ({}, 20), ({"normal": 1e-3}, 8), ({"normal": 1e-3}, 20),
        *(pytest.param({"depth": 0.1}, n, marks=TOO_WIDE) for n in (8, 20)),
    ],
)  # fmt: skip
def test_the_stated_region_holds_the_truth_in_93_to_97_percent(
    kind: dict[str, Any], n: int
) -> None:
    inside = np.mean([holds(solve(simulate(n, seed, **kind))) for seed in range(1000)])
    assert 0.93 <= inside <= 0.97


@pytest.mark.slow
def test_the_bound_and_the_outliers_in_400_runs() -> None:
    errors, bounds, with_outliers, inliers_alone = [], [], [], []
    for seed in range(400):
        observations = simulate(75, seed)
        errors.append(rms_at_work(solve(observations)))
        tcps = np.array([o.tcp_in_base for o in observations])
        at_work = covariance_at(kabsch_covariance(tcps, 0.3 * MM), tcps.mean(axis=0), WORK.grid(4))
        bounds.append(np.sqrt(np.trace(at_work, axis1=1, axis2=2).mean()))
        observations = simulate(75, seed, wrong=11)
        with_outliers.append(rms_at_work(solve(observations)))
        inliers_alone.append(rms_at_work(svd(observations[:64])))
    assert rms(errors) <= 1.05 * rms(bounds)
    assert rms(with_outliers) <= 1.10 * rms(inliers_alone)


def test_the_answer_is_bit_identical() -> None:
    observations = simulate(25, 1, wrong=3, normal=1e-3)
    first, second = solve(observations).base_T_camera, solve(observations).base_T_camera
    assert first.transform.matrix.tobytes() == second.transform.matrix.tobytes()
    assert first.covariance.tobytes() == second.covariance.tobytes()


@pytest.mark.slow
def test_of_twenty_sets_without_a_wrong_pose_one_loses_any() -> None:
    lost = [not all(p.used for p in solve(simulate(50, seed)).pairs) for seed in range(400)]
    assert np.mean(lost) <= 0.05 + 0.033  # three standard deviations of 400 sets
