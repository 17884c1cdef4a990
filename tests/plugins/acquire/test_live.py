"""What a live session makes of its devices; the devices themselves are tested with the loopback."""

from typing import Any

import numpy as np
import pytest

from flangeye.motion.supervision import RememberedState
from flangeye.types.geometry import rigid, rotation_exp
from flangeye_plugins.acquire.live import IdleTimer, LiveSession, movement, within


def samples(*times, move=0.0, turn=0.0):
    """Return samples of an arm that moves and turns by so much from each to the next."""
    return [
        RememberedState(
            time, rigid(rotation_exp([0.0, 0.0, turn * i]), [move * i, 0.0, 0.0]), np.zeros(6)
        )
        for i, time in enumerate(times)
    ]


@pytest.mark.parametrize(
    ("start", "end", "expected"),
    [(10, 30, [10, 20, 30]), (12, 18, [10, 20]), (11, 21, [10, 20, 30]), (0, 40, [0, 10, 20, 30, 40])],
)  # fmt: skip
def test_an_exposure_is_framed_by_samples(start: int, end: int, expected: list[Any]) -> None:
    found = within(samples(0, 10, 20, 30, 40), start, end)
    assert [sample.time_ns for sample in found] == expected


@pytest.mark.parametrize(("start", "end"), [(-1, 20), (20, 41), (50, 60)])
def test_an_exposure_that_is_not_covered_has_no_pose(start: int, end: int) -> None:
    assert within(samples(0, 10, 20, 30, 40), start, end) == []
    assert within([], start, end) == []


def test_movement_counts_shifts_and_turns() -> None:
    assert movement(samples(0, 1, 2)) == 0.0
    assert movement(samples(0, 1, 2, move=1e-4)) == pytest.approx(2e-4)
    assert movement(samples(0, 1, 2, turn=1e-3)) == pytest.approx(2e-4, rel=1e-3)


def test_an_arm_is_idle_while_it_stands_and_nothing_is_exposed() -> None:
    idle = IdleTimer()
    assert idle.share is None
    idle.leaves(100)
    assert idle.share is None
    idle.exposed(110, 112, 115)  # what was computed on the way took 2 too long
    idle.leaves(118)  # 3 were spent on choosing where to go
    idle.exposed(130, 120, 150)  # another clock may tell the arrival a little late
    assert idle.share == 5 / 50


def test_since_when_an_arm_stands_is_told_by_its_samples() -> None:
    class Arm:
        seen: list[RememberedState]

        def during(self, start_ns: int, end_ns: int) -> list[RememberedState]:
            assert (start_ns, end_ns) == (60 - 10_000_000_000, 60)
            return self.seen

    nothing: Any = None
    arm: Any = Arm()
    session = LiveSession(nothing, arm, nothing, 0.05e-3, frozenset(), nothing)
    *moving, arrived = samples(0, 10, 20, move=1e-3)
    stands = [arrived._replace(time_ns=time) for time in (20, 40, 60)]
    for arm.seen, since in ((moving + stands, 20), (stands[1:], 40)):
        assert session._stands_since(60) == since
