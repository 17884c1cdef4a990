"""The arms that are simulated in this process: what else is simulated meets them where they are.

A controller reads where an arm says it is; a finger on that arm touches the work where the arm
really is. The two meet here, as they do in a real room, and not through the controller.
"""

from __future__ import annotations

from typing import Protocol
from weakref import WeakSet, ref

import numpy as np

from flangeye.devices import RobotState
from flangeye.types import BASE, FLANGE, Floats, Transform


class StandingArm(Protocol):
    """An arm in the room."""

    def state(self) -> RobotState:
        """Return what it says of itself."""
        ...

    def true_flange(self) -> Floats:
        """Return where its flange really is (4, 4), in base."""
        ...


_ARMS: WeakSet[StandingArm] = WeakSet()
_NEWEST: list[ref[StandingArm]] = []


def enter(arm: StandingArm) -> None:
    """Let an arm stand in the room, for as long as it lives."""
    _ARMS.add(arm)
    _NEWEST[:] = [ref(arm)]


def newest() -> StandingArm | None:
    """Return the arm that came into the room last, which carries what is mounted on an arm."""
    return _NEWEST[0]() if _NEWEST else None


def true_flange(reported: RobotState) -> Transform:
    """Return where the flange of the arm that reports this really is.

    An arm that is not simulated here is where it says.
    """
    for arm in _ARMS:
        state = arm.state()
        same = len(state.joints) == len(reported.joints) and state.time_ns == reported.time_ns
        if same and np.array_equal(state.joints, reported.joints):
            return Transform(BASE, FLANGE, arm.true_flange())
    return reported.base_T_flange
