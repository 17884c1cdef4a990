"""A terminal in which ROS 2 is sourced, on a domain of the test's own."""

from collections.abc import Iterator

import pytest

from flangeye.motion.watchdog import SERVO_PRIORITY, realtime_priority
from tests.plugins.ros2 import installed


@pytest.fixture
def env(monkeypatch: pytest.MonkeyPatch) -> Iterator[dict[str, str]]:
    installed.require()
    given = installed.environment(installed.free_domain())
    for name, value in given.items():
        monkeypatch.setenv(name, value)
    with realtime_priority(SERVO_PRIORITY):  # as the guard of an arm
        yield given
