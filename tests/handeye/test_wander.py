"""A wander in time is looked for only where one of camera and target rests."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from flangeye.handeye import wander


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
