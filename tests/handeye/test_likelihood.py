"""The most likely unknowns: against differences, dense normal distributions and fits without one."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from flangeye.handeye import likelihood
from flangeye.handeye.components import Noise
from flangeye.handeye.likelihood import (
    Problem,
    Solution,
    climb,
    freedom_of_sizes,
    gates,
    judged,
    log_likelihood,
    settle,
    weigh,
    with_noise,
)
from flangeye.handeye.loop import ArmNoise, LoopProblem
from flangeye.handeye.smoothing import steps_told
from flangeye.handeye.unknowns import weights_of
from flangeye.handeye.walk import Course, StepSize, Walk
from flangeye.maths.geometry import rotation_exp
from flangeye.maths.statistics import f_quantile
from flangeye.types import Floats, Mask
from tests.handeye.cells import ISSUE, fitted, given, start, two_numbers, with_wrong

ARMS = ArmNoise(2e-4, 5e-5)
NONE = Noise(0.0, 0.0)
HAND = "eye-in-hand, marker"
CELLS = [(HAND, "pose"), ("eye-on-base, flange", "normal"), ("two arms, flange", "normal")]


def cost_at(problem: LoopProblem, here: Solution, shares: Floats, step: Floats) -> float:
    """Return the cost after a step, the weights as they were."""
    at = here.at.moved(here.basis @ step)
    linear = replace(problem, arms=ARMS).linearised(at)
    return likelihood._weighed(problem, at, linear, here.noise, shares, here.weights).cost


@pytest.mark.parametrize(("name", "feature"), CELLS)
def test_slope_and_information_are_the_costs_derivatives(name: str, feature: str) -> None:
    problem = given(name, feature, 9, nuisance=two_numbers(9))
    shares, rng = np.random.default_rng(1).uniform(0.1, 1.0, 9), np.random.default_rng(2)
    found = fitted(problem)
    aside = found.at.moved(found.basis @ (2e-4 * rng.normal(size=found.basis.shape[1])))
    here = weigh(problem, aside, Noise(1e-9, 1e-8), shares)
    assert here.inliers.tolist() == (shares > 0.5).tolist()
    sizes = 1e-2 / np.sqrt(np.diag(here.information))
    for step in np.diag(sizes):
        more, less = (cost_at(problem, here, shares, x) for x in (step, -step))
        slope, curve = (less - more) / 4, (more + less) / 2 - here.cost
        scale = np.sqrt(here.cost * (step @ here.information @ step))
        assert slope == pytest.approx(here.slope @ step, abs=2e-3 * scale)
        assert curve == pytest.approx(step @ here.information @ step, rel=0.02)
    tilted = here.at.tilt @ here.at.tilt * 1e6
    expected = (((here.at.nuisance - [1e-4, -2e-4]) / 2e-4) ** 2).sum()
    assert here.cost == pytest.approx(shares @ here.squares + tilted + expected)
    left = here.linear.residuals
    assert here.squares == pytest.approx(np.einsum("na,nab,nb->n", left, here.weights, left))


@pytest.mark.parametrize(("name", "feature"), CELLS)
def test_a_climb_ends_where_nothing_is_less_and_begins_anywhere_near(
    name: str, feature: str
) -> None:
    problem = given(name, feature, 12)
    found, rng = fitted(problem), np.random.default_rng(3)
    away = found.at.moved(found.basis @ (0.03 * rng.normal(size=found.basis.shape[1])))
    every = np.ones(12)
    again = climb(problem, weigh(problem, away, NONE, every), NONE, every)
    assert again.slope @ again.known @ again.slope < 1e-8
    for a, b in (
        (again.at.x, found.at.x),
        (again.at.y, found.at.y),
        (again.at.z[:, 3], found.at.z[:, 3]),
    ):
        assert a == pytest.approx(b, abs=1e-7)
    assert again.cost == pytest.approx(found.cost, rel=1e-6)
    same = climb(problem, found, NONE, every, iterations=0)
    assert same.at is found.at


def test_how_well_unknowns_are_known_is_the_inverse_of_their_information() -> None:
    found = fitted(given(HAND, "pose", 9, nuisance=two_numbers(9)))
    known = np.linalg.inv(found.information)
    assert found.covariance == pytest.approx(
        found.basis @ known @ found.basis.T, rel=1e-6, abs=1e-18
    )
    jacobian = found.linear.jacobian
    assert found.spread == pytest.approx(
        jacobian @ found.covariance @ jacobian.transpose(0, 2, 1), rel=1e-6, abs=1e-18
    )
    assert (found.parameters, found.known.shape) == (12, (14, 14))
    blind = replace(found, information=np.diag([4e6, 1e6, 0.0]))
    assert blind.known == pytest.approx(np.diag([0.25e-6, 1e-6, 0.0]), abs=1e-15)


@pytest.mark.parametrize(("name", "feature"), CELLS[:2])
def test_each_is_held_against_a_fit_to_the_others(name: str, feature: str) -> None:
    """And against the noise that the others show, where it was told by all."""
    problem, count = given(name, feature, 10), 10
    found = fitted(problem)
    squares, _ = judged(problem, found)
    freedoms = problem.measurements.freedoms
    told = replace(found, freedom=20.0, all_freedom=40.0)
    scaled, _ = judged(problem, told)
    for i in range(count):
        others = (np.arange(count) != i).astype(float)
        without = climb(problem, found, NONE, others)
        p = problem.measurements.projectors[i]
        jacobian = without.linear.jacobian[i] @ without.basis
        spread = np.linalg.pinv(without.weights[i], rcond=1e-9, hermitian=True)
        spread = spread + p @ jacobian @ without.known @ jacobian.T @ p
        left = without.linear.residuals[i]
        alone = left @ np.linalg.pinv(spread, rcond=1e-9, hermitian=True) @ left
        assert squares[i] == pytest.approx(alone, rel=0.02)
        kept = replace(found, inliers=others > 0.5)
        assert judged(problem, replace(without, inliers=kept.inliers))[0][i] == pytest.approx(
            alone, rel=1e-4
        )
        noise = (40.0 - squares[i]) / (40.0 - freedoms[i])
        assert scaled[i] == pytest.approx(squares[i] / noise)


def test_who_agrees_is_within_the_quantile_of_its_own_freedom() -> None:
    problem = given("eye-on-base, flange", "normal", 10)
    freedoms = np.array([5.0, 3.0] * 5)
    mixed = replace(problem, measurements=replace(problem.measurements, freedoms=freedoms))
    assert gates(mixed, 12.0) == pytest.approx(
        [n * f_quantile(0.999, int(n), 12.0) for n in freedoms]
    )
    assert np.isinf(gates(mixed, 0.0)).all() and np.isfinite(gates(mixed, 0.5)).all()
    found = fitted(problem)
    squares, agree = judged(problem, found)
    assert agree.all() and (squares <= gates(problem, np.inf)).all()
    # One that is out is judged by all of the noise's freedom, one that is in by that of the others.
    wide = replace(problem, measurements=problem.measurements.where(np.zeros(1, dtype=int)))
    for inside, freedom in ((True, 7.0), (False, 12.0)):
        limit = gates(wide, freedom)[0]
        for off, wanted in ((0.99, True), (1.01, False)):
            one = _one_that_is_off(wide, found, off * limit, inside)
            assert judged(wide, one)[1].tolist() == [wanted]


def _one_that_is_off(problem: Problem, found: Solution, square: float, inside: bool) -> Solution:
    """Return a solution of one measurement, known for sure, that is so far from it."""
    linear = found.linear.where(np.arange(10) == 0)
    weights = np.diag([0.0, 0.0, 0.0, 1e6, 1e6, 1e6])[None]
    linear = replace(linear, residuals=np.array([[0, 0, 0, np.sqrt(square) * 1e-3, 0, 0]]))
    # Freedom of both together so large that the noise without it is one.
    return replace(
        found, linear=linear, weights=weights, basis=np.zeros((20, 0)), information=np.zeros((0, 0)),
        inliers=np.array([inside]), freedom=12.0, all_freedom=1e9,
    )  # fmt: skip


@pytest.mark.parametrize("walked", [False, True])
def test_the_restricted_likelihood_is_that_of_one_dense_normal_distribution(walked: bool) -> None:
    """Of all residuals at once, with nuisances of a size, and a base that walks."""
    n, noises = 8, [Noise(1e-8, 4e-8, size=1e-4), Noise(4e-8, 1e-8, size=5e-4)]
    nuisance = replace(two_numbers(n, sized=True), mean=np.zeros(2))
    problem = given(HAND, "pose", n, nuisance=nuisance)
    if walked:
        walk = Walk(np.full((n, 3), 0.3))
        problem = replace(problem, walk=walk)
        sizes = StepSize(2e-4, 1e-4), StepSize(5e-4, 3e-4)
        noises = [replace(x, walk=w) for x, w in zip(noises, sizes, strict=True)]
    found, wanted = [], []
    at = replace(fitted(replace(problem, walk=None)).at, nuisance=np.zeros(2))
    for noise in noises:
        every = np.ones(n)
        begun = weigh(problem, at, noise, every)
        end = likelihood._climb_on(problem, begun, every, 30)
        found.append(log_likelihood(problem, replace(end, noise=noise)))
        spread = np.zeros((6 * n, 6 * n))
        for i, own in enumerate(np.linalg.inv(begun.weights)):
            spread[6 * i : 6 * i + 6, 6 * i : 6 * i + 6] = own
        moved = begun.linear.jacobian[:, :, 20:].reshape(6 * n, 2)
        spread += noise.size**2 * moved @ moved.T
        if walked:
            steps = np.linalg.inv(walk.local()) * np.sqrt(walk.variances(noise.walk))[:, None]
            led = np.zeros((n, 6, n, 6))
            for k in range(n):
                led[k, :, : k + 1] = np.einsum(
                    "ij,mjk->imk", begun.linear.drift[k, :, :6], steps[: k + 1]
                )
            spread += led.reshape(6 * n, -1) @ led.reshape(6 * n, -1).T
        rows = (begun.linear.jacobian[:, :, :20] @ begun.basis[:20, :12]).reshape(6 * n, 12)
        left = begun.linear.residuals.ravel()
        told = rows.T @ np.linalg.solve(spread, rows)
        left = left - rows @ np.linalg.solve(told, rows.T @ np.linalg.solve(spread, left))
        wanted.append(
            -np.linalg.slogdet(spread)[1] - np.linalg.slogdet(told)[1]
            - left @ np.linalg.solve(spread, left)
        )  # fmt: skip
    assert found[0] - found[1] == pytest.approx(wanted[0] - wanted[1], abs=0.05)


def test_of_poses_alone_the_likelihood_is_that_of_each() -> None:
    problem = given(HAND, "pose", 9)
    found = replace(fitted(problem), inliers=np.arange(9) != 4)
    noise, wanted = Noise(1e-7, 1e-6), 0.0
    for i in np.flatnonzero(found.inliers):
        spread = np.linalg.inv(weights_of(problem.measurements, found.linear, noise)[i])
        left = found.linear.residuals[i]
        wanted -= np.linalg.slogdet(spread)[1] + left @ np.linalg.solve(spread, left)
    assert likelihood._likelihood(problem, found, noise) == pytest.approx(wanted)


@pytest.mark.parametrize(("name", "feature"), CELLS)
def test_residuals_have_as_much_freedom_as_numbers_less_unknowns(name: str, feature: str) -> None:
    problem = given(name, feature, 11, stated=False)
    found = fitted(problem)
    noise, freedom, both = likelihood._components(problem, found)
    # Two angles of all normals are known beforehand, and so take less than two.
    numbers = problem.measurements.freedoms.sum() - found.parameters
    assert numbers - 1e-6 <= both <= numbers + 2
    turned, shifted = (likelihood._residuals(problem, found, slice(k, k + 3)) for k in (0, 3))
    assert turned.freedom + shifted.freedom == pytest.approx(both)
    assert freedom == pytest.approx(min(turned.freedom, shifted.freedom))
    assert np.concatenate([turned.errors, shifted.errors], axis=1) == pytest.approx(
        found.linear.residuals, abs=1e-12
    )
    kept = replace(found, inliers=np.arange(11) < 9)
    assert len(likelihood._residuals(problem, kept, slice(0, 3)).errors) == 9


def test_noise_that_is_known_is_not_estimated() -> None:
    problem = given("eye-on-base, flange", "centre", 12)
    stated = with_noise(problem, fitted(problem))
    assert (stated.noise, stated.freedom, stated.all_freedom) == (NONE, np.inf, np.inf)
    known = with_noise(replace(problem, stated=False, pose_noise=4e-8), fitted(problem))
    assert known.noise.pose == 4e-8 and known.freedom == np.inf
    free = with_noise(replace(problem, stated=False), fitted(problem))
    assert free.freedom == pytest.approx(3 * 12 - 6)
    hand = given(HAND, "pose", 12, stated=False)
    aside = start(hand).moved(np.append([1e-3, 2e-3, 0, 1e-3], np.zeros(16)))
    for each in (hand, replace(hand, stated=True)):
        still = with_noise(each, weigh(each, aside, NONE, np.ones(12)), refit=False)
        np.testing.assert_array_equal(still.at.x, aside.x)
        np.testing.assert_array_equal(still.at.z, aside.z)


def test_noise_in_depth_is_what_goes_beyond_that_across() -> None:
    problem = given(HAND, "pose", 60, stated=False, in_depth=True)
    rng, s = np.random.default_rng(5), problem.measurements
    centres = s.centres + rng.normal(size=(60, 3)) * [1e-3, 1e-3, 4e-3]
    turns = rotation_exp(2e-3 * rng.normal(size=(60, 3))) @ s.rotations
    problem = replace(problem, measurements=replace(s, centres=centres, rotations=turns))
    found = with_noise(problem, fitted(problem))
    assert found.noise.depth == pytest.approx(15e-6, rel=0.4)
    assert found.noise.pose + found.noise.arms * 25e-10 == pytest.approx(1e-6, rel=0.4)
    assert with_noise(replace(problem, in_depth=False), found).noise.depth == 0.0


def test_the_size_of_nuisances_is_their_root_mean_square_over_how_many_are_told() -> None:
    problem = given(HAND, "pose", 9, nuisance=two_numbers(9, sized=True))
    noise = replace(NONE, size=3e-4)
    found = fitted(problem, noise)
    told = 2 - np.diag(found.covariance)[20:].sum() / 9e-8
    wanted = np.sqrt((found.at.nuisance**2).sum() / told)
    assert likelihood._size(problem, found) == pytest.approx(wanted)
    still = replace(found, at=replace(found.at, nuisance=np.zeros(2)))
    assert likelihood._size(problem, still) == 1e-7
    alone = given(HAND, "pose", 9, nuisance=two_numbers(9))
    assert likelihood._size(alone, fitted(alone, noise)) == 3e-4


def test_those_that_are_wrong_are_set_aside_and_take_no_part() -> None:
    problem = given(HAND, "pose", 14, stated=False)
    s, wrong = problem.measurements, np.isin(np.arange(14), [2, 5, 11])
    aside = np.where(wrong[:, None], [0.03, -0.02, 0.01], 0.0)
    bad = replace(problem, measurements=replace(s, centres=s.centres + aside))
    found = settle(bad, start(problem), NONE)
    assert (found.inliers == ~wrong).all()
    assert (found.squares[wrong] > 100).all() and (found.squares[~wrong] < 30).all()
    alone = settle(problem.where(~wrong), start(problem), NONE)
    assert found.at.x == pytest.approx(alone.at.x, abs=1e-7)
    assert found.noise.pose == pytest.approx(alone.noise.pose, rel=2e-3, abs=1e-12)
    assert found.all_freedom == pytest.approx(6 * 11 - 12)
    assert settle(problem, start(problem), NONE).inliers.all()


def test_where_the_base_walked_steps_tell_the_noise_as_well() -> None:
    problem = given(HAND, "pose", 8, stated=False)
    found = replace(fitted(problem), freedom=9.0)
    assert freedom_of_sizes(problem, found) == 9.0
    walking = replace(problem, walk=Walk(np.full((8, 3), 0.3)))
    noise = replace(NONE, walk=StepSize(5e-4, 2e-4))
    found = fitted(walking, noise)
    assert freedom_of_sizes(walking, found) == np.inf
    found = replace(found, freedom=9.0)
    assert found.course is not None and walking.walk is not None
    steps = steps_told(walking.walk, noise.walk, found.course.spread(walking.walk, found.known))
    left = [likelihood._residuals(walking, found, slice(k, k + 3)).freedom for k in (0, 3)]
    assert freedom_of_sizes(walking, found) == pytest.approx(
        min(left[0] + steps[0], left[1] + steps[1])
    )
    # Of 48 numbers 12 are the unknowns'; the walk's first step is part of where it begins.
    assert sum(left) + sum(steps) == pytest.approx(48 - 12, abs=1.0)
    course = found.at.course
    assert course is not None
    for k in range(3):
        by = np.zeros((8, 6))
        by[2 + k, k], by[4, 3 + k] = 1e-4, 1e-4
        there = replace(found.at, course=course.moved(by))
        for at in (there, replace(found.at, course=course.moved(-by))):
            assert weigh(walking, at, noise, np.ones(8)).cost > found.cost
    assert isinstance(course, Course)


def test_wrong_poses_are_found_where_the_others_agree_far_better_than_was_stated() -> None:
    """Begun at a fit to all, every pose is a thousand times its stated noise away: none is out."""
    problem = given(HAND, "pose", 11, ISSUE.scaled(0.01), stated=False)
    spoilt, wrong = with_wrong(problem, 4)
    found = settle(spoilt, start(problem), NONE)
    assert (found.inliers == ~wrong).all()


@pytest.mark.parametrize(
    ("agreeing", "rounds", "taken"),
    [
        ([8], 1, 8),  # the same as before
        ([7, 7], 2, 7),
        ([6, 7, 6], 3, 7),  # to and fro
        ([3, 2], 2, 3),  # three tell an answer, two do not
        ([7, 6, 5, 4, 7], 5, 4),
    ],
)
def test_those_that_agree_are_fitted_again_until_they_have_been_before(
    agreeing: list[int], rounds: int, taken: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    problem = given(HAND, "pose", 8)
    begun, asked = fitted(problem), list[int]()

    def judge(problem: Problem, found: Solution) -> tuple[Floats, Mask]:
        asked.append(int(found.inliers.sum()))
        return np.full(8, float(len(asked))), np.arange(8) < agreeing[len(asked) - 1]

    monkeypatch.setattr(likelihood, "judged", judge)
    found = likelihood.agreeing(problem, begun)
    assert asked == [8, *agreeing[:-1]][:rounds]
    assert found.inliers.sum() == taken and (found.squares == rounds).all()


def test_from_far_away_a_climb_arrives_in_few_steps_and_never_goes_up(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    problem, every, costs = given(HAND, "pose", 12), np.ones(12), list[float]()
    found = fitted(problem)
    weighing = likelihood.weigh

    def weighed(*given: Any) -> Solution:
        there = weighing(*given)
        costs.append(there.cost)
        return there

    for seed in range(6):
        step = np.random.default_rng(seed).normal(size=found.basis.shape[1])
        away = weighing(problem, found.at.moved(found.basis @ (0.6 * step)), NONE, every)
        costs.clear()
        with monkeypatch.context() as watched:
            watched.setattr(likelihood, "weigh", weighed)
            again = likelihood._climb_on(problem, away, every, 60)
        assert again.cost == pytest.approx(found.cost, rel=1e-6)
        assert again.cost == min(costs)
        assert len(costs) <= 16


def test_outliers_are_left_behind_by_degrees(monkeypatch: pytest.MonkeyPatch) -> None:
    """Yang et al. (2020): from shares that are all alike, by factors of 1.4, to those of none or one."""
    problem = given(HAND, "pose", 8)
    limits = gates(problem, 9.0)
    ratios = np.array([0.0, 0.5, 0.99, 1.02, 2.0, 30.0, 0.1, 0.2])
    begun = replace(fitted(problem), squares=ratios * limits, freedom=9.0)
    begun = replace(begun, inliers=np.arange(8) != 3)
    asked = list[Any]()

    def climb(
        problem: Problem, found: Solution, noise: Noise, shares: Floats, iterations: int = 60
    ) -> Solution:
        asked.append((shares, iterations))
        return replace(found, freedom=np.inf)

    monkeypatch.setattr(likelihood, "climb", climb)
    found = likelihood._graduate(problem, begun)
    assert found.freedom == 9.0
    (first, _), *between, (last, steps) = asked
    assert first.tolist() == [1, 1, 1, 0, 1, 1, 1, 1]
    assert steps == 60 and last.tolist() == [1, 1, 1, 0, 0, 0, 1, 1]
    for k, (shares, each) in enumerate(between):
        mu = 1.4**k / (2 * 30 - 1)
        expected = np.sqrt(mu * (mu + 1) / np.maximum(ratios, 1e-9)) - mu
        assert each == 1 and shares == pytest.approx(np.clip(expected, 0, 1), abs=1e-6)
    # The last that is not decided is the one nearest to its limit: 0.99 from below.
    mu = 1.4 ** len(between) / 59
    assert mu / (mu + 1) >= 0.99 > mu / (1.4 + mu)
    asked.clear()
    within = replace(begun, squares=np.minimum(ratios, 1.0) * limits)
    assert likelihood._graduate(problem, within).freedom == 9.0
    assert [shares.tolist() for shares, _ in asked] == [[1, 1, 1, 0, 1, 1, 1, 1], [1] * 8]


def test_noise_and_unknowns_are_found_in_turn_until_the_noise_stays(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """To a thousandth; two steps of the unknowns each time, and then all."""
    problem = given(HAND, "pose", 8, stated=False)
    begun, asked = replace(fitted(problem), inliers=np.arange(8) != 3), list[Any]()

    def climb(
        problem: Problem, found: Solution, noise: Noise, shares: Floats, iterations: int
    ) -> Solution:
        asked.append((noise.pose, iterations))
        assert shares.tolist() == [1, 1, 1, 0, 1, 1, 1, 1]
        return replace(found, noise=noise)

    def climb_on(problem: Problem, found: Solution, shares: Floats, iterations: int) -> Solution:
        asked.append(("on", iterations))
        return found

    monkeypatch.setattr(likelihood, "climb", climb)
    monkeypatch.setattr(likelihood, "_climb_on", climb_on)
    for poses, rounds in (
        ([1.0, 1.0005], 2),
        ([1.0, 1.002, 1.0025], 3),
        ([float(k) for k in range(1, 40)], 12),
    ):
        for refit in (True, False):
            left = iter(poses)
            monkeypatch.setattr(
                likelihood, "_components", lambda *_, left=left: (Noise(next(left), 0.0), 5.0, 8.0)
            )
            asked.clear()
            found = with_noise(problem, begun, refit)
            assert (found.freedom, found.all_freedom) == (5.0, 8.0)
            few, many = (2, 60) if refit else (0, 0)
            expected = [(0.0, few), *((pose, few) for pose in poses[:rounds]), ("on", many)]
            assert asked == expected


def test_who_agrees_is_found_by_degrees_at_most_four_times(monkeypatch: pytest.MonkeyPatch) -> None:
    """With the noise of those that do, until the same do, or fewer than three."""
    problem = given(HAND, "pose", 9)
    for agreeing, graduated, with_their_noise in (
        ([7, 7, 5], 2, 1), ([7, 3, 3], 3, 2), ([7, 2], 2, 1), ([8, 7, 6, 5, 4], 4, 4),
    ):  # fmt: skip
        calls = list[str]()

        def graduate(
            problem: Problem, found: Solution, to: Any = agreeing, calls: Any = calls
        ) -> Solution:
            calls.append("by degrees")
            return replace(found, inliers=np.arange(9) < to[calls.count("by degrees") - 1])

        def noised(problem: Problem, found: Solution, calls: Any = calls) -> Solution:
            calls.append("noise")
            return found

        monkeypatch.setattr(likelihood, "_graduate", graduate)
        monkeypatch.setattr(likelihood, "with_noise", noised)
        monkeypatch.setattr(likelihood, "agreeing", lambda problem, found: found)
        found = settle(problem, start(problem), NONE)
        assert calls.count("by degrees") == graduated and calls.count("noise") == with_their_noise
        assert found.inliers.sum() == agreeing[graduated - 1]


def test_a_climb_weighs_by_the_noise_it_is_given_not_by_that_before() -> None:
    problem, every = given(HAND, "pose", 9), np.ones(9)
    before, noise = fitted(problem), Noise(4e-6, 1e-5)
    for steps in (0, 5):
        found = climb(problem, before, noise, every, steps)
        assert found.noise == noise
        expected = weights_of(problem.measurements, found.linear, noise)
        assert found.weights == pytest.approx(expected, rel=1e-6)
    same = climb(problem, before, before.noise, every, 0)
    assert same.weights is before.weights  # they are the same, and are not worked out again
