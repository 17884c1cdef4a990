"""The paper's simulated cell, the emulated oracle, and the targets of figure 9."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from flangeye import StageError
from flangeye.types import BASE, CAMERA, Transform, Views
from flangeye.types.geometry import kabsch, rigid, rotation_exp
from flangeye_paper.points import (
    BASE_T_CAMERA,
    WORKSPACE,
    PointsParams,
    acquire_points,
    bound,
    errors_of,
    grid,
    observations_of,
    realise,
    rms_over_workspace,
)
from flangeye_paper.realisations import (
    RealisationsParams,
    error_oracle,
    verify_realisations,
)

STEP = "verify.realisations"
MM = 1e-3


def realised(seed=0, noise=1e-12, outliers=0.0, poses=75):
    return realise(np.random.default_rng(seed), noise, outliers, poses)


def test_the_grid_fills_the_workspace() -> None:
    points = grid()
    assert points.shape == (75, 3)
    np.testing.assert_allclose(np.ptp(points, axis=0), WORKSPACE.size)
    np.testing.assert_allclose(points.mean(axis=0), WORKSPACE.centre)


def test_without_noise_the_points_obey_equation_7() -> None:
    drawn = realised()
    mapped = drawn.centres @ BASE_T_CAMERA[:3, :3].T + BASE_T_CAMERA[:3, 3]
    np.testing.assert_allclose(mapped, drawn.tcps, atol=1e-10)
    assert (drawn.centres[:, 2] > 0.5).all()  # before the camera


def test_the_flange_faces_the_camera() -> None:
    towards = (BASE_T_CAMERA[:3, 3] - realised().tcps) / 0.7
    cosines = np.einsum("ni,ni->n", realised().rotations[:, :, 2], towards)
    assert (cosines > 0.7).all()


def test_fewer_poses_are_the_first_of_more() -> None:
    few, many = realised(3, MM, 0.0, 20), realised(3, MM, 0.0, 75)
    np.testing.assert_array_equal(few.centres, many.centres[:20])


def test_outliers_are_as_many_and_as_far_as_said() -> None:
    clean, gross = realised(5, MM), realised(5, MM, 0.15)
    away = np.linalg.norm(gross.centres - clean.centres, axis=1)
    assert gross.gross.sum() == 11
    assert (away[~gross.gross] == 0).all()
    assert (away[gross.gross] >= 0.05).all() and (away[gross.gross] <= 0.15).all()


def test_every_noise_has_draws_of_its_own() -> None:
    params = [PointsParams(noise=noise) for noise in ("1 mm", "2 mm")]
    one, two = (acquire_points(0, p).source.draw(0).centres for p in params)
    exact = realised().centres
    assert not np.allclose(two - exact, 2 * (one - exact))


@given(st.lists(st.floats(-1e-3, 1e-3), min_size=6, max_size=6))
def test_the_error_is_what_takes_the_measured_onto_the_predicted(motion: Any) -> None:
    wrong = rigid(rotation_exp(np.array(motion[:3])), np.array(motion[3:])) @ BASE_T_CAMERA
    point = np.array([0.1, -0.1, 0.7, 1.0])
    predicted = np.linalg.inv(wrong) @ BASE_T_CAMERA @ point
    np.testing.assert_allclose(errors_of(wrong) @ point, predicted, atol=1e-12)


def test_the_oracle_measures_nothing_at_the_truth() -> None:
    error = error_oracle(Transform(BASE, CAMERA, BASE_T_CAMERA), [], Views(), None)
    np.testing.assert_allclose(error.motion, np.eye(4), atol=1e-15)
    np.testing.assert_allclose(error.at, [0.0, 0.0, 0.7])


def test_least_squares_reaches_the_bound() -> None:
    errors, rms = [], []
    for seed in range(400):
        drawn = realised(seed, MM)
        found = rigid(*kabsch(drawn.centres, drawn.tcps))
        errors.append(errors_of(found)[:3, 3])
        rms.append(rms_over_workspace(found, WORKSPACE.grid()))
    limits = bound(grid(), MM, WORKSPACE.grid())
    assert np.std(errors, axis=0) == pytest.approx([limits[a] for a in "xyz"], rel=0.12)
    assert np.sqrt(np.mean(np.square(rms))) == pytest.approx(limits["workspace_rms"], rel=0.05)


def test_observations_say_what_they_were_told_and_no_more() -> None:
    source = acquire_points(0, PointsParams(noise="5 mm", poses=6)).source
    observations = list(observations_of(source.draw(0), source))
    assert [o.id for o in observations] == ["00", "01", "02", "03", "04", "05"]
    assert observations[0].circle.normal is None
    np.testing.assert_allclose(np.diag(observations[0].circle.covariance), 1e-8)


def test_robust_reaches_the_bound_and_all_data(paper: Callable[..., Any]) -> None:
    """Target: rms over the workspace within 1.05 of the bound; here against the same draws."""
    overrides = ["steps.2.count=8"]
    ours, result = paper("fig9_robust", STEP, *overrides)
    plain, _ = paper("fig9_all-data", STEP, *overrides)
    assert ours["workspace_rms"] <= 1.05 * plain["workspace_rms"]
    assert plain["workspace_rms"] == pytest.approx(plain["inliers_alone_rms"], rel=1e-9)
    assert ours["refused"] == 0
    assert result.status == "verified"
    assert result.truth.rms_over_workspace > 0


def test_robust_with_outliers_is_as_good_as_the_inliers_alone(paper: Callable[..., Any]) -> None:
    """Target: within 1.10."""
    overrides = ["steps.2.count=12", "steps.0.outliers=0.15"]
    ours, _ = paper("fig9_robust", STEP, *overrides)
    plain, _ = paper("fig9_all-data", STEP, *overrides)
    assert ours["workspace_rms"] <= 1.10 * ours["inliers_alone_rms"]
    assert plain["workspace_rms"] > 10 * ours["workspace_rms"]


ALLOWS_FOR_MORE = pytest.mark.xfail(
    strict=True,
    reason="1.10 times: an arm's error and a drift are allowed for, of which it has none",
)


@pytest.mark.slow
@pytest.mark.parametrize("noise", [pytest.param("0.2 mm", marks=ALLOWS_FOR_MORE), "2 mm", "10 mm"])
def test_robust_against_the_bound_itself(paper: Callable[..., Any], noise: str) -> None:
    overrides = ["steps.2.count=400", f"steps.0.noise={noise}"]
    clean, _ = paper("fig9_robust", STEP, *overrides)
    gross, _ = paper("fig9_robust", STEP, *overrides, "steps.0.outliers=0.15")
    assert clean["workspace_rms"] <= 1.05 * clean["bound_workspace_rms"]
    assert gross["workspace_rms"] <= 1.10 * gross["inliers_alone_rms"]


def test_the_paper_s_cost_hides_its_error_at_the_camera(paper: Callable[..., Any]) -> None:
    """At the camera's origin the emulation beats all data; at the work it is far worse."""
    overrides = ["steps.2.count=8"]
    oracle, _ = paper("fig9_algorithm-1-oracle", STEP, *overrides)
    plain, _ = paper("fig9_all-data", STEP, *overrides)
    assert oracle["x_std"] < 0.5 * plain["x_std"]
    assert oracle["workspace_rms"] > 2 * plain["workspace_rms"]


def test_a_held_out_cost_needs_no_truth(paper: Callable[..., Any]) -> None:
    held_out, result = paper("fig9_algorithm-1-held-out", STEP, "steps.2.count=3")
    assert held_out["workspace_rms"] > held_out["bound_workspace_rms"]
    assert sum(o.used for o in result.observations) == 4


def test_the_same_seed_gives_the_same_figures(paper: Callable[..., Any]) -> None:
    runs = [paper("fig9_robust", STEP, "steps.2.count=2", "seed=5")[0] for _ in range(2)]
    assert runs[0] == runs[1]


def test_other_observations_cannot_be_repeated() -> None:
    with pytest.raises(StageError) as error:
        verify_realisations(None, None, RealisationsParams(count=2), None)
    assert str(error.value) == ("verify.realisations works only with acquire.points_as_in_paper")
