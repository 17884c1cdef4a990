"""verify.holdout: folds, figures, outliers, and the prediction over the workspace."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from flangeye import StageError
from flangeye.types import (
    BASE,
    FLANGE,
    CircleFeature,
    HandEye,
    Observation,
    Observations,
    Pair,
    PoseFeature,
    Seed,
    Source,
    Transform,
    by_frame,
)
from flangeye.types.geometry import rigid, rotation_exp
from flangeye_plugins.solve.svd import SvdParams, solve_svd
from flangeye_plugins.verify.holdout import (
    HoldoutParams,
    deal,
    deal_moments,
    verify_holdout,
)
from tests.plugins.fixed import fixed

TRUTH = rotation_exp(np.array([2.9, 0.4, -0.3])), np.array([0.4, -0.7, 0.9])
MM = 1e-3


def simulate(
    n: int, sigma: float = 0.3 * MM, tilt: float = 0.0, seed: int = 0
) -> list[Observation]:
    """Observations with isotropic noise; every normal is off by ``tilt`` in a random direction."""
    rng = np.random.default_rng(seed)
    observations = []
    for i in range(n):
        pose = np.eye(4)
        pose[:3, :3] = rotation_exp(rng.uniform(-0.3, 0.3, 3))
        pose[:3, 3] = np.array([0.4, -0.5, 0.2]) + rng.uniform(-1, 1, 3) * [0.15, 0.15, 0.1]
        centre = TRUTH[0].T @ (pose[:3, 3] - TRUTH[1]) + sigma * rng.standard_normal(3)
        across = np.cross(pose[:3, 2], rng.standard_normal(3))
        axis = across / np.linalg.norm(across)
        normal = TRUTH[0].T @ rotation_exp(tilt * axis) @ pose[:3, 2]
        circle = CircleFeature(
            centre, normal, {}, np.eye(3) * sigma**2, np.diag([1e-6, 1e-6, 0]), 1.0
        )
        observations.append(
            Observation(f"{i:02d}", circle, by_frame(Transform(BASE, FLANGE, pose)))
        )
    return observations


def svd(observations: Sequence[Observation]) -> HandEye:
    return solve_svd(Observations(observations, Source("test")), SvdParams())


def displaced(observation: Observation, by: Sequence[float]) -> Observation:
    circle = observation.circle
    moved = CircleFeature(
        circle.centre + by, circle.normal, {}, circle.covariance, circle.normal_covariance, 1.0
    )
    return Observation(observation.id, moved, by_frame(observation.base_T_flange))


def marker_of(circle: CircleFeature) -> PoseFeature:
    """A marker in a circle's place, its z along the circle's normal."""
    rotation = Rotation.align_vectors([circle.normal], [[0, 0, 1]])[0].as_matrix()
    covariance = np.diag([1e-6, 1e-6, 1e-6, *np.diag(circle.covariance)])
    return PoseFeature(Transform("camera", "target", rigid(rotation, circle.centre)), covariance)


def test_folds_hold_out_every_pose_once_and_do_not_depend_on_global_state() -> None:
    np.random.seed(1)
    first = deal(13, 5, 0)
    np.random.seed(2)
    second = deal(13, 5, 0)
    assert sorted(np.concatenate(first)) == list(range(13))
    assert [f.tolist() for f in first] == [f.tolist() for f in second]
    assert [len(f) for f in first] == [3, 3, 3, 2, 2]
    assert len(deal(4, 5, 0)) == 4


def test_errors_are_those_of_solutions_without_the_pose() -> None:
    observations = simulate(8)
    result = verify_holdout(svd(observations), svd, HoldoutParams(folds=8))
    for i, observation in enumerate(observations):
        without = svd(observations[:i] + observations[i + 1 :]).base_T_camera.transform
        error = np.linalg.norm(without.apply(observation.circle.centre) - observation.tcp_in_base)
        assert result.errors[observation.id] == pytest.approx(error)
    assert result.figures["rms"] == pytest.approx(
        np.sqrt(np.mean(np.square(list(result.errors.values()))))
    )
    assert result.figures["folds"] == 8
    assert not [name for name in result.figures if name.startswith("corrected")]


def test_the_figures_of_isotropic_noise() -> None:
    result = verify_holdout(svd(simulate(60)), svd, HoldoutParams())
    figures = result.figures
    assert result.passed
    assert figures["rms"] == pytest.approx(0.3 * MM * np.sqrt(3), rel=0.15)
    sizes = list(result.errors.values())
    assert figures["median"] == pytest.approx(np.median(sizes))
    assert figures["p95"] == pytest.approx(np.quantile(sizes, 0.95))
    assert figures["max"] == max(sizes)
    assert figures["outliers"] == 0
    assert figures["rms_inliers"] == figures["rms_all"] == figures["rms"]
    assert result.reason == (
        f"held-out error {figures['rms'] * 1e3:.3f} mm rms, within the limit of 1 mm"
    )


def test_tilt_is_the_angle_between_mapped_and_reported_normals() -> None:
    result = verify_holdout(svd(simulate(30, 1e-6, tilt=2e-3)), svd, HoldoutParams())
    assert result.figures["tilt_rms"] == pytest.approx(2e-3, rel=0.01)


def test_angles_that_were_read_wrongly_do_not_pass_though_positions_fit() -> None:
    result = verify_holdout(svd(simulate(30, tilt=np.radians(6))), svd, HoldoutParams())
    assert not result.passed and "off by 6.0 deg" in result.reason
    assert result.figures["rms"] < 1 * MM
    assert verify_holdout(svd(simulate(30, tilt=np.radians(1))), svd, HoldoutParams()).passed


def test_a_calibration_above_the_limit_does_not_pass() -> None:
    result = verify_holdout(
        svd(simulate(20)), svd, HoldoutParams.model_validate({"max_rms": "0.1 mm"})
    )
    assert not result.passed
    assert result.reason == (
        f"held-out error {result.figures['rms'] * 1e3:.3f} mm rms, above the limit of 0.1 mm"
    )


def test_a_solver_that_sets_nothing_aside_answers_for_every_pose() -> None:
    observations = simulate(20)
    observations[7] = displaced(observations[7], [0.02, 0, 0])
    result = verify_holdout(svd(observations), svd, HoldoutParams())
    assert not result.passed
    assert result.figures["outliers"] == 0
    assert result.figures["rms"] == result.figures["rms_all"] > 3 * MM


def without_07(observations: Sequence[Observation]) -> HandEye:
    """A solver that sets pose 07 aside."""
    solved = svd([o for o in observations if o.id != "07"])
    transform = solved.base_T_camera.transform
    pairs = [
        Pair(o, transform.apply(o.circle.centre) - o.tcp_in_base, o.id != "07", None)
        for o in observations
    ]
    return HandEye(solved.base_T_camera, tuple(pairs), "test")


def test_an_outlier_the_solver_set_aside_is_counted_and_reported() -> None:
    observations = simulate(20)
    observations[7] = displaced(observations[7], [0.02, 0, 0])
    result = verify_holdout(without_07(observations), without_07, HoldoutParams())
    assert result.passed
    assert result.figures["outliers"] == 1
    assert result.figures["rms"] < 0.8 * MM < result.figures["rms_all"]
    assert result.errors["07"] == pytest.approx(0.02, rel=0.05)
    assert result.reason.endswith("mm rms (1 of 20 poses set aside), within the limit of 1 mm")


def test_too_many_outliers_do_not_pass() -> None:
    observations = simulate(20)
    observations[7] = displaced(observations[7], [0.02, 0, 0])
    params = fixed(HoldoutParams, max_outliers=0.01)
    result = verify_holdout(without_07(observations), without_07, params)
    assert not result.passed
    assert result.reason == "1 of 20 poses are outliers, limit 1%"
    assert result.advice == "look at the scans the solver set aside"


def test_three_poses_cannot_be_held_out() -> None:
    result = verify_holdout(svd(simulate(3)), svd, HoldoutParams())
    assert not result.passed
    assert result.reason == (
        "the calibration without one of 3 folds fails: 3 poses needed, 2 given: "
        "add poses, or see why captures were set aside"
    )


def test_another_seed_deals_other_folds() -> None:
    observations = simulate(20)
    first = verify_holdout(svd(observations), svd, HoldoutParams())
    again = verify_holdout(svd(observations), svd, HoldoutParams())
    other = verify_holdout(svd(observations), svd, HoldoutParams(), seed=Seed(1))
    assert first.figures == again.figures
    assert first.figures["rms"] != other.figures["rms"]


def test_errors_of_other_kinds_are_not_hidden() -> None:
    def broken(_observations: Sequence[Observation]) -> HandEye:
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        verify_holdout(svd(simulate(10)), broken, HoldoutParams())


def test_an_unsolvable_fold_is_said_and_not_raised() -> None:
    def refusing(_observations: Sequence[Observation]) -> HandEye:
        raise StageError("no")

    result = verify_holdout(svd(simulate(10)), refusing, HoldoutParams())
    assert (result.passed, result.reason) == (
        False,
        "the calibration without one of 5 folds fails: no",
    )


def test_two_folds_are_enough_and_one_is_not() -> None:
    assert HoldoutParams(folds=2).folds == 2
    with pytest.raises(ValueError, match="greater than or equal to 2"):
        HoldoutParams(folds=1)


def test_what_cameras_saw_of_one_pose_is_held_out_together() -> None:
    once = simulate(6, 1e-4)
    twice = [replace(o, id=f"{o.id}-{camera}", camera=camera) for o in once for camera in "ab"]
    folds = deal_moments(twice, 3, seed=0)
    assert sorted(np.concatenate(folds)) == list(range(12))
    for fold in folds:
        assert len(fold) == 4
        assert {i ^ 1 for i in fold} == set(fold.tolist())
