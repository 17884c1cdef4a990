"""What a run came to: whose layout its truth is compared in."""

from typing import Any

from flangeye.models.cell import Cell, cell_in, cell_of
from flangeye.models.configuration import DEFAULT, Configuration
from flangeye.models.loading import load_model
from flangeye.models.robots import RobotModel
from flangeye.types import BASE, CAMERA, FLANGE


def test_the_layout_is_the_cells_else_the_configurations_else_a_camera_beside_an_arm() -> None:
    given: dict[Any, Any] = {}
    assert cell_in(given).frames[CAMERA].parent == BASE
    given[Configuration] = Configuration(camera=FLANGE)
    assert cell_in(given).frames[CAMERA].parent == FLANGE
    assert not cell_in(given).arms
    given[RobotModel] = load_model("robots", "ur5")
    assert cell_in(given).arms == {FLANGE: given[RobotModel]}
    given[Cell] = cell_of(DEFAULT, None)
    assert cell_in(given) is given[Cell]
