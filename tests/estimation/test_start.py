"""Where the estimate begins: the places that exact sightings have, and those that most agree on.

The bounds stand here as numbers: a test that took them from the code would follow any change of it.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from flangeye.errors import CalibrationRefused
from flangeye.estimation.graph import Places, Problem
from flangeye.estimation.start.loops import (
    agreeing,
    distances,
    initial_guess,
    loop_of,
    size_of,
    start_of_circles,
)
from flangeye.types import Floats
from flangeye.types.geometry import invert, rigid, rotation_exp
from tests.estimation.cells import CONFIGURATIONS, problem_in

MARKERS = [name for name in CONFIGURATIONS if "marker" in name]
MOUNTED = [name for name in CONFIGURATIONS if "marker" not in name and "two arms" not in name]
FREE = [name for name in MARKERS if "two arms" not in name]


def off(problem: Problem, places: Places) -> float:
    """Return the largest distance of a sighting from where it should be [m]."""
    return float(np.sqrt(distances(problem, places).max()))


def spoilt(problem: Problem, which: list[int]) -> Problem:
    """Return the problem with some sightings a decimetre and half a radian off."""
    rng, seen = np.random.default_rng(2), problem.seen
    centres, rotations = seen.centres.copy(), seen.rotations.copy()
    for row in which:
        axis = rng.standard_normal(3)
        rotations[row] = rotation_exp(0.5 * axis / np.linalg.norm(axis)) @ rotations[row]
        centres[row] += 0.1 * axis / np.linalg.norm(axis)
    return replace(problem, seen=replace(seen, centres=centres, rotations=rotations))


@pytest.mark.parametrize("feature", ["normal", "centre"])
@pytest.mark.parametrize("name", MOUNTED + FREE)
def test_a_closed_form_of_circles_is_exact(name: str, feature: str) -> None:
    problem = problem_in(name, feature, 20)
    assert off(problem, start_of_circles(problem)) < 1e-6


def test_two_arms_with_a_circle_anywhere_have_no_closed_form() -> None:
    with pytest.raises(CalibrationRefused, match="two arms with a circle at an unknown place"):
        start_of_circles(problem_in("two arms, marker", "normal"))


@pytest.mark.parametrize(("name", "feature"), [
    *((name, "pose") for name in CONFIGURATIONS), *((name, "normal") for name in MOUNTED + FREE),
    *((name, "centre") for name in MOUNTED + FREE),
])  # fmt: skip
def test_a_third_of_the_sightings_may_be_wrong(name: str, feature: str) -> None:
    wrong = [1, 4, 6, 11, 13]
    problem = spoilt(problem_in(name, feature, 18), wrong)
    places, squares = initial_guess(problem, search=False)
    right = np.delete(np.arange(18), wrong)
    assert off(problem.where(right), places) < 1e-4
    assert np.flatnonzero(~agreeing(problem, squares)).tolist() == wrong


@pytest.mark.parametrize("n", [3, 4, 41, 60])
def test_few_sightings_suffice_and_many_are_drawn_from(n: int) -> None:
    problem = problem_in("eye-in-hand, marker", "pose", n)
    places, squares = initial_guess(problem, search=False)
    assert off(problem, places) < 1e-6
    assert agreeing(problem, squares).all()


@pytest.mark.parametrize("feature", ["normal", "centre"])
def test_what_has_no_closed_form_is_found_from_random_places(feature: str) -> None:
    problem = problem_in("two arms, flange", feature, 20)
    free = {
        n: replace(f, place=None if n == "target" else f.place) for n, f in problem.frames.items()
    }
    problem = replace(problem, frames=free)
    with pytest.raises(CalibrationRefused, match="the closed forms give no plausible start"):
        initial_guess(problem, search=False)
    assert off(problem, initial_guess(problem)[0]) < 1e-4


def test_a_rotation_counts_as_its_lever_of_three_decimetres() -> None:
    problem = problem_in("eye-on-base, flange", "pose")
    places = initial_guess(problem)[0]
    seen = problem.seen
    turn = rotation_exp(np.array([0.03, -0.04, 0.0]))
    turned = replace(problem, seen=replace(seen, rotations=turn @ seen.rotations))
    np.testing.assert_allclose(distances(turned, places), (0.3 * 0.05) ** 2, rtol=1e-3)
    shifted = replace(problem, seen=replace(seen, centres=seen.centres + [2e-3, -1e-3, 2e-3]))
    np.testing.assert_allclose(distances(shifted, places), 9e-6, rtol=1e-3)


def test_of_each_pair_those_agree_that_are_no_more_than_five_times_as_far_as_its_middle() -> None:
    problem = problem_in("eye-on-base, flange", "pose", 10)
    pairs = np.arange(10) % 2
    problem = replace(problem, ends=[*problem.ends, *problem.ends],
                      seen=replace(problem.seen, pairs=pairs))  # fmt: skip
    squares = np.where(pairs == 0, 0.5, 4.0)
    squares[[0, 2, 1, 3]] = 24.9, 25.1, 99.9, 100.1  # noise alone is one; four is the other's
    assert np.flatnonzero(~agreeing(problem, squares)).tolist() == [2, 3]


def resized(problem: Problem, factor: float) -> Problem:
    return replace(problem, seen=replace(problem.seen, centres=factor * problem.seen.centres))


@pytest.mark.parametrize("factor", [0.0101, 0.5, 1.0, 3.0, 99.0])
@pytest.mark.parametrize("name", ["eye-in-hand, marker", "eye-on-base, marker"])
def test_a_marker_s_size_follows_from_the_arm_s_motion(name: str, factor: float) -> None:
    problem = problem_in(name, "pose", 20)
    assert size_of(resized(problem, 1 / factor)) == pytest.approx(factor, rel=1e-5)
    many = spoilt(problem, [0, 3, 8, 9, 14])
    assert size_of(resized(many, 1 / factor)) == pytest.approx(factor, rel=1e-3)


@pytest.mark.parametrize("factor", [0.0099, 101.0])
def test_a_marker_is_not_a_hundred_times_as_large(factor: float) -> None:
    assert size_of(resized(problem_in("eye-in-hand, marker", "pose"), 1 / factor)) == 1.0


def test_a_size_is_not_looked_for_where_a_place_is_known_or_two_arms_are() -> None:
    for name in ("eye-on-base, flange", "two arms, marker"):
        assert size_of(resized(problem_in(name, "pose"), 0.5)) == 1.0


@pytest.mark.parametrize("name", MARKERS)
def test_a_loop_closes_with_its_unknowns_and_what_is_known_between_them(name: str) -> None:
    problem = problem_in(name, "pose", 6)
    names, known = loop_of(problem)
    places = initial_guess(problem)[0]
    whole: Floats = np.eye(4)
    for (each, back), between in zip(names, known, strict=True):
        whole = whole @ (invert(places[each]) if back else places[each]) @ between
    np.testing.assert_allclose(whole, np.tile(np.eye(4), (6, 1, 1)), atol=1e-5)


def test_frames_that_no_sighting_ties_stay_where_their_parent_is() -> None:
    problem = problem_in("eye-on-base, flange", "pose")
    frames = {**problem.frames, "spare": replace(problem.frames["camera"])}
    places = initial_guess(replace(problem, frames=frames))[0]
    np.testing.assert_allclose(places["spare"], np.eye(4), atol=1e-9)


def test_a_second_camera_follows_from_the_first_one_s_target() -> None:
    """The marker on the flange is found with the camera that has more sightings, then the other."""
    problem = problem_in("eye-on-base, marker", "pose", 20)
    known = initial_guess(problem)[0]
    there = known["camera"] @ rigid(rotation_exp(np.array([0.1, 0.2, -0.1])), [0.2, 0.0, 0.1])
    seen, pairs = problem.seen, (np.arange(20) >= 17).astype(np.intp)
    again = invert(there) @ known["camera"] @ seen.poses
    second = pairs == 1
    seen = replace(
        seen, pairs=pairs,
        rotations=np.where(second[:, None, None], again[:, :3, :3], seen.rotations),
        centres=np.where(second[:, None], again[:, :3, 3], seen.centres),
    )  # fmt: skip
    frames = {**problem.frames, "second": problem.frames["camera"]}
    ends = [problem.ends[0], ("second", problem.ends[0][1])]
    both = replace(problem, frames=frames, ends=ends, seen=seen)
    places = initial_guess(both, search=False)[0]
    np.testing.assert_allclose(places["second"], there, atol=1e-5)


def test_two_arms_are_named_apart() -> None:
    names, _ = loop_of(problem_in("two arms, marker", "pose", 6))
    assert sorted(back for _, back in names) == [False, True, True]
