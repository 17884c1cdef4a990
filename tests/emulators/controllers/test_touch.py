"""Contact, in simulated time."""

from typing import Any

import numpy as np
import pytest

from flangeye_emulators.controllers.arm import SpringSurface
from flangeye_emulators.controllers.ur.controller import SafetyMode
from tests.emulators.controllers.desk import Desk, away

MOVE = 3


@pytest.fixture
def over_floor(desk: Desk) -> Any:
    """A desk whose tool is 10 mm above a surface of 20 N/mm."""
    desk.arm.surfaces.append(SpringSurface.floor(desk.pose()[2] - 0.01))
    return desk


def test_a_surface_is_a_spring_that_never_pulls() -> None:
    surface = SpringSurface.floor(0.1)
    below, still = np.array([0.3, 0.2, 0.0999]), np.zeros(3)
    assert surface.force(below, still) == pytest.approx([0, 0, 2.0])
    assert not surface.force(away(below, 0, 0, 0.1), still).any()
    assert not surface.force(below, np.array([0, 0, 1.0])).any()


@pytest.mark.parametrize(
    "wrong",
    [{"normal": [0, 0, 0]}, {"point": [0, 0]}, {"stiffness": -1.0}, {"point": [0, 0, np.nan]}],
)
def test_a_surface_that_makes_no_sense_is_refused(wrong: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match="a surface"):
        SpringSurface(**{"point": [0, 0, 0], "normal": [0, 0, 1], **wrong})


def test_too_much_force_stops_the_arm(over_floor: Any) -> None:
    target = away(over_floor.pose(), 0, 0, -0.05, 0, 0, 0)
    assert not over_floor.order(MOVE, [*target, 0.05, 0.5])
    assert over_floor.box.safety is SafetyMode.PROTECTIVE_STOP
    assert over_floor.log()[-1] == "protective stop: the tool meets more than 150 N"
    over_floor.seconds(0.3)
    assert over_floor.arm.standing
    assert over_floor.arm.felt[2] < 250.0
