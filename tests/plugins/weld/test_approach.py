"""Before the arm moves the finger is watched: whether it is seen, and hangs free."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from flangeye.errors import StageError
from flangeye_plugins.weld.execution import _watch, approach
from tests.plugins.weld.bench import refused


def watched(displacements: list[Any], seen: int = 1, period: float = 0.05) -> tuple[int, int]:
    """Watch a finger, of each of whose images such displacements are told; None without a tag [m].

    Returns how many images were logged, and the cycles that it took.
    """
    logged, cycles, told = list[Any](), [0], iter(displacements)

    def tick() -> Any:
        cycles[0] += 1
        return SimpleNamespace(time_ns=round(cycles[0] * period * 1e9))

    def sights() -> Any:
        for off in (next(told, None) for _ in range(seen)):
            feeling = None if off is None else SimpleNamespace(displacement=np.array(off))
            yield SimpleNamespace(feeling=feeling)

    drive, eyes = SimpleNamespace(tick=tick), SimpleNamespace(seen=sights)
    cell: Any = SimpleNamespace(drive=drive, eyes=eyes)
    log: Any = SimpleNamespace(before=logged.append)
    _watch(cell, log)
    return len(logged), cycles[0]


@pytest.mark.parametrize(
    ("off", "told"), [(0.49e-3, None), (0.51e-3, "0.5 mm"), (2.6e-3, "2.6 mm")]
)
def test_a_finger_that_touches_nothing_is_not_displaced(off: float, told: str | None) -> None:
    """By the middle of ten measurements."""
    seen = [[0.0, 0.6 * off, -0.8 * off]] * 8 + [[0.1, 0.0, 0.0]] * 2
    with refused(told and f"the tip is displaced by {told} though nothing should"):
        assert watched(seen)[0] == 10


def test_a_finger_is_watched_for_two_seconds_or_ten_measurements() -> None:
    still = [0.0, 0.0, 0.0]
    assert watched([still] * 99) == (10, 12)  # the first cycle says when it began
    logged, cycles = watched([still, None, None] * 99, period=0.1)
    assert cycles == 21 and logged == 19  # two seconds after the first cycle
    with pytest.raises(StageError, match="no tag is in view; is the finger's light on"):
        watched([None] * 99)
    with pytest.raises(StageError, match="the camera gives no images; is the finger's light on"):
        watched([], seen=0)


@pytest.mark.parametrize(("mode", "watched_first"), [("tactile", True), ("vision", False)])
def test_the_finger_is_watched_before_the_arm_moves_where_it_is_needed(
    mode: Any, watched_first: bool
) -> None:
    """What is seen on the way is logged, and is no news to the controller."""
    told, cycles = list[Any](), [0]

    def tick() -> Any:
        cycles[0] += 1
        return SimpleNamespace(time_ns=cycles[0] * 10**8, joints=[0.1, 0.2])

    free = SimpleNamespace(feeling=SimpleNamespace(displacement=np.zeros(3)))
    eyes = SimpleNamespace(seen=lambda: [free])
    drive = SimpleNamespace(tick=tick, follow=lambda route: told.append(route))
    passage: Any = SimpleNamespace(to_start=lambda here: ("way from", *here.tolist()))
    log: Any = SimpleNamespace(before=lambda sight: told.append("seen"))
    cell: Any = SimpleNamespace(drive=drive, eyes=eyes)
    approach(cell, passage, log, mode)
    before = ["seen"] * 10 if watched_first else []
    assert told == [*before, ("way from", 0.1, 0.2), "seen"]
