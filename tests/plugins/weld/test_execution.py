"""The finger is watched, then the loop keeps time, and says how."""

import gc
import time
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from flangeye.devices import DeviceError, WeldProfile
from flangeye.errors import StageError
from flangeye.motion.seam_following import Command, Controller, ToolPose
from flangeye_plugins.weld.execution import WeldClock, _watch, approach, follow, low_latency
from flangeye_plugins.weld.tactile import _longest
from flangeye_plugins.weld.touch.tip_displacement import TipDisplacement
from flangeye_plugins.weld.weld_log import WeldLog
from tests.plugins.weld.bench import refused


def busy(seconds):
    began = time.thread_time()
    while time.thread_time() - began < seconds:
        pass


def test_a_clock_counts_what_a_cycle_computes_and_nothing_else() -> None:
    clock = WeldClock()
    busy(5e-3)
    clock.start()
    assert clock.period >= 5e-3
    busy(2e-3)
    with clock.aside():
        busy(20e-3)
    time.sleep(20e-3)
    busy(2e-3)
    assert 4e-3 <= clock.computing < 15e-3
    assert clock.answering >= 24e-3  # it slept
    clock.start()
    with clock.aside():
        time.sleep(50e-3)
    assert clock.computing < 2e-3
    assert clock.answering < 50e-3
    assert clock.period >= 40e-3
    clock.start()
    assert clock.answering < 50e-3


def test_garbage_is_not_collected_in_the_loop_and_is_again_after_it() -> None:
    assert gc.isenabled()
    with pytest.raises(KeyboardInterrupt), low_latency():
        assert not gc.isenabled()
        raise KeyboardInterrupt
    assert gc.isenabled()
    gc.disable()
    try:
        with low_latency():
            pass
        assert not gc.isenabled()
    finally:
        gc.enable()


class Desk:
    """A cell of stand-ins: an arm whose cycles take a tenth of a second, and what it was told.

    Attributes:
        told: What happened, by name.
    """

    def __init__(self, lost_at: int | None = None) -> None:
        self.told, self.cycles, self.lost_at = list[Any](), 0, lost_at
        self.drive = self.robot = self.eyes = self.tool = self.bounds = self
        self.limits, self.steered = SimpleNamespace(acceleration=0.7), None
        self.gas_after = None

    def expect_velocities(self) -> None:
        self.told.append("expect_velocities")

    def stop(self) -> None:
        self.told.append("stop")

    def wait_cycle(self) -> None:
        self.cycles += 1

    def read(self) -> Any:
        if self.cycles == self.lost_at:
            raise DeviceError("the arm is lost")
        return SimpleNamespace(time_ns=(5 * 10**9 + self.cycles * 10**8), base_T_flange="here")

    def seen(self) -> list[Any]:
        feeling = TipDisplacement(
            self.cycles * 10**9, np.full(3, float(self.cycles)), np.zeros(3), np.eye(3), 1.0
        )
        felt = feeling if self.cycles % 2 else None
        return [
            SimpleNamespace(
                feeling=felt, time_ns=7, piece=SimpleNamespace(corner=(0, 0), image=None)
            )
        ]

    def pose(self, flange: Any, seconds: float) -> ToolPose:
        assert flange == "here"
        return ToolPose(seconds, np.array([1.0, 2.0, 3.0]), 0.4)

    def check(self, pose: Any, progress: float, felt: Any) -> None:
        self.told.append(("checked", progress, len(felt)))

    def twist(self, command: Command, flange: Any) -> Any:
        return ("twist", command.turn, flange)

    def move_velocity(self, twist: Any, acceleration: float) -> None:
        self.told.append((twist, acceleration))


class Ending:
    """A controller that is done after so many cycles."""

    def __init__(self, cycles: int) -> None:
        self.cycles, self.touches, self.phase, self.reason = cycles, list[Any](), "following", ""
        self.tip, self.torch, self.wanted = 0.11, 0.12, 0.13
        self.sigma, self.bound, self.band = 0.14, 0.15, 0.16

    def step(self, pose: ToolPose, touches: Any) -> Command:
        self.touches.append((pose.time, [(touch.time, touch.displacement[0]) for touch in touches]))
        if len(self.touches) == self.cycles:
            self.phase, self.reason = "stopped", "enough"
        return Command(np.array([1.0, -2.0, 0.5]), 0.3)


def followed(cell: Any, controller: Any, longest: float = 60.0) -> Any:
    given: Controller = controller
    with WeldLog(lambda name, value: None, False) as log:
        return follow(cell, given, log, longest), log.cycles


def test_a_cycle_reads_decides_commands_and_is_logged() -> None:
    desk, controller = Desk(), Ending(3)
    reason, cycles = followed(desk, controller)
    assert reason == "enough"
    command = (("twist", 0.3, "here"), 0.7)
    felt = [("checked", 0.11, 1), ("checked", 0.11, 0), ("checked", 0.11, 1)]
    assert desk.told == [
        "expect_velocities",
        *(each for one in felt for each in (one, command)),
        "stop",
    ]
    assert controller.touches == [
        (pytest.approx(5.1), [(1.0, 1.0)]), (pytest.approx(5.2), []),
        (pytest.approx(5.3), [(pytest.approx(3.0), 3.0)]),
    ]  # fmt: skip
    assert [cycle.touches for cycle in cycles] == [(0,), (), (2,)]
    last = cycles[-1]
    assert last.position == (1.0, 2.0, 3.0) and last.velocity == (1.0, -2.0, 0.5)
    assert (last.angle, last.turn, last.phase) == (0.4, 0.3, "stopped")
    stated = (last.tip, last.torch, last.wanted, last.sigma, last.bound, last.band)
    assert stated == (0.11, 0.12, 0.13, 0.14, 0.15, 0.16)


def test_a_weld_that_takes_longer_than_it_may_ends_by_the_arm_s_clock_and_the_arm_is_stopped() -> (
    None
):
    desk = Desk()
    reason, cycles = followed(desk, Ending(99), longest=1.05)
    assert reason == "the end of the seam was not reached within 1 s"
    assert len(cycles) == 11 and desk.told[-1] == "stop"  # a tenth of a second each


def test_an_arm_that_is_lost_ends_the_weld_with_its_reason_and_is_told_to_stop() -> None:
    desk = Desk(lost_at=4)
    reason, cycles = followed(desk, Ending(99))
    assert reason == "the arm is lost" and len(cycles) == 3 and desk.told[-1] == "stop"


def test_what_is_seen_behind_the_torch_is_told_before_the_cycle_s_decision() -> None:
    desk, controller = Desk(), Ending(2)
    told = list[Any]()
    cell: Any = desk
    cell.profiles = lambda: [WeldProfile(1e-4, 5e-5, 9)]
    cell.steered = SimpleNamespace(looked=lambda profile: told.append(len(controller.touches)))
    followed(cell, controller)
    assert told == [0, 1]


@pytest.mark.parametrize(("passes", "times"), [(0, 1), (2, 5)])
def test_a_weld_may_take_a_minute_and_three_times_its_way_there_and_back_in_each_pass(
    passes: int, times: int
) -> None:
    params: Any = SimpleNamespace(passes=[None] * passes, speed=5e-3)
    assert _longest(0.1, params) == pytest.approx(60.0 + 3.0 * times * 20.0)


# --- before the arm moves --------------------------------------------------------------------------


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
