"""Poses held out: the systems they lead to, against least squares by singular values."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from flangeye.handeye import candidates
from flangeye.handeye.candidates import (
    LEAST_KEPT,
    Model,
    _solved,
    better,
    considered,
    held_out,
    judged,
    rms,
    understated,
    weighed_with,
    with_nuisance,
)
from flangeye.handeye.consensus import Consensus
from flangeye.handeye.likelihood import weigh
from flangeye.handeye.walk import StepSize, Walk
from flangeye.types import ArmCorrection
from tests.handeye.cells import fitted, given, two_numbers


@pytest.mark.parametrize("smallest", [1.0, 1e-3, 1e-7, 1e-11, 0.0])
def test_held_out_systems_are_solved_as_by_singular_values(smallest: float) -> None:
    rng = np.random.default_rng(3)
    left, right = (np.linalg.qr(rng.normal(size=(24, 24)))[0] for _ in range(2))
    square = left * np.append(np.linspace(1.0, 0.1, 23), smallest) @ right
    wanted = rng.normal(size=(24, 5))
    expected = np.linalg.lstsq(square, wanted, rcond=LEAST_KEPT)[0]
    scale = np.abs(expected).max()
    assert _solved(square, wanted) == pytest.approx(expected, abs=1e-8 * scale)


def test_a_system_without_an_inverse_has_the_least_solution() -> None:
    assert _solved(np.diag([2.0, 0.0]), np.ones((2, 1))) == pytest.approx(np.array([[0.5], [0.0]]))


def test_joints_are_corrected_where_the_correction_has_offsets_of_them() -> None:
    some: Any = None
    offset = ArmCorrection(np.zeros(3))
    joints = ArmCorrection(np.zeros(3), joint_offsets=np.zeros(6), joints=np.zeros(6))
    assert [Model(some, each).corrects_joints for each in (None, offset, joints)] == [
        False, False, True,
    ]  # fmt: skip


def a_fit(n: int) -> Any:
    """Return a fit of four unknowns to n measurements, every seventh left out of it."""
    rng, inliers = np.random.default_rng(n), np.arange(n) % 7 != 5
    jacobian, seen = rng.normal(size=(n, 6, 4)), 1e-3 * rng.normal(size=(n, 6))
    rows = rng.normal(size=(n, 6, 8)) * np.array([1.0, 2, 1, 30, 50, 300])[:, None]
    weights = rows @ rows.transpose(0, 2, 1)
    covariance = np.linalg.inv(np.einsum("nai,nab,nbj->ij", *[jacobian[inliers], weights[inliers]],
                                         jacobian[inliers]))  # fmt: skip
    told = np.einsum("nai,nab,nb->i", jacobian[inliers], weights[inliers], seen[inliers])
    linear = SimpleNamespace(residuals=seen - jacobian @ covariance @ told, jacobian=jacobian)
    return SimpleNamespace(
        course=None, linear=linear, weights=weights, covariance=covariance, inliers=inliers
    )


@pytest.mark.parametrize(("n", "folds"), [(4, 4), (14, 5), (140, 6)])
def test_errors_held_out_are_those_of_a_fit_to_the_other_folds(n: int, folds: int) -> None:
    fit = a_fit(n)
    residuals, slopes = fit.linear.residuals, fit.linear.jacobian
    errors, covariances = held_out(fit)
    kept = np.flatnonzero(fit.inliers)
    order = np.random.default_rng(0).permutation(kept)
    for k in range(folds):
        part = order[k::folds]
        rest = np.setdiff1d(kept, part)
        jacobian, weights = slopes[rest], fit.weights[rest]
        known = np.linalg.inv(np.einsum("nai,nab,nbj->ij", jacobian, weights, jacobian))
        step = known @ np.einsum("nai,nab,nb->i", jacobian, weights, residuals[rest])
        for i in part:
            assert errors[i] == pytest.approx((residuals[i] - slopes[i] @ step)[3:])
            spread = slopes[i] @ known @ slopes[i].T + np.linalg.inv(fit.weights[i])
            assert covariances[i] == pytest.approx(spread[3:, 3:])
    out = ~fit.inliers
    np.testing.assert_array_equal(errors[out], residuals[out, 3:])
    assert not covariances[out].any()


def test_where_the_base_walks_each_is_left_out_alone() -> None:
    fit = a_fit(9)
    residuals, slopes = fit.linear.residuals, fit.linear.jacobian
    fit.spread = spread = slopes @ fit.covariance @ slopes.transpose(0, 2, 1)
    rested, _ = held_out(fit)
    fit.course = 1
    errors, covariances = held_out(fit)
    assert errors != pytest.approx(rested)
    for i in range(9):
        own = np.linalg.inv(fit.weights[i])
        share = np.linalg.inv(own - spread[i])
        if fit.inliers[i]:
            assert errors[i] == pytest.approx((own @ share @ residuals[i])[3:])
            assert covariances[i] == pytest.approx((own @ share @ own)[3:, 3:])
        else:
            assert errors[i] == pytest.approx(residuals[i, 3:]) and not covariances[i].any()


@pytest.mark.parametrize(("scale", "told"), [(3.0, 9.0), (0.5, 1.0)])
def test_covariances_fall_short_by_the_mean_square_of_what_was_held_out(
    scale: float, told: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    errors = 1e-3 * scale * np.array([[1.0, 1.0, 1.0], [1.0, -1.0, 1.0], [50.0, 0, 0]])
    stated = errors, np.tile(1e-6 * np.eye(3), (3, 1, 1))
    monkeypatch.setattr(candidates, "held_out", lambda _: stated)
    found: Any = SimpleNamespace(inliers=np.array([True, True, False]))
    assert understated(found) == pytest.approx(told)


def test_a_candidate_helps_that_leaves_nine_tenths_or_less() -> None:
    assert judged(1e-3, 0.9e-3, "it") == (
        True, "it (held-out error 0.900 mm with it, 1.000 mm without)"
    )  # fmt: skip
    assert judged(2e-3, 1.81e-3, "it") == (
        False,
        "left out, for it does not help: it (held-out error 1.810 mm with it, 2.000 mm without)",
    )
    assert not judged(1.0, np.nan, "it")[0]
    assert rms(np.array([[3.0, 4.0, 0.0], [0.0, 0.0, 1.0]])) == pytest.approx(np.sqrt(13))


def test_models_are_compared_where_either_of_them_agrees(monkeypatch: pytest.MonkeyPatch) -> None:
    some: Any = None
    one, two = (Model(SimpleNamespace(found=SimpleNamespace(inliers=np.array(i), off=off)))  # type: ignore[arg-type]
                for i, off in (([True, True, False], [1.0, 1.0, 9.0]),
                               ([True, False, False], [0.5, 1.1, 0.0])))  # fmt: skip
    monkeypatch.setattr(
        candidates, "held_out", lambda found: (np.outer(found.off, [1e-3, 0.0, 0.0]), some)
    )
    chosen = better(one, two, "it")
    assert chosen.found is two.found
    assert chosen.notes == ("it (held-out error 0.854 mm with it, 1.000 mm without)",)
    assert better(two, one, "it").found is two.found


def model(n: int = 9, **more: Any) -> Model:
    problem = given("eye-on-base, marker", "pose", n, **more)
    return Model(Consensus(problem, fitted(problem)))


def test_what_moves_all_poses_alike_is_followed_by_the_answer() -> None:
    """As it is where what was seen is moved by it, and fitted again."""
    bare, further = model(), two_numbers(9)
    found, problem = bare.found, bare.problem
    effects = weighed_with(problem, found, further).linear.jacobian[:, :, 20:]
    added = np.zeros((18, 18))
    for k in range(2):
        told = np.einsum("nai,nab,nb->i", found.linear.jacobian @ found.basis, found.weights,
                         effects[:, :, k])  # fmt: skip
        moved = (found.basis @ np.linalg.solve(found.information, told))[:18] * 2e-4
        added = added + np.outer(moved, moved)
    assert considered(bare, further) == pytest.approx(added, rel=1e-6, abs=1e-16)
    sized = model(nuisance=replace(two_numbers(9, sized=True), mean=np.zeros(2)))
    # Such an error of unknown size, estimated along, has taken its part already.
    assert np.trace(considered(sized, further)) < 1e-3 * np.trace(added)


def test_residuals_stand_in_the_base_with_what_a_smooth_error_explains_or_without() -> None:
    nuisance = two_numbers(9, sized=True).and_also(two_numbers(9))
    fit = model(nuisance=nuisance)
    found, s = fit.found, fit.problem.measurements
    turns = s.a[:, :3, :3] @ found.at.x[:3, :3]
    own = found.linear.residuals[:, 3:]
    sized = own + found.linear.jacobian[:, 3:, 20:22] @ found.at.nuisance[:2]
    assert fit.residuals() == pytest.approx((turns @ own[..., None])[..., 0])
    assert fit.residuals(as_reported=True) == pytest.approx((turns @ sized[..., None])[..., 0])
    walking = model(walk=Walk(np.full((9, 3), 0.3)))
    noise = replace(walking.found.noise, walk=StepSize(1e-3, 1e-3))
    problem = walking.problem
    walked = replace(walking, consensus=Consensus(problem, fitted(problem, noise)))
    resting = weigh(replace(problem, walk=None), walked.found.at, noise, np.ones(9))
    turns = problem.measurements.a[:, :3, :3] @ walked.found.at.x[:3, :3]
    reported = (turns @ resting.linear.residuals[:, 3:, None])[..., 0]
    assert walked.residuals(as_reported=True) == pytest.approx(reported)
    assert np.abs(walked.residuals() - reported).max() > 1e-5


def test_sized_nuisances_begin_at_the_size_of_the_residuals(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(
        candidates, "again", lambda consensus, problem: replace(consensus, problem=problem)
    )
    bare = model()
    found = replace(bare.found, inliers=np.arange(9) > 2)
    bare = replace(bare, consensus=Consensus(bare.problem, found))
    sized, known = two_numbers(9, sized=True), two_numbers(9)
    one = with_nuisance(bare, sized)
    assert one is not None
    assert one.found.noise.size == pytest.approx(rms(found.linear.residuals[3:, 3:]))
    still = replace(found, linear=replace(found.linear, residuals=0 * found.linear.residuals))
    least = with_nuisance(replace(bare, consensus=Consensus(bare.problem, still)), sized)
    assert least is not None and least.found.noise.size == 1e-7
    two = with_nuisance(one, known)
    assert two is not None and two.problem.nuisance.sized.tolist() == [True, True, False, False]
    assert two.found.noise.size == one.found.noise.size
    assert len(one.problem.nuisance) == 2


def test_a_direction_that_is_known_a_thousand_times_better_counts_as_well(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Of one that is not known at all nothing is held against the covariances."""
    errors = np.array([[1e-3, 4e-6, 7.0], [-1e-3, -4e-6, -7.0]])
    stated = errors, np.tile(np.diag([1e-6, 4e-12, 0.0]), (2, 1, 1))
    monkeypatch.setattr(candidates, "held_out", lambda _: stated)
    found: Any = SimpleNamespace(inliers=np.array([True, True]))
    assert understated(found) == pytest.approx((1 + 4) / 3)
