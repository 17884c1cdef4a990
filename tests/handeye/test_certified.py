"""Certificates of answers for graphs of frames: which can be written as such, and what they say."""

import re
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from flangeye.handeye import certified
from flangeye.handeye.cell import _at_best, answer_of, calibrate_cell
from flangeye.handeye.certified import NOT_CERTIFIED, OPTIMAL, Answer, _sightings, verdict_of
from flangeye.handeye.components import Noise
from flangeye.handeye.graph import LIMITS, Sighting, Solved, problem_of, solve_graph, solved_of
from flangeye.handeye.likelihood import climb, weigh
from flangeye.handeye.unknowns import Unknowns
from flangeye.maths.frame_graph import Frame, composed
from flangeye.maths.geometry import basis_of_plane, invert, rigid, rotation_exp
from flangeye.types import Floats, Observations, Source
from flangeye_plugins.solve.cell import CellParams, solve_cell
from tests.handeye.cells import ROBOT
from tests.handeye.sightings import anywhere, squared
from tests.handeye.test_cell_arm import seen_by
from tests.handeye.test_cell_clock import CELL, seen
from tests.plugins.solve.test_arm import simulate, solver

NOISE = np.repeat([2e-3, 5e-4], 3) * [1.0, 3.0, 1.0, 1.0, 1.0, 4.0]
"""Of a sighting, about and along the camera's axes [rad, m]."""
GRAPHS: dict[str, tuple[list[tuple[str, str]], dict[str, bool]]] = {
    "two cameras, two targets": (
        [
            ("wall", "tool"),
            ("left", "tool"),
            ("left", "table"),
            ("hand", "table"),
            ("wall", "spare"),
        ],
        {"wall": True, "left": True, "hand": True, "tool": True, "spare": True, "table": True},
    ),
    "a camera alone": ([("wall", "tool")], {"wall": True}),
    "two on one way": (
        [("wall", "other_tool"), ("wall", "other_spare")],
        {"other_base": True, "other_tool": True},
    ),
    "two on one way, and its first alone": (
        [("wall", "other_tool"), ("left", "other_spare"), ("other_hand", "table")],
        {"other_base": True, "other_tool": True},
    ),
    "two on the camera's way": (
        [("other_hand", "table"), ("other_hand", "tool")],
        {"other_base": True, "other_hand": True},
    ),
    "three places between": (
        [("hand", "other_tool")],
        {"hand": True, "other_base": True, "other_tool": True},
    ),
    "three, and two the other way round": (
        [("wall", "other_tool"), ("hand", "other_spare")],
        {"hand": True, "other_base": True, "other_tool": True},
    ),
    "two arms, three cameras": (
        [("hand", "other_tool"), ("other_hand", "tool"), ("left", "tool"), ("left", "other_tool")],
        {
            "hand": True,
            "other_hand": True,
            "left": True,
            "other_base": True,
            "tool": True,
            "other_tool": True,
        },
    ),
    "what stands on both ways": (
        [("other_hand", "other_wall")],
        {"other_base": False, "other_hand": True, "other_wall": True},
    ),
}
"""Who sees what, and what is to be found; what is false drops out."""


def made(
    name: str, seed: int = 0, kind: str = "pose", n: int = 12, noise: Any = NOISE
) -> tuple[dict[str, Frame], list[Sighting], dict[str, Floats]]:
    """Return frames, sightings and the places of the unknowns."""
    rng = np.random.default_rng(seed)
    pairs, unknown = GRAPHS[name]
    moved = [np.array([rigid(rotation_exp(rng.uniform(-0.8, 0.8, 3)), rng.uniform(-0.4, 0.4, 3))
                       for _ in range(n * len(pairs))]) for _ in range(2)]  # fmt: skip
    stands = {"wall": "base", "left": "base", "table": "base", "hand": "arm", "tool": "arm",
              "spare": "arm", "other_base": "base", "other_wall": "other_base",
              "other_hand": "other", "other_tool": "other", "other_spare": "other"}  # fmt: skip
    true = {n: Frame(parent, anywhere(rng)) for n, parent in stands.items()}
    true |= {"arm": Frame("base", moved[0]), "other": Frame("other_base", moved[1])}
    sightings = []
    for time in range(n * len(pairs)):
        camera, target = pairs[time % len(pairs)]
        at = {n: replace(f, place=np.broadcast_to(np.asarray(f.place), (len(moved[0]), 4, 4))[time])
              for n, f in true.items()}  # fmt: skip
        exact = invert(composed(at, camera)) @ composed(at, target)
        sightings.append(_sighting(time, (camera, target), exact, kind, rng, noise))
    frames = {n: replace(f, place=None if unknown.get(n) else f.place) for n, f in true.items()}
    return frames, sightings, {n: np.asarray(true[n].place) for n, is_ in unknown.items() if is_}


def _sighting(
    time: int, ends: tuple[str, str], exact: Floats, kind: str, rng: np.random.Generator, noise: Any
) -> Sighting:
    off = noise * rng.standard_normal(6)
    seen = rigid(rotation_exp(off[:3]) @ exact[:3, :3], exact[:3, 3] + off[3:])
    covariance, projector = np.diag(np.square(noise)), np.eye(6)
    if kind != "pose":
        axis = seen[:3, 2]
        seen[:3, :3] = basis_of_plane(axis).T
        projector[:3, :3] = np.eye(3) - np.outer(axis, axis) if kind == "normal" else 0.0
        covariance = projector @ covariance @ projector
    return Sighting(time, *ends, seen, covariance, projector)


def answered(
    given: tuple[dict[str, Frame], list[Sighting], dict[str, Floats]], start: Any = None
) -> tuple[Solved, Answer]:
    frames, sightings, true = given
    found = solve_graph(frames, sightings, start=start or true)
    return found, answer_of(found)


def squares(found: Solved) -> float:
    """Return what the fit made small."""
    r = found.found.linear.residuals[found.found.inliers]
    return float(np.einsum("na,nab,nb->", r, found.found.weights[found.found.inliers], r))


@pytest.mark.parametrize("name", GRAPHS)
def test_the_best_answer_of_a_graph_is_certified(name: str) -> None:
    for seed in range(3):
        assert verdict_of(answered(made(name, seed))[1]).note == OPTIMAL


@pytest.mark.parametrize("kind", ["normal", "centre"])
def test_circles_and_centres_are_certified_as_well(kind: str) -> None:
    for name in ("a camera alone", "two on the camera's way"):
        assert verdict_of(answered(made(name, 1, kind, n=20))[1]).note == OPTIMAL
    for name in ("three places between", "two arms, three cameras"):  # which do not tell all
        assert verdict_of(_as_it_is(made(name, 1, kind, n=20))[1]).note == OPTIMAL


@pytest.mark.parametrize("kind", ["pose", "normal", "centre"])
@pytest.mark.parametrize("name", GRAPHS)
def test_what_is_certified_are_the_squares_that_the_graph_made_small(name: str, kind: str) -> None:
    given = made(name, 2, kind)
    found, answer = answered(given) if kind == "pose" else _as_it_is(given)
    root = certified._seen_from(answer)
    assert root is not None
    places = certified._turned(answer.places, root, answer)
    told = squared(_sightings(answer, root), np.array(list(places.values())))
    assert told == pytest.approx(squares(found), rel=1e-6)


def _as_it_is(given: Any) -> tuple[Solved, Answer]:
    """Return the true places as an answer: circles do not tell every place."""
    frames, sightings, true = given
    problem, every = problem_of(frames, sightings), np.ones(len(sightings))
    at = Unknowns(np.array([true[name] for name in problem.unknown]))
    found = solved_of(problem, weigh(problem, at, Noise(0.0, 0.0), every))
    return found, answer_of(found)


def _valley(given: Any, rng: np.random.Generator) -> Solved:
    """Return where a descent ends that begins anywhere, all sightings counting."""
    frames, sightings, _ = given
    problem, every = problem_of(frames, sightings), np.ones(len(sightings))
    at = Unknowns(np.array([anywhere(rng) for _ in problem.unknown]))
    exact = Noise(0.0, 0.0)
    return solved_of(problem, climb(problem, weigh(problem, at, exact, every), exact, every))


def test_another_valley_is_not_certified() -> None:
    """Descents that begin anywhere end in the answer, or in a valley that is not certified."""
    rng, wrong = np.random.default_rng(5), 0
    given = made("two cameras, two targets", 0, n=5)
    best = squares(answered(given)[0])
    for _ in range(8):
        found = _valley(given, rng)
        note = verdict_of(answer_of(found)).note
        if squares(found) < 1.001 * best:
            assert note == OPTIMAL
        else:
            wrong += 1
            assert re.fullmatch(
                NOT_CERTIFIED + ": with its weights the best .* 1.* deg from it", note
            )
            moved, (told,) = _at_best(found)
            assert squares(moved) == pytest.approx(best, rel=1e-6)
            said = re.fullmatch(
                "what the search had found was not the best: the certificate led to an answer that "
                r"leaves (\S+) times its squared errors",
                told,
            )
            assert said is not None
            assert float(said[1]) == pytest.approx(best / squares(found), rel=0.1)
    assert wrong >= 2


def test_an_answer_over_three_places_in_another_valley_is_left_for_the_best() -> None:
    rng, wrong = np.random.default_rng(5), 0
    given = made("three places between", 1, n=8)
    best = answered(given)[0]
    assert _at_best(best) == (best, ())
    for _ in range(12):
        found = _valley(given, rng)
        if squares(found) > 1.001 * squares(best):
            wrong += 1
            moved, _ = _at_best(found)
            assert squares(moved) == pytest.approx(squares(best), rel=1e-6)
    assert wrong >= 2


def test_noise_that_hides_the_answer_is_told_with_its_gap() -> None:
    noise, limits = np.repeat([2.0, 0.3], 3), (10.0, 10.0)
    told = []
    for seed in range(4):
        frames, sightings, true = made("two on one way", seed, n=4, noise=noise)
        found = solve_graph(frames, sightings, limits=limits, start=true)
        told.append(verdict_of(answer_of(found)).note)
    less = "another answer may leave squared errors less by so much"
    wanted = re.compile(rf"{NOT_CERTIFIED} \(gap \d+\.\d%\): {less}")
    assert [note for note in told if wanted.fullmatch(note)]
    assert all(note == OPTIMAL or wanted.fullmatch(note) for note in told)


def test_what_has_too_many_unknown_places_between_is_named() -> None:
    """A camera alone sees what stands at the end of four slides, each mounted somewhere."""
    moved = np.tile(np.eye(4), (2, 1, 1))
    frames = {"camera": Frame("base"), "slide1": Frame("base"), "end": Frame("moved3")}
    for k in (1, 2, 3):
        frames[f"moved{k}"] = Frame(f"slide{k}", moved)
        frames[f"slide{k + 1}"] = Frame(f"moved{k}")
    del frames["slide4"]
    for count, told in ((5, "not certifiable: where camera saw end, too many unknown places lie "
                         "between them: camera, slide1, slide2, slide3, end"), (4, None)):  # fmt: skip
        places = {n: np.eye(4) for n, f in frames.items() if f.place is None}
        if count == 4:
            frames["camera"] = Frame("base", places.pop("camera"))
        nothing = np.zeros((2, 6))
        answer = Answer(frames, [("camera", "end")] * 2, np.arange(2), places,
                        {n: np.eye(6) for n in places}, nothing, np.tile(np.eye(6), (2, 1, 1)),
                        np.full(2, 6.0))  # fmt: skip
        if told:
            assert verdict_of(answer).note == told
        else:
            assert certified._seen_from(answer) == "slide2"


@pytest.mark.parametrize("certify", [True, False])
def test_solve_cell_says_so_where_it_is_asked(certify: bool) -> None:
    observations = seen({"left": 0.0, "right": 0.0})
    stream = Observations(observations, Source("cells"), len(observations))
    told = solve_cell(stream, CELL, CellParams(certify=certify))
    assert [note for note in told.notes if "globally optimal" in note] == [OPTIMAL] * certify


CORRECTED = f"for the corrected arm: {OPTIMAL}"


def test_the_answer_for_the_corrected_arms_of_a_cell_is_certified_as_well() -> None:
    observations, cell, _ = seen_by(1, "zeros: 2 mrad")
    told = calibrate_cell(observations, cell, LIMITS, "solve.cell", certify=True)
    assert told.corrected is not None
    assert told.notes[-2:] == (OPTIMAL, CORRECTED)


def test_the_answer_for_a_corrected_arm_is_certified_as_well() -> None:
    offsets = np.array([0.0, 4.0, -3.0, 5.0, -4.0, 0.0]) * 1e-3
    observations = simulate(ROBOT, 30, offsets=offsets, with_joints=True, tilt=0.6)
    told = solver(ROBOT, joint_offsets="auto", tool_offset="off", certify=True)(observations)
    assert told.corrected is not None
    assert [note for note in told.notes if "optimal" in note] == [OPTIMAL, CORRECTED]
