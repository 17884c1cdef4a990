"""An arm that follows late: where it will come to is the sum of all it was told."""

import math

import numpy as np
import pytest

from flangeye.motion.seam_following import Command, ToolPose
from flangeye_plugins.weld.following.response import Response, identify

CYCLE = 0.01


@pytest.mark.parametrize(("dead", "lag"), [(0.0, 0.1), (0.05, 0.0), (0.03, 0.2), (0.0, 0.0)])
def test_a_late_arm_comes_to_where_its_commands_lead(dead: float, lag: float) -> None:
    response = Response()
    response.dead_time, response.lag = dead, lag
    assert response.delay == pytest.approx(dead + lag)
    motion = np.array([0.01, -0.02, 0.005, 0.5])
    told = np.repeat([motion, np.zeros(4), -motion], [100, 60, 40], axis=0)
    place, speed, late = np.zeros(4), np.zeros(4), round(dead / CYCLE)
    for cycle, command in enumerate(told):
        # The dead time ago it was told this, which it follows with its lag.
        now = cycle * CYCLE
        pose = ToolPose(now, place[:3].copy(), float(place[3]))
        ahead = response.ahead(pose)
        if dead or lag:
            off = np.array([*ahead.position, ahead.angle]) - CYCLE * told[:cycle].sum(axis=0)
            assert (np.abs(off) <= 1.01 * CYCLE * np.abs(motion)).all()  # the cycle under way
        else:
            assert ahead is pose
        response.record(now, Command(command[:3], float(command[3])))
        followed = told[cycle - late] if cycle >= late else np.zeros(4)
        left = math.exp(-CYCLE / lag) if lag else 0.0
        place = place + CYCLE * followed + lag * (1 - left) * (speed - followed)
        speed = followed + left * (speed - followed)


@pytest.mark.parametrize(
    ("dead", "lag"),
    [(0.0, 0.0), (0.0, 0.1), (0.08, 0.2), (0.04, 0.05), (0.12, 0.15), (0.16, 0.3)],
)
def test_what_an_arm_does_to_a_stroke_tells_how_late_it_is(dead: float, lag: float) -> None:
    clock = 3.0 + np.arange(0.0, 2.0, 5e-3)
    command = 0.01 * np.sign(np.sin(4.0 * clock))
    late = np.interp(clock - dead, clock, command, left=0.0)
    speed, place = 0.0, np.zeros(len(clock))
    for now in range(1, len(clock)):
        share = 1 - math.exp(-5e-3 / lag) if lag else 1.0
        speed += share * (late[now - 1] - speed)
        place[now] = place[now - 1] + 5e-3 * speed
    found = identify(np.column_stack([clock, command, place + 0.3]))
    assert found == pytest.approx((dead, lag), abs=1e-9)


def test_an_arm_whose_controller_limits_its_acceleration_is_late_after_steps_alone() -> None:
    """Half a second to turn round at the ends, as where the tool's turn is limited with it."""
    clock = np.arange(0.0, 8.0, 5e-3)
    command = 4e-3 * np.sign(np.sin(3.0 * clock)) * (0.2 + 0.8 * np.sin(4.0 * clock) ** 2)
    speed, place = 0.0, np.zeros(len(clock))
    for now in range(1, len(clock)):
        speed += float(np.clip(command[now - 1] - speed, -20e-3 * 5e-3, 20e-3 * 5e-3))
        place[now] = place[now - 1] + 5e-3 * speed
    assert sum(identify(np.column_stack([clock, command, place]))) <= 0.05
