"""Contact, force control and its commands, in simulated time."""

from typing import Any

import numpy as np
import pytest

from flangeye_emulators.controllers.arm import SpringSurface
from flangeye_emulators.controllers.ur.controller import SafetyMode
from tests.emulators.controllers.desk import Desk, away

FORCE, STOP_FORCE, ZERO, MOVE, SPEED, UNTIL_CONTACT = 6, 7, 8, 3, 10, 51
DOWN = [0, 0, -1.0, 0, 0, 0]


@pytest.fixture
def over_floor(desk: Desk) -> Any:
    """A desk whose tool is 10 mm above a surface of 20 N/mm."""
    desk.arm.surfaces.append(SpringSurface.floor(desk.pose()[2] - 0.01))
    return desk


def press(desk, newton, compliant=(0, 0, 1, 0, 0, 0), seconds=2.0):
    numbers = [*[0] * 6, 0, 0, newton, 0, 0, 0, 0.1, 0.1, 0.05, 1, 1, 1]
    desk.stream(FORCE, numbers, [2, *compliant], seconds)


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


@pytest.mark.parametrize("stiffness", [2e3, 20e3, 200e3])
def test_force_mode_finds_the_surface_and_holds_the_force(
    over_floor: Any, stiffness: float
) -> None:
    desk = over_floor
    desk.arm.surfaces[:] = [
        SpringSurface(desk.arm.surfaces[0].point, np.array([0, 0, 1]), stiffness)
    ]
    start = desk.pose()
    press(desk, -15.0, seconds=4.0)
    forces = np.array([felt[2] for *_, felt in desk.trace])
    assert forces[-1] == pytest.approx(15.0, abs=0.1)
    assert np.abs(forces[-500:] - 15.0).max() < 0.2
    assert desk.pose()[:2] == pytest.approx(start[:2], abs=1e-6)
    assert desk.order(STOP_FORCE)
    held = desk.pose()
    desk.seconds(0.5)
    assert np.array_equal(desk.pose(), held)


def test_force_mode_gives_way_only_where_it_may(over_floor: Any) -> None:
    press(over_floor, -15.0, compliant=(0, 0, 0, 0, 0, 0), seconds=0.5)
    assert over_floor.arm.standing


def test_a_velocity_along_a_surface_keeps_the_force(over_floor: Any) -> None:
    desk = over_floor
    press(desk, -10.0, seconds=2.0)
    start = desk.pose()
    desk.stream(SPEED, [0.05, 0, 0, 0, 0, 0, 0.5, 0], seconds=1.0)
    assert desk.pose()[0] - start[0] == pytest.approx(0.05 - 0.0025, abs=2e-4)
    assert desk.arm.felt[2] == pytest.approx(10.0, abs=0.2)


def test_a_tilted_task_frame(over_floor: Any) -> None:
    """The force acts along the axes of the frame, here y is the base's -z."""
    turned = [0, 0, 0, np.pi / 2, 0, 0]
    numbers = [*turned, 0, 12.0, 0, 0, 0, 0, 0.1, 0.05, 0.1, 1, 1, 1]
    over_floor.stream(FORCE, numbers, [2, 0, 1, 0, 0, 0, 0], 3.0)
    # y of the frame is base z: 12 N upwards means the arm leaves the floor below at once.
    assert over_floor.arm.twist[2] == pytest.approx(0.024, rel=0.01)


def test_zeroing_the_sensor(over_floor: Any) -> None:
    press(over_floor, -15.0)
    assert over_floor.order(STOP_FORCE)
    assert over_floor.order(ZERO)
    assert over_floor.arm.felt[2] == pytest.approx(0.0, abs=1e-6)
    assert over_floor.arm.wrench[2] == pytest.approx(15.0, abs=0.2)


@pytest.mark.parametrize("speed", [0.01, 0.05])
def test_moving_until_contact_ends_where_it_began(over_floor: Any, speed: float) -> None:
    floor = over_floor.arm.surfaces[0].point[2]
    numbers = [0, 0, -speed, 0, 0, 0, *[0] * 6, 1.0]
    assert over_floor.order(UNTIL_CONTACT, numbers)
    assert over_floor.pose()[2] == pytest.approx(floor, abs=2e-4)
    peak = max(felt[2] for *_, felt in over_floor.trace)
    assert peak < 40.0
    assert over_floor.box.safety is SafetyMode.NORMAL


def test_contact_is_looked_for_along_a_direction(over_floor: Any) -> None:
    press(over_floor, -15.0)
    over_floor.order(STOP_FORCE)
    over_floor.stream(25, DOWN)
    assert over_floor.given_integer() > 100
    over_floor.stream(25, [0, 0, 1.0, 0, 0, 0])
    assert over_floor.given_integer() == 0


def test_contact_ends_a_move_in_the_background(over_floor: Any) -> None:
    floor = over_floor.arm.surfaces[0].point[2]
    assert over_floor.order(62, DOWN)
    target = away(over_floor.pose(), 0, 0, -0.05, 0, 0, 0)
    assert over_floor.order(MOVE, [*target, 0.03, 0.5], [1])
    over_floor.seconds(3.0)
    assert over_floor.progress() is None
    assert over_floor.pose()[2] == pytest.approx(floor, abs=2e-4)
    assert over_floor.order(63)
    assert over_floor.given_integer() > 0


def test_contact_that_comes_during_another_command_is_lost(over_floor: Any) -> None:
    """The script forgets its own command while it waits for a client's to be cleared: as is."""
    assert over_floor.order(62, DOWN)
    target = away(over_floor.pose(), 0, 0, -0.014, 0, 0, 0)
    assert over_floor.order(MOVE, [*target, 0.03, 0.5], [1])
    over_floor.write(64)
    over_floor.seconds(1.0)
    over_floor.write(0)
    over_floor.seconds(1.0)
    assert over_floor.order(64)
    assert over_floor.given_integer() > 0
    assert over_floor.misses(target) < 1e-9


def test_too_much_force_stops_the_arm(over_floor: Any) -> None:
    target = away(over_floor.pose(), 0, 0, -0.05, 0, 0, 0)
    assert not over_floor.order(MOVE, [*target, 0.05, 0.5])
    assert over_floor.box.safety is SafetyMode.PROTECTIVE_STOP
    assert over_floor.log()[-1] == "protective stop: the tool meets more than 150 N"
    over_floor.seconds(0.3)
    assert over_floor.arm.standing
    assert over_floor.arm.wrench[2] < 250.0


def test_another_kind_of_force_frame_is_refused(over_floor: Any) -> None:
    over_floor.stream(FORCE, [0] * 18, [1, 0, 0, 1, 0, 0, 0])
    assert over_floor.log()[-1] == (
        "program stopped: runtime error: force mode type 1 is not simulated; 2 is"
    )
