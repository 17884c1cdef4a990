"""The sequential test: what it finds, when, and how often it cries wolf."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from flangeye.maths.statistics import MISFIT, chi2_quantile, f_quantile
from flangeye.types import Floats
from flangeye.types.geometry import rigid, rotation_exp
from flangeye.workflow.doctor.monitor.drift import (
    CheckSightings,
    DriftTest,
    Information,
    Prior,
    _began,
    _change,
    _deviation,
    _scatter,
    _slow,
    _step,
    _surprise,
    _windows,
    allowance,
    information_of,
    largest_shift,
    misfits,
    moved_since,
    prior_of,
    sightings_of,
    verdict,
)
from tools import drift_year
from tools.checked_year import CORNERS, Happening, Year, watch


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


def told(rng: np.random.Generator, *shape: int, numbers: int = 6) -> Information:
    """Return what is known of a camera's six numbers, or more: positive, no axis by itself."""
    rows = rng.standard_normal((*shape, 12, numbers))
    return Information(np.swapaxes(rows, -1, -2) @ rows, rng.standard_normal((*shape, numbers)))


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
    seen = CheckSightings(
        residuals, effects, own, np.tile(np.eye(3), (4, 1, 1)), None, np.arange(4)
    )
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
    seen = CheckSightings(residuals, effects, own, np.tile(np.eye(3), (9, 1, 1)), None, check)
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
    from flangeye.workflow.doctor.monitor.attribution import attribute_change, suspects
    from tools.checked_year import ABOUT, step_at

    wrong = step_at(40, np.array([0, 0, 2e-3, 0, 0, 0]))
    watched = watch(Year(checks=46), Happening(joints=wrong), np.random.default_rng(3))
    known = information_of(watched.sightings, DriftTest().daily)
    found = verdict(known, Prior(Information.of_covariance(watched.prior)), CORNERS, DriftTest())
    assert found.state == "MOVED" and found.since is not None
    before = Information.of_covariance(watched.prior).plus(known.summed(10, 40))
    parts = attribute_change(before, watched.sightings.of(40, 46), ABOUT, watched.scanner, 3e-5)
    assert suspects(parts)[0][0] == "arm"
    assert max(parts, key=lambda part: parts[part]) == "joint 3 re-mastered"


@pytest.mark.slow
def test_a_year_as_the_page_says() -> None:
    for part, size in drift_year.STEPS.values():
        assert drift_year.steps(part, size, 200)[2][2] >= 0.95
    alarms, checks = drift_year.false_alarms(3)
    assert alarms <= checks / 1000
    assert max(drift_year.slow(20)) < 0.3


def a_sighting(motion: Floats, at: Floats, normal: bool = True) -> CheckSightings:
    """Return four sightings of circles, the camera moved since about 0.5 m before it."""
    rng = np.random.default_rng(3)
    pose = rigid(rotation_exp(np.array([0.2, 2.8, 0.1])), np.array([0.5, 0.1, 1.2]))
    poses = np.array([rigid(rotation_exp(rng.uniform(-0.4, 0.4, 3)), rng.uniform(-0.2, 0.2, 3))
                      for _ in range(4)])  # fmt: skip
    centres = (poses[:, :3, 3] + 1e-4 - pose[:3, 3]) @ pose[:3, :3]
    normals = poses[:, :3, 2] @ pose[:3, :3]
    if not normal:
        normals[2] = np.nan
    moved = pose.copy()
    turn = rotation_exp(motion[:3])
    moved[:3, :3], moved[:3, 3] = (
        turn @ pose[:3, :3],
        turn @ (pose[:3, 3] - ABOUT) + ABOUT + motion[3:],
    )
    expected = poses.copy()
    expected[:, :3, :3] = rotation_exp(at[:3]) @ poses[:, :3, :3]
    expected[:, :3, 3] += at[3:]
    jacobians = np.tile(np.eye(6), (4, 1, 1))
    own = np.tile(1e-8 * np.eye(5), (4, 1, 1))
    return sightings_of(moved, ABOUT, centres, normals, own, expected, jacobians, np.arange(4))


ABOUT = np.array([0.1, -0.2, 0.05])


def test_residuals_change_with_the_camera_and_with_the_arm_as_differences_say() -> None:
    none = np.zeros(6)
    here = a_sighting(none, none)
    assert here.residuals[:, :3] == pytest.approx(1e-4) and here.joints is not None
    for k in range(6):
        step = 1e-6 * np.eye(6)[k]
        by_camera = (a_sighting(step, none).residuals - here.residuals) / 1e-6
        assert by_camera == pytest.approx(here.effects[:, :, k], abs=1e-5)
        by_arm = (here.residuals - a_sighting(none, step).residuals) / 1e-6
        assert by_arm == pytest.approx(here.joints[:, :, k], abs=1e-5)
    blind = a_sighting(none, none, normal=False)
    assert blind.joints is not None
    for each in (blind.residuals, blind.effects, blind.joints):
        assert not each[2, 3:].any() and each[1, 3:].any() == here.effects[1, 3:].any()
    assert blind.covariances[2] == pytest.approx(np.diag([1e-8] * 3 + [1.0] * 2))
    assert here.covariances == pytest.approx(np.tile(1e-8 * np.eye(5), (4, 1, 1)))


def test_a_calibration_tells_what_its_sightings_do_and_leaves_as_many_numbers() -> None:
    seen = replace(a_sighting(np.zeros(6), np.zeros(6), normal=False), check=np.zeros(4, int))
    variances = np.array([1e-2] * 3 + [1e-4] * 3)
    prior = prior_of(seen, variances)
    weights = np.linalg.inv(seen.covariances)
    wanted = np.einsum("nai,nab,nbj->ij", seen.effects, weights, seen.effects)
    assert prior.information.matrix == pytest.approx(wanted + np.diag(1 / variances))
    right = -np.einsum("nai,nab,nb->i", seen.effects, weights, seen.residuals)
    assert prior.information.vector == pytest.approx(right)
    assert prior.freedom == 3 * 4 + 2 * 3 - 6
    assert prior_of(seen.of(0, 1), variances).freedom == 12.0
    each = replace(seen, check=np.arange(4))
    one = replace(each.of(2, 3), check=np.zeros(1, int))
    assert prior_of(one, variances).freedom == 1.0


def test_checks_are_taken_from_the_first_up_to_the_last() -> None:
    seen = a_sighting(np.zeros(6), np.zeros(6))
    assert seen.of(1, 3).check.tolist() == [1, 2] and len(seen.of(1, 3).effects) == 2
    assert seen.of(1, 3).joints is not None and replace(seen, joints=None).of(0, 2).joints is None
    each = told(np.random.default_rng(6), 5)
    assert each.summed(1, 3).matrix == pytest.approx(each.matrix[1] + each.matrix[2])
    assert each.summed(3, None).vector == pytest.approx(each.vector[3] + each.vector[4])
    looser = Information.of_covariance(allowance(1e-3), np.arange(6.0)).after_unknown_motion(2e-3)
    assert looser.covariance == pytest.approx(5 * allowance(1e-3))
    assert looser.mean == pytest.approx(np.arange(6.0))
    assert allowance(1e-3) == pytest.approx(np.diag([4e-6] * 3 + [1e-6] * 3))


def test_a_motion_moves_the_farthest_corner_most_and_is_known_along_that() -> None:
    corners = np.array([[0.1, 0, 0], [0.0, 0.3, 0], [0, 0, 0.2]])
    motion = np.array([0, 0, 1e-2, 0, 4e-3, 0])
    assert largest_shift(motion, corners) == pytest.approx(np.hypot(1e-2 * 0.1 + 4e-3, 0.0))
    turned = np.array([0, 0, 1e-2, -4e-3, 0, 0])
    assert largest_shift(turned, corners) == pytest.approx(1e-2 * 0.3 + 4e-3)
    covariance = told(np.random.default_rng(8)).matrix * 1e-9
    slope = np.array([
        (largest_shift(turned + d, corners) - largest_shift(turned - d, corners)) / 2e-7
        for d in 1e-7 * np.eye(6)
    ])  # fmt: skip
    assert _deviation(turned, covariance, corners) == pytest.approx(
        np.sqrt(slope @ covariance @ slope), rel=1e-4
    )


def test_a_drift_began_where_the_mean_of_nine_was_a_quarter_of_the_limit_away() -> None:
    """A step of the limit at check 20: of nine checks three are after it at check 22."""
    means = np.zeros((40, 6))
    means[20:, 3] = 0.4e-3
    own = 1e12 * np.eye(6)
    checks = Information(np.tile(own, (40, 1, 1)), means @ own)
    prior = Prior(Information.of_covariance(np.eye(6)))
    assert _began(checks, CORNERS, prior, DriftTest()) == 22
    gone = Information(checks.matrix, (means - means[39]) @ own)  # from the first check on
    known = Prior(Information.of_covariance(1e-16 * np.eye(6)))
    back = Information(gone.matrix[:20], gone.vector[:20])
    assert _began(back, CORNERS, known, DriftTest()) == 8
    motion, covariance = _slow(checks, prior, DriftTest())
    assert motion == pytest.approx([0, 0, 0, 4e-4, 0, 0], abs=1e-9)
    assert covariance == pytest.approx(2 / 9e12 * np.eye(6), rel=1e-3)
    few = Information(checks.matrix[:12], checks.vector[:12])
    assert _slow(few, prior, DriftTest())[1] == pytest.approx(
        (1 / 9 + 1 / 3) / 1e12 * np.eye(6), rel=1e-3
    )
    none = Information(checks.matrix[:8], checks.vector[:8])
    assert not _slow(none, prior, DriftTest())[0].any()
    assert _slow(none, prior, DriftTest())[1] == pytest.approx(np.eye(6))


def test_a_step_is_looked_for_in_the_last_four_checks_against_an_f_distribution() -> None:
    assert list(_windows(9, DriftTest())) == [1, 2, 3, 4] and list(_windows(2, DriftTest())) == [
        1,
        2,
    ]
    rng, test = np.random.default_rng(2), DriftTest(reference=12)
    checks = Information(np.tile(np.eye(6), (20, 1, 1)), rng.standard_normal((20, 6)))
    start = Prior(Information.of_covariance(1e6 * np.eye(6)), 50.0)
    ratio, first = _step(checks, start, 18, test)
    before, after = checks.vector[6:18].mean(axis=0), checks.vector[18:].mean(axis=0)
    square = ((after - before) ** 2).sum() / (1 / 2 + 1 / 12)
    known = start.information.plus(checks.summed(6, 18))
    scale, freedom = _scatter(checks, known, (6, 18), 50.0)
    limit = 6 * scale * f_quantile(1 - 2e-4 / 4, 6, freedom)
    assert first == 18 and ratio == pytest.approx(square / limit, rel=1e-4)


def test_a_change_is_the_cameras_whose_arm_stays_as_wrong_as_it_was() -> None:
    """Against one system of all that is unknown: the arm's three weights, and both motions."""
    rng = np.random.default_rng(0)
    after, before = told(rng, numbers=9), told(rng, numbers=9)
    change = _change(after, before)
    # Unknown are what was before, and by what the camera moved since.
    then, since = np.eye(9, 15), np.eye(9, 15)
    since[:6, 9:] = np.eye(6)
    matrix = then.T @ before.matrix @ then + since.T @ after.matrix @ since
    vector = then.T @ before.vector + since.T @ after.vector
    assert np.linalg.inv(change.matrix) == pytest.approx(np.linalg.inv(matrix)[9:, 9:], rel=1e-6)
    mean = np.linalg.solve(matrix, vector)[9:]
    assert change.mean == pytest.approx(mean, rel=1e-6)


def test_of_what_is_told_a_billionth_as_well_nothing_is_told() -> None:
    for share, rank in ((2e-9, 2), (0.5e-9, 1)):
        flat = Information(np.diag([4.0, 4.0 * share, 0, 0, 0, 0]), np.array([2.0, 0, 0, 0, 0, 0]))
        assert int(_surprise(flat)[1]) == rank


def test_one_sighting_in_a_million_is_a_misfit_by_chance() -> None:
    assert pytest.approx(1e-6) == MISFIT
    seen = a_sighting(np.zeros(6), np.zeros(6))
    exact = Information.of_covariance(1e-20 * np.eye(6))
    still = DriftTest(daily=1e-10)
    limit = np.sqrt(chi2_quantile(1 - 1e-6, 5)) * 1e-4
    for share, wanted in ((0.99, False), (1.01, True)):
        off = replace(seen, residuals=share * limit * np.eye(5)[[0, 1, 3, 4]])
        assert misfits(off, exact, still).tolist() == [wanted] * 4
