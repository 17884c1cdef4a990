"""A wander in time is looked for only where one of camera and target rests."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from flangeye.handeye import wander
from flangeye.handeye.walk import StepSize


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
    assert wander.with_walk(model) is model
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
