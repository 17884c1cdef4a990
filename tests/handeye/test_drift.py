"""The sequential test: what it finds, when, and how often it cries wolf."""

from __future__ import annotations

import numpy as np
import pytest

from flangeye.handeye.drift import (
    MISFIT,
    DriftTest,
    Information,
    Prior,
    Sightings,
    _change,
    _scatter,
    _surprise,
    allowance,
    information_of,
    misfits,
    moved_since,
    verdict,
)
from flangeye.maths.statistics import chi2_quantile
from flangeye_emulators.world.year import CORNERS, Happening, Year, watch
from tools import drift_year


def test_the_days_motion_is_marginalised_as_an_unknown_would_be() -> None:
    watched = watch(Year(checks=2), Happening(), np.random.default_rng(0))
    seen, daily = watched.sightings, 3e-5
    known = information_of(seen, daily)
    own = seen.of(1, 2)
    stacked = own.effects.reshape(-1, 6)
    noise = stacked @ allowance(daily) @ stacked.T
    for i, each in enumerate(own.covariances):
        noise[5 * i : 5 * i + 5, 5 * i : 5 * i + 5] += each
    weighted = np.linalg.solve(noise, stacked)
    np.testing.assert_allclose(known.matrix[1], stacked.T @ weighted, rtol=1e-6, atol=1e-3)
    np.testing.assert_allclose(known.vector[1], -weighted.T @ own.residuals.ravel(), rtol=1e-5)


def told(rng: np.random.Generator, *shape: int) -> Information:
    """Return what a camera's six numbers are known to be: positive, no axis by itself."""
    rows = rng.standard_normal((*shape, 9, 6))
    return Information(np.swapaxes(rows, -1, -2) @ rows, rng.standard_normal((*shape, 6)))


def test_a_change_is_what_came_after_less_what_came_before() -> None:
    rng = np.random.default_rng(0)
    after, before = told(rng, 4), told(rng)
    change = _change(after, before)
    for k in range(4):
        inverse = np.linalg.inv(after.matrix[k]), np.linalg.inv(before.matrix)
        assert np.linalg.inv(change.matrix[k]) == pytest.approx(sum(inverse), rel=1e-6)
        mean = inverse[0] @ after.vector[k] - inverse[1] @ before.vector
        assert np.linalg.solve(change.matrix[k], change.vector[k]) == pytest.approx(mean)


def test_a_surprise_is_the_squared_distance_along_what_is_told() -> None:
    change = told(np.random.default_rng(1))
    mean = np.linalg.solve(change.matrix, change.vector)
    squares, rank = _surprise(change)
    assert squares == pytest.approx(mean @ change.matrix @ mean) and rank == 6
    flat = Information(np.diag([4.0, 1.0, 0, 0, 0, 0]), np.array([2.0, 3.0, 0, 0, 0, 0]))
    assert [float(x) for x in _surprise(flat)] == [2.0**2 / 4 + 3.0**2, 2.0]


@pytest.mark.parametrize("factor", [1.0, 9.0])
def test_checks_scatter_by_the_factor_that_their_middle_one_does(factor: float) -> None:
    rng = np.random.default_rng(2)
    vectors = np.sqrt(factor) * rng.standard_normal((260, 6))
    vectors[50:70] *= 30.0  # some bad ones hide nothing
    checks = Information(np.tile(np.eye(6), (260, 1, 1)), vectors)
    before = Information(1e9 * np.eye(6), np.zeros(6))
    found, freedom = _scatter(checks, before, (10, 250), np.inf)
    assert found == pytest.approx(factor, rel=0.25)
    assert freedom == pytest.approx(0.4 * 6 * 240)
    assert _scatter(checks, before, (10, 19), 7.0) == (1.0, 7.0)
    assert _scatter(checks, before, (10, 20), 7.0)[1] == pytest.approx(0.4 * 6 * 10)
    still = Information(checks.matrix, 0.01 * vectors)
    assert _scatter(still, before, (100, 250), np.inf)[0] == 0.25


def test_a_sighting_is_a_misfit_beyond_what_camera_day_and_scan_allow_together() -> None:
    camera, scan, mean = 3e-4, 4e-4, 1e-3
    covariance = np.diag([1e-12] * 3 + [camera**2] * 3)
    before = Information.of_covariance(covariance, np.array([0, 0, 0, mean, 0, 0]))
    limit = np.sqrt(chi2_quantile(1 - MISFIT, 5) * (camera**2 + scan**2 + DriftTest().daily ** 2))
    off = np.array([0.99, 1.01, -0.99, -1.01]) * limit - mean
    residuals, effects = np.zeros((4, 5)), np.zeros((4, 5, 6))
    residuals[:, 0], effects[:, :3, 3:] = off, np.eye(3)
    own = np.tile(np.diag([scan**2] * 3 + [1e-6] * 2), (4, 1, 1))
    seen = Sightings(residuals, effects, own, np.tile(np.eye(3), (4, 1, 1)), None, np.arange(4))
    assert misfits(seen, before, DriftTest()).tolist() == [False, True, False, True]


def test_a_motion_is_held_against_the_checks_of_its_reference_alone() -> None:
    test, weight = DriftTest(reference=8), 1e8
    means = np.zeros((20, 6))
    means[:4, 3], means[4:12, 3] = 9.0, 1e-3  # the first four are no longer held against it
    means[12:, 3:] = [1e-3, 3e-3, 4e-3]
    checks = Information(np.tile(weight * np.eye(6), (20, 1, 1)), weight * means)
    unknown = Prior(Information.of_covariance(1e6 * np.eye(6)))
    found = moved_since(checks, unknown, CORNERS, test, 12, 2.5)
    assert (found.state, found.since, found.statistic) == ("MOVED", 12, 2.5)
    assert found.motion == pytest.approx([0, 0, 0, 0, 3e-3, 4e-3], abs=1e-9)
    assert found.shift == pytest.approx(5e-3)
    assert found.covariance == pytest.approx((1 / 8 + 1 / 8) / weight * np.eye(6), abs=1e-13)


def test_weights_of_the_arm_are_told_by_every_check_less_the_days_motion_of_each() -> None:
    """Against one system of all that is unknown: the motion, two weights, each check's day."""
    rng, daily = np.random.default_rng(4), 3e-5
    effects, residuals = rng.normal(size=(9, 5, 8)), 1e-4 * rng.normal(size=(9, 5))
    own, check = np.tile(1e-9 * np.eye(5), (9, 1, 1)), np.repeat(np.arange(3), 3)
    seen = Sightings(residuals, effects, own, np.tile(np.eye(3), (9, 1, 1)), None, check)
    found = information_of(seen, daily)
    assert found.matrix.shape == (3, 8, 8)
    rows = np.zeros((9, 5, 8 + 18))
    rows[..., :8] = effects
    for i, c in enumerate(check):
        rows[i, :, 8 + 6 * c : 14 + 6 * c] = effects[i, :, :6]
    normal = np.einsum("nij,nik->jk", rows, rows) / 1e-9
    normal[8:, 8:] += np.kron(np.eye(3), np.linalg.inv(allowance(daily)))
    right = -np.einsum("nij,ni->j", rows, residuals) / 1e-9
    matrix, vector = found.matrix.sum(0), found.vector.sum(0)
    assert np.linalg.inv(matrix) == pytest.approx(np.linalg.inv(normal)[:8, :8], rel=1e-4)
    assert np.linalg.solve(matrix, vector) == pytest.approx(
        np.linalg.solve(normal, right)[:8], rel=1e-4
    )


def drifted(to: float, since: int = 20, count: int = 60) -> Information:
    """Return checks of a camera that goes evenly to a shift along x [m], from a check on."""
    means = np.zeros((count, 6))
    means[:, 3] = to * np.clip((np.arange(count) - since) / (count - 9 - since), 0.0, 1.0)
    own = np.linalg.inv(allowance(2e-5))
    return Information(np.tile(own, (count, 1, 1)), means @ own)


@pytest.mark.parametrize(
    ("to", "state"), [(0.15e-3, "OK"), (0.3e-3, "DEGRADED"), (0.55e-3, "MOVED")]
)
def test_a_slow_drift_counts_by_how_far_it_surely_went(to: float, state: str) -> None:
    """Held against the first nine checks; it began where a quarter of the limit was gone."""
    prior = Prior(Information.of_covariance(allowance(1e-3)))
    unseen = DriftTest(false_alarms=1e-300)  # no step of it is one
    found = verdict(drifted(to), prior, CORNERS, unseen)
    assert found.state == state
    assert found.shift == pytest.approx(to, rel=0.01)
    assert found.motion[3] == pytest.approx(to, rel=0.01)
    assert found.covariance[3, 3] == pytest.approx((2e-5) ** 2 * (1 / 9 + 1 / 9), rel=0.01)
    if state == "OK":
        assert found.since is None
        return
    # The mean of nine checks lags by four: 20 + 31 * 0.1 mm / to, and 4 more.
    assert found.since == np.floor(24 + 31 * 1e-4 / to) + 1


def test_of_fewer_checks_than_settle_nothing_drifted() -> None:
    prior = Prior(Information.of_covariance(allowance(1e-3)))
    for count, told in ((8, 0.0), (10, 1.0), (9, 1.0)):
        means = np.zeros((count, 6))
        means[:, 3] = 1e-3
        own = np.linalg.inv(allowance(1e-6))
        checks = Information(np.tile(own, (count, 1, 1)), means @ own)
        found = verdict(checks, prior, CORNERS, DriftTest(false_alarms=1e-300, seasonal=1.0))
        # Of nine, the calibration alone is what they are held against; of ten, one check more.
        assert found.motion[3] == pytest.approx(told * (1e-3 if count == 9 else 0.0), abs=1e-8)


@pytest.mark.parametrize("name", drift_year.STEPS)
def test_a_step_is_found_within_three_checks(name: str) -> None:
    part, size = drift_year.STEPS[name]
    found, _, by_check = drift_year.steps(part, size, 20)
    assert by_check[2] >= 0.95 and found >= 19


def test_a_cell_that_only_warms_and_cools_is_ok() -> None:
    watched = watch(Year(checks=90), Happening(), np.random.default_rng(5))
    known = information_of(watched.sightings, DriftTest().daily)
    for n in range(1, 91):
        seen = Information(known.matrix[:n], known.vector[:n])
        assert (
            verdict(
                seen, Prior(Information.of_covariance(watched.prior)), CORNERS, DriftTest()
            ).state
            == "OK"
        )


def test_a_scanner_knocked_by_millimetres_is_found_at_once_and_named() -> None:
    part, _ = drift_year.STEPS["scanner 0.2 mm"]
    _, right, by_check = drift_year.steps(part, lambda v: np.concatenate([2e-3 * v, 2e-3 * v]), 8)
    assert by_check[0] == 1.0 and right == 1.0


def test_a_joint_re_mastered_is_named() -> None:
    from flangeye.handeye.blame import blame, suspects
    from flangeye_emulators.world.year import ABOUT, step_at

    wrong = step_at(40, np.array([0, 0, 2e-3, 0, 0, 0]))
    watched = watch(Year(checks=46), Happening(joints=wrong), np.random.default_rng(3))
    known = information_of(watched.sightings, DriftTest().daily)
    found = verdict(known, Prior(Information.of_covariance(watched.prior)), CORNERS, DriftTest())
    assert found.state == "MOVED" and found.since is not None
    before = Information.of_covariance(watched.prior).plus(known.summed(10, 40))
    parts = blame(before, watched.sightings.of(40, 46), ABOUT, watched.scanner, 3e-5)
    assert suspects(parts)[0][0] == "arm"
    assert max(parts, key=lambda part: parts[part]) == "joint 3 re-mastered"


@pytest.mark.slow
def test_a_year_as_the_page_says() -> None:
    for part, size in drift_year.STEPS.values():
        assert drift_year.steps(part, size, 200)[2][2] >= 0.95
    alarms, checks = drift_year.false_alarms(3)
    assert alarms <= checks / 1000
    assert max(drift_year.slow(20)) < 0.3
