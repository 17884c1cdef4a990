"""Squared errors as a quadratic of features: they are the errors', and its slopes its own."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from flangeye.estimation.certify.certificate import certify
from flangeye.estimation.certify.lifted import squares_of
from flangeye.types import Floats
from flangeye.types.geometry import invert, rotation_exp
from tests.estimation.sightings import (
    any_sightings,
    anywhere,
    errors_of,
    of_three,
    sighted,
    squared,
)


def least_of(squares: Any, places: Floats) -> float:
    """Return the least of a quadratic in translations: gradient and Hessian are differences."""

    def at(shift: Floats) -> float:
        shifted = places.copy()
        shifted[:, :3, 3] += shift.reshape(-1, 3)
        return float(squares(shifted))

    eye = np.eye(3 * len(places))
    zero = at(0 * eye[0])
    hessian = np.array([[at(a + b) - at(a) - at(b) + zero for a in eye] for b in eye])
    gradient = np.array([at(a) - zero for a in eye]) - np.diag(hessian) / 2
    return at(-np.linalg.solve(hessian, gradient))


def test_the_quadratic_is_the_least_error_that_translations_leave_to_rotations() -> None:
    s, rng = any_sightings(1), np.random.default_rng(2)
    start = np.array([anywhere(rng), anywhere(rng)])
    squares = squares_of(s, start)
    about = squares_of(s, np.tile(np.eye(4), (2, 1, 1)))
    for _ in range(3):
        places = np.array([anywhere(rng), anywhere(rng)])
        least = least_of(lambda at: errors_of(s, at), places)
        assert about.cost(places) == pytest.approx(least, rel=1e-9)
        assert errors_of(s, about.with_shifts(places)) == pytest.approx(least, rel=1e-9)
        # About other places they are other features of the same errors.
        beyond = invert(start) @ places
        assert squares.cost(beyond) == pytest.approx(least, rel=1e-9)
    assert squares.quadratic.shape == (19, 19)


def test_over_three_places_translations_behind_another_are_features() -> None:
    s, _ = of_three((1.0, 1.0), 1, n=6)
    rng, squares = np.random.default_rng(2), squares_of(s, np.tile(np.eye(4), (3, 1, 1)))
    assert squares.quadratic.shape == (1 + 9 + 129, 1 + 9 + 129)
    for _ in range(3):
        places = np.array([anywhere(rng) for _ in range(3)])
        best = squares.with_shifts(places)
        assert (best[2] == places[2]).all()
        assert squares.cost(places) == pytest.approx(errors_of(s, best), rel=1e-9)
        for shift in 1e-3 * np.eye(3):
            for which in range(2):
                shifted = best.copy()
                shifted[which, :3, 3] += shift
                assert errors_of(s, shifted) > errors_of(s, best)


@pytest.mark.parametrize("three", [False, True])
def test_moves_are_how_features_change(three: bool) -> None:
    rng = np.random.default_rng(3)
    s = of_three((1.0, 1.0), 1, n=6)[0] if three else any_sightings(1)
    places = np.array([anywhere(rng) for _ in range(3 if three else 2)])
    squares = squares_of(s, places)
    moves = squares.moves(places).reshape(-1, len(places), 6)
    for k, i in np.ndindex(len(places), 6):
        step = 1e-6 * np.eye(6)[i]
        ends = []
        for sign in (1, -1):
            moved = places.copy()
            moved[k, :3, :3] = rotation_exp(sign * step[:3]) @ places[k, :3, :3]
            moved[k, :3, 3] += sign * step[3:]
            ends.append(squares.features(moved))
        assert moves[:, k, i] == pytest.approx((ends[0] - ends[1]) / 2e-6, abs=1e-8)


def test_the_bottom_of_the_valley_is_reached_from_its_slope() -> None:
    sightings, x, y = sighted((5e-3, 1e-3), 0)
    squares = squares_of(sightings, np.tile(np.eye(4), (2, 1, 1)))
    bottom = squares.descend(np.array([x, y]))
    aside = bottom.copy()
    aside[:, :3, :3] = rotation_exp([[0.2, -0.1, 0.1], [0.1, 0.2, -0.2]]) @ bottom[:, :3, :3]
    assert squares.descend(aside) == pytest.approx(bottom, abs=1e-10)
    assert certify(sightings, np.array([x, y])).cost == pytest.approx(squares.cost(bottom))
    for turn in 1e-4 * np.concatenate([np.eye(6), -np.eye(6)]):
        there = bottom.copy()
        there[:, :3, :3] = rotation_exp(turn.reshape(2, 3)) @ bottom[:, :3, :3]
        assert squares.cost(there) > squares.cost(bottom)


def test_near_the_answer_the_quadratic_is_the_sum_of_squares_with_all_their_covariances() -> None:
    rng = np.random.default_rng(4)
    sightings, x, y = sighted((1e-4, 1e-4), 0)
    roots = rng.normal(size=(15, 6, 6))
    s, places = replace(sightings, weights=roots @ np.swapaxes(roots, 1, 2)), np.array([x, y])
    squares = squares_of(s, places)
    for _ in range(3):
        turned = np.tile(np.eye(4), (2, 1, 1))
        turned[:, :3, :3] = rotation_exp(1e-3 * rng.standard_normal((2, 3)))
        least = least_of(lambda at: squared(s, places @ at), turned)
        assert squares.cost(turned) == pytest.approx(least, rel=1e-3)


def test_places_that_nothing_tells_apart_are_those_of_a_circle_turned_about_itself() -> None:
    """Of Z, which ends in the circle: a one, a cosine and a sine of its turn."""
    sightings, places = of_three((1e-3, 5e-4), 1)
    squares = squares_of(sightings, places)
    at = squares.descend(np.tile(np.eye(4), (3, 1, 1)))
    assert len(squares.alike(at)) == 1
    circles = replace(sightings, freedoms=np.full(15, 5.0))
    squares = squares_of(circles, places)
    at = squares.descend(np.tile(np.eye(4), (3, 1, 1)))
    alike = squares.alike(at)
    assert len(alike) == 21
    for each in alike:
        assert each @ squares.quadratic @ each == pytest.approx(squares.cost(at), rel=1e-5)
    assert np.linalg.matrix_rank(alike, tol=1e-4) == 3
