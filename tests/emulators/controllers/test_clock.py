import asyncio
import time
from typing import Any

import numpy as np
import pytest

from flangeye_emulators.controllers.network import DelayLine
from flangeye_emulators.controllers.server import ControllerClock, _precise_loop


def run(coroutine):
    with asyncio.Runner(loop_factory=_precise_loop) as runner:
        return runner.run(coroutine)


def clocked(step, seconds, cycle=0.002):
    async def count():
        clock = ControllerClock(cycle, step)
        clock.start()
        await asyncio.sleep(seconds)
        return clock

    return run(count())


def test_the_clock_does_not_drift() -> None:
    """Every step costs half a cycle; the count follows the wall all the same."""
    began = time.monotonic()
    clock = clocked(lambda: time.sleep(0.001), 1.0)
    elapsed = time.monotonic() - began
    figures = clock.figures()
    # Gaps are time that the machine did not give; each is at least CATCH_UP long.
    assert figures["ticks"] <= elapsed / 0.002 + 1
    if not figures["gaps"]:
        assert figures["ticks"] >= elapsed / 0.002 - 30


def test_a_short_delay_is_made_up_and_a_long_one_is_a_gap() -> None:
    for pause, gaps in ((0.02, 0), (0.2, 1)):
        pauses = [0.0] * 20 + [pause] + [0.0] * 10_000
        clock = clocked(lambda pauses=pauses: time.sleep(pauses.pop(0)), 0.4)
        assert clock.gaps >= gaps
        assert clock.made_up >= (8 if not gaps else 0)
        assert clock.figures()["late_max"] >= pause - 0.003


def test_a_clock_that_never_ticked_has_no_figures() -> None:
    assert ControllerClock(0.002, lambda: None).figures() == {"ticks": 0}


@pytest.mark.parametrize("delays", [[0.0] * 5, [0.03, 0.02, 0.01, 0.0, 0.02]])
def test_a_delay_line_keeps_the_order(delays: Any) -> None:
    async def push():
        arrived: list[bytes] = []
        line = DelayLine(arrived.append)
        for i, delay in enumerate(delays):
            line.push(bytes([i]), delay)
        await asyncio.sleep(max(delays) + 0.05)
        return b"".join(arrived)

    assert run(push()) == bytes(range(5))


def test_what_is_late_is_late_by_the_delay() -> None:
    async def push():
        arrived = []
        loop = asyncio.get_running_loop()
        line = DelayLine(lambda _: arrived.append(loop.time()))
        began = loop.time()
        line.push(b"x", 0.05)
        await asyncio.sleep(0.2)
        return arrived[0] - began

    assert 0.05 <= run(push()) < np.inf
