"""A move in pieces that end by themselves, by a clock that the test moves on."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
import pytest

from flangeye.devices import SILENT
from flangeye_plugins.robot.aubo.client import VelocityMove

SPEED, ACCELERATION, TICK = 0.2, 1.0, 0.01


class Driven:
    """An arm of one axis that follows the last velocity, and a ride of it to 0.1."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now, self.at, self.velocity, self.done = 100.0, 0.0, 0.0, list[str]()
        monkeypatch.setattr(time, "monotonic", lambda: self.now)
        self.ride = VelocityMove(SPEED, ACCELERATION, self._go, self._stop, self._arrive)

    def look(self, after: float = TICK, fastest: float | None = None) -> None:
        """Let time pass, and renew the ride as a look at the arm does."""
        self.now += after
        self.at += after * self.velocity
        left = 0.1 - self.at
        speed = abs(self.velocity) if fastest is None else fastest
        self.ride.renew(np.array([left]), abs(left), speed)

    def _go(self, velocity: Any) -> None:
        self.velocity = float(velocity[0])
        self.done.append("go")

    def _stop(self) -> None:
        self.velocity = 0.0
        self.done.append("stop")

    def _arrive(self) -> None:
        self.done.append("arrive")


@pytest.fixture
def driven(monkeypatch: pytest.MonkeyPatch) -> Driven:
    return Driven(monkeypatch)


def test_it_speeds_up_rides_slows_down_stops_and_arrives(driven: Driven) -> None:
    speeds = []
    while not driven.ride.over:
        driven.look()
        speeds.append(driven.velocity)
    assert np.diff(speeds).max() <= ACCELERATION * TICK + 1e-12
    assert max(speeds) == SPEED
    assert [speeds[0], speeds[1]] == pytest.approx([ACCELERATION * TICK, 2 * ACCELERATION * TICK])
    assert driven.done[-2:] == ["stop", "arrive"] and driven.done.count("arrive") == 1
    assert abs(0.1 - driven.at) < 2e-3
    ways = 0.1 - np.cumsum(speeds) * TICK
    braking = np.sqrt(2 * 0.5 * ACCELERATION * np.clip(ways, 0.0, None))
    assert (np.array(speeds)[:-1] <= braking[:-1] + SPEED * 0.1).all()


def test_it_never_asks_for_more_than_it_can_brake_from(driven: Driven) -> None:
    driven.look()
    driven.at = 0.1 - 4 * 2e-3
    driven.look(0.0)
    driven.look(0.1)
    assert driven.velocity <= np.sqrt(2 * 0.5 * ACCELERATION * 4 * 2e-3) + 1e-12


def test_a_ride_that_nobody_looked_at_is_over_and_stays_so(driven: Driven) -> None:
    driven.look()
    driven.now += SILENT - 1e-6
    assert not driven.ride.over
    driven.now += 2e-6
    assert driven.ride.over


def test_a_new_ride_is_over_too_when_nobody_looks(driven: Driven) -> None:
    assert not driven.ride.over
    driven.now += SILENT + 1e-6
    assert driven.ride.over


def test_it_waits_until_the_arm_stands(driven: Driven) -> None:
    driven.look(fastest=0.003)
    assert driven.done == [] and not driven.ride.over
    driven.look(fastest=0.002)
    assert driven.done == ["go"]


def test_the_controllers_own_end_of_a_move_is_no_longer_than_a_piece() -> None:
    assert 2.0 * np.sqrt(2e-3 / 0.5) < SILENT


def test_it_heads_straight_for_the_goal(monkeypatch: pytest.MonkeyPatch) -> None:
    gone: list[Any] = []
    ride = VelocityMove(SPEED, ACCELERATION, gone.append, lambda: None, lambda: None)
    later = time.monotonic() + 0.1
    monkeypatch.setattr(time, "monotonic", lambda: later)
    ride.renew(np.array([0.3, -0.4]), 0.5, 0.0)
    (velocity,) = gone
    np.testing.assert_allclose(velocity / np.linalg.norm(velocity), [0.6, -0.8])
    assert 0.09 < np.linalg.norm(velocity) <= 0.11


@pytest.mark.parametrize(("acceleration", "speed"), [(4.0, 1.0), (0.25, 0.25), (100.0, 3.0)])
def test_it_slows_down_by_half_of_the_acceleration_that_it_may_have(
    monkeypatch: pytest.MonkeyPatch, acceleration: float, speed: float
) -> None:
    gone: list[Any] = []
    ride = VelocityMove(3.0, acceleration, gone.append, lambda: None, lambda: None)
    later = time.monotonic() + 10.0
    monkeypatch.setattr(time, "monotonic", lambda: later)
    ride.renew(np.array([0.25]), 0.25, 0.0)
    assert gone == [pytest.approx([speed])]
