"""Whether an answer is the best of all: shown where it is, not shown where it is not."""

from dataclasses import astuple, replace
from typing import Any

import numpy as np
import pytest

from flangeye.handeye import certificate, certified
from flangeye.handeye.certificate import (
    Certificate,
    Sightings,
    _constraints,
    _descend,
    _missing,
    _quadratic,
    _unchanging,
    _vector,
    certify,
)
from flangeye.handeye.certified import NOT_CERTIFIED, OPTIMAL, answer_of, certificate_note
from flangeye.handeye.components import Noise
from flangeye.handeye.likelihood import settle
from flangeye.handeye.loop import ArmNoise, LoopProblem
from flangeye.handeye.measurements import loop_of, measurements_of
from flangeye.handeye.starts import start_of
from flangeye.maths.geometry import invert, rigid, rotation_exp, rotation_log
from flangeye.types import Floats
from flangeye_plugins.solve.robust import RobustParams, solve_poses
from tests.handeye.cells import CONFIGURATIONS, ROBOT, session


def anywhere(rng: np.random.Generator) -> Floats:
    axis = rng.standard_normal(3)
    turn = rotation_exp(rng.uniform(-np.pi, np.pi) * axis / np.linalg.norm(axis))
    return rigid(turn, rng.uniform(-1, 1, 3))


def sighted(noise: tuple[float, float], seed: int) -> tuple[Sightings, Floats, Floats]:
    """Fifteen sightings of A X M = Y with noise [rad, m], X and Y."""
    rng = np.random.default_rng(seed)
    x, y, seen = anywhere(rng), anywhere(rng), []
    a = np.array([rigid(rotation_exp(rng.uniform(-0.8, 0.8, 3)), rng.uniform(-0.4, 0.4, 3))
                  for _ in range(15)])  # fmt: skip
    for exact in invert(a @ x) @ y:
        turn = exact[:3, :3] @ rotation_exp(noise[0] * rng.standard_normal(3))
        seen.append(rigid(turn, exact[:3, 3] + noise[1] * rng.standard_normal(3)))
    still = np.broadcast_to(np.eye(4), a.shape)
    return (
        of_two((a, np.array(seen), still, still), *(np.full(15, each**-2.0) for each in noise)),
        x,
        y,
    )


def of_two(sides: Any, turning: Floats, shifting: Floats) -> Sightings:
    """Return sightings of ``A X M = B Y D`` with errors alike in all directions."""
    a, m, b, d = sides
    each = np.repeat(np.stack([turning, shifting], axis=1), 3, axis=1)
    first = np.zeros(len(a), dtype=np.intp)
    whole = np.full(len(a), 6.0)
    return Sightings(a, first, m, b, first + 1, d, each[:, :, None] * np.eye(6), whole)


@pytest.mark.parametrize("noise", [(1e-3, 1e-4), (5e-3, 1e-3), (3e-2, 5e-3), (0.2, 2e-2)])
@pytest.mark.parametrize("seed", range(3))
def test_the_best_answer_is_certified(noise: tuple[float, float], seed: int) -> None:
    sightings, x, y = sighted(noise, seed)
    shown = certify(sightings, np.array([x, y]))
    assert shown.optimal
    assert shown.missing < 1e-3 * shown.cost
    assert 0.6 * 78 < shown.cost < 1.5 * 78  # numbers measured less those found


def test_another_valley_is_not_certified() -> None:
    rng, found = np.random.default_rng(7), 0
    for seed in range(3):
        sightings, x, y = sighted((5e-3, 1e-3), seed)
        best = certify(sightings, np.array([x, y]))
        for _ in range(5):
            other = certify(sightings, np.array([anywhere(rng), anywhere(rng)]))
            if other.cost > 1.01 * best.cost:
                found += 1
                assert not other.optimal
                assert other.missing >= (1 - 1e-6) * (other.cost - best.cost)  # it is a bound
    assert found >= 2


@pytest.mark.parametrize("name", ["eye-in-hand, marker", "eye-on-base, marker"])
def test_a_solver_says_so(name: str) -> None:
    made = session(CONFIGURATIONS[name], np.random.default_rng(3), n=15)
    told = solve_poses(made.observations, RobustParams(certify=True), ROBOT, made.configuration)
    assert told.notes[-1] == OPTIMAL


@pytest.mark.parametrize("seed", range(3))
def test_a_circle_anywhere_is_certified_though_nothing_tells_its_turn_about_itself(
    seed: int,
) -> None:
    configuration = CONFIGURATIONS["eye-on-base, marker"]
    made = session(configuration, np.random.default_rng(seed), n=25, tilt=0.5, feature="normal")
    told = solve_poses(made.observations, RobustParams(certify=True), ROBOT, configuration)
    assert told.notes[-1] == OPTIMAL


def test_what_cannot_be_certified_is_said_to_be_so() -> None:
    made = session(CONFIGURATIONS["two arms, marker"], np.random.default_rng(3), n=15)
    told = solve_poses(made.observations, RobustParams(certify=True), ROBOT, made.configuration)
    assert told.notes[-1] == (
        "not certifiable: where camera saw target_point, squared errors are no quadratic of "
        "the 3 unknown places between them: camera, base2, target"
    )


@pytest.mark.parametrize(
    ("cost", "missing", "told"), [(8.0, 1.0, "12.5%"), (2.0, 5.0, "100.0%"), (0.0, 0.0, "0.0%")]
)
def test_how_much_better_another_answer_may_be_is_said(
    cost: float, missing: float, told: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def shown(sightings: Sightings, places: Floats) -> Certificate:
        return Certificate(places[:, :3, :3], cost, missing, False)

    monkeypatch.setattr(certified, "certify", shown)
    made = session(CONFIGURATIONS["eye-in-hand, marker"], np.random.default_rng(3), n=15)
    found = solve_poses(made.observations, RobustParams(certify=True), ROBOT, made.configuration)
    assert found.notes[-1] == (
        f"{NOT_CERTIFIED} (gap {told}): another answer may leave squared errors less by so much"
    )


def errors_of(s: Sightings, x: Floats, y: Floats) -> float:
    """Return the weighed squares of A X M - B Y D, half of the rotation matrices'."""
    off = s.a @ x @ s.m - s.b @ y @ s.d
    turned, shifted = (off[:, :3, :3] ** 2).sum(axis=(1, 2)), (off[:, :3, 3] ** 2).sum(axis=1)
    return float(s.weights[:, 0, 0] @ turned / 2 + s.weights[:, 3, 3] @ shifted)


def any_sightings(seed: int) -> Sightings:
    """Return sightings in which nothing rests, of different weights."""
    rng = np.random.default_rng(seed)
    a, m, b, d = (np.array([anywhere(rng) for _ in range(6)]) for _ in range(4))
    return of_two((a, m, b, d), rng.uniform(1, 3, 6), rng.uniform(1, 3, 6))


def test_the_quadratic_is_the_least_error_that_translations_leave_to_rotations() -> None:
    s, rng = any_sightings(1), np.random.default_rng(2)
    quadratic = _quadratic(s, np.array([anywhere(rng), anywhere(rng)]))
    for _ in range(3):
        x, y = anywhere(rng), anywhere(rng)
        here = (
            _vector(np.array([x[:3, :3], y[:3, :3]]))
            @ quadratic
            @ _vector(np.array([x[:3, :3], y[:3, :3]]))
        )

        def moved(shift: Floats, x: Floats = x, y: Floats = y) -> float:
            return errors_of(s, rigid(x[:3, :3], shift[:3]), rigid(y[:3, :3], shift[3:]))

        # A quadratic in the translations: its gradient and Hessian are differences, exactly.
        eye, zero = np.eye(6), moved(np.zeros(6))
        hessian = np.array([[moved(a + b) - moved(a) - moved(b) + zero for a in eye] for b in eye])
        gradient = np.array([moved(a) - zero for a in eye]) - np.diag(hessian) / 2
        least = moved(-np.linalg.solve(hessian, gradient))
        assert here == pytest.approx(least, rel=1e-9)


def test_constraints_hold_for_rotations_alone() -> None:
    """Of one rotation 20 are independent: 11 of its lines' products, 9 of their crosses."""
    constraints, rng = np.array(list(_constraints(2))), np.random.default_rng(3)
    np.testing.assert_array_equal(constraints, constraints.transpose(0, 2, 1))
    pair = np.array([anywhere(rng)[:3, :3], anywhere(rng)[:3, :3]])
    at = _vector(pair)
    assert np.abs(constraints @ at @ at).max() < 1e-12
    assert np.linalg.matrix_rank(constraints.reshape(60, -1)) == 40
    for spoilt in (
        pair * [[[-1.0]], [[1.0]]],
        pair * [[[1.0]], [[1.1]]],
        pair @ np.diag([1, 1, -1]),
    ):
        assert np.abs(constraints @ _vector(spoilt) @ _vector(spoilt)).max() > 0.2


def test_what_leaves_the_answer_as_it_is_is_orthonormal_and_complete() -> None:
    constraints = np.array(list(_constraints(2)))
    at = _vector(np.array([anywhere(np.random.default_rng(5))[:3, :3]] * 2))
    effects = np.einsum("kij,j->ik", constraints, at)
    free = _unchanging(constraints, effects)
    # L r has no part along r nor along the six turns: of 40 the 12 others are taken.
    assert free.shape == (40 - 12, 19, 19)
    assert free.reshape(28, -1) @ free.reshape(28, -1).T == pytest.approx(np.eye(28), abs=1e-9)
    assert np.abs(free @ at).max() < 1e-9


def test_the_bottom_of_the_valley_is_reached_from_its_slope() -> None:
    sightings, x, y = sighted((5e-3, 1e-3), 0)
    quadratic = _quadratic(sightings, np.array([x, y]))
    bottom = _descend(quadratic, np.array([x[:3, :3], y[:3, :3]]))
    aside = rotation_exp(np.array([[0.2, -0.1, 0.1], [0.1, 0.2, -0.2]]))
    assert _descend(quadratic, aside @ bottom) == pytest.approx(bottom, abs=1e-10)
    least = _vector(bottom) @ quadratic @ _vector(bottom)
    assert certify(sightings, np.array([x, y])).cost == pytest.approx(least)
    for turn in 1e-4 * np.concatenate([np.eye(6), -np.eye(6)]):
        there = _vector(rotation_exp(turn.reshape(2, 3)) @ bottom)
        assert there @ quadratic @ there > least


def test_what_may_be_missing_is_seven_times_the_most_negative_eigenvalue(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Of rotations and a one the squares are seven: a quadratic of -1 in all is -7."""
    at = _vector(np.array([np.eye(3)] * 2))
    assert _missing(3.0 * np.eye(19), at, 21.0, 1e-9) == pytest.approx(0.0, abs=1e-9)
    # Where no constraint explains it, and it moves the answer, that counts against it as well.
    monkeypatch.setattr(certificate, "_constraints", lambda _: [np.zeros((19, 19))])
    alone = np.zeros((19, 19))
    alone[0, 0] = -0.5
    assert _missing(alone, at, 0.0, 0.0) == pytest.approx(7 * 0.5 + 2 * 0.5 * np.sqrt(7))


def test_an_answer_is_the_best_where_next_to_nothing_is_missing(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A thousandth of the cost; where there is none, what rounding leaves."""
    sightings, x, y = sighted((5e-3, 1e-3), 0)
    cost = certify(sightings, np.array([x, y])).cost
    exact = replace(sightings, m=invert(sightings.a @ x) @ y)
    size = 1e-9 * np.trace(_quadratic(exact, np.array([x, y])))
    for which, limit in ((sightings, 1e-3 * cost), (exact, size)):
        for share in (0.99, 1.01):
            monkeypatch.setattr(certificate, "_missing", lambda *_, m=share * limit: m)
            assert certify(which, np.array([x, y])).optimal == (share < 1)
    assert certify(exact, np.array([x, y])).cost < 1e-6


def squares_of(s: Sightings, places: Floats) -> float:
    """Return the weighed squares of the turns and shifts that take one side to the other."""
    every = np.concatenate([places, np.eye(4)[None]])
    left, right = s.a @ every[s.left] @ s.m, s.b @ every[s.right] @ s.d
    turns = rotation_log(left[:, :3, :3] @ np.swapaxes(right[:, :3, :3], 1, 2))
    off = np.concatenate([turns, left[:, :3, 3] - right[:, :3, 3]], axis=1)
    return float(np.einsum("ni,nij,nj->", off, s.weights, off))


def test_near_the_answer_the_quadratic_is_the_sum_of_squares_with_all_their_covariances() -> None:
    rng = np.random.default_rng(4)
    sightings, x, y = sighted((1e-4, 1e-4), 0)
    roots = rng.normal(size=(15, 6, 6))
    s, places = replace(sightings, weights=roots @ np.swapaxes(roots, 1, 2)), np.array([x, y])
    quadratic = _quadratic(s, places)
    for _ in range(3):
        turned = rotation_exp(1e-3 * rng.standard_normal((2, 3))) @ places[:, :3, :3]

        def moved(shift: Floats, turned: Floats = turned) -> float:
            shifts = places[:, :3, 3] + shift.reshape(2, 3)
            return squares_of(
                s, np.array([rigid(r, t) for r, t in zip(turned, shifts, strict=True)])
            )

        eye, zero = np.eye(6), moved(np.zeros(6))
        hessian = np.array([[moved(a + b) - moved(a) - moved(b) + zero for a in eye] for b in eye])
        gradient = np.array([moved(a) - zero for a in eye]) - np.diag(hessian) / 2
        least = moved(-np.linalg.solve(hessian, gradient))
        assert _vector(turned) @ quadratic @ _vector(turned) == pytest.approx(least, rel=1e-3)


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("noise", [(5e-3, 1e-3), (0.3, 0.05), (2.0, 0.3)])
def test_no_rotations_cost_less_than_the_bound(noise: tuple[float, float], seed: int) -> None:
    """Wherever the descent began, and whether or not anything is certified."""
    rng = np.random.default_rng(seed)
    s = replace(sighted(noise, seed)[0], weights=(lambda r: r @ np.swapaxes(r, 1, 2))(
        rng.normal(size=(15, 6, 6))))  # fmt: skip
    places = np.array([anywhere(rng), anywhere(rng)])
    shown, quadratic = certify(s, places), _quadratic(s, places)
    others = [
        _descend(quadratic, np.array([anywhere(rng)[:3, :3] for _ in "xy"])) for _ in range(8)
    ]
    others += [np.array([anywhere(rng)[:3, :3] for _ in "xy"]) for _ in range(50)]
    least = min(_vector(each) @ quadratic @ _vector(each) for each in others)
    assert shown.cost - shown.missing <= least * (1 + 1e-9)


@pytest.mark.parametrize("name", ["eye-in-hand, marker", "two arms, flange"])
def test_what_is_certified_are_the_poses_that_agree_in_their_loop(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[tuple[Sightings, Floats]] = []

    def shown(sightings: Sightings, places: Floats) -> Certificate:
        seen.append((sightings, places))
        return certify(sightings, places)

    monkeypatch.setattr(certified, "certify", shown)
    made = session(CONFIGURATIONS[name], np.random.default_rng(3), n=15, feature="pose")
    solve_poses(made.observations, RobustParams(certify=True), ROBOT, made.configuration)
    ((s, places),) = seen
    assert all(len(each) == 15 for each in astuple(s))
    assert {*s.left.tolist()} == {0} and {*s.right.tolist()} == {1}
    off = s.a @ places[0] @ s.m - s.b @ places[1] @ s.d
    assert np.abs(off).max() < 5e-3
    # Of 90 numbers 12 were found; the weights are those of the noise that they show.
    assert 40 < squares_of(s, places) < 140
    for part in (slice(0, 3), slice(3, 6)):
        alone = s.weights.copy()
        alone[:, part], alone[:, :, part] = 0.0, 0.0
        assert squares_of(replace(s, weights=alone), places) > 10


@pytest.mark.parametrize(
    ("off", "told"), [(0.9, OPTIMAL), (1.1, f"{NOT_CERTIFIED}: with its weights the best")]
)
def test_a_best_answer_further_away_than_five_sigma_is_named(
    off: float, told: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Along any axis: by the largest standard deviation of the camera's rotation."""
    made = session(CONFIGURATIONS["eye-in-hand, marker"], np.random.default_rng(3), n=15)
    measured = measurements_of(made.observations, made.configuration, None)
    loop = loop_of(made.configuration)
    problem = LoopProblem(measurements=measured, loop=loop, arms=ArmNoise(2e-4, 5e-5), stated=True)
    start = start_of(measured, problem.loop, np.random.default_rng(0))
    found = settle(problem, start, Noise(0.0, 0.0))
    values, axes = np.linalg.eigh(found.covariance[:3, :3])
    away = rotation_exp(off * 5.0 * np.sqrt(values[-1]) * axes[:, 0])

    def shown(sightings: Sightings, places: Floats) -> Certificate:
        sizes = np.linalg.eigvalsh(found.weights)
        assert np.linalg.eigvalsh(sightings.weights) == pytest.approx(sizes, rel=1e-6)
        return Certificate(np.array([away @ places[0, :3, :3], places[1, :3, :3]]), 1.0, 0.0, True)

    monkeypatch.setattr(certified, "certify", shown)
    said = certificate_note(answer_of(problem, found))
    assert said.startswith(told)
    if off > 1:
        far = np.degrees(off * 5.0 * np.sqrt(values[-1]))
        assert said.endswith(f"the best answer is {far:.2g} deg from it")
