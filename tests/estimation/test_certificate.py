"""Whether an answer is the best of all: shown where it is, not shown where it is not."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from flangeye.estimation.certify import certificate, certified
from flangeye.estimation.certify.certificate import GAP, Certificate, _Dual, certify
from flangeye.estimation.certify.certified import NOT_CERTIFIED, OPTIMAL
from flangeye.estimation.certify.lifted import LiftedSightings, squares_of
from flangeye.types import Floats
from flangeye.types.geometry import invert
from tests.estimation.cells import CONFIGURATIONS, session, solved
from tests.estimation.sightings import any_sightings, anywhere, of_three, sighted


@pytest.mark.parametrize("noise", [(1e-3, 1e-4), (5e-3, 1e-3), (3e-2, 5e-3), (0.2, 2e-2)])
@pytest.mark.parametrize("seed", range(3))
def test_the_best_answer_is_certified(noise: tuple[float, float], seed: int) -> None:
    sightings, x, y = sighted(noise, seed)
    shown = certify(sightings, np.array([x, y]))
    assert shown.optimal
    assert shown.missing <= 1e-3 * shown.cost
    assert 0.6 * 78 < shown.cost < 1.5 * 78  # numbers measured less those found


@pytest.mark.parametrize("noise", [(1e-4, 5e-5), (1e-3, 5e-4), (1e-2, 5e-3), (0.1, 2e-2)])
@pytest.mark.parametrize("seed", range(3))
def test_the_best_answer_over_three_places_is_certified(
    noise: tuple[float, float], seed: int
) -> None:
    sightings, places = of_three(noise, seed)
    shown = certify(sightings, places)
    assert shown.optimal
    assert shown.missing <= 1e-3 * shown.cost
    assert 0.6 * 72 < shown.cost < 1.5 * 72  # numbers measured less those found


def test_another_valley_over_three_places_is_not_certified_and_leads_to_the_best() -> None:
    rng, found = np.random.default_rng(7), 0
    for seed in range(2):
        sightings, places = of_three((1e-2, 5e-3), seed, n=8)
        best = certify(sightings, places)
        for _ in range(6):
            other = certify(sightings, np.array([anywhere(rng) for _ in range(3)]))
            if other.cost > 1.01 * best.cost:
                found += 1
                assert not other.optimal
                assert other.missing >= (1 - 1e-6) * (other.cost - best.cost)  # it is a bound
                assert other.better is not None
                better = certify(sightings, other.better)
                assert better.optimal
                assert better.cost == pytest.approx(best.cost, rel=1e-6)
    assert found >= 2


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


@pytest.mark.parametrize("name", ["eye-in-hand, marker", "eye-on-base, marker", "two arms, marker"])
def test_a_solver_says_so(name: str) -> None:
    made = session(CONFIGURATIONS[name], np.random.default_rng(3), n=15)
    told = solved(made, certify=True)
    assert told.notes[-1] == OPTIMAL


@pytest.mark.parametrize("seed", range(3))
def test_a_circle_anywhere_is_certified_though_nothing_tells_its_turn_about_itself(
    seed: int,
) -> None:
    configuration = CONFIGURATIONS["eye-on-base, marker"]
    made = session(configuration, np.random.default_rng(seed), n=25, tilt=0.5, feature="normal")
    told = solved(made, certify=True)
    assert told.notes[-1] == OPTIMAL


@pytest.mark.parametrize(
    ("cost", "missing", "told"), [(8.0, 1.0, "12.5%"), (2.0, 5.0, "100.0%"), (0.0, 0.0, "0.0%")]
)
def test_how_much_better_another_answer_may_be_is_said(
    cost: float, missing: float, told: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def shown(sightings: LiftedSightings, places: Floats) -> Certificate:
        return Certificate(places, cost, missing, False)

    monkeypatch.setattr(certified, "certify", shown)
    made = session(CONFIGURATIONS["eye-in-hand, marker"], np.random.default_rng(3), n=15)
    found = solved(made, certify=True)
    assert found.notes[-1] == (
        f"{NOT_CERTIFIED} (gap {told}): another answer may have squared errors smaller by that share"
    )


def duals_of(three: bool) -> tuple[Any, _Dual]:
    s = of_three((1.0, 1.0), 1, n=6)[0] if three else any_sightings(1)
    squares = squares_of(s, np.tile(np.eye(4), (3 if three else 2, 1, 1)))
    return squares, _Dual.of(squares.quadratic, squares.families)


@pytest.mark.parametrize("three", [False, True])
def test_all_matrices_have_the_quadratics_values_for_rotations_alone(three: bool) -> None:
    squares, dual = duals_of(three)
    rng, size = np.random.default_rng(3), sum(len(block.at) ** 2 for block in dual.blocks)
    matrix = dual.at(rng.standard_normal(size))
    matrix = (matrix + matrix.T) / 2

    def off(places: Floats) -> float:
        at = squares.features(places)
        return abs(float(at @ (matrix - dual.bare) @ at))

    places = np.array([anywhere(rng) for _ in range(3 if three else 2)])
    assert off(places) < 1e-9
    for spoilt in (-np.eye(3), 1.3 * np.eye(3), np.diag([1, 1, -1])):
        others = places.copy()
        others[0, :3, :3] = others[0, :3, :3] @ spoilt
        assert off(others) > 0.1
    if three:
        at = squares.features(places)
        at[squares.families[-1].at[3, 4]] += 0.5
        assert abs(at @ (matrix - dual.bare) @ at) > 0.1  # it is not a product of two places


@pytest.mark.parametrize("three", [False, True])
def test_what_is_bounded_is_of_rotations_alone_and_has_their_length(three: bool) -> None:
    squares, dual = duals_of(three)
    rng = np.random.default_rng(4)
    for _ in range(3):
        at = squares.features(np.array([anywhere(rng) for _ in range(3 if three else 2)]))
        assert at**2 @ dual.bounded == pytest.approx(1.0)


def test_of_one_rotation_twenty_are_independent_and_of_two_in_products_as_many_as_they_can() -> (
    None
):
    """Squares of a one and its entries are 55, of which 1 + 9 + 25 differ; of ten times thirteen
    8515, of which 35 times 1 + 9 + 25 + 3 (1 + 9) + 6."""
    for matrices, wanted in ((certificate._of_first(), 35), (certificate._of_others(1), 71),
                             (certificate._of_others(2), 2 * 70 + 1 + 144)):  # fmt: skip
        assert matrices.shape[1] == wanted
        assert matrices.T @ matrices == pytest.approx(np.eye(wanted), abs=1e-12)


def test_what_may_be_missing_is_seven_times_the_most_negative_eigenvalue() -> None:
    """Of rotations and a one the squares are seven: a quadratic of -0.01 in all is -0.07."""
    bounded = np.full(19, 1 / 7)
    assert _Dual(1e-3 * np.eye(19), [], bounded).missing(np.zeros(0)) == GAP
    less = _Dual(-0.01 * np.eye(19), [], bounded).missing(np.zeros(0))
    assert 0.07 <= less < 0.07 * 1.26  # the next of the shares that are tried
    assert _Dual(-np.eye(19), [], bounded).missing(np.zeros(0)) == 1.0
    # Where translations are free, nothing bounds what a negative one leaves.
    free = np.append(bounded[:18], 0.0)
    alone = np.diag(np.append(np.ones(18), -1e-6))
    assert _Dual(alone, [], free).missing(np.zeros(0)) == 1.0


def test_an_answer_is_the_best_where_next_to_nothing_is_missing(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A thousandth of the cost; where there is none, what rounding leaves."""
    sightings, x, y = sighted((5e-3, 1e-3), 0)
    places = np.array([x, y])
    cost = certify(sightings, places).cost
    exact = replace(sightings, camera=replace(
        sightings.camera, c=invert(sightings.camera.b @ x) @ y))  # fmt: skip
    size = 1e-12 * np.trace(squares_of(exact, places).quadratic)
    for which, limit in ((sightings, 1e-3 * cost), (exact, size)):
        for share in (1.0, 1.01):
            monkeypatch.setattr(_Dual, "missing", lambda *_, m=share * GAP: m)
            shown = certify(which, places)
            assert shown.optimal == (share <= 1)
            assert shown.missing == pytest.approx(share * limit)
    assert certify(exact, places).cost < 1e-6


@pytest.mark.parametrize("three", [False, True])
@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("noise", [(5e-3, 1e-3), (0.3, 0.05), (2.0, 0.3)])
def test_no_places_cost_less_than_the_bound(
    noise: tuple[float, float], seed: int, three: bool
) -> None:
    """Wherever the descent began, and whether or not anything is certified."""
    rng = np.random.default_rng(seed)
    s = of_three(noise, seed)[0] if three else sighted(noise, seed)[0]
    s = replace(s, weights=(lambda r: r @ np.swapaxes(r, 1, 2))(rng.normal(size=(15, 6, 6))))
    places = np.array([anywhere(rng) for _ in range(3 if three else 2)])
    shown, squares = certify(s, places), squares_of(s, places)
    others = [np.array([anywhere(rng) for _ in places]) for _ in range(58)]
    others = [*(squares.descend(each) for each in others[:8]), *others[8:]]
    least = min(squares.cost(each) for each in others)
    assert shown.cost - shown.missing <= least * (1 + 1e-9)
