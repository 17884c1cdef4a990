"""What a run came to: whose layout its truth is compared in."""

from types import SimpleNamespace
from typing import Any

import pytest

from flangeye.models.cell import Cell
from flangeye.models.configuration import DEFAULT, Configuration
from flangeye.models.loading import load_model
from flangeye.models.robots import RobotModel
from flangeye.run.outcome import _robots

CELL, HAND = object(), Configuration(camera="flange")


@pytest.mark.parametrize(
    ("given", "layout"),
    [({}, DEFAULT), ({Configuration: HAND}, HAND), ({Cell: CELL}, CELL)],
)
def test_the_layout_is_the_cells_else_the_configurations_else_a_camera_beside_an_arm(
    given: dict[Any, Any], layout: Any
) -> None:
    recipe: Any = SimpleNamespace(context=given)
    assert _robots(recipe) == (layout, None)
    recipe.context = {**given, RobotModel: load_model("robots", "ur5")}
    assert _robots(recipe)[1] is not None
