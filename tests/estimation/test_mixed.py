"""The mixed model: its gradient, its folds, and how true it is on arms that it did not make."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from flangeye.estimation.mixed import Posterior, fit, left_out, mode_of, shares
from tests.estimation import foreign
from tests.estimation.sessions import estimated, robot, score


@pytest.fixture(scope="module")
def found():
    return estimated(foreign.session("marker", foreign.UR5E, 1e-3, 16, 1), "marker")


@pytest.mark.parametrize("arm", [foreign.UR5E, foreign.PANDA])
def test_the_foreign_arms_are_those_of_the_catalogue(arm) -> None:
    joints = arm["home"] + np.linspace(-0.4, 0.4, 5)[:, None]
    assert robot(arm["name"])[1].flange(joints) == pytest.approx(foreign.pose(arm, joints))


def test_the_gradient_is_that_of_the_cost(found) -> None:
    model = found.posterior.model
    model = replace(model, shares=np.arange(16) != 3)
    x = model.sizes.centre + 0.5 * np.random.default_rng(0).standard_normal(len(model.sizes.centre))
    here = fit(model, np.exp(x), with_slopes=True)
    steps = 1e-4 * np.eye(len(x))
    slopes = [
        (fit(model, np.exp(x + e)).cost - fit(model, np.exp(x - e)).cost) / 2e-4 for e in steps
    ]
    assert here.gradient == pytest.approx(slopes, rel=1e-4, abs=1e-3)


def test_the_curvature_is_between_the_observed_and_the_expected_one(found) -> None:
    model, rng = found.posterior.model, np.random.default_rng(0)
    x = model.sizes.centre + 0.5 * rng.standard_normal(len(model.sizes.centre))
    sizes, (n, _, count) = np.exp(x), model.design.shape
    scale = np.concatenate([np.zeros(model.p), sizes[model.sizes.effect]])
    roots = model.projectors @ np.linalg.cholesky(model.noise(sizes))
    steps, differences = 1e-4 * np.eye(len(x)), []
    for _ in range(60):
        drawn = model.design @ (scale * rng.standard_normal(count))
        drawn += (roots @ rng.standard_normal((n, 6, 1)))[..., 0]
        some = replace(model, residuals=drawn)
        here = fit(some, sizes, with_slopes=True)
        both = [
            [fit(some, np.exp(y), with_slopes=True).gradient for y in (x + e, x - e)] for e in steps
        ]
        observed = np.array([(a - b) / 2e-4 for a, b in both])
        differences.append(np.stack([observed, here.curvature]))
    observed, ours = np.mean(differences, axis=0)
    spread = np.std(np.diff(differences, axis=1)[:, 0], axis=0) / np.sqrt(len(differences))
    # The observed one is the expected one in the mean
    assert (np.abs(ours - observed) < 5 * spread + 1e-6).all()
    assert np.diag(ours).max() > 5


def test_the_most_likely_sizes_are_where_the_cost_is_least(found) -> None:
    model = found.posterior.model
    mode = mode_of(model)
    best = fit(model, model.sizes.at(mode.z)).cost + mode.z @ mode.z
    for step in 0.03 * np.vstack([np.eye(len(mode.z)), -np.eye(len(mode.z))]):
        z = mode.z + step
        assert fit(model, model.sizes.at(z)).cost + z @ z > best


def test_leaving_one_out_in_closed_form_is_leaving_it_out(found) -> None:
    model, mode = found.posterior.model, found.posterior.mode
    parts = np.ones(16)
    everyone = fit(replace(model, shares=parts), mode.sizes)
    parts[3] = 0.0
    others = fit(replace(model, shares=parts), mode.sizes)
    expected = (model.residuals - model.design @ others.mean)[3]
    assert left_out(model, everyone)[0][3] == pytest.approx(expected, rel=1e-5, abs=1e-10)


@pytest.mark.parametrize("sightings", [16, pytest.param(200, marks=pytest.mark.slow)])
def test_leaving_a_fold_out_is_fitting_the_others_at_the_same_sizes(sightings) -> None:
    fold = np.arange(1, sightings, 5)
    session = foreign.session("marker", foreign.UR5E, 1e-3, sightings, 1)
    posterior = estimated(session, "marker").posterior
    shares = posterior.model.shares.copy()
    shares[fold] = 0.0
    others = replace(posterior.model, shares=shares)
    assert posterior.without(fold).model.shares.tolist() == shares.tolist()
    for known, left in zip(posterior.fits, posterior.without(fold).fits, strict=True):
        again = fit(others, known.sizes)
        assert left.mean == pytest.approx(again.mean, rel=1e-6, abs=1e-12)
        assert left.covariance == pytest.approx(again.covariance, rel=1e-6, abs=1e-15)


def test_shares_are_what_each_cause_does_to_the_answer(found) -> None:
    known, mode = found.posterior, found.posterior.mode
    model, (n, _, count) = known.model, known.model.design.shape
    one = Posterior(model, mode, lambda: [mode], 0.0)
    of_effects, noise = shares(one, np.eye(count)[: model.p])
    gain = (mode.covariance @ (model.weights(mode.sizes) @ model.design).reshape(6 * n, count).T)[
        : model.p
    ]
    # An effect of one size at a time, through the linear estimator
    for k, share in enumerate(of_effects):
        columns = model.p + np.flatnonzero(model.sizes.effect == k)
        error = gain @ model.design.reshape(6 * n, count)[:, columns] * mode.sizes[k]
        assert share == pytest.approx(error @ error.T, rel=1e-4, abs=1e-6 * share.max())
    each = gain.reshape(model.p, n, 6).swapaxes(0, 1)
    whole = (each @ model.noise(mode.sizes) @ each.swapaxes(1, 2)).sum(axis=0)
    assert noise == pytest.approx(whole, rel=1e-4, abs=1e-6 * whole.max())


def test_where_a_draw_has_more_noise_of_one_kind_it_has_less_of_another(found) -> None:
    """Sightings tell how large all noise is, but not which: draws differ in this alone."""
    model, own = found.posterior.model, np.unique(found.posterior.model.factors)
    sizes = np.array([each.sizes for each in found.posterior.fits])
    whole = [np.linalg.slogdet(model.noise(each))[1].mean() / 12 for each in sizes]
    assert np.std(whole) < 0.1 and np.std(np.log(sizes[:, own]), axis=0).max() > 1.0


def test_a_pose_that_belongs_elsewhere_is_set_aside() -> None:
    session = foreign.session("marker", foreign.UR5E, 0.3e-3, 20, 2)
    session.seen[5, :3, 3] += [0.0, 0.02, 0.0]
    inliers = estimated(session, "marker").inliers
    assert not inliers[5] and inliers.sum() == 19


@pytest.mark.parametrize("kind", [pytest.param("marker", marks=pytest.mark.slow), "flange"])
def test_what_is_stated_as_reported_is_as_large_as_the_error(kind) -> None:
    arms = foreign.UR5E, foreign.PANDA
    scores = [score(kind, arms[seed % 2], 0.3e-3, 16, seed) for seed in range(4)]
    nees, stated, true = np.array([s.reported for s in scores]).T
    assert 0.4 < nees.mean() < 1.9  # 4 sessions of 6 numbers: 99 % of means
    assert 0.6 < np.sqrt(stated.mean() / true.mean()) < 1.7
    if kind == "flange":
        assert true.mean() < 1.1**2 * np.mean([s.svd for s in scores])


@pytest.mark.parametrize("kind", [pytest.param("hand", marks=pytest.mark.slow), "flange"])
def test_both_answers_hold_where_no_joints_were_recorded(kind) -> None:
    arms = foreign.UR5E, foreign.PANDA
    scores = [score(kind, arms[seed % 2], 0.3e-3, 16, seed, told=False) for seed in range(4)]
    for answer in ("true", "reported"):
        nees = np.mean([getattr(s, answer).nees for s in scores])
        assert 0.3 < nees < 1.9  # 16 and 5 before, of what all poses have in common


def test_where_no_joints_were_recorded_a_coarse_arm_is_met_better_than_by_least_squares() -> None:
    arms = foreign.UR5E, foreign.PANDA
    scores = [score("flange", arms[seed % 2], 3e-3, 16, seed, told=False) for seed in range(6)]
    nees, stated, true = np.array([s.reported for s in scores]).T
    assert 0.4 < nees.mean() < 1.9  # 4 before, as if the work were the session's own poses
    assert 0.6 < np.sqrt(stated.mean() / true.mean()) < 1.7
    assert true.mean() < 0.85**2 * np.mean([s.svd for s in scores])
