"""An arm under guard: it arrives, or it stops and says why; nothing is waited for in vain."""

import multiprocessing
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from flangeye.devices import SILENT, DeviceError, RobotState
from flangeye.errors import RunStopped
from flangeye.motion import watchdog as guard_module
from flangeye.motion.arm import GUARD, WatchedArm, _alarmed, run_number, watched
from flangeye.motion.route import Route, Router
from flangeye.motion.supervision import RememberedState
from flangeye.motion.watchdog import GuardConfig, Watchdog
from tests.motion.stand_in import (
    LIMITS,
    MODEL,
    StandIn,
    driver_of,
    elsewhere,
    opened_nowhere,
    turned,
)


def way_to(arm, **turns):
    joints = arm.state.joints
    return Router(MODEL, LIMITS, joints).route(joints, turned(joints, **turns))


def test_it_drives_there_and_has_settled() -> None:
    robot, told = StandIn(), list[RobotState]()
    with watched(driver_of(robot), MODEL, LIMITS, told.append) as arm:
        goal = turned(arm.state.joints, j1=0.3)
        arm.go(way_to(arm, j1=0.3))
        state = arm.wait()
    assert state.joints == pytest.approx(goal, abs=1e-3)
    assert np.abs(state.joint_speeds).max() < 1e-3
    assert robot.closed
    assert len(told) > 2
    # Every fifth of a second, at the next of its cycles.
    late = [b.time_ns - a.time_ns - 200_000_000 for a, b in pairwise(told[:-1])]
    assert all(0 < each <= 10_000_000 for each in late)


def test_it_knows_where_the_arm_was() -> None:
    with watched(driver_of(StandIn()), MODEL, LIMITS) as arm:
        arm.go(way_to(arm, j1=0.1))
        end = arm.wait().time_ns
        samples = arm.during(end // 2, end)
    assert samples[0].time_ns <= end // 2 < samples[1].time_ns
    assert samples[-1].time_ns >= end
    assert np.abs(np.diff([s.time_ns for s in samples])).max() < 5_000_000


def test_the_samples_of_an_interval_are_those_in_it_and_one_to_each_side() -> None:
    samples = [RememberedState(t, np.eye(4), np.zeros(6)) for t in (10, 20, 30, 40)]

    def during(start: int, end: int) -> list[int]:
        return [sample.time_ns for sample in guard_module._during(samples, start, end)]

    assert during(21, 29) == [20, 30]
    assert during(20, 30) == [20, 30]
    assert during(5, 35) == [10, 20, 30, 40]
    assert during(31, 99) == [30, 40]


@pytest.mark.parametrize(("asked", "cycle"), [(0, 1), (30, 30)])
def test_samples_are_told_once_their_interval_is_over(asked: int, cycle: int) -> None:
    robot = StandIn()
    period = round(robot.period * 1e9)
    start = robot.state().time_ns
    wanted = (start, start + asked * period)
    wire: Any = Wire(robot, [(0, ("samples", wanted)), (60, ("close", None))])
    told: list[tuple[int, Any]] = []
    wire.send = lambda report: told.append((robot.cycles, report))
    Watchdog(robot, wire, GuardConfig(lambda: robot, MODEL, LIMITS)).run()
    ((when, report),) = [each for each in told if each[1].what == "samples"]
    assert when <= cycle
    assert report.content[-1].time_ns >= wanted[1]


def under_way(change):
    """Return a misbehaviour that begins half a second after the arm was first sent away."""

    def misbehave(robot, state):
        sent = robot.asked and robot.cycles - robot.asked[0][1] > 250
        return change(robot, state) if sent else state

    return misbehave


def lost(robot, state):
    raise DeviceError("no sample for 100 ms: the controller is gone")


def moved_aside(robot, state):
    return replace(state, joints=turned(state.joints, j2=0.1))


def rushing(robot, state):
    return replace(state, joint_speeds=np.full(6, 2.0))


def outside(robot, state):
    return replace(state, base_T_flange=elsewhere(state, [0.0, 0.0, 1.0]))


def protected(robot, state):
    return replace(state, mode="protective stop", message="collision of joint 2")


@pytest.mark.parametrize(
    ("misbehaviour", "line"),
    [
        (lost, "no sample for 100 ms: the controller is gone"),
        (moved_aside, "the arm is 5.7 deg away from its commanded path"),
        (rushing, "a joint turns at 115 deg/s, allowed 30 deg/s"),
        (outside, "the arm is outside the box: z is"),
        (protected, "the controller reports protective stop: collision of joint 2"),
    ],
)
def test_any_doubt_stops_the_arm_and_is_told(misbehaviour: Any, line: str) -> None:
    robot = StandIn(under_way(misbehaviour))
    with watched(driver_of(robot), MODEL, LIMITS) as arm:
        arm.go(way_to(arm, j1=0.8))
        with pytest.raises(DeviceError) as error:
            arm.wait()
        assert str(error.value).startswith(line)
        assert "stop" in robot.commands()
        arm.go(way_to(arm, j1=0.1))
    assert robot.commands().count("move") == 1  # a safety fault is not outlived


@pytest.mark.parametrize(
    ("refusal", "line"),
    [
        ("no sample for 100 ms: the controller is gone",
         "no sample for 100 ms: the controller is gone"),
        ("the command was not taken",
         "no sample for 100 ms: the controller is gone; stopping it: the command was not taken"),
    ],
)  # fmt: skip
def test_an_arm_that_cannot_be_stopped_either_is_told_once(refusal: str, line: str) -> None:
    class Gone(StandIn):
        def stop(self):
            raise DeviceError(refusal)

    robot = Gone(under_way(lost))
    with watched(driver_of(robot), MODEL, LIMITS) as arm:
        arm.go(way_to(arm, j1=0.8))
        with pytest.raises(DeviceError) as error:
            arm.wait()
    assert str(error.value) == line


def test_an_arm_that_does_not_set_off_is_noticed(monkeypatch: pytest.MonkeyPatch) -> None:
    robot = StandIn()
    monkeypatch.setattr(robot.arm, "step", lambda: None)
    with watched(driver_of(robot), MODEL, LIMITS) as arm:
        arm.go(way_to(arm, j1=0.8))
        with pytest.raises(DeviceError, match="has not moved 1 s after the command"):
            arm.wait()


class GoesHalfWay(StandIn):
    """Takes an order for half of the way."""

    def move_joints(self, joints, speed, acceleration):
        here = self.arm.stance.joints
        super().move_joints(here + 0.5 * (joints - here), speed, acceleration)


def test_an_arm_that_never_arrives_is_noticed() -> None:
    robot = GoesHalfWay()
    with watched(driver_of(robot), MODEL, LIMITS) as arm:
        arm.go(way_to(arm, j1=0.3))
        with pytest.raises(DeviceError, match="the arm stopped .* before the goal"):
            arm.wait()


def pushed(robot, state):
    return replace(state, joint_speeds=np.full(6, 0.1)) if robot.cycles > 1500 else state


def test_an_arm_that_moves_untold_is_noticed() -> None:
    robot = StandIn(pushed)
    with (
        watched(driver_of(robot), MODEL, LIMITS) as arm,
        pytest.raises(DeviceError, match="the arm moves without a command of flangeye"),
    ):
        arm.wait()


@pytest.mark.parametrize(
    ("change", "line"),
    [
        (lambda r, s: replace(s, base_T_flange=elsewhere(s, [0.0, 0.0, 0.163])),
         "the controller's flange is 163 mm from where the robot's model has it: is a tool set in "
         "the controller, or is it another model?"),
        (lambda r, s: replace(s, joints=np.zeros(7)), "the arm has 7 joints, its model 6"),
    ],
)  # fmt: skip
def test_another_arm_than_the_model_is_refused(change: Callable[..., Any], line: str) -> None:
    with pytest.raises(DeviceError) as error, watched(driver_of(StandIn(change)), MODEL, LIMITS):
        pass
    assert str(error.value) == line


def test_a_driver_that_cannot_open_says_so() -> None:
    with (
        pytest.raises(DeviceError, match=r"^robot.nowhere: nobody answers at 10.0.0.1$"),
        watched(opened_nowhere(), MODEL, LIMITS),
    ):
        pass


class Mute:
    """A wire on which a guard says so much and then nothing any more."""

    def __init__(self, *reports):
        self.reports, self.waited = list(reports), 0.0

    def poll(self, seconds):
        self.waited = seconds
        return bool(self.reports)

    def recv(self):
        return self.reports.pop(0)


def test_a_guard_is_waited_for_as_long_as_is_said() -> None:
    wire: Any = Mute()
    with pytest.raises(DeviceError, match=r"^the arm does not answer \(30 s\)"):
        WatchedArm(wire, lambda state: None)
    assert wire.waited == 30.0
    wire = Mute(guard_module.Report("opened", ("ur5e", 2e-3, StandIn().state())))
    arm = WatchedArm(wire, lambda state: None)
    with pytest.raises(DeviceError, match=r"^the arm has fallen silent \(3 s\)"):
        arm.wait()
    assert wire.waited == 3.0


def test_a_driver_that_breaks_is_one_line_and_the_arm_is_let_go() -> None:
    def broken(robot, state):
        raise ZeroDivisionError("division by zero")

    robot = StandIn(under_way(broken))
    with watched(driver_of(robot), MODEL, LIMITS) as arm:
        arm.go(way_to(arm, j1=0.8))
        with pytest.raises(DeviceError, match="the driver failed with ZeroDivisionError: division"):
            arm.wait()
    assert robot.closed


class Wire:
    """The guard's end of a wire on which the program says what a test wants, when it wants."""

    def __init__(self, robot, requests):
        self.robot, self.requests, self.heard = robot, requests, []
        self.waited = set[float]()

    def poll(self, seconds):
        self.waited.add(seconds)
        return bool(self.requests) and self.requests[0][0] <= self.robot.cycles

    def recv(self):
        _, request = self.requests.pop(0)
        if request is None:
            raise EOFError
        return request

    def send(self, report):
        self.heard.append(report)


@pytest.mark.parametrize(
    ("key", "pressed", "said"),
    [
        ("alarm", b"\x02", "Ctrl-C"),
        ("alarm", bytes([guard_module.BEAT, signal.SIGTSTP]), "Ctrl-Z"),
        ("alarm", bytes([signal.SIGHUP]), "SIGHUP"),
        ("keyboard", b"x ", "the space bar"),
    ],
)
def test_the_operator_stops_it_within_one_cycle(
    monkeypatch: pytest.MonkeyPatch, key: str, pressed: bytes, said: str
) -> None:
    reading, writing = os.pipe()
    robot = StandIn()
    joints = robot.arm.stance.joints
    way = Router(MODEL, LIMITS, joints).route(joints, turned(joints, j1=0.8))
    wire: Any = Wire(robot, [(0, ("go", way)), (2000, ("close", None))])
    guard = Watchdog(robot, wire, GuardConfig(lambda: robot, MODEL, LIMITS, **{key: reading}))
    wait = robot.wait_cycle

    def presses():
        wait()
        if robot.cycles == 300:
            os.write(writing, pressed)

    monkeypatch.setattr(robot, "wait_cycle", presses)
    monkeypatch.setattr(time, "monotonic", lambda: guard._heard)  # no silence
    guard.run()
    stopped = [cycle for name, cycle in robot.asked if name == "stop"]
    assert stopped[0] == 300
    (report,) = [r for r in wire.heard if r.what == "stopped"]
    assert report.content == said
    assert robot.arm.standing


def test_the_person_reads_who_stopped_it() -> None:
    robot = StandIn()
    reading, writing = os.pipe()
    driver = driver_of(robot)
    open_guard = guard_module.guard

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            "flangeye.motion.arm.guard",
            lambda wire, charge: open_guard(wire, charge._replace(alarm=reading)),
        )
        # How long the program may be silent is tested in real time; here the machine may be busy.
        for limit in ("SILENT", "AT_REST"):
            patch.setattr(guard_module, limit, 60.0)
        with watched(driver, MODEL, LIMITS) as arm:
            arm.go(way_to(arm, j1=0.8))
            os.write(writing, b"\x02")
            with pytest.raises(RunStopped, match=r"^the operator stopped the arm \(Ctrl-C\)$"):
                arm.wait()


def test_a_program_that_dies_stops_the_arm() -> None:
    robot = StandIn()
    joints = robot.arm.stance.joints
    way = Router(MODEL, LIMITS, joints).route(joints, turned(joints, j1=0.8))
    wire: Any = Wire(robot, [(0, ("go", way)), (200, None)])
    guard_module.guard(wire, GuardConfig(lambda: robot, MODEL, LIMITS))
    assert robot.closed
    assert ("stop", 200) in robot.asked


def test_the_guard_s_process_opens_the_terminal_anew_if_there_is_one(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(os, "open", lambda path, flags: {"/dev/tty": 17}[path])
    assert guard_module._terminal(None) is None
    assert guard_module._terminal(0) == 17


def test_the_run_s_number_is_the_same_in_its_guard(monkeypatch: pytest.MonkeyPatch) -> None:
    assert run_number() == os.getpid()
    monkeypatch.setattr(multiprocessing.current_process(), "_name", GUARD)
    assert run_number() == os.getppid()


def test_a_signal_writes_to_the_alarm_and_what_was_there_before_comes_back() -> None:
    hears, alarm = multiprocessing.Pipe(duplex=False)
    before = signal.set_wakeup_fd(-1)
    signal.set_wakeup_fd(before)
    number, handler = signal.SIGUSR1, signal.signal(signal.SIGUSR1, lambda *_: None)
    try:
        with _alarmed(alarm):
            os.kill(os.getpid(), number)
            assert os.read(hears.fileno(), 1) == bytes([number])
        assert signal.getitimer(signal.ITIMER_REAL) == (0.0, 0.0)  # it beats no more
    finally:
        signal.signal(number, handler)
    assert signal.set_wakeup_fd(before) == before


def test_an_arm_heeds_ctrl_c_in_a_program_that_ignores_it() -> None:
    hears, alarm = multiprocessing.Pipe(duplex=False)
    handler = signal.signal(signal.SIGINT, signal.SIG_IGN)  # as in a shell script's background job
    try:
        with pytest.raises(KeyboardInterrupt), _alarmed(alarm):
            os.kill(os.getpid(), signal.SIGINT)
            time.sleep(5)
        assert signal.SIGINT in os.read(hears.fileno(), 4096)
        assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGINT, handler)


def test_an_arm_is_opened_from_the_main_thread_which_alone_hears_of_signals() -> None:
    def opens() -> None:
        with (
            pytest.raises(DeviceError, match="must be opened in the main thread"),
            _alarmed(multiprocessing.Pipe(duplex=False)[1]),
        ):
            pass
        refused.append(True)

    refused: list[bool] = []
    thread = threading.Thread(target=opens)
    thread.start()
    thread.join()
    assert refused


def beats_in(hears, seconds):
    """Return how often BEAT came in so long, and every other signal."""
    time.sleep(seconds)
    signals = os.read(hears.fileno(), 4096)
    return signals.count(guard_module.BEAT), [*signals.replace(bytes([guard_module.BEAT]), b"")]


def test_a_program_shows_life_while_it_computes_and_none_when_it_is_stopped() -> None:
    hears, alarm = multiprocessing.Pipe(duplex=False)
    code = (
        "import itertools, sys; from multiprocessing.connection import Connection\n"
        "from flangeye.motion.arm import _alarmed\n"
        "with _alarmed(Connection(int(sys.argv[1]), readable=False)):\n"
        "    print('beats', flush=True)\n"
        "    sum(itertools.repeat(1, 10**11))\n"  # for minutes, in C, with the interpreter's lock
    )
    with subprocess.Popen(
        [sys.executable, "-c", code, str(alarm.fileno())],
        pass_fds=[alarm.fileno()], stdout=subprocess.PIPE,
    ) as program:  # fmt: skip
        assert program.stdout is not None
        try:
            assert program.stdout.readline() == b"beats\n"
            beats_in(hears, 0.3)
            count, others = beats_in(hears, 1.0)
            assert 20 <= count <= 40 and others == []
            os.kill(program.pid, signal.SIGTSTP)
            assert beats_in(hears, 0.2)[1] == [signal.SIGTSTP]
            os.kill(program.pid, signal.SIGSTOP)
            os.write(alarm.fileno(), b"\0")
            assert beats_in(hears, 0.1)[1] == [0]
            os.write(alarm.fileno(), b"\0")
            assert beats_in(hears, 0.3) == (0, [0])
        finally:
            program.kill()


def held(what, seconds, cycle=300):
    """A guard whose program or which itself is held for so long on the way; return its report."""
    reading, writing = os.pipe()
    robot = StandIn()
    joints = robot.arm.stance.joints
    way = Router(MODEL, LIMITS, joints).route(joints, turned(joints, j1=0.8))
    wire: Any = Wire(robot, [(0, ("go", way)), (4000, ("close", None))])
    guard = Watchdog(robot, wire, GuardConfig(lambda: robot, MODEL, LIMITS, alarm=reading))
    wait, now = robot.wait_cycle, [0.0]

    def passes():
        wait()
        now[0] += robot.period
        late = robot.cycles >= cycle
        if robot.cycles == cycle and what == "guard":
            now[0] += seconds
        if not (late and what == "program" and now[0] < cycle * robot.period + seconds):
            os.write(writing, bytes([guard_module.BEAT]))

    robot.wait_cycle = passes  # type: ignore[method-assign]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(time, "monotonic", lambda: now[0])
        guard._turned = guard._heard = 0.0
        guard.run()
    return robot, wire, cycle


@pytest.mark.parametrize("what", ["guard", "program"])
def test_a_guard_that_was_held_or_hears_nothing_of_the_program_stops_for_good(what: str) -> None:
    robot, wire, cycle = held(what, 0.2)
    (report,) = [r for r in wire.heard if r.what == "fault"]
    assert report.content.startswith(f"the {what} was held for 0.")
    assert report.content.endswith(
        "s, at most 0.15 s are allowed (it was suspended, or the machine is too busy): the arm was "
        "stopped"
    )
    stopped = [number for name, number in robot.asked if name == "stop"]
    assert (stopped[0] - cycle) * robot.period <= SILENT + 2 * robot.period
    assert robot.arm.standing
    assert "arrived" not in [r.what for r in wire.heard]


@pytest.mark.parametrize(("late", "done"), [(1.0, True), (1.001, False), (3.0, False)])
def test_what_was_asked_before_a_guard_was_held_is_not_done_after_it(
    late: float, done: bool
) -> None:
    reading, writing = os.pipe()
    robot, now = StandIn(), [0.0]
    joints = robot.arm.stance.joints
    way = Router(MODEL, LIMITS, joints).route(joints, turned(joints, j1=0.8))
    wire: Any = Wire(robot, [(0, ("go", way)), (0, ("close", None))])
    guard = Watchdog(robot, wire, GuardConfig(lambda: robot, MODEL, LIMITS, alarm=reading))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(time, "monotonic", lambda: now[0])
        guard._turned = guard._heard = 0.0
        now[0] = late
        guard.run()
    faults = [r.content for r in wire.heard if r.what == "fault"]
    assert robot.commands()[:1] == (["move"] if done else ["stop"])
    if not done:
        assert faults[0].startswith(f"the guard was held for {late:.2f} s")
    os.close(writing)
    os.close(reading)


@pytest.mark.parametrize("what", ["guard", "program"])
def test_a_short_silence_is_borne(what: str) -> None:
    _, wire, _ = held(what, 0.14)
    assert [r.what for r in wire.heard if r.what != "state"] == ["opened", "arrived"]


@pytest.mark.parametrize("what", ["guard", "program"])
@pytest.mark.parametrize(("seconds", "faults"), [(0.9, 0), (1.1, 1)])
def test_an_arm_at_rest_bears_a_longer_silence(what: str, seconds: float, faults: int) -> None:
    _, wire, _ = held(what, seconds, cycle=3000)
    assert [r.what for r in wire.heard if r.what != "state"] == ["opened", "arrived"] + faults * [
        "fault"
    ]


def test_a_guard_has_precedence_over_who_leads_and_leaves_signals_to_the_alarm(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    asked: list[Any] = []
    handlers: dict[int, Any] = {}
    monkeypatch.setattr(os, "sched_setscheduler", lambda *given: asked.append(given))
    monkeypatch.setattr(signal, "signal", lambda number, what: handlers.setdefault(number, what))
    monkeypatch.setattr(guard_module, "guard", lambda wire, charge: asked.append(charge))
    hears, alarm = multiprocessing.Pipe(duplex=False)
    robot = StandIn()
    with hears, alarm:
        charge = GuardConfig(lambda: robot, MODEL, LIMITS)
        guard_module.watchdog_process(alarm, charge, hears)
        assert asked[1].alarm == hears.fileno()
    (who, policy, how), _ = asked
    assert (who, policy, how.sched_priority) == (0, os.SCHED_FIFO, 2)
    assert handlers[signal.SIGINT] is handlers[signal.SIGTSTP] is signal.SIG_IGN
    for ending in (signal.SIGTERM, signal.SIGHUP):
        with pytest.raises(SystemExit):  # as an exception, which stops the arm
            handlers[ending]()
    del asked[:]
    with guard_module.realtime_priority(guard_module.SERVO_PRIORITY):
        ((who, policy, how),) = asked
        assert (who, policy, how.sched_priority) == (0, os.SCHED_FIFO, 1)
    who, policy, how = asked[1]
    assert (who, policy, how.sched_priority) == (0, os.SCHED_OTHER, 0)


def test_the_legs_of_a_way_are_driven_one_after_the_other() -> None:
    robot = StandIn()
    joints = robot.arm.stance.joints
    router, middle, goal = Router(MODEL, LIMITS, joints), turned(joints, j1=0.1), joints
    legs = [
        leg
        for way in (router.route(joints, middle), router.route(middle, goal))
        if isinstance(way, Route)
        for leg in way.legs
    ]
    wire: Any = Wire(robot, [(0, ("go", Route(tuple(legs)))), (3000, ("close", None))])
    Watchdog(robot, wire, GuardConfig(lambda: robot, MODEL, LIMITS)).run()
    assert [r.what for r in wire.heard if r.what != "state"] == ["opened", "arrived"]
    assert robot.commands() == ["move", "move"]
    assert robot.state().joints == pytest.approx(goal, abs=1e-3)
    assert wire.waited == {0.0}  # a guard that nobody leads waits for the arm alone
