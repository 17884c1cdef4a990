"""A wander in time is looked for only where one of camera and target rests."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy import stats

from flangeye.handeye import wander
from flangeye.handeye.candidates import Model
from flangeye.handeye.components import Noise
from flangeye.handeye.consensus import Consensus
from flangeye.handeye.likelihood import weigh
from flangeye.handeye.walk import Course, Of, StepSize, Walk
from flangeye.maths.geometry import nearest_rotation, rigid, rotation_exp
from tests.handeye.cells import given, start


@pytest.mark.parametrize(
    ("camera_moves", "target_moves", "poses", "looked"),
    [
        (False, True, 24, 1),
        (True, False, 24, 1),
        (True, True, 24, 0),
        (False, False, 24, 0),
        (False, True, 23, 0),
    ],
)
def test_where_a_wander_is_looked_for(
    camera_moves: bool, target_moves: bool, poses: int, looked: int, monkeypatch: Any
) -> None:
    asked: list[Any] = []

    def none(*given: Any) -> list[Any]:
        asked.append(given)
        return []

    monkeypatch.setattr(wander, "_walking", none)
    loop = SimpleNamespace(y=None, z="flange", camera_moves=camera_moves, target_moves=target_moves)
    found = SimpleNamespace(inliers=np.ones(poses, dtype=bool))
    model: Any = SimpleNamespace(problem=SimpleNamespace(loop=loop), found=found)
    assert wander.with_walk(model) == (model, 0.0)
    assert len(asked) == looked


def test_steps_turn_about_what_makes_them_likeliest_their_size_taken_as_it_is_there(
    monkeypatch: Any,
) -> None:
    """A size of shifts is that of the steps as they are about each, the first not counted."""
    lengths = {"target": 1.0, "world": 3.0, "base": 0.5}

    def steps(walk: str) -> Any:
        out = np.zeros((5, 7))
        out[0], out[1:, :3], out[1:, 3:6], out[1:, 6] = 1e3, 50.0, lengths[walk], 70.0
        return out

    tried: dict[str, Any] = {}

    def likelihood(problem: Any, found: Any) -> float:
        tried[problem.walk] = found.noise.walk
        return -abs(float(found.noise.walk.shift) - 6e-4)

    monkeypatch.setattr(wander, "log_likelihood", likelihood)
    monkeypatch.setattr(wander, "replace", lambda of, **new: SimpleNamespace(**vars(of) | new))
    size = StepSize(1e-3, 2e-4, 5e-4)
    found = SimpleNamespace(
        at=SimpleNamespace(course=SimpleNamespace(steps=steps)), noise=SimpleNamespace(walk=size)
    )
    model: Any = SimpleNamespace(found=found, problem=SimpleNamespace(walk="target"))
    walks: Any = {name: name for name in lengths}
    assert wander._likeliest(model, walks) == "world"
    assert {name: float(s.shift) for name, s in tried.items()} == pytest.approx(
        {"target": 2e-4, "world": 6e-4, "base": 1e-4}
    )
    assert all(s.turn == 1e-3 and s.growth == 5e-4 for s in tried.values())


def walked(name: str, of: Of) -> Model:
    """Return a model whose course has led it some way off, three of its poses not counting."""
    bare, rng = given(name, "pose", 27, stated=False), np.random.default_rng(3)
    about = np.tile([0.4, 0.1, 0.2], (27, 1))
    problem = replace(bare, walk=Walk(about, of=of))
    turns = rotation_exp(np.cumsum(2e-3 * rng.normal(size=(27, 3)), axis=0))
    shifts = np.cumsum(1e-3 * rng.normal(size=(27, 3)), axis=0)
    motions = np.array([rigid(*each) for each in zip(turns, shifts, strict=True)])
    at = replace(start(bare), course=Course(motions, np.zeros(27), of))
    found = weigh(problem, at, Noise(1e-8, 1e-8), (np.arange(27) < 24).astype(float))
    return Model(Consensus(problem, found))


@pytest.mark.parametrize(
    ("name", "of"),
    [
        ("eye-in-hand, marker", "base"),
        ("eye-on-base, marker", "base"),
        ("eye-in-hand, marker", "camera"),
        ("eye-on-base, marker", "target"),
    ],
)
def test_what_wandered_is_told_where_it_was_in_the_mean_and_nothing_else_changes(
    name: str, of: Of
) -> None:
    """What rests in the base, or in the hand, takes the mean of its motions, and they lose it."""
    before = walked(name, of)
    after = wander._about_the_mean(before)
    course = after.found.at.course
    assert course is not None and before.found.at.course is not None and course.of == of
    mean = course.motions[:24].mean(axis=0)
    assert nearest_rotation(mean[:3, :3]) == pytest.approx(np.eye(3), abs=1e-5)
    assert mean[:3, 3] == pytest.approx(np.zeros(3), abs=1e-5)
    assert np.abs(before.found.at.course.motions[:24].mean(axis=0) - np.eye(4)).max() > 1e-3
    again = weigh(after.problem, after.found.at, after.found.noise, np.ones(27))
    assert again.linear.residuals == pytest.approx(before.found.linear.residuals, abs=1e-9)
    still = replace(before.found, at=replace(before.found.at, course=None))
    resting = replace(before, consensus=replace(before.consensus, found=still))
    assert wander._about_the_mean(resting) is resting


@pytest.mark.parametrize(("grows", "numbers"), [(False, 2), (True, 3)])
def test_the_likelier_walk_is_taken_where_chance_gives_it_once_in_ten_thousand(
    grows: bool, numbers: int, monkeypatch: Any
) -> None:
    """Twice the gain of a log likelihood by so many sizes follows chi-square."""
    model, limit = walked("eye-in-hand, marker", "base"), stats.chi2(numbers).ppf(0.9999)
    one, two = walked("eye-in-hand, marker", "base"), walked("eye-in-hand, marker", "camera")
    gains: dict[int, float] = {}
    monkeypatch.setattr(
        wander, "_walking", lambda *_: [("target", one), ("camera", None), ("world", two)]
    )
    monkeypatch.setattr(wander, "_gain", lambda _, each: gains[id(each)])
    for first, second, name in ((1.01, 0.5, "target"), (0.5, 1.01, "world"), (0.99, 0.5, None)):
        gains.update({id(one): first * limit, id(two): second * limit})
        found, beyond_chance = wander.with_walk(model, grows)
        assert beyond_chance == pytest.approx(max(max(first, second) - 1, 0.0) * limit)
        if name is None:
            assert found is model
            continue
        (note,) = found.notes
        assert note.startswith(f"the {name} wandered during the session, by ")
        taken = wander._about_the_mean(one if name == "target" else two)
        off = (taken.residuals(as_reported=True) - taken.residuals())[:24]
        told = float(note.partition("by ")[2].partition(" mm")[0])
        assert told == pytest.approx(1e3 * np.sqrt((off**2).sum(axis=1).mean()), abs=6e-4)


def test_a_walk_begins_with_the_size_that_leaves_the_residuals_there_are(monkeypatch: Any) -> None:
    """Of N steps the middle is off by root of half as many; of those that agree."""
    model = walked("eye-in-hand, marker", "base")
    seen: list[Any] = []
    monkeypatch.setattr(Model, "with_problem", lambda self, problem: seen.append((self, problem)))
    walk = Walk(np.zeros((27, 3)))
    wander._with(model, walk)
    ((begun, problem),) = seen
    assert problem.walk is walk
    left = model.found.linear.residuals[:24]
    turn, shift = (np.sqrt((left[:, k : k + 3] ** 2).sum(axis=1).mean()) for k in (0, 3))
    sizes = np.array(begun.found.noise.walk)
    assert sizes == pytest.approx(np.sqrt(2 / 27) * np.array([turn, shift, turn]))


@pytest.mark.parametrize(
    ("name", "resting", "held"),
    [("eye-in-hand, marker", "target", "camera"), ("eye-on-base, marker", "camera", "target")],
)
@pytest.mark.parametrize("likelier", ["resting", "world", "base"])
def test_what_may_wander_is_the_base_about_three_places_or_what_the_hand_carries(
    name: str, resting: str, held: str, likelier: str, monkeypatch: Any
) -> None:
    model = walked(name, "base")
    s, at = model.problem.measurements, model.found.at
    camera, target = (s.a @ at.x)[:, :3, 3], (s.b @ at.z)[:, :3, 3]
    about = {
        resting: target if resting == "target" else camera,
        "world": camera if resting == "target" else target,
        "base": np.zeros((27, 3)),
    }
    tried: list[Walk] = []

    def with_it(_: Any, walk: Walk) -> Any:
        tried.append(walk)
        return SimpleNamespace(walk=walk)

    wanted = resting if likelier == "resting" else likelier
    monkeypatch.setattr(wander, "_with", with_it)
    monkeypatch.setattr(wander, "_likeliest", lambda found, walks: wanted)
    found = list(wander._walking(model, True))
    assert [each for each, _ in found] == [wanted, held]
    assert all(walk.grows for walk in tried)
    assert [walk.of for walk in tried] == ["base"] * (len(tried) - 1) + [held]
    assert tried[0].about == pytest.approx(about[resting])
    first, second = (getattr(of, "walk", None) for _, of in found)
    assert first is not None and first.about == pytest.approx(about[wanted])
    place = (at.x if held == "camera" else at.z)[:3, 3]
    assert second is not None and second.about == pytest.approx(np.tile(place, (27, 1)))
